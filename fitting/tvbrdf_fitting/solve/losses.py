"""Weights that follow the residuals: a model's own error, and robust losses for stray values.

Both are found in rounds of weighted least squares, each by any solver, until they agree with the
residuals that they lead to.

*A model's own error.* One number e is estimated such that the residuals are as large as ``stated
variance + (e unit)^2`` says (`metrics`): their mean square, by degrees of freedom, is 1 (Paule and
Mandel, "Consensus Values and Weighting Factors", 1982; the generalisation to a fit is by Birge's
ratio). It is 0 unless noise alone leaves a mean square above `MISFIT`.

*Robust losses* (Huber, "Robust Statistics", 1981; Holland and Welsch, "Robust Regression Using
Iteratively Reweighted Least-Squares", 1977), with z a residual in its deviations::

    least_squares  weight 1
    huber          weight min(1, k / |z|),     k = 1.345
    cauchy         weight 1 / (1 + (z / c)^2), c = 2.385

Both lose 5 % of precision where nothing is wrong. The scale of z is the stated deviation, with the
model's error added; the latter comes from the median of |z| instead of the mean square, since a
mean would take the stray values for the model's error. Huber's loss has one minimum for each that
least squares has, but every value pulls: a share p of values far off *to one side* shifts a fit by
about 1.6 p / (1 - p) deviations of a single value. Cauchy's lets go of what is far off; it starts
where Huber's ends, from which it finds the minimum of the majority.

*Covariance.* Each value keeps the information ``u / (mean(u) kappa)`` of a stated one, with u its
weight and kappa the loss in efficiency ``mean(psi^2) / mean(psi')^2``, psi = u z (Huber 1981,
section 7.6): at the measured residuals, but never below what normal noise of the stated size gives.
So values that are let go take their information with them, also where they lie together.

A robust loss takes what a model can't explain in a few values for an error of those values: a wrong
model misses the peak with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..geometry import FloatArray
from ..problem import Problem, Solution, Solver

MISFIT = 4.0
"""Mean squared residual in stated deviations above which a model can't explain the data."""
MISFIT_ROUNDS, MISFIT_AGREEMENT = 6, 0.02
ROBUST_ROUNDS = 60
SEARCHED_ROUNDS = 4
"""Rounds in which a solver searches; after these it starts from the previous round's answer."""
SETTLED = 1e-3
"""Change of the coordinates, in their joint deviations, at which weights have settled."""
DOWN_WEIGHTED = 0.5
HUBER, CAUCHY = 1.345, 2.385
_NORMAL_MEDIAN = 0.6744897501960817
"""Median of |z| for a standard normal z."""


@dataclass(frozen=True)
class Loss:
    """A loss by what it does to residuals z in deviations.

    Attributes
    ----------
    name
        As in `LOSSES`.
    weight
        u(z), from 0 to 1.
    slope
        Derivative of psi(z) = u(z) z.
    normal_square
        Mean of psi^2 for a standard normal z.
    before
        Name of the loss whose answer this one starts from, if any.
    """

    name: str
    weight: Callable[[FloatArray], FloatArray]
    slope: Callable[[FloatArray], FloatArray]
    normal_square: float
    before: str | None = None

    @property
    def robust(self) -> bool:
        """Whether weights follow the residuals."""
        return self.name != "least_squares"

    def information(self, z: FloatArray, freedom: int) -> FloatArray:
        """Share of its stated information that each value keeps, 1 on average at the most."""
        if not self.robust:
            return np.ones_like(z)
        weight = self.weight(z)
        square = float(np.sum((weight * z) ** 2)) / max(freedom, 1)
        curvature = max(float(np.mean(self.slope(z))), 1e-6)
        kappa = max(square, self.normal_square) / curvature**2
        return np.asarray(weight / (float(np.mean(weight)) * max(kappa, 1.0)))


def _huber_weight(z: FloatArray) -> FloatArray:
    return np.asarray(HUBER / np.maximum(np.abs(z), HUBER))


def _cauchy_weight(z: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + np.square(z / CAUCHY)))


def _cauchy_slope(z: FloatArray) -> FloatArray:
    square = np.square(z / CAUCHY)
    return np.asarray((1.0 - square) / np.square(1.0 + square))


LOSSES = {
    loss.name: loss
    for loss in (
        Loss("least_squares", np.ones_like, np.ones_like, 1.0),
        Loss("huber", _huber_weight, lambda z: (np.abs(z) < HUBER).astype(float), 0.71016),
        Loss("cauchy", _cauchy_weight, _cauchy_slope, 0.51195, before="huber"),
    )
}
"""Losses by the name that `fit_scan(loss=...)` takes."""


@dataclass(frozen=True, eq=False)
class Reweighted:
    """What the rounds of weights led to.

    Attributes
    ----------
    problem
        With the weights that state what each value tells: for covariances.
    solution
        The last round's; its evaluations are those of all.
    model_error_std
        e, in the metric's units.
    down_weighted
        Number of values whose robust weight is below `DOWN_WEIGHTED`.
    """

    problem: Problem
    solution: Solution
    model_error_std: float
    down_weighted: int


def fit_reweighted(problem: Problem, solve: Solver, loss: Loss, model_error: bool) -> Reweighted:
    """Fit, with a model error where `model_error` allows and noise can't explain the data."""
    solution = solve(problem)
    if not loss.robust and (not model_error or _explained(problem, solution)):
        return Reweighted(problem, solution, 0.0, 0)
    rounds = _Rounds(problem, solve, model_error, solution)
    if loss.robust:
        for stage in (loss.before, loss.name):
            if stage is not None:
                rounds.robust(LOSSES[stage])
    else:
        rounds.least_squares()
    return rounds.result(loss)


def _explained(problem: Problem, solution: Solution) -> bool:
    """Whether noise alone explains the residuals; too few values to tell count as explained."""
    freedom = problem.degrees_of_freedom
    return freedom <= 0 or 2 * problem.cost(solution.internal) <= MISFIT * freedom


class _Rounds:
    """The state of the rounds: the last answer, the model's error, and the effort so far."""

    def __init__(
        self, problem: Problem, solve: Solver, model_error: bool, solution: Solution
    ) -> None:
        self._problem, self._solve, self._model_error = problem, solve, model_error
        self._seen = problem.weight > 0
        self._noise = 1.0 / np.square(problem.weight[self._seen])
        unit = np.broadcast_to(problem.metric.unit, problem.weight.shape)[self._seen]
        self._unit_square = unit * unit
        self._error = 0.0
        self._searched = 1
        self._solution = solution
        self._evaluations = solution.evaluations
        self._remark = ""

    def least_squares(self) -> None:
        """Add the model's error to the variances and fit again, until the two agree."""
        for _ in range(MISFIT_ROUNDS):
            error = self._estimate_error(robust=False)
            if abs(error - self._error) <= MISFIT_AGREEMENT * error:
                return
            self._error = error
            self._fit(np.ones(self._noise.shape), search=True)

    def robust(self, loss: Loss) -> None:
        """Weigh by a loss and fit again, until the answer stays."""
        for count in range(1, ROBUST_ROUNDS + 1):
            before, self._error = self._error, self._estimate_error(robust=True)
            weight = loss.weight(self._misfit() / np.sqrt(self._variance()))
            previous = self._solution.internal
            current = self._fit(weight, search=self._searched < SEARCHED_ROUNDS)
            free = list(self._problem.free)
            step = (self._solution.internal - previous)[free]
            moved = float(np.linalg.norm(current.jacobian(self._solution.internal) @ step))
            agreed = abs(self._error - before) <= MISFIT_AGREEMENT * self._error
            if agreed and moved <= SETTLED * math.sqrt(max(len(free), 1)):
                self._remark = f"; {loss.name} weights settled in {count} rounds"
                return
        self._remark = f"; {loss.name} weights did not settle in {ROBUST_ROUNDS} rounds"

    def result(self, loss: Loss) -> Reweighted:
        """Return where the rounds ended."""
        z = self._misfit() / np.sqrt(self._variance())
        information = loss.information(z, len(z) - len(self._problem.free))
        return Reweighted(
            problem=self._weighted(information),
            solution=replace(
                self._solution,
                evaluations=self._evaluations,
                reason=self._solution.reason + self._remark,
            ),
            model_error_std=self._error,
            down_weighted=int(np.count_nonzero(loss.weight(z) < DOWN_WEIGHTED)),
        )

    def _misfit(self) -> FloatArray:
        problem = self._problem
        predicted = problem.predict(self._solution.internal)
        return np.asarray(problem.misfit_of(predicted)[self._seen])

    def _variance(self) -> FloatArray:
        return np.asarray(self._noise + self._error**2 * self._unit_square)

    def _weighted(self, weight: FloatArray) -> Problem:
        whole = np.zeros(self._problem.weight.shape)
        whole[self._seen] = np.sqrt(weight / self._variance())
        return replace(self._problem, weight=whole)

    def _fit(self, weight: FloatArray, *, search: bool) -> Problem:
        current = self._weighted(weight)
        if search:
            self._searched += 1
            self._solution = self._solve(current)
        else:
            start = {i: float(self._solution.internal[i]) for i in current.free}
            self._solution = self._solve(replace(current, initial=start))
        self._evaluations += self._solution.evaluations
        return current

    def _estimate_error(self, *, robust: bool) -> float:
        """e at the present residuals; 0 where noise explains them."""
        square = np.square(self._misfit())
        freedom = self._problem.degrees_of_freedom
        if not self._model_error or freedom <= 0:
            return 0.0

        def excess(log_variance: float) -> float:
            ratio = square / (self._noise + math.exp(log_variance) * self._unit_square)
            if robust:
                return float(np.median(ratio)) / _NORMAL_MEDIAN**2 - 1.0
            return float(ratio.sum()) / freedom - 1.0

        from scipy.optimize import brentq

        # a thousandth of the least noise changes nothing: there it is as without a model error
        lowest = math.log(1e-3 * float((self._noise / self._unit_square).min()))
        if excess(lowest) + 1.0 <= MISFIT:
            return 0.0
        highest = math.log(float((square / self._unit_square).max())) + 5.0
        while excess(highest) > 0:
            highest += 5.0
        return math.exp(0.5 * float(brentq(excess, lowest, highest, xtol=1e-6)))
