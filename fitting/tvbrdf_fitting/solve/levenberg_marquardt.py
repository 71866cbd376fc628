"""Nonlinear least squares with bounds, to the last digit that the arithmetic carries.

Minimises half the sum of squares of a residual r(x) within bounds on x, from one start.

* Levenberg-Marquardt steps from a QR decomposition, never the normal equations, in a trust region
  whose shape is the running maximum of the columns' lengths: the path does not depend on the units
  of residuals or parameters. Source: J. J. More, "The Levenberg-Marquardt algorithm:
  implementation and theory", Lecture Notes in Mathematics 630 (1978), 105-116. (Damping by gain
  ratio alone, as in H. B. Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05, was
  tried: it takes more evaluations, and the wrong way on two of NIST's problems.)
* A step that did badly is corrected for the bend of the path that it revealed: geodesic
  acceleration, its second derivative taken from the step itself, so that steps that do well cost
  nothing more. Source: M. K. Transtrum, J. P. Sethna, arXiv:1201.5885 (2012).
* Bounds by an active set: every step is the exact minimum of the linearised problem in the box.
* Near the minimum the sum of squares no longer tells two points apart once they agree to half of
  the digits. There the Gauss-Newton step is followed to its root, each point accepted because the
  step from it is shorter than the step before, until steps stop shrinking: that yields the other
  half of the digits. Where second derivatives rule (a large residual, a singular Jacobian), the
  same is done with the damping that worked last. Steps are extrapolated by Anderson's method,
  without which they shrink slowly, or not at all, in those cases. Sources: D. G. Anderson,
  "Iterative procedures for nonlinear integral equations", Journal of the ACM 12 (1965), 547-560;
  nearness by the angle between residual and tangent plane: D. M. Bates, D. G. Watts, "A relative
  offset orthogonality convergence criterion for nonlinear least squares", Technometrics 23 (1981),
  179-183.

Certified on the 27 nonlinear problems of NIST's Statistical Reference Datasets.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import FloatArray
from .least_squares_problem import BoundedProblem, LeastSquaresError, Point, as_vector
from .least_squares_step import LinearModel, Step, StepHistory, accelerate, length_of

__all__ = ["LeastSquaresError", "LeastSquaresSolution", "levenberg_marquardt"]

_NEAR = 1e-2
"""Sine between residual and tangent plane from which on steps are judged by their size."""
_SLOW = 1e-2
"""The same, as far as a damped step foresees: a slow approach is extrapolated."""
_ACCEPTED, _POOR, _GOOD = 1e-4, 0.25, 0.75
"""Actual by predicted reduction: above it a step is taken; up to it the trust region shrinks;
from it on it grows (More 1978)."""
_UNSEEN = 1e-3
"""Share of the rounding of the cost, at worst, below which no reduction is seen."""
_SETTLED = "steps no longer shrink"
_CLEAR = 10.0
"""Changes of the residual this many times as long as its rounding are none of it."""


@dataclass(frozen=True, eq=False)
class LeastSquaresSolution:
    """Where a search ended.

    Attributes
    ----------
    x
        (n,) parameters, within the bounds.
    cost
        Half the sum of squares.
    residual, jacobian
        (m,) and (m, n), at x. The Jacobian is in float64, whatever x is.
    evaluations, iterations
        How often the residual and the Jacobian were computed.
    converged
        Whether x is a minimum as far as the arithmetic, or the tolerance, can tell.
    reason
        Why the search stopped, in words.
    held
        Indices of parameters at a bound that the cost would cross if it could.
    rank
        Independent columns of the Jacobian among the parameters that are not held.
    """

    x: FloatArray
    cost: float
    residual: FloatArray
    jacobian: FloatArray
    evaluations: int
    iterations: int
    converged: bool
    reason: str
    held: tuple[int, ...]
    rank: int

    def covariance(self) -> FloatArray:
        """Return ``(J^T J)^-1`` (n, n) over the parameters that are not held, 0 for the others.

        For residuals in standard deviations this is the covariance of x; where their common
        deviation is unknown, it is to be multiplied by ``2 cost / (m - n)``.

        Raises
        ------
        LeastSquaresError
            The Jacobian does not determine the parameters.
        """
        n = self.x.size
        free = [i for i in range(n) if i not in self.held]
        if self.rank < len(free):
            raise LeastSquaresError(
                f"the residual determines {self.rank} combinations of {len(free)} parameters, "
                "which have no covariance then: fix parameters, or leave them out"
            )
        size = np.linalg.norm(self.jacobian[:, free], axis=0)
        triangle = np.linalg.qr(self.jacobian[:, free] / size, mode="r")
        inverse = np.linalg.inv(triangle) / size[:, None]
        out = np.zeros((n, n))
        out[np.ix_(free, free)] = inverse @ inverse.T
        return out


def levenberg_marquardt(
    residual: Callable[[Any], Any],
    jacobian: Callable[[Any], Any],
    start: ArrayLike,
    *,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    scale: ArrayLike | None = None,
    tolerance: float = 0.0,
    max_evaluations: int = 1000,
    first_radius: float = 1.0,
) -> LeastSquaresSolution:
    """Minimise half the sum of squares of a residual.

    The result depends on the arguments alone. A residual that is not finite is a refused step, so
    a model need not be defined everywhere; floating-point warnings are off meanwhile.

    Parameters
    ----------
    residual
        Takes x (n,), returns r (m,), a new array each time.
    jacobian
        Takes x (n,), returns the derivatives of r (m, n), a new array each time. Fastest where the
        columns are contiguous. Exact ones: an error in them moves the answer.
    start
        (n,) first x; moved inside the bounds. Of dtype longdouble, x is kept so, and residual and
        Jacobian may be computed so: the answer is then good beyond float64, for residuals that are
        tiny differences of large numbers. Steps are found in float64 either way, but from a
        gradient in longdouble, so that they lead to its root.
    lower, upper
        (n,) or single bounds, which may be infinite, or equal.
    scale
        (n,) or single typical changes of the parameters, which shape the trust region; by default
        the reciprocals of the greatest lengths that their columns of the Jacobian have had.
    tolerance
        0: as many digits as there are. Otherwise the search ends where the next step would change
        the residual by less than this share of it, or the parameters by less than this share of
        them, each weighted with the length of its column.
    max_evaluations
        Limit to computations of the residual.
    first_radius
        First trust region as a share of the length of x, both scaled. Smaller stays nearer.

    Raises
    ------
    LeastSquaresError
        Arrays of the wrong shape, bounds the wrong way round, or a start at which residual or
        Jacobian is not finite.
    """
    problem = BoundedProblem(residual, jacobian, start, lower, upper)
    weights = None
    if scale is not None:
        sizes = as_vector("scale", scale, problem.start.size)
        if not ((sizes > 0) & np.isfinite(sizes)).all():
            raise LeastSquaresError(f"scale must be positive numbers, not {sizes}")
        weights = 1 / sizes
    search = _Search(problem, weights, tolerance, max_evaluations)
    with np.errstate(all="ignore"):
        return search.run(first_radius)


class _Search:
    def __init__(
        self,
        problem: BoundedProblem,
        weights: FloatArray | None,
        tolerance: float,
        max_evaluations: int,
    ) -> None:
        self._problem, self._weights = problem, weights
        self._tolerance, self._max_evaluations = tolerance, max_evaluations
        self._largest: FloatArray = np.zeros(problem.start.size)

    def run(self, first_radius: float) -> LeastSquaresSolution:
        """Search from the start."""
        point, near, slow, radius = self._problem.first_point(), _NEAR, _SLOW, 0.0
        while not self._finished(point):
            norm = point.model.norm
            blurred = norm * self._problem.rounding(point)
            weight = self._weight(point.model)
            shape = weight * point.model.unit
            if point.step.reduction <= blurred or point.step.promise <= near * norm:
                point, settled = self._polish(point, 0.0, shape)
                if settled or point.step.reduction <= blurred:
                    return self._solution(point, True, self._finished(point) or _SETTLED)
                near = 0.01 * point.step.promise / norm
                continue
            if not radius:
                length = length_of(weight * point.step.u)
                reach = length_of(shape * point.x.astype(np.float64))
                radius = min(first_radius * reach or length, length)
            moved, step, radius = self._descend(point, weight, radius, blurred)
            if moved is not None and step.promise > slow * norm:
                point = moved
                continue
            point, settled = self._polish(moved or point, step.damping, shape)
            if settled:
                return self._solution(point, True, self._finished(point) or _SETTLED)
            if moved is None:
                return self._stuck(point)
            slow = 0.01 * step.promise / norm
        return self._solution(point, True, self._finished(point))

    def _finished(self, point: Point) -> str:
        """Return why there is nothing left to do, or nothing."""
        model = point.model
        if model.norm == 0:
            return "the residual is zero"
        if not (point.step.free.any() or point.step.u.any()):
            return "every parameter is held at a bound or without effect"
        if self._tolerance:
            reach = length_of(model.unit * point.x.astype(np.float64))
            within = point.step.promise <= self._tolerance * model.norm
            if within or length_of(point.step.u) <= self._tolerance * reach:
                return "the next step is within the tolerance"
        return ""

    def _weight(self, model: LinearModel) -> FloatArray:
        """Return the weights of u in the trust region."""
        if self._weights is not None:
            return self._weights / model.unit
        self._largest = np.maximum(self._largest, model.size)
        return np.where(model.alive, self._largest, 1.0) / model.unit

    # ---- far from the minimum

    def _descend(
        self, point: Point, weight: FloatArray, radius: float, blurred: float
    ) -> tuple[Point | None, Step, float]:
        """Take one step that lowers the cost; return where it led, itself, and the next radius.

        Where there is none, the last one that was tried.
        """
        problem, tried, step = self._problem, False, point.step
        while problem.evaluations < self._max_evaluations:
            step = point.model.trust_region(point.box, weight, radius, point.step)
            length = length_of(weight * step.u)
            if step.reduction <= _UNSEEN * blurred:
                if tried or not step.reduction > 0:
                    break
                # too short to be seen; the undamped step is not
                tried, radius = True, 10 * length * min(blurred / step.reduction, 1e300)
                continue
            tried = True
            x, value, gain = self._try(point, step, weight)
            moved = problem.point(x, value) if gain > _ACCEPTED else None
            if moved is None and gain > _ACCEPTED:
                gain = -np.inf
            if gain <= _POOR:
                radius = _shrink(gain, step, point.model) * min(radius, 10 * length)
            elif gain >= _GOOD or step is point.step:
                radius = 2 * length
            if moved is not None:
                return moved, step, radius
            if (x == point.x).all():
                break
        return None, step, radius

    def _try(
        self, point: Point, step: Step, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray, float]:
        """Return where a step leads, bent if it does badly, the residual there, and the gain.

        The gain is the actual by the predicted reduction, -inf where the residual is not finite.
        """
        problem, model = self._problem, point.model
        x = problem.move(point, step.u)
        value = problem.evaluate(x)
        gain = _gain(point, value, step)
        if not -np.inf < gain < _POOR or problem.evaluations >= self._max_evaluations:
            return x, value, gain
        second = (value - point.residual).astype(np.float64)
        second -= point.jacobian @ (step.u / model.unit)
        bend = accelerate(step, 2 * (second @ point.jacobian) / model.unit, weight)
        if bend is None:
            return x, value, gain
        other = problem.move(point, step.u + bend)
        bent = problem.evaluate(other)
        better = _gain(point, bent, step)
        return (other, bent, better) if better > gain else (x, value, gain)

    # ---- near the minimum

    def _polish(self, point: Point, damping: float, shape: FloatArray) -> tuple[Point, bool]:
        """Follow Gauss-Newton steps, or equally damped ones, extrapolated, while they shrink.

        `shape`: weights of the parameters in the damping. Returns the point with the shortest
        step, and whether that is as short as can be told.
        """
        problem, unit, n = self._problem, point.model.unit, point.x.size

        def step_from(p: Point) -> Step:
            return p.model.damped(p.box, damping, shape / p.model.unit) if damping else p.step

        step, misses, history = step_from(point), 0, StepHistory(n)
        shift, promise, shortest, best = step.u, step.promise, length_of(step.u), point
        while problem.evaluations < self._max_evaluations:
            if self._finished(point):
                return point, True
            way = history.extrapolate(shift)
            x = problem.move(point, way / unit * point.model.unit)
            if problem.is_rounding(point, step) or (x == point.x).all():
                return best, problem.is_level(best)
            value = problem.evaluate(x)
            rounding = _CLEAR * problem.rounding(point)
            cheaper = point.reduction(value) >= -rounding * point.model.norm
            moved = problem.point(x, value) if np.isfinite(value).all() else None
            if moved is None:
                break
            after = step_from(moved)
            change = after.u / moved.model.unit * unit - shift
            if (after.free == step.free).all():
                history.learn(way, change)
            else:
                history.forget()
            # a step may get longer along what hardly matters while the rest still converges
            shorter = length_of(shift + change) < shortest
            if cheaper and (shorter or after.promise < 0.5 * promise):
                point, step, shift, misses = moved, after, shift + change, 0
                promise = min(promise, after.promise)
                if shorter:
                    best, shortest = moved, length_of(shift)
                continue
            # a miss teaches the extrapolation; rounding needs no second try
            if step.promise <= rounding:
                return best, problem.is_level(best)
            misses += 1
            if misses > n + 2:
                break
        return best, False

    # ---- the end

    def _stuck(self, point: Point) -> LeastSquaresSolution:
        if self._problem.evaluations >= self._max_evaluations:
            return self._solution(point, False, f"all {self._max_evaluations} evaluations spent")
        return self._solution(
            point,
            False,
            "no step lowers the cost, although the derivatives promise it: they are wrong, or the "
            "valley is too narrow or too flat for the arithmetic",
        )

    def _solution(self, point: Point, converged: bool, reason: str) -> LeastSquaresSolution:
        held = self._problem.held(point)
        free = np.ones(point.x.size, dtype=bool)
        free[list(held)] = False
        rank, count = point.model.rank(free), int(free.sum())
        if rank < count:
            reason += (
                f"; the Jacobian has rank {rank} of {count}: some combination of parameters has "
                "no effect"
            )
        return LeastSquaresSolution(
            x=point.x,
            cost=0.5 * float(point.residual @ point.residual),
            residual=point.residual,
            jacobian=point.jacobian,
            evaluations=self._problem.evaluations,
            iterations=self._problem.jacobians,
            converged=converged,
            reason=reason,
            held=held,
            rank=rank,
        )


def _gain(point: Point, value: FloatArray, step: Step) -> float:
    actual = point.reduction(value)
    return actual / step.reduction if np.isfinite(actual) and step.reduction > 0 else -np.inf


def _shrink(gain: float, step: Step, model: LinearModel) -> float:
    """Return the factor of the trust region: to the minimum of a parabola through what is known."""
    if gain >= 0:
        return 0.5
    slope = float(model.gradient() @ step.u)
    share = slope / (2 * (slope + gain * step.reduction))
    return min(max(share, 0.1), 0.5) if np.isfinite(share) else 0.1
