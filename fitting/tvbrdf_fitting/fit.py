"""Fit a reflectance model to the observations of one scan."""

from __future__ import annotations

import time
from collections.abc import Mapping

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


def fit_scan(
    observations: Observations,
    model: str | ReflectanceModel = SURFACE,
    *,
    method: str = "paper",
    fixed: Mapping[str, float] | None = None,
    initial: Mapping[str, float] | None = None,
    common_errors: CommonErrors | None = None,
) -> FitResult:
    """Fit a model to one scan, weighted by the stated variances.

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
    return _result(observations, problem, solution, common_errors, began)


def _result(
    observations: Observations,
    problem: Problem,
    solution: Solution,
    common_errors: CommonErrors | None,
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
    residual = problem.residual(internal)
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
        chi_square=float(residual @ residual),
        degrees_of_freedom=problem.value_count - len(problem.free),
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
