"""What becomes of a plain fit when frames share errors: its nuisances are marginalised.

Where noise and nuisances together explain the data, the parameters become those of the posterior's
maximum, in which gains, light offsets and tilt are unknowns with a prior.

Where they do not, the model is wrong, and what it gets wrong is the same all over a camera or a
sweep. Nuisances would take that up, far outside their priors, and bend the parameters. The plain
fit then stays as it is, and the common errors are carried to its parameters to first order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..geometry import FloatArray
from ..problem import Problem, Solution, Solver
from ..solve.losses import MISFIT, Loss, Reweighted, fit_reweighted
from .nuisances import Nuisances, no_nuisances
from .posterior import (
    STEPS,
    Linearised,
    Point,
    Posterior,
    linearise_plain,
    linearise_with_common_errors,
    maximise,
)

_NORMAL_MEDIAN_SQUARE = 0.4549364231195727
"""Median of z^2 for a standard normal z."""
_HOPELESS = 4.0
"""Excess of the limit of misfit, with nuisances but before the weights follow, that ends a try."""
_TRIAL_STEPS = 2


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
    optimum = Optimum(posterior, internal, np.zeros(0), plain.problem.cost(internal), solve)
    return Marginal(plain, optimum, linearised, 2 * noise_only.cost(internal))


def _explained(
    plain: Reweighted, noise_only: Problem, nuisances: Nuisances, asked: Asked
) -> Marginal | None:
    """Return the posterior's maximum, or None where noise and nuisances can't explain the data."""
    posterior = Posterior(plain.problem, nuisances)
    doubtful = plain.model_error_std > 0 or asked.loss.robust
    start = posterior.point(plain.solution.internal)
    maximum = maximise(posterior, start, steps=_TRIAL_STEPS if doubtful else STEPS)
    steps, found = maximum.steps, plain
    if doubtful:
        # the plain fit's weights followed residuals that nuisances may have caused
        if _misfit(noise_only, nuisances, maximum.point, asked.loss) > _HOPELESS * MISFIT:
            return None
        found = _reweighted(noise_only, maximum.point, nuisances, asked)
        if found.model_error_std:
            return None
        posterior = Posterior(found.problem, nuisances)
        maximum = maximise(posterior, posterior.point(maximum.point.internal, maximum.point.values))
        steps += maximum.steps
    point = maximum.point
    if _misfit(noise_only, nuisances, point, asked.loss) > MISFIT:
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


def _misfit(noise_only: Problem, nuisances: Nuisances, point: Point, loss: Loss) -> float:
    """Mean squared residual in stated deviations, as `losses.MISFIT` limits it."""
    residual = Posterior(noise_only, nuisances).point(point.internal, point.values).residual
    if loss.robust:
        seen = noise_only.weight.reshape(-1) > 0
        return float(np.median(np.square(residual[seen]))) / _NORMAL_MEDIAN_SQUARE
    return float(residual @ residual) / max(noise_only.degrees_of_freedom, 1)


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
