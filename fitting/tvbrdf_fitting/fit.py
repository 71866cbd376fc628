"""Fit a reflectance model to the observations of one scan."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from .error_measures import measure_errors
from .geometry import FloatArray
from .models import SURFACE, ReflectanceModel, get_model
from .observations import Observations
from .problem import FitError, Problem, Solution, Solver, make_problem
from .result import FitResult
from .solvers import SOLVERS
from .uncertainty import (
    CommonErrors,
    bounds_reached,
    estimate,
    published_scale,
    to_published,
    undetermined,
)

MISFIT = 4.0
"""Chi-square by degrees of freedom above which a model can't explain the data."""
MISFIT_ROUNDS, MISFIT_AGREEMENT = 6, 0.02


def fit_scan(
    observations: Observations,
    model: str | ReflectanceModel = SURFACE,
    *,
    method: str = "paper",
    fixed: Mapping[str, float] | None = None,
    initial: Mapping[str, float] | None = None,
    common_errors: CommonErrors | None = None,
    model_error: bool = True,
) -> FitResult:
    """Fit a model to one scan, weighted by the stated variances.

    Where the model can't explain the data within their noise (`chi_square` a few times the degrees
    of freedom), noise alone would let the many precise, dark values decide everything and a peak
    be missed. Then the model's own error, one standard deviation of radiance for all values, is
    estimated from the residuals and added to the variances, until both agree.

    Parameters
    ----------
    observations
        What was measured; values that are not valid and directions below the horizon are left out.
    model
        Name for `get_model`, or a model.
    method
        A name of `SOLVERS`: "paper" (Levenberg-Marquardt from a coarse search) or "trust_region".
    fixed
        Published values that are known, by name: for dust w, g from pure dust, Kd and sigma_d from
        the clean surface, as the paper did.
    initial
        Published values to start from, by name, instead of the search's; one start then.
    common_errors
        Errors that frames share; adds `covariance_common`.
    model_error
        False: weigh by the stated variances whatever the misfit.

    Raises
    ------
    FitError
        Unknown method or parameter, a value out of bounds, fewer usable values than free
        parameters.
    ValueError
        Unknown model.
    """
    began = time.perf_counter()
    chosen = get_model(model) if isinstance(model, str) else model
    if method not in SOLVERS:
        raise FitError(f"unknown method {method!r}; known methods: {', '.join(SOLVERS)}")
    problem = make_problem(observations, chosen, fixed or {}, initial or {})
    solution = SOLVERS[method](problem)
    misfit = 0.0
    noise_only = problem
    if model_error and 2 * problem.cost(solution.internal) > MISFIT * problem.degrees_of_freedom:
        problem, solution, misfit = _fit_with_model_error(problem, solution, SOLVERS[method])
    chi_square = 2 * noise_only.cost(solution.internal)
    return _result(observations, problem, solution, common_errors, misfit, chi_square, began)


def _fit_with_model_error(
    problem: Problem, solution: Solution, solve: Solver
) -> tuple[Problem, Solution, float]:
    """Add the residuals' spread to the variances and fit again, until the two agree."""
    weighted = problem.weight > 0
    variance = np.zeros(problem.weight.shape)
    variance[weighted] = problem.weight[weighted] ** -2
    spread = 0.0
    current = problem
    for _ in range(MISFIT_ROUNDS):
        residual = (problem.predict(solution.internal) - problem.radiance)[weighted]
        before, spread = spread, float(np.sqrt(np.mean(residual**2)))
        if abs(spread - before) <= MISFIT_AGREEMENT * spread:
            break
        weight = np.zeros(problem.weight.shape)
        weight[weighted] = 1.0 / np.sqrt(variance[weighted] + spread**2)
        current = replace(problem, weight=weight)
        solution = solve(current)
    return current, solution, spread


def _result(
    observations: Observations,
    problem: Problem,
    solution: Solution,
    common_errors: CommonErrors | None,
    misfit: float,
    chi_square: float,
    began: float,
) -> FitResult:
    model, internal = problem.model, solution.internal
    uncertainty = estimate(problem, internal, observations, common_errors)
    at_bound = bounds_reached(problem, internal)
    lost = undetermined(problem, internal, uncertainty, at_bound)
    unmeasured = [
        i for i in range(len(model.parameters)) if i not in problem.free and i not in problem.fixed
    ]
    values, internal = model.to_published(internal), internal.copy()
    errors = measure_errors(observations, _whole_prediction(observations, problem, internal))
    scale = published_scale(problem, internal, uncertainty)
    random = to_published(uncertainty.random, scale)
    common = to_published(uncertainty.common, scale)
    values[unmeasured] = np.nan
    internal[unmeasured] = np.nan
    names = model.parameter_names
    return FitResult(
        model=model.name,
        parameter_names=names,
        values=_frozen(values),
        covariance_random=_frozen(random),
        covariance_common=_frozen(common),
        at_bound=tuple(names[i] for i in at_bound),
        undetermined=tuple(names[i] for i in lost),
        fixed=tuple(names[i] for i in sorted(problem.fixed)),
        errors=errors,
        chi_square=chi_square,
        degrees_of_freedom=problem.degrees_of_freedom,
        model_error_std=misfit,
        solver=solution.solver,
        reason=solution.reason,
        evaluations=solution.evaluations,
        solve_time_s=time.perf_counter() - began,
        internal_names=model.internal_names,
        internal_values=_frozen(internal),
        internal_covariance=_frozen(uncertainty.random + uncertainty.common),
    )


def _whole_prediction(
    observations: Observations, problem: Problem, internal: FloatArray
) -> FloatArray:
    """Predicted radiance (n, 3) in the observations' rows; 0 in the rows that were not fitted."""
    rows = observations.usable.any(axis=1)
    whole = np.zeros(observations.radiance.shape)
    whole[rows] = problem.predict(internal).T
    return whole


def _frozen(array: FloatArray) -> FloatArray:
    array.setflags(write=False)
    return array


__all__ = ["SOLVERS", "CommonErrors", "FitError", "FitResult", "Solution", "Solver", "fit_scan"]
