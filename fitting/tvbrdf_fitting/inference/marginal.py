"""What becomes of a plain fit when frames share errors: its nuisances are marginalised.

Where noise and nuisances together explain the data, the parameters become those of the posterior's
maximum, in which gains, light offsets and tilt are unknowns with a prior.

Where they do not, the model is wrong, and what it gets wrong is the same all over a camera or a
sweep. Nuisances would take that up, far outside their priors, and bend the parameters. The plain
fit then stays as it is, and the common errors are carried to its parameters to first order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..geometry import FloatArray
from ..problem import Problem, Solution, Solver
from ..solve.losses import MISFIT, Loss, Reweighted, fit_reweighted
from .nuisances import Nuisances, no_nuisances
from .posterior import (
    Linearised,
    Point,
    Posterior,
    linearise_plain,
    linearise_with_common_errors,
    maximise,
)

_NORMAL_MEDIAN_SQUARE = 0.4549364231195727
"""Median of z^2 for a standard normal z."""
_FALLING, _TRIAL_STEPS, _DAMPED_STEPS = 0.5, 2, 8
"""That many steps towards data that can be explained leave at most this part of the misfit; the
second number where a shorter step must be found first."""
_FAR = 5.0
"""Root mean square of the nuisances, in prior deviations, that only a wrong model leads to."""


@dataclass(frozen=True)
class Asked:
    """How a plain fit was made: by which solver, which loss, with an error of the model or not."""

    solve: Solver
    loss: Loss
    model_error: bool


@dataclass(frozen=True, eq=False)
class Optimum:
    """Where a fit ended: all that is needed to look around it.

    `posterior` is without nuisances where there are none, or where the model is wrong; `solve` is
    the solver that fitted.
    """

    posterior: Posterior
    internal: FloatArray
    values: FloatArray
    cost: float
    solve: Solver


@dataclass(frozen=True, eq=False)
class Marginal:
    """A fit with its common errors.

    Attributes
    ----------
    found
        Parameters, and the problem with the weights that go with them.
    optimum
        Where it ended.
    linearised
        The linearisation there, for the covariance.
    chi_square
        At the stated weights, with the squares of the nuisances.
    """

    found: Reweighted
    optimum: Optimum
    linearised: Linearised
    chi_square: float


def marginalise(
    plain: Reweighted, noise_only: Problem, nuisances: Nuisances, asked: Asked
) -> Marginal:
    """Return what a plain fit becomes with its common errors.

    Parameters
    ----------
    plain
        The fit without nuisances.
    noise_only
        Its problem with the stated weights.
    nuisances
        Errors that its frames share.
    asked
        How the plain fit was made.
    """
    whole = noise_only.whole(plain.solution.internal)
    plain = replace(plain, solution=replace(plain.solution, internal=whole))
    if not len(nuisances):
        linearised = linearise_plain(plain.problem, nuisances, whole)
        return _plain(plain, noise_only, linearised, asked.solve)
    marginal = _explained(plain, noise_only, nuisances, asked)
    if marginal is not None:
        return marginal
    linearised = linearise_with_common_errors(plain.problem, nuisances, whole)
    return _plain(plain, noise_only, linearised, asked.solve)


def _plain(
    plain: Reweighted, noise_only: Problem, linearised: Linearised, solve: Solver
) -> Marginal:
    internal = plain.solution.internal
    posterior = Posterior(plain.problem, no_nuisances(plain.problem))
    cost = noise_only.cost(internal)
    weighted = cost if plain.problem is noise_only else plain.problem.cost(internal)
    optimum = Optimum(posterior, internal, np.zeros(0), weighted, solve)
    return Marginal(plain, optimum, linearised, 2 * cost)


def _explained(
    plain: Reweighted, noise_only: Problem, nuisances: Nuisances, asked: Asked
) -> Marginal | None:
    """Return the posterior's maximum, or None where noise and nuisances can't explain the data."""
    doubtful = plain.model_error_std > 0 or asked.loss.robust
    posterior = Posterior(_without_model_error(plain, noise_only), nuisances)
    start, steps, found = posterior.point(plain.solution.internal), 0, plain
    if doubtful:
        tried = _towards(posterior, start, noise_only, asked)
        if tried is None:
            return None
        start, steps = tried
    maximum = maximise(posterior, start)
    steps += maximum.steps
    if doubtful:
        # the plain fit's weights followed residuals that nuisances may have caused
        found = _reweighted(noise_only, maximum.point, nuisances, asked)
        if found.model_error_std:
            return None
        posterior = Posterior(found.problem, nuisances)
        maximum = maximise(posterior, posterior.point(maximum.point.internal, maximum.point.values))
        steps += maximum.steps
    point = maximum.point
    far = doubtful and _root_mean_square(point.values) > _FAR
    if far or _misfit(noise_only, nuisances, point, asked.loss) > MISFIT:
        return None
    remark = "" if maximum.settled else "; the nuisances did not settle"
    solution = replace(
        plain.solution,
        internal=noise_only.whole(point.internal),
        solver=f"{plain.solution.solver}, then Gauss-Newton with {len(nuisances)} nuisances",
        reason=plain.solution.reason + remark,
        evaluations=plain.solution.evaluations + steps,
    )
    return Marginal(
        found=replace(found, problem=posterior.problem, solution=solution),
        optimum=Optimum(posterior, solution.internal, point.values, point.cost, asked.solve),
        linearised=maximum.linearised,
        chi_square=2 * Posterior(noise_only, nuisances).point(point.internal, point.values).cost,
    )


def _without_model_error(plain: Reweighted, noise_only: Problem) -> Problem:
    """Return the plain fit's problem with the stated noise alone, and the weights of its loss.

    With the model's error in the variances, nuisances would stay at their priors' centres.
    """
    if not plain.model_error_std:
        return plain.problem
    error = plain.model_error_std * noise_only.metric.unit * noise_only.weight
    return replace(noise_only, weight=plain.problem.weight * np.hypot(1.0, error))


def _towards(
    posterior: Posterior, start: Point, noise_only: Problem, asked: Asked
) -> tuple[Point, int] | None:
    """Return a point where noise and nuisances explain the data, and the steps; None if there
    is none.

    The plain fit may have ended in a valley, or at a bound, that only errors of gains and angles
    led to. So the solver searches once more, with these as they were found.
    """

    def misfit(point: Point) -> float:
        return _misfit(noise_only, posterior.nuisances, point, asked.loss)

    point, steps = _falling(posterior, start, misfit)
    solution = asked.solve(_without_gains(posterior, point.values))
    other = posterior.point(noise_only.whole(solution.internal), point.values)
    if other.cost < point.cost:
        point, more = _falling(posterior, other, misfit)
        steps += more
    if misfit(point) > MISFIT:
        return None
    balanced = maximise(posterior, _balanced(posterior, point), steps=_TRIAL_STEPS)
    nearer = balanced.point if balanced.point.cost < point.cost else point
    return nearer, steps + balanced.steps


def _falling(
    posterior: Posterior, point: Point, misfit: Callable[[Point], float]
) -> tuple[Point, int]:
    """Return a point with less misfit, and the steps that were made while it fell fast."""
    steps, before, left = 0, math.inf, misfit(point)
    while MISFIT < left <= _FALLING * before:
        maximum = maximise(posterior, point, steps=_TRIAL_STEPS)
        if maximum.point is point:
            maximum = maximise(posterior, point, steps=_DAMPED_STEPS)
        point, steps = maximum.point, steps + maximum.steps
        before, left = left, misfit(point)
    return point, steps


def _balanced(posterior: Posterior, point: Point) -> Point:
    """Return a point with a factor moved from a channel's gains to its amplitudes.

    So that the priors are pleased best. What is predicted hardly changes. Gauss-Newton's straight
    steps follow this bent valley in a crawl.
    """
    nuisances, problem = posterior.nuisances, posterior.problem
    gain, values = 1.0 + point.values * nuisances.deviations, point.values.copy()
    factors = np.ones(len(nuisances.gain_of))
    for channel, of_values in enumerate(nuisances.gain_of):
        own = np.unique(of_values[of_values >= 0])
        if len(own):
            weight = gain[own] / nuisances.deviations[own] ** 2
            factors[channel] = weight.sum() / (weight @ gain[own])
            values[own] = (gain[own] * factors[channel] - 1.0) / nuisances.deviations[own]
    names = {name for term in problem.model.terms for name in term.amplitudes}
    internal = point.internal.copy()
    for index in problem.free:
        parameter = problem.model.parameters[index]
        if parameter.name in names:
            shared = parameter.channel is None
            internal[index] /= factors.mean() if shared else factors[parameter.channel]
    return posterior.point(problem.clamp(internal), values)


def _without_gains(posterior: Posterior, values: FloatArray) -> Problem:
    """Return the problem as nuisances (m,) have it, with gains in the data, as solvers take it."""
    here = posterior.nuisances.apply(posterior.problem, values)
    if here.to_radiance.ndim == 1:
        return here
    gain = posterior.nuisances.gain(values)
    known = replace(here, to_radiance=here.to_radiance[0] / gain[0])
    if here.metric.curve is not None:
        return known  # which holds the data: only directions are as they were found
    return replace(known, radiance=here.radiance / gain, weight=here.weight * gain)


def _misfit(noise_only: Problem, nuisances: Nuisances, point: Point, loss: Loss) -> float:
    """Mean squared residual in stated deviations, as `losses.MISFIT` limits it."""
    residual = Posterior(noise_only, nuisances).point(point.internal, point.values).residual
    if loss.robust:
        seen = noise_only.weight.reshape(-1) > 0
        return float(np.median(np.square(residual[seen]))) / _NORMAL_MEDIAN_SQUARE
    return float(residual @ residual) / max(noise_only.degrees_of_freedom, 1)


def _root_mean_square(values: FloatArray) -> float:
    return math.sqrt(float(values @ values) / max(len(values), 1))


def _reweighted(
    noise_only: Problem, point: Point, nuisances: Nuisances, asked: Asked
) -> Reweighted:
    """Return the fit by parameters alone near a point, with the weights that go with it."""

    def solve(problem: Problem) -> Solution:
        alone = Posterior(problem, no_nuisances(problem))
        found = maximise(alone, alone.point(point.internal))
        return Solution(found.point.internal, "", "", 1 + found.steps)

    here = nuisances.apply(noise_only, point.values)
    found = fit_reweighted(here, solve, asked.loss, asked.model_error)
    return replace(found, problem=replace(noise_only, weight=found.problem.weight))
