"""The most probable parameters when frames share errors: a fit with nuisances and their priors.

With r the weighted residual at parameters x and nuisances nu (in prior deviations), the posterior's
cost is ``(|r(x, nu)|^2 + |nu|^2) / 2``. Gauss-Newton steps, damped where one fails, solve the
augmented system ``[dr/dnu dr/dx; I 0]`` by QR, within the bounds of x. Nuisances come first in the
triangle, so its last block is the root of the parameters' information with the nuisances
marginalised: the Schur complement, never formed as a difference.

Without nuisances it is the plain weighted fit, continued from where a solver left it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..geometry import FloatArray
from ..problem import Problem
from .nuisances import Nuisances

STEPS = 40
_LAST_STEP, _NO_GAIN = 1e-5, 1e-8
"""Predicted decreases of the cost: a step of 0.4 % of a standard deviation is the last, with the
linearisation before it; one of 0.01 % is not taken."""
_ROUNDING = 1e-13
_SAME_SLOPE_DEG = 2e-3
"""Directions turned by less than this keep their derivatives: 1/140 of the narrowest lobe."""
_DAMPING = 1e-3
_RANK = 1e-10


@dataclass(frozen=True, eq=False)
class Posterior:
    """A problem with the nuisances of its scan."""

    problem: Problem
    nuisances: Nuisances

    def point(self, internal: FloatArray, values: FloatArray | None = None) -> Point:
        """Return a point of the posterior; the nuisances are 0 unless given."""
        chosen = np.zeros(len(self.nuisances)) if values is None else values
        here = self.nuisances.apply(self.problem, chosen) if chosen.any() else self.problem
        with np.errstate(over="ignore"):
            residual = here.residual(internal)
            cost = 0.5 * float(residual @ residual + chosen @ chosen)
        return Point(internal, chosen, here, residual, cost)


@dataclass(frozen=True, eq=False)
class Point:
    """Parameters (p,) and nuisances (m,), and what follows from them.

    `here` is the problem as the nuisances have it, `residual` (3 n,) weighted.
    """

    internal: FloatArray
    values: FloatArray
    here: Problem
    residual: FloatArray
    cost: float


@dataclass(frozen=True, eq=False)
class Linearised:
    """Triangle (m + q, m + q) of the augmented system and its right side (m + q,) at a point.

    Attributes
    ----------
    triangle, right
        Columns are the nuisances', then those of the parameters `moving`. Without priors, in
        ``[dr/dx dr/dnu]``, the parameters come first.
    moving
        The q coordinates.
    derivatives
        (m + q, 3 n) of the weighted residual, in the triangle's order; kept where the channels of
        a frame share noise.
    priors
        Whether the nuisances were fitted.
    """

    triangle: FloatArray
    right: FloatArray
    moving: tuple[int, ...]
    derivatives: FloatArray | None
    priors: bool = True


@dataclass(frozen=True, eq=False)
class Maximum:
    """Where the posterior is largest, the linearisation there, the steps, and if they settled."""

    point: Point
    linearised: Linearised
    steps: int
    settled: bool


def linearise_plain(problem: Problem, nuisances: Nuisances, internal: FloatArray) -> Linearised:
    """Return the linearisation of a plain fit at parameters (p,)."""
    jacobian = problem.jacobian(internal)
    derivatives = jacobian.T.copy() if nuisances.frame_relative is not None else None
    return Linearised(triangle_of(jacobian), np.zeros(len(problem.free)), problem.free, derivatives)


def linearise_with_common_errors(
    problem: Problem, nuisances: Nuisances, internal: FloatArray
) -> Linearised:
    """Return the linearisation of a plain fit, and by nuisances that it did not move."""
    posterior = Posterior(problem, nuisances)
    slopes, point = _Slopes(posterior, priors=False), posterior.point(internal)
    return slopes.complete(slopes.linearise(point), point)


def linearise_at(posterior: Posterior, point: Point) -> Linearised:
    """Return the linearisation by nuisances and free parameters at any point."""
    slopes = _Slopes(posterior)
    return slopes.complete(slopes.linearise(point), point)


def maximise(
    posterior: Posterior, start: Point, moving: Sequence[int] | None = None, steps: int = STEPS
) -> Maximum:
    """Return the maximum of the posterior downhill from a point, within the bounds.

    `moving` are the coordinates that may change, by default the free ones; after `steps` it ends
    unsettled.
    """
    # a lobe out of sight can have an amplitude of 1e150: what overflows is a step too far
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        return _maximise(posterior, start, moving, steps)


def _maximise(
    posterior: Posterior, start: Point, moving: Sequence[int] | None, steps: int
) -> Maximum:
    slopes = _Slopes(posterior, moving)
    point, damping = start, 0.0
    linearised = slopes.linearise(point)
    for count in range(steps):
        step, decrease = _bounded_step(posterior.problem, point, linearised, damping)
        if decrease <= _NO_GAIN + _ROUNDING * point.cost:
            settled = damping < 1  # a strongly damped step says nothing
            return Maximum(point, slopes.complete(linearised, point), count, settled)
        trial = posterior.point(*_moved(posterior, point, linearised.moving, step))
        if trial.cost <= point.cost - 1e-3 * decrease:
            if decrease <= _LAST_STEP:
                return Maximum(trial, slopes.complete(linearised, trial), count + 1, True)
            point, damping = trial, damping / 10 if damping > _DAMPING else 0.0
            linearised = slopes.linearise(point)
        else:
            damping = max(10 * damping, _DAMPING)
    return Maximum(point, slopes.complete(linearised, point), steps, False)


class _Slopes:
    """Linearises a posterior by some coordinates.

    The derivatives by angles are kept while these hardly change, the memory for all of them.
    """

    def __init__(
        self, posterior: Posterior, moving: Sequence[int] | None = None, *, priors: bool = True
    ) -> None:
        self._posterior, self._priors = posterior, priors
        self._moving = posterior.problem.free if moving is None else tuple(moving)
        self._at: FloatArray | None = None
        self._around: list[tuple[Problem, Problem]] = []
        m, q, size = len(posterior.nuisances), len(self._moving), posterior.problem.radiance.size
        self._system = np.empty((m + q + 1, size + m * priors))
        self._nuisances = slice(0, m) if priors else slice(q, q + m)
        self._parameters = slice(m, m + q) if priors else slice(0, q)

    def linearise(self, point: Point) -> Linearised:
        """Return the triangle of the augmented system at a point, without derivatives."""
        self._write(point)
        m, size, system = len(point.values), point.residual.size, self._system
        system[-1, :size] = point.residual
        if self._priors:
            system[:, size:] = 0.0
            system[range(m), range(size, size + m)] = 1.0
            system[-1, size:] = point.values
        whole = triangle_of(system.T)
        return Linearised(whole[:-1, :-1], whole[:-1, -1], self._moving, None, self._priors)

    def complete(self, linearised: Linearised, point: Point) -> Linearised:
        """Return the linearisation at a point with its derivatives, where these are needed."""
        if self._posterior.nuisances.frame_relative is None:
            return linearised
        self._write(point)
        return replace(linearised, derivatives=self._system[:-1, : point.residual.size])

    def _write(self, point: Point) -> None:
        """Write the derivatives of the weighted residual into the system."""
        nuisances, size = self._posterior.nuisances, point.residual.size
        jacobian = point.here.jacobian(point.internal, self._moving)
        self._system[self._parameters, :size] = jacobian.T
        if len(nuisances):
            self._turn(point.values)
            columns = self._system[self._nuisances, :size]
            columns.fill(0.0)
            nuisances.write_columns(columns, point.here, point.internal, point.values, self._around)

    def _turn(self, values: FloatArray) -> None:
        nuisances = self._posterior.nuisances
        if not nuisances.is_angle.any():
            return
        angles = nuisances.angles_deg(values)
        if self._at is None or np.abs(angles - self._at).max() > _SAME_SLOPE_DEG:
            self._around = nuisances.neighbours(self._posterior.problem, values)
            self._at = angles


def triangle_of(system: FloatArray) -> FloatArray:
    """Return the square triangle of a tall Fortran-ordered matrix, which is overwritten."""
    from scipy.linalg import lapack

    columns = system.shape[1]
    reflected, _, _, status = lapack.dgeqrf(system, overwrite_a=1)
    if status:
        raise ValueError(f"LAPACK dgeqrf: argument {-status} is illegal")
    square = np.zeros((columns, columns))
    rows = min(system.shape)
    square[:rows] = np.triu(reflected[:rows])
    return square


def _moved(
    posterior: Posterior, point: Point, moving: tuple[int, ...], step: FloatArray
) -> tuple[FloatArray, FloatArray]:
    count = len(point.values)
    internal = point.internal.copy()
    internal[list(moving)] += step[count:]
    return posterior.problem.clamp(internal), point.values + step[:count]


def _bounded_step(
    problem: Problem, point: Point, linearised: Linearised, damping: float
) -> tuple[FloatArray, float]:
    """Best step (m + q,) within the bounds in the linearised system, and the decrease it gives.

    Steps of columns without effect, or with one beyond all numbers, are 0.
    """
    triangle, right = linearised.triangle, linearised.right
    if not np.isfinite(triangle).all():
        triangle = np.where(np.isfinite(triangle).all(axis=0), triangle, 0.0)
    norms = np.linalg.norm(triangle, axis=0)
    scale = np.where(norms > 0, norms, 1.0)
    scaled, target = triangle / scale, -right
    if damping:
        scaled = np.concatenate([scaled, np.sqrt(damping) * np.eye(len(scale))])
        target = np.concatenate([target, np.zeros(len(scale))])
    chosen, count = list(linearised.moving), len(point.values)
    lower, upper = np.full(len(scale), -np.inf), np.full(len(scale), np.inf)
    lower[count:] = (problem.lower - point.internal)[chosen] * scale[count:]
    upper[count:] = (problem.upper - point.internal)[chosen] * scale[count:]
    step = np.linalg.lstsq(scaled, target, rcond=_RANK)[0]
    if (step < lower).any() or (step > upper).any():
        from scipy.optimize import lsq_linear

        step = lsq_linear(scaled, target, bounds=(lower, upper), method="bvls").x
    step = step / scale
    change = triangle @ step
    # |right|^2 - |right + change|^2, without the difference of the two
    return step, -float(change @ (right + 0.5 * change))
