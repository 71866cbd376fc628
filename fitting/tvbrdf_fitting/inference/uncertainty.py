"""How well a fit knows its parameters: random and common errors.

Random errors are those of each value, as the observations state them, not rescaled by chi-square.
*Common* errors are shared by whole groups of frames (the light's offset in a sweep, a gain of a
camera and channel, the plate's tilt), so that more frames do not average them out; they are
nuisances that the fit marginalises.

With J the weighted derivatives by the parameters, N those by the nuisances in prior deviations and
``M = [N J]^T [N J] + diag(1, 0)`` the information of both, priors included, the covariance of the
parameters is the block ``C = (M^-1)_xx``. It is split by where the errors come from: a nuisance
that is off by one prior deviation moves the estimate by a column of ``S = (M^-1)_xn`` (with its
sign reversed), so ``S S^T`` is the common part, and ``C - S S^T`` is what the noise of the values
does. Both are positive semi-definite. Fits of several scans with the same calibration share the
common part and nothing of the random one. Without nuisances ``C = (J^T J)^-1``.

Where a fit left its nuisances out (a wrong model, see `marginal`), ``(J^T J)^-1`` is the random
part and ``S = (J^T J)^-1 J^T N`` gives the common one.

A part of a frame's noise, the flicker of the lamp, is the same in its three channels; with u_f the
sum over a frame's channels of what that part moves the estimate by, and d each of them alone, the
random covariance gains ``sum u u^T - sum d d^T``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..geometry import FloatArray
from ..models.base import SQUARE
from ..problem import Problem
from .nuisances import CommonErrors, Nuisances
from .posterior import Linearised, triangle_of

SIGNIFICANCE = 3.0
"""An amplitude within this many standard deviations of 0 carries no information on its shape."""
_RANK = 1e-10
_NULL_SHARE = 1e-3
_FAINTEST = 1e-150
"""Effect of a unit of a coordinate, in deviations of the data, below which it has none: the
variance would overflow."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariances (p, p) in internal coordinates; NaN for what the data say nothing of.

    Fixed parameters have variance 0. `nuisance_deviations` (m,) are those that the data leave, in
    prior deviations: at most 1.
    """

    random: FloatArray
    common: FloatArray
    uninformed: tuple[int, ...]
    nuisance_deviations: FloatArray


def estimate(problem: Problem, nuisances: Nuisances, linearised: Linearised) -> Uncertainty:
    """Covariances at the end of a fit, from its linearisation there.

    Coordinates at a bound are treated as if the bound were not there, which overstates rather than
    understates the uncertainty of the others.
    """
    count, m = len(problem.model.parameters), len(nuisances)
    informed = _Informed(linearised, m)
    columns = informed.columns
    if linearised.priors:
        root, shift, deviations = _marginal(informed, m)
    else:
        root, shift, deviations = informed.half, informed.follow(), np.ones(m)
    random, common = np.zeros((count, count)), np.zeros((count, count))
    where = np.ix_(columns, columns)
    random[where] = root @ root.T
    if m:
        common[where] = shift @ shift.T
    if nuisances.frame_relative is not None:
        random[where] += _shared_by_channels(
            problem, nuisances.frame_relative, informed.effects(shift)
        )
    uninformed = [i for i in range(count) if i not in columns and i not in problem.fixed]
    uninformed += informed.lost()
    if uninformed:
        for matrix in (random, common):
            matrix[uninformed, :] = np.nan
            matrix[:, uninformed] = np.nan
    return Uncertainty(random, common, tuple(sorted(uninformed)), deviations)


class _Informed:
    """The part of a linearisation that the data say something of, and its decomposition.

    Attributes
    ----------
    columns
        The k of the moving coordinates that have any effect.
    block
        Slice of the triangle that is theirs.
    half
        (k, k) root of the covariance: half half^T.
    """

    def __init__(self, linearised: Linearised, m: int) -> None:
        moving, triangle = linearised.moving, linearised.triangle
        first = m if linearised.priors else 0
        scale = np.linalg.norm(triangle[:, first : first + len(moving)], axis=0)
        known = scale > _FAINTEST
        self.columns = [i for i, k in zip(moving, known, strict=True) if k]
        self._kept = np.ones(len(triangle), dtype=bool)
        self._kept[first : first + len(moving)] = known
        if not known.all():
            triangle = triangle_of(np.asfortranarray(triangle[:, self._kept]))
            scale = scale[known]
        self.triangle, self._linearised = triangle, linearised
        self.block = slice(first, first + len(self.columns))
        self._left, singular, self._directions = np.linalg.svd(
            triangle[self.block, self.block] / scale
        )
        self._weak = singular < _RANK * singular.max(initial=0.0)
        inverse = np.where(self._weak, 0.0, 1 / np.where(self._weak, 1.0, singular))
        self.half = (self._directions.T * inverse) / scale[:, None]

    def follow(self) -> FloatArray:
        """How the parameters (k, m) follow nuisances that a fit left out: (J^T J)^-1 J^T N."""
        after = self.triangle[self.block, self.block.stop :]
        return np.asarray(self.half @ (self._left.T @ after))

    def lost(self) -> list[int]:
        """Coordinates that move along a direction without information."""
        if not self._weak.any():
            return []
        share = np.square(self._directions[self._weak]).sum(axis=0)
        return [i for i, gone in zip(self.columns, share > _NULL_SHARE, strict=True) if gone]

    def effects(self, shift: FloatArray) -> FloatArray:
        """Return what an error of each weighted value moves the parameters by, (3 n, k)."""
        derivatives = self._linearised.derivatives
        if derivatives is None:
            raise ValueError("the linearisation kept no derivatives: no noise shared by channels")
        of_kept = np.zeros((len(self.triangle), len(self.half)))
        of_kept[self.block] = self.half @ self.half.T
        if self._linearised.priors:
            of_kept[: self.block.start] = shift.T
        of_all = np.zeros((len(derivatives), len(self.half)))
        of_all[self._kept] = of_kept
        return np.asarray(derivatives.T @ of_all)


def _marginal(informed: _Informed, m: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Roots (k, k) and (k, m) of the random and the common covariance, nuisances' deviations (m,).

    With the nuisances fitted: the triangle's first m rows are theirs.
    """
    half = informed.half
    if not m:
        return half, np.zeros((len(half), 0)), np.zeros(0)
    above = informed.triangle[:m]
    inverse = np.linalg.inv(above[:, :m])
    # how the nuisances follow the parameters
    moved = -(inverse @ above[:, m:]) @ half
    left, share, _ = np.linalg.svd(moved.T)
    kept = np.ones(len(half))
    kept[: len(share)] = np.sqrt(np.maximum(1 - share**2, 0.0))
    variance = np.square(inverse).sum(axis=1) + np.square(moved).sum(axis=1)
    return (half @ left) * kept, half @ moved.T, np.sqrt(variance)


def published_scale(problem: Problem, internal: FloatArray, uncertainty: Uncertainty) -> FloatArray:
    """Factors (p,) from deviations in internal coordinates to published ones; 0 where fixed.

    To first order, but for sigma_d: near 0 the square root has no slope. There the published
    deviation is a third of the way to the further end of the interval sigma_d^2 +- 3 deviations.
    It is finite at sigma_d = 0, and 3 published deviations cover what 3 internal ones do.
    """
    model = problem.model
    slopes = model.slopes(model.to_published(internal))
    deviations = np.sqrt(np.diag(uncertainty.random + uncertainty.common))
    scale = np.zeros(len(internal))
    for i, parameter in enumerate(model.parameters):
        if i in problem.fixed:
            continue
        if parameter.transform is SQUARE:
            square, reach = float(internal[i]), SIGNIFICANCE * float(deviations[i])
            root = math.sqrt(max(square, 0.0))
            up = math.sqrt(max(square + reach, 0.0)) - root
            down = root - math.sqrt(max(square - reach, 0.0))
            # a NaN deviation stays one
            scale[i] = max(up, down) / reach if reach > 0 else math.nan
        else:
            scale[i] = 1 / slopes[i]
    return scale


def to_published(covariance: FloatArray, scale: FloatArray) -> FloatArray:
    """Covariance in published units, given `published_scale`."""
    out = covariance * np.outer(scale, scale)
    out[scale == 0, :] = 0.0
    out[:, scale == 0] = 0.0
    return np.asarray(out)


def _shared_by_channels(problem: Problem, relative: FloatArray, effects: FloatArray) -> FloatArray:
    """What (k, k) to add for noise that the channels of a frame share.

    `effects` (3 n, k) are what an error of each weighted value moves the parameters by.
    """
    # never more than all of a value's noise
    part = np.minimum(relative * np.abs(problem.radiance) * problem.weight, 1.0)
    each = part[..., None] * effects.reshape(*part.shape, -1)
    together, alone = each.sum(axis=0), each.reshape(-1, each.shape[-1])
    return np.asarray(together.T @ together - alone.T @ alone)


__all__ = [
    "SIGNIFICANCE",
    "CommonErrors",
    "Uncertainty",
    "estimate",
    "published_scale",
    "to_published",
]
