"""Solvers by name.

``separable``, the default: compiled, for Oren-Nayar (or Lambert) with a Torrance-Sparrow lobe, in
any metric that is linear in the radiance. What it can't fit is descended from several starts of a
coarse search, by the project's own Levenberg-Marquardt, which knows bounds.

``paper``: MINPACK's Levenberg-Marquardt on all parameters at once, as Sun et al. did. It knows no
bounds; where its answer leaves them, the offending coordinates are held at their bound and the
rest fitted again, until no bound is violated and no held one wants back inside.

``trust_region``: scipy's reflective trust region, which knows bounds; slower, an independent check.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..geometry import FloatArray
from ..problem import Problem, Solution, Solver
from . import separable
from .levenberg_marquardt import LeastSquaresSolution, levenberg_marquardt
from .starts import find_starts, other_valleys

_FINE = 1e-10
_COARSE = 1e-4
_COARSE_STEPS = 10
_FINE_STEPS = 100
_ROUNDS = 12
_SECOND_LOOKS = 2
_LOOK_BUDGET = 80
_GENERAL_TOLERANCE, _GENERAL_EVALUATIONS = 1e-9, 200


@dataclass
class _Run:
    """Levenberg-Marquardt over some coordinates, the others held; counts what it costs."""

    problem: Problem
    evaluations: int = 0
    message: str = ""
    finished: bool = False
    held: dict[int, float] = field(default_factory=dict)

    def moving(self) -> tuple[int, ...]:
        return tuple(i for i in self.problem.free if i not in self.held)

    def fit(self, start: FloatArray, tolerance: float, steps: int) -> FloatArray:
        point = start.copy()
        for index, value in self.held.items():
            point[index] = value
        moving = _informed(self.problem, point, self.moving())
        while moving:
            point = self._minimise(point, moving, tolerance, steps)
            # an amplitude that left 0 gives its lobe's width an effect
            wider = _informed(self.problem, point, self.moving())
            if set(wider) <= set(moving):
                return point
            moving = wider
        self.message = "every coordinate is held at a bound or without effect"
        self.finished = True
        return point

    def _minimise(
        self, full: FloatArray, moving: tuple[int, ...], tolerance: float, steps: int
    ) -> FloatArray:
        from scipy.optimize import least_squares  # takes long, and the compiled search needs none

        chosen = list(moving)

        def whole(x: FloatArray) -> FloatArray:
            point = full.copy()
            point[chosen] = x
            return point

        answer: Any = least_squares(
            lambda x: self.problem.residual(whole(x)),
            full[chosen],
            jac=lambda x: self.problem.jacobian(whole(x), moving),
            method="lm",
            x_scale="jac",
            ftol=tolerance,
            xtol=tolerance,
            gtol=tolerance,
            max_nfev=steps,
        )
        self.evaluations += int(answer.nfev)
        self.message, self.finished = str(answer.message), bool(answer.success)
        return whole(answer.x)


def solve_paper(problem: Problem) -> Solution:
    """Levenberg-Marquardt from the best starts, with an active set for the bounds."""
    starts = find_starts(problem)
    run = _Run(problem)
    candidates = list(starts)
    if len(starts) > 1:
        # every valley gets a few steps; the lowest one is then finished
        candidates += [problem.clamp(run.fit(s, _COARSE, _COARSE_STEPS)) for s in starts]
    best = min(candidates, key=problem.cost)
    solution = _finish(run, best)
    if problem.initial:
        return solution
    for _ in range(_SECOND_LOOKS):
        if solution.evaluations > _LOOK_BUDGET:
            break  # a flat valley of parameters the data cannot tell; a second look only adds time
        better = [
            _finish(_Run(problem), start) for start in other_valleys(problem, solution.internal)
        ]
        spent = solution.evaluations + sum(s.evaluations for s in better)
        previous = problem.cost(solution.internal)
        solution = min([solution, *better], key=lambda s: problem.cost(s.internal))
        solution = replace(solution, evaluations=spent)
        if problem.cost(solution.internal) >= previous * (1 - 1e-7):
            break
    return solution


def _finish(run: _Run, start: FloatArray) -> Solution:
    """Fit within the bounds, by trust region where the active set gets no lower than the start."""
    problem = run.problem
    found = _within_bounds(run, start)
    if found is not None and problem.cost(found) <= problem.cost(start) * (1 + 1e-9):
        names = [problem.model.parameter_names[i] for i in sorted(run.held)]
        held = f", held at a bound: {', '.join(names)}" if names else ""
        return Solution(found, run.message, f"Levenberg-Marquardt (MINPACK){held}", run.evaluations)
    solution = _trust_region(problem, [start])
    return Solution(
        solution.internal,
        solution.reason,
        f"{solution.solver}, after Levenberg-Marquardt did not settle within the bounds",
        solution.evaluations + run.evaluations,
    )


def solve_trust_region(problem: Problem) -> Solution:
    """scipy's trust region with bounds, from several starts, the lowest cost kept."""
    return _trust_region(problem, find_starts(problem))


def solve_separable(problem: Problem) -> Solution:
    """Search every valley with compiled code where the model allows, else as `solve_general`."""
    return separable.solve(problem) if separable.fits(problem) else solve_general(problem)


def solve_general(problem: Problem) -> Solution:
    """Descend every valley that a coarse search finds, for any model and metric, within bounds."""
    run = _Descents(problem)
    best = run.descend(find_starts(problem))
    if not problem.initial:
        for _ in range(_SECOND_LOOKS):
            before = best.cost
            best = run.descend(other_valleys(problem, run.whole(best.x)), best)
            if best.cost >= before * (1 - 1e-7):
                break
    names = [problem.model.parameter_names[problem.free[i]] for i in best.held]
    held = f", held at a bound: {', '.join(names)}" if names else ""
    return Solution(
        run.whole(best.x),
        best.reason,
        f"Levenberg-Marquardt from {run.descents} starts{held}",
        run.evaluations,
    )


class _Descents:
    """Descents of the general solver; counts what they cost."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.chosen = list(problem.free)
        self.evaluations = 0
        self.descents = 0

    def whole(self, x: FloatArray) -> FloatArray:
        point = self.problem.values.copy()
        point[self.chosen] = x
        return self.problem.whole(point)

    def descend(
        self, starts: list[FloatArray], best: LeastSquaresSolution | None = None
    ) -> LeastSquaresSolution:
        """Return the lowest of the descents from some starts, and of one that is known."""
        problem = self.problem
        for start in starts:
            found = levenberg_marquardt(
                lambda x: problem.residual(self.whole(x)),
                lambda x: problem.jacobian(self.whole(x)),
                start[self.chosen],
                lower=problem.lower[self.chosen],
                upper=problem.upper[self.chosen],
                tolerance=_GENERAL_TOLERANCE,
                max_evaluations=_GENERAL_EVALUATIONS,
            )
            self.evaluations += found.evaluations
            self.descents += 1
            if best is None or found.cost < best.cost:
                best = found
        if best is None:
            raise AssertionError("a coarse search finds one start at least")
        return best


SOLVERS: dict[str, Solver] = {
    "separable": solve_separable,
    "paper": solve_paper,
    "trust_region": solve_trust_region,
}
"""Solvers by the name that `fit_scan(method=...)` takes."""


def _within_bounds(run: _Run, start: FloatArray) -> FloatArray | None:
    """Fit with an active set of bounds, or None where the set does not settle."""
    problem, point = run.problem, start
    for _ in range(_ROUNDS):
        # few steps show whether a bound is in the way; only an answer inside is worth finishing
        end = run.fit(point, _FINE, _COARSE_STEPS)
        outside = _outside(run, end)
        if not outside and not run.finished:
            end = run.fit(end, _FINE, _FINE_STEPS)
            outside = _outside(run, end)
        if outside:
            # one at a time, the furthest along the step first: the others may then stay inside
            first = min(outside, key=lambda i: _step_to_bound(problem, point, end, i))
            run.held[first] = float(problem.clamp(end)[first])
            point = problem.clamp(point)
            continue
        back = _wants_inside(run, end)
        if back is None:
            return end
        del run.held[back]
        point = end
    return None


def _outside(run: _Run, point: FloatArray) -> list[int]:
    problem = run.problem
    return [i for i in run.moving() if not problem.lower[i] <= point[i] <= problem.upper[i]]


def _step_to_bound(problem: Problem, start: FloatArray, end: FloatArray, index: int) -> float:
    """Return the share of the step from start to end that stays within the bound of `index`."""
    length = end[index] - start[index]
    bound = problem.upper[index] if end[index] > problem.upper[index] else problem.lower[index]
    return float((bound - start[index]) / length) if length else 0.0


def _wants_inside(run: _Run, point: FloatArray) -> int | None:
    """Return the held coordinate whose release would lower the cost most, if any would."""
    if not run.held:
        return None
    problem, held = run.problem, tuple(run.held)
    residual, columns = problem.residual(point), problem.jacobian(point, tuple(run.held))
    size = float(np.linalg.norm(residual))
    if size == 0:
        return None
    best, worth = None, 1e-8
    for column, index in zip(columns.T, held, strict=True):
        norm = float(np.linalg.norm(column))
        if norm == 0:
            continue
        downhill = -float(column @ residual) / (norm * size)
        inward = downhill if point[index] <= problem.lower[index] else -downhill
        if inward > worth:
            best, worth = index, inward
    return best


def _informed(problem: Problem, point: FloatArray, moving: tuple[int, ...]) -> tuple[int, ...]:
    """Leave out coordinates without any effect at this point, as a lobe's width at amplitude 0."""
    columns = problem.jacobian(point, moving)
    return tuple(i for i, c in zip(moving, columns.T, strict=True) if c.any())


def _trust_region(problem: Problem, starts: list[FloatArray]) -> Solution:
    from scipy.optimize import least_squares

    chosen = list(problem.free)
    if not chosen:
        return Solution(starts[0], "no parameter is free", "none", 0)
    lower, upper = problem.lower[chosen], problem.upper[chosen]
    evaluations = 0
    best: Any = None
    # amplitudes have no upper bound, so the margin that keeps a start inside is absolute there
    margin = 1e-6 * np.where(np.isfinite(upper - lower), upper - lower, 1.0)

    def whole(x: FloatArray) -> FloatArray:
        point = problem.values.copy()
        point[chosen] = x
        return point

    for start in starts:
        answer: Any = least_squares(
            lambda x: problem.residual(whole(x)),
            np.clip(start[chosen], lower + margin, upper - margin),
            jac=lambda x: problem.jacobian(whole(x)),
            bounds=(lower, upper),
            method="trf",
            x_scale="jac",
            ftol=1e-13,
            xtol=1e-12,
            gtol=None,  # not relative to the cost's scale in this solver
            max_nfev=200,
        )
        evaluations += int(answer.nfev)
        if best is None or answer.cost < best.cost:
            best = answer
    internal = problem.clamp(whole(best.x))
    return Solution(internal, str(best.message), "trust region (scipy)", evaluations)
