"""Fit a reflectance model to the observations of one scan."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from .error_measures import measure_errors
from .geometry import FloatArray
from .inference.determined import bounds_reached, undetermined
from .inference.lobe_order import in_order
from .inference.marginal import Asked, Marginal, marginalise
from .inference.nuisances import CommonErrors, Nuisances, make_nuisances
from .inference.uncertainty import estimate, published_scale, to_published
from .metrics import METRICS
from .models import SURFACE, ReflectanceModel, get_model
from .observations import Observations
from .problem import FitError, Problem, Solution, Solver, make_problem
from .result import FitResult
from .solve.losses import LOSSES, fit_reweighted
from .solve.solvers import SOLVERS


def fit_scan(
    observations: Observations,
    model: str | ReflectanceModel = SURFACE,
    *,
    method: str = "separable",
    metric: str = "radiance",
    loss: str = "least_squares",
    fixed: Mapping[str, float] | None = None,
    initial: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    tied: Mapping[str, str] | None = None,
    common_errors: CommonErrors | None = None,
    model_error: bool = True,
) -> FitResult:
    """Fit a model to one scan, weighted by the stated variances.

    Where the model can't explain the data within their noise (`chi_square` a few times the degrees
    of freedom), noise alone would let the many precise, dark values decide everything and a peak
    be missed. Then the model's own error, one number for all values, is estimated from the
    residuals and added to the variances, until both agree. `metric` says in what it is one number.

    Of several lobes of one kind the broader comes first, one that is not there last, so that a
    series' parameters go together; not those that are fixed, bounded, tied or started differently
    (see `lobe_order`).

    Parameters
    ----------
    observations
        What was measured; values that are not valid and directions below the horizon are left out.
    model
        Name for `get_model`, or a model.
    method
        A name of `SOLVERS`: "separable" (certain of the global optimum), "paper" or "trust_region".
    metric
        What counts as equal misfit: "radiance", "cosine_weighted", "relative" or "log" (see
        `metrics`). Where noise explains the data they agree, but for what "log" leaves out.
    loss
        "least_squares", or for glints and stray frames "huber" or "cauchy" (see `losses`).
    fixed
        Published values that are known, by name: for dust w, g from pure dust, Kd and sigma_d from
        the clean surface, as the paper did.
    initial
        Published values to start from, by name, instead of the search's; one start then.
    bounds
        Narrower bounds than the model's, published units, by name; an infinite one stays as it is.
    tied
        Parameters that follow another one: {"kd_g": "kd_b", "kd_r": "kd_b"} is a grey surface.
        (Lobes have an option for one amplitude or one a channel.)
    common_errors
        Errors that frames share: they become unknowns with a prior, and the parameters the most
        probable ones (see `posterior`); adds `covariance_common` and `nuisances`.
    model_error
        False: weigh by the stated variances whatever the misfit.

    Raises
    ------
    FitError
        Unknown method, metric, loss or parameter, a value out of bounds, a metric that needs the
        model's error without it, directions that cannot determine the model, fewer usable values
        than free parameters.
    ValueError
        Unknown model.
    """
    began = time.perf_counter()
    chosen = get_model(model) if isinstance(model, str) else model
    if method not in SOLVERS:
        raise FitError(f"unknown method {method!r}; known methods: {', '.join(SOLVERS)}")
    if loss not in LOSSES:
        raise FitError(f"unknown loss {loss!r}; known losses: {', '.join(LOSSES)}")
    if metric in {"cosine_weighted", "relative"} and not model_error:
        raise FitError(f"metric {metric!r} weighs the model's error: it needs model_error=True")
    problem = make_problem(
        observations, chosen, fixed or {}, initial or {}, metric=metric, bounds=bounds, tied=tied
    )
    if problem.tied:
        problem = _started_untied(problem, SOLVERS[method])
    asked = Asked(SOLVERS[method], LOSSES[loss], model_error)
    found = fit_reweighted(problem, asked.solve, asked.loss, model_error)
    nuisances = make_nuisances(problem, observations, common_errors)
    marginal = marginalise(found, problem, nuisances, asked)
    named = {*(initial or {}), *(tied or {}), *(tied or {}).values()}
    result = in_order(_result(observations, nuisances, marginal), problem, named)
    return replace(
        result,
        **_followed(result, problem),
        metric=metric,
        loss=loss,
        down_weighted=marginal.found.down_weighted,
        tied=dict(tied or {}),
        solve_time_s=time.perf_counter() - began,
    )


def _started_untied(problem: Problem, solve: Solver) -> Problem:
    """Return a problem with tied parameters that starts from the answer without ties.

    A coarse search takes each amplitude on its own; a leader starts at its group's mean.
    """
    followers = tuple(i for i in problem.tied if problem.tied[i] in problem.free)
    alone = replace(problem, tied={}, free=tuple(sorted({*problem.free, *followers})))
    internal = solve(alone).internal
    start = {}
    for index in problem.free:
        group = [index, *(i for i in followers if problem.tied[i] == index)]
        start[index] = float(np.mean(internal[group]))
    return replace(problem, initial=start | dict(problem.initial))


def _followed(result: FitResult, problem: Problem) -> dict[str, Any]:
    """Return the fields of a result in which tied parameters take after their leaders."""
    if not problem.tied:
        return {}
    names = result.parameter_names
    source = [problem.tied.get(i, i) for i in range(len(names))]
    lost = {names[i] for i, leader in enumerate(source) if names[leader] in result.undetermined}
    asked = {n for n in result.fixed if problem.tied.get(names.index(n)) not in problem.free}
    return {
        "values": _frozen(result.values[source]),
        "internal_values": _frozen(result.internal_values[source]),
        "undetermined": tuple(n for n in names if n in lost),
        "fixed": tuple(n for n in names if n in asked),
    } | {
        name: _frozen(getattr(result, name)[np.ix_(source, source)])
        for name in ("covariance_random", "covariance_common", "internal_covariance")
    }


def _result(observations: Observations, nuisances: Nuisances, marginal: Marginal) -> FitResult:
    found, optimum = marginal.found, marginal.optimum
    problem, solution = found.problem, found.solution
    model, internal = problem.model, solution.internal
    uncertainty = estimate(problem, nuisances, marginal.linearised)
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
        chi_square=marginal.chi_square,
        degrees_of_freedom=problem.degrees_of_freedom,
        model_error_std=found.model_error_std,
        solver=solution.solver,
        reason=solution.reason,
        evaluations=solution.evaluations,
        solve_time_s=0.0,
        internal_names=model.internal_names,
        internal_values=_frozen(internal),
        internal_covariance=_frozen(uncertainty.random + uncertainty.common),
        internal_bounds=_frozen(np.array([problem.lower, problem.upper])),
        nuisances=nuisances.named(optimum.values, uncertainty.nuisance_deviations),
        optimum=optimum,
    )


def _whole_prediction(
    observations: Observations, problem: Problem, internal: FloatArray
) -> FloatArray:
    """Predicted radiance (n, 3) in the observations' rows; 0 in the rows that were not fitted."""
    rows, predicted = observations.used_rows, problem.predict(internal).T
    if len(predicted) == len(rows):
        return predicted
    whole = np.zeros(observations.radiance.shape)
    whole[rows] = predicted
    return whole


def _frozen(array: FloatArray) -> FloatArray:
    array.setflags(write=False)
    return array


__all__ = [
    "LOSSES",
    "METRICS",
    "SOLVERS",
    "CommonErrors",
    "FitError",
    "FitResult",
    "Solution",
    "Solver",
    "fit_scan",
]
