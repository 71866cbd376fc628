"""Adaptive Gauss-Kronrod rules for many integrals of three channels at once.

Source of the rule and of its error estimate: R. Piessens et al., "QUADPACK", 1983, routine QK15.
The estimate is no proof, but in practice some orders above the true error. scipy's `quad_vec`
shares its intervals among all components of a vector, and `cubature` is for one integral at a time;
here each integral has intervals of its own, and all of a round are evaluated in one call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..geometry import BoolArray, FloatArray, IntArray


class Rule(NamedTuple):
    """Nodes (k,) in (-1, 1), and weights (k,) of the Kronrod and of the Gauss rule within it."""

    nodes: FloatArray
    kronrod: FloatArray
    gauss: FloatArray
    caution: float
    """Largest factor between the difference of the two and the error that is stated."""

    @classmethod
    def of(
        cls,
        nodes: Sequence[float],
        kronrod: Sequence[float],
        gauss: Sequence[float],
        caution: float,
    ) -> Rule:
        """Return the rule of its half, outermost first, the middle last."""
        inner = np.zeros(len(nodes))
        inner[1::2] = gauss
        outer = np.asarray(kronrod)
        return cls(
            np.concatenate([np.negative(nodes), nodes[-2::-1]]),
            np.concatenate([outer, outer[-2::-1]]),
            np.concatenate([inner, inner[-2::-1]]),
            caution,
        )


RULE_7 = Rule.of(
    (0.960491268708020283, 0.774596669241483377, 0.434243749346802558, 0.0),
    (0.104656226026467265, 0.268488089868333440, 0.401397414775962223, 0.450916538658474142),
    (5 / 9, 8 / 9),
    1.0,
)
"""Exact for polynomials of degree 11, the Gauss rule of degree 5: for large tolerances."""
RULE_15 = Rule.of(
    (
        0.991455371120812639207,
        0.949107912342758524526,
        0.864864423359769072790,
        0.741531185599394439864,
        0.586087235467691130294,
        0.405845151377397166907,
        0.207784955007898467601,
        0.0,
    ),
    (
        0.022935322010529224964,
        0.063092092629978553291,
        0.104790010322250183840,
        0.140653259715525918745,
        0.169004726639267902827,
        0.190350578064785409913,
        0.204432940075298892414,
        0.209482141084727828013,
    ),
    (
        0.129484966168869693271,
        0.279705391489276667901,
        0.381830050505118944950,
        0.417959183673469387755,
    ),
    10.0,
)
"""Exact for polynomials of degree 23, the Gauss rule of degree 13."""

_ROUNDING = 50 * np.finfo(float).eps
_DEEPEST = 50
_MOST_PANELS = 2000


class Integral(NamedTuple):
    """A value and the estimated bound of its error, arrays of the same shape (..., 3)."""

    value: FloatArray
    error: FloatArray


Integrand = Callable[[FloatArray, IntArray], Integral]
"""`f(x (m, k), owner (m,))`: values and errors (m, k, 3) at points of the owners' integrals."""


def integrate(
    function: Integrand,
    breaks: FloatArray,
    tolerance: float,
    *,
    group: IntArray | None = None,
    floor: FloatArray | float = 0.0,
    rule: Rule = RULE_15,
    stop: Callable[[], bool] = lambda: False,
) -> Integral:
    """Integrate several vector-valued functions at once, each adaptively over its own panels.

    Parameters
    ----------
    function
        Values at points of the integrals; its errors are integrated too.
    breaks
        (n, m) ascending end points of the first panels of each of n integrals; empty panels are
        left out.
    tolerance
        Wanted error relative to each integral.
    group
        (n,) numbers from 0: integrals of one group are parts of one whole, so that those below a
        thousandth of its largest matter as if they were that.
    floor
        Absolute values (3,) below which an integral matters as if it were that.
    rule
        Points of each panel.
    stop
        Asked before each round: no more panels are to be divided, whatever the error is by then.

    Returns
    -------
    value and error (n, 3)
    """
    number = breaks.shape[0]
    owner = np.repeat(np.arange(number), breaks.shape[1] - 1)
    left, right = breaks[:, :-1].ravel(), breaks[:, 1:].ravel()
    filled = right > left
    panels = _panels(function, rule, left[filled], right[filled], owner[filled])
    for _ in range(_DEEPEST):
        total, error = panels.sums(panels.value, number), panels.sums(panels.error, number)
        allowed = tolerance * np.maximum(_size(np.abs(total), group), floor)
        split = panels.to_split(error, allowed)
        if not split.any() or stop():
            break
        middle = 0.5 * (panels.left + panels.right)[split]
        halves = _panels(
            function,
            rule,
            np.concatenate([panels.left[split], middle]),
            np.concatenate([middle, panels.right[split]]),
            np.tile(panels.owner[split], 2),
        )
        panels = _Panels(
            *(np.concatenate([old[~split], new]) for old, new in zip(panels, halves, strict=True))
        )
    total = panels.sums(panels.value, number)
    return Integral(total, panels.sums(panels.error + panels.given_error, number))


def _size(size: FloatArray, group: IntArray | None) -> FloatArray:
    """Return the sizes (n, 3), no one below a thousandth of the largest in its group."""
    if group is None:
        return size
    largest = np.zeros((int(group.max(initial=0)) + 1, 3))
    np.maximum.at(largest, group, size)
    return np.maximum(size, 1e-3 * largest[group])


class _Panels(NamedTuple):
    """Intervals (m,) and owners; (m, 3): integral, error, the least there can be, f's own."""

    left: FloatArray
    right: FloatArray
    owner: IntArray
    value: FloatArray
    error: FloatArray
    least: FloatArray
    given_error: FloatArray

    def sums(self, what: FloatArray, number: int) -> FloatArray:
        """Return the sums (number, 3) over each owner's panels."""
        columns = [np.bincount(self.owner, what[:, k], minlength=number) for k in range(3)]
        return np.stack(columns, axis=1)

    def to_split(self, error: FloatArray, allowed: FloatArray) -> BoolArray:
        """Return the mask of panels with more than their share of an error that is too large."""
        count = np.bincount(self.owner, minlength=error.shape[0])
        open_ = (error > allowed) & (count < _MOST_PANELS)[:, None]
        share = np.where(open_, allowed / np.maximum(count, 1)[:, None], np.inf)
        worst = (self.error > np.maximum(share[self.owner], self.least)).any(axis=1)
        middle = 0.5 * (self.left + self.right)
        return np.asarray(worst & (middle > self.left) & (middle < self.right))


def _panels(
    function: Integrand, rule: Rule, left: FloatArray, right: FloatArray, owner: IntArray
) -> _Panels:
    centre, half = 0.5 * (left + right), 0.5 * (right - left)
    value, given_error = function(centre[:, None] + half[:, None] * rule.nodes, owner)
    width = half[:, None]
    kronrod = width * np.einsum("mjk,j->mk", value, rule.kronrod)
    gauss = width * np.einsum("mjk,j->mk", value, rule.gauss)
    given_error = width * np.einsum("mjk,j->mk", given_error, rule.kronrod)
    size = width * np.einsum("mjk,j->mk", np.abs(value), rule.kronrod)
    mean = (0.5 * kronrod / width)[:, None, :]
    spread_ = width * np.einsum("mjk,j->mk", np.abs(value - mean), rule.kronrod)
    error = np.abs(kronrod - gauss)
    # that is the error of the Gauss rule; where it is small, Kronrod's is smaller by a power
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = spread_ * (200 * error / spread_) ** 1.5
    error = np.where(spread_ > 0, np.minimum(rule.caution * error, scaled), error)
    error = np.maximum(error, _ROUNDING * size)
    # smaller panels do not help against rounding, nor against errors of the integrand
    least = np.maximum(_ROUNDING * size, given_error)
    return _Panels(left, right, owner, kronrod, error, least, given_error)


def peaks(height: FloatArray, x: FloatArray) -> FloatArray:
    """Places (n, 2) of the two highest inner maxima of values (n, m) at x (n, m); 0 for none.

    As break points they let a rule see peaks that are narrower than its first panels.
    """
    inner = height[:, 1:-1]
    is_peak = (inner > height[:, :-2]) & (inner > height[:, 2:])
    order = np.argsort(np.where(is_peak, inner, 0.0), axis=1)[:, -2:]
    rows = np.arange(height.shape[0])[:, None]
    return np.where(is_peak[rows, order], x[rows, order + 1], 0.0)
