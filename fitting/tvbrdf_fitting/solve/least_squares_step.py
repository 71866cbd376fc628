"""Steps of a least squares search: the linearised problem in a box, with or without damping.

At a point, `J s + r` is linear in the step s. One QR decomposition of `[J r]` reduces it to a
triangle of the size of the parameters; every later question (Gauss-Newton step, damped steps, a
step that stays within bounds) costs microseconds, and none squares the condition of J. Columns are
scaled to length 1; what is called `u` here is a step times the lengths of its columns. A column of
length 0 is left out.

Steps within bounds minimise the quadratic model in the box by an active set: exact, and each of
its moves lowers the model. Damping is chosen so that the step has the length of a trust region.

Sources
-------
J. J. More, "The Levenberg-Marquardt algorithm: implementation and theory", Numerical Analysis,
Lecture Notes in Mathematics 630 (1978), 105-116: trust region and its damping. P. B. Stark, R. L.
Parker, "Bounded-variable least squares", Computational Statistics 10 (1995), 129-141: active set.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from ..geometry import BoolArray, FloatArray

_LENGTH_SLACK = 0.1
"""Share by which a step may be longer or shorter than its trust region (More 1978)."""
_DAMPING_ROUNDS = 12
_SINGULAR = 16 * float(np.finfo(np.float64).eps)
"""Reciprocal condition, a parameter, below which columns of length 1 count as dependent."""

_SIMILAR = 1e-8
"""Changes whose directions differ by less teach nothing more."""


@dataclass(eq=False, slots=True)
class Step:
    """A minimum of the quadratic model.

    Attributes
    ----------
    u
        (n,) step times the lengths of its columns.
    damping
        Weight of the squared length of the step, 0 for a Gauss-Newton step.
    free
        (n,) parameters not held at a bound nor left out.
    reduction
        By how much the model says that half the sum of squares falls.
    factor
        Triangle of the (damped) columns that are free; None where they are dependent.
    """

    u: FloatArray
    damping: float
    free: BoolArray
    reduction: float
    factor: FloatArray | None

    @property
    def promise(self) -> float:
        """How far the residual would have to move straight towards 0 to gain as much."""
        return math.sqrt(2 * max(self.reduction, 0.0))


class LinearModel:
    """The residual to first order around a point, reduced to n equations.

    Attributes
    ----------
    size
        (n,) lengths of the columns of J.
    norm
        Length of the residual.
    triangle, image
        (n, n) and (n,): ``|J s + r|^2 = |triangle u + image|^2 + constant``, ``u = size s``.
    """

    def __init__(self, residual: FloatArray, jacobian: FloatArray, work: FloatArray) -> None:
        """Decompose in `work`, (max(m, n + 1), n + 1) in Fortran order, which is overwritten."""
        from scipy.linalg.lapack import dgeqrf

        m, n = jacobian.shape
        work[:m, :n] = jacobian
        work[:m, n] = residual
        work[m:] = 0.0
        top = dgeqrf(work, overwrite_a=1)[0][: n + 1] * _upper(n + 1)
        size = np.sqrt(np.einsum("ij,ij->j", top, top))
        self.norm = float(size[n])
        self.size: FloatArray = size[:n]
        self.image: FloatArray = top[:n, n]
        self.alive: BoolArray = self.size > 0
        self.unit: FloatArray = np.where(self.alive, self.size, 1.0)
        self.triangle: FloatArray = np.asfortranarray(top[:n, :n] / self.unit)

    @property
    def is_finite(self) -> bool:
        """Whether residual and derivatives are numbers, and small enough to be squared."""
        return math.isfinite(self.norm) and bool(np.isfinite(self.triangle).all())

    def gradient(self) -> FloatArray:
        """Return derivatives (n,) of half the sum of squares by u."""
        return self.image @ self.triangle

    def rank(self, free: BoolArray) -> int:
        """Return the number of independent ones among some columns (n,)."""
        spectrum = np.linalg.svd(self.triangle[:, free & self.alive], compute_uv=False)
        return int(np.count_nonzero(spectrum > _SINGULAR * free.size * spectrum.max(initial=0.0)))

    def refine(self, gradient: FloatArray) -> None:
        """Take over derivatives (n,) by u that are known better than float64 columns give them."""
        from scipy.linalg.lapack import dtrtrs

        image, singular = dtrtrs(self.triangle, gradient, trans=1)
        if not singular:
            self.image = image

    def gauss_newton(self, box: tuple[FloatArray, FloatArray] | None) -> Step:
        """Return the undamped minimum in a box of u, the shortest of several."""
        return self.damped(box, 0.0, None)

    def trust_region(
        self,
        box: tuple[FloatArray, FloatArray] | None,
        weight: FloatArray,
        radius: float,
        undamped: Step,
    ) -> Step:
        """Return the minimum in a box of u with ``|weight u|`` at most about `radius`.

        More's search for the damping: Newton's method on the reciprocal length, within limits.
        """
        step = undamped
        length = length_of(weight * step.u)
        if length <= (1 + _LENGTH_SLACK) * radius:
            return step
        highest = length_of((self.gradient() / weight)[self.alive]) / radius
        lowest, damping = 0.0, _newton(step, weight, length, radius)
        for _ in range(_DAMPING_ROUNDS):
            if not lowest < damping < highest:
                damping = max(1e-3 * highest, math.sqrt(lowest * highest))
            step = self.damped(box, damping, weight)
            length = length_of(weight * step.u)
            if abs(length - radius) <= _LENGTH_SLACK * radius:
                break
            if length > radius:
                lowest = damping
            else:
                highest = damping
            damping += _newton(step, weight, length, radius)
        return step

    def damped(
        self,
        box: tuple[FloatArray, FloatArray] | None,
        damping: float,
        weight: FloatArray | None,
    ) -> Step:
        """Return the minimum of ``|triangle u + image|^2 + damping |weight u|^2`` in a box of u."""
        rows = None if weight is None else np.sqrt(damping) * weight
        free, u = self.alive.copy(), np.zeros(self.size.size)
        if box is None:
            part, factor = self._solve_free(free, u, rows)
            u[free] = part
            return self._step(u, damping, free, factor)
        lowest, highest = box
        slope = self.gradient()
        free &= ~(((lowest >= 0) & (slope >= 0)) | ((highest <= 0) & (slope <= 0)))
        free &= lowest < highest
        # in exact arithmetic each round lowers the model; the limit only guards against rounding
        for _ in range(6 * u.size + 6):
            part, factor = self._solve_free(free, u, rows)
            wanted = u.copy()
            wanted[free] = part
            stop = ((wanted < lowest) | (wanted > highest)) & free
            if stop.any():
                u, hit = _first_bound(u, wanted, stop, lowest, highest)
                free[hit] = False
                continue
            u = wanted
            if free.all():
                break
            slope = (self.triangle @ u + self.image) @ self.triangle
            if rows is not None:
                slope += rows * rows * u
            inward = np.where(u <= lowest, -slope, slope)
            inward[free | ~self.alive | (lowest >= highest)] = 0.0
            worst = int(np.argmax(inward))
            if inward[worst] <= _SINGULAR * self.norm:
                break
            free[worst] = True
        else:
            factor = None
        return self._step(u, damping, free, factor)

    def _solve_free(
        self, free: BoolArray, u: FloatArray, rows: FloatArray | None
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the best u of the free columns, the others staying as they are."""
        if free.all():
            return _solve(self.triangle, self.image, rows)
        if not free.any():
            return np.zeros(0), None
        rest = np.where(free, 0.0, u)
        image = self.image + self.triangle @ rest
        return _solve(
            self.triangle[:, free], image, None if rows is None else rows[free], reduced=False
        )

    def _step(
        self, u: FloatArray, damping: float, free: BoolArray, factor: FloatArray | None
    ) -> Step:
        change = self.triangle @ u
        reduction = -float(change @ self.image) - 0.5 * float(change @ change)
        return Step(u, damping, free, reduction, factor)


def accelerate(step: Step, bend: FloatArray, weight: FloatArray) -> FloatArray | None:
    """Return the correction (n,) of a step for the bend of the path, None where it is too long.

    ``a = -1/2 (J^T J + damping)^-1 J^T r_vv``, accepted where ``2 |a| <= 0.75 |v|``; source: M. K.
    Transtrum, J. P. Sethna, "Improvements to the Levenberg-Marquardt algorithm for nonlinear
    least-squares minimization", arXiv:1201.5885 (2012).

    Parameters
    ----------
    step
        The velocity v.
    bend
        (n,) ``J^T r_vv`` by u: the second derivative of the residual along the step.
    weight
        (n,) weights of u in the length.
    """
    from scipy.linalg.lapack import dtrtrs

    if step.factor is None:
        return None
    part = dtrtrs(step.factor, bend[step.free], trans=1)[0]
    part = dtrtrs(step.factor, part)[0]
    correction = np.zeros(step.u.size)
    correction[step.free] = -0.5 * part
    if not 2 * length_of(weight * correction) <= 0.75 * length_of(weight * step.u):
        return None
    return correction


class StepHistory:
    """What earlier moves did to the Gauss-Newton step, from which its root is extrapolated.

    The combination of past changes is taken back that lowers the present step most. Source: D. G.
    Anderson, "Iterative procedures for nonlinear integral equations", Journal of the ACM 12 (1965),
    547-560, here with as many past steps as parameters.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self.forget()

    def forget(self) -> None:
        """Start anew."""
        self._moves: list[FloatArray] = []
        self._changes: list[FloatArray] = []

    def learn(self, move: FloatArray, change: FloatArray) -> None:
        """Note that a move changed the step so; the oldest of more than n is dropped."""
        self._moves, self._changes = [*self._moves, move], [*self._changes, change]
        del self._moves[: -self._size], self._changes[: -self._size]

    def extrapolate(self, step: FloatArray) -> FloatArray:
        """Return the move after which no step is expected to be left."""
        if not self._moves:
            return step
        moves, changes = np.array(self._moves).T, np.array(self._changes).T
        size = np.sqrt(np.einsum("ij,ij->j", changes, changes))
        size[size == 0] = 1.0
        share = np.linalg.lstsq(changes / size, step, rcond=_SIMILAR)[0] / size
        return np.asarray(step - (moves + changes) @ share)


def _solve(
    columns: FloatArray, image: FloatArray, rows: FloatArray | None, reduced: bool = True
) -> tuple[FloatArray, FloatArray | None]:
    """Minimise ``|columns u + image|^2 + |rows u|^2``; return u and the triangular factor.

    `reduced`: the columns are triangular already.
    """
    from scipy.linalg.lapack import dgeqrf, dtrtrs

    height, width = columns.shape
    target = image
    if rows is not None or not reduced:
        extra = 0 if rows is None else width
        # damping on top: its rows may be the large ones, and QR is stable with those first
        work = np.zeros((height + extra, width + 1), order="F")
        if rows is not None:
            work[:width, :width] = np.diag(rows)
        work[extra:, :width] = columns
        work[extra:, width] = image
        work = dgeqrf(work, overwrite_a=1)[0]
        factor, target = np.asfortranarray(np.triu(work[:width, :width])), work[:width, width]
    else:
        factor = columns
    answer, singular = dtrtrs(factor, target)
    if rows is None and not singular:
        inverse = dtrtrs(factor, _identity(width))[0]
        singular = not length_of(inverse) * length_of(factor) * _SINGULAR < 1
    if singular:
        return np.linalg.lstsq(factor, -target, rcond=_SINGULAR * width)[0], None
    return -answer, factor


def _newton(step: Step, weight: FloatArray, length: float, radius: float) -> float:
    """Return Newton's change of the damping, from the reciprocal of the length (More 1978)."""
    from scipy.linalg.lapack import dtrtrs

    if step.factor is None or not step.free.any():
        return 0.0
    direction = (weight * weight * step.u)[step.free] / length
    slope = length_of(dtrtrs(step.factor, direction, trans=1)[0])
    return (length - radius) / radius / slope**2 if slope else 0.0


def _first_bound(
    u: FloatArray, wanted: FloatArray, stop: BoolArray, lowest: FloatArray, highest: FloatArray
) -> tuple[FloatArray, int]:
    """Go from u towards what is wanted, up to the first bound; return where, and whose bound."""
    bound = np.where(wanted < lowest, lowest, highest)
    way = wanted - u
    share = np.where(stop, (bound - u) / np.where(stop, way, 1.0), np.inf)
    hit = int(np.argmin(share))
    u = u + max(float(share[hit]), 0.0) * way
    u[hit] = bound[hit]
    return np.clip(u, lowest, highest), hit


def length_of(vector: FloatArray) -> float:
    """Return the Euclidean length of all numbers of an array."""
    flat = vector.ravel(order="K")
    return math.sqrt(flat @ flat)


@cache
def _upper(n: int) -> FloatArray:
    return np.triu(np.ones((n, n)))


@cache
def _identity(n: int) -> FloatArray:
    return np.eye(n, order="F")
