"""Parameters of many scans that share their directions: pixels of a patch, Monte Carlo runs.

Only parameters and costs, no uncertainties: a fraction of the time of `fit_scan`.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from .geometry import BoolArray, FloatArray, IntArray, above_horizon
from .inference.lobe_order import lobe_order
from .models import SURFACE, ReflectanceModel, get_model
from .models.base import IDENTITY
from .observations import Observations
from .problem import Problem, make_problem
from .solve import separable
from .solve.solvers import SOLVERS


@dataclass(frozen=True, eq=False)
class ParameterBatch:
    """Parameters of m scans.

    Attributes
    ----------
    model
        Full name.
    parameter_names
        Of the p parameters.
    values
        (m, p) published units; NaN for a channel without a usable value.
    chi_square
        (m,) sums of squared weighted residuals.
    evaluations
        (m,) how often the residuals were evaluated.
    converged
        (m,) False where a descent ended after its largest number of steps.
    """

    model: str
    parameter_names: tuple[str, ...]
    values: FloatArray
    chi_square: FloatArray
    evaluations: IntArray
    converged: BoolArray


def fit_parameters(
    light_direction: ArrayLike,
    view_direction: ArrayLike,
    radiance: ArrayLike,
    variance: ArrayLike,
    model: str | ReflectanceModel = SURFACE,
    *,
    fixed: Mapping[str, float] | None = None,
    method: str = "separable",
    jobs: int = 1,
) -> ParameterBatch:
    """Fit a model to many scans with the same directions.

    Parameters
    ----------
    light_direction, view_direction
        (n, 3) unit vectors in the sample's frame.
    radiance
        (m, n, 3) pi x BRDF x cos(theta_i), B, G, R.
    variance
        (n, 3), shared by the scans, which then share more of the work, or (m, n, 3). Infinite where
        a value is not to be used.
    model, fixed, method
        As in `fit_scan`.
    jobs
        Threads. The compiled solver scales with the cores; other models hardly gain.

    Raises
    ------
    FitError, ValueError
        As `fit_scan`; or shapes that do not go together.
    """
    chosen = get_model(model) if isinstance(model, str) else model
    lights, views = np.asarray(light_direction, float), np.asarray(view_direction, float)
    measured, spread = np.asarray(radiance, float), np.asarray(variance, float)
    n = lights.shape[0]
    if measured.ndim != 3 or measured.shape[1:] != (n, 3) or not len(measured):
        raise ValueError(f"radiance has shape {measured.shape}, expected (m, {n}, 3)")
    if spread.shape not in {(n, 3), measured.shape}:
        raise ValueError(
            f"variance has shape {spread.shape}, expected {(n, 3)} or {measured.shape}"
        )
    # a channel or row that no scan saw is no part of the problem
    seen = np.isfinite(spread) if spread.ndim == 2 else np.isfinite(spread).any(axis=0)
    problem = make_problem(_frame(lights, views, seen), chosen, fixed or {}, {})
    rows = np.flatnonzero((seen & (above_horizon(lights) & above_horizon(views))[:, None]).any(1))
    count = max(1, min(jobs, len(measured)))
    chunks = [slice(c[0], c[-1] + 1) for c in np.array_split(np.arange(len(measured)), count)]
    fast = method == "separable" and separable.fits(problem)

    def work(chunk: slice) -> tuple[FloatArray, FloatArray, IntArray, BoolArray]:
        own = spread if spread.ndim == 2 else spread[chunk]
        if fast:
            return separable.solve_many(problem, measured[chunk], own, rows)
        return _solve_each(problem, measured[chunk], own, rows, method)

    try:
        if count == 1:
            parts = [work(chunks[0])]
        else:
            with ThreadPoolExecutor(count) as pool:
                parts = list(pool.map(work, chunks))
    except ValueError as error:
        raise _unusable(measured, spread) or error from error
    internal, costs, evaluations, converged = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    values = np.array(
        [
            column
            if p.transform is IDENTITY
            else [p.transform.to_published(x) for x in column.tolist()]
            for p, column in zip(chosen.parameters, internal.T, strict=True)
        ]
    ).T
    unmeasured = set(range(values.shape[1])) - set(problem.free) - set(problem.fixed)
    values[:, sorted(unmeasured)] = np.nan
    return ParameterBatch(
        model=chosen.name,
        parameter_names=chosen.parameter_names,
        values=values,
        chi_square=2 * costs,
        evaluations=evaluations,
        converged=converged,
    )


def _frame(lights: FloatArray, views: FloatArray, seen: BoolArray) -> Observations:
    """Return observations with the batch's directions and mask; their radiance is not used."""
    n = len(lights)
    return Observations(
        light_direction=lights,
        view_direction=views,
        radiance=np.zeros((n, 3)),
        variance=np.ones((n, 3)),
        valid=seen,
        camera=np.ones(n, dtype=np.int64),
        sweep=np.ones(n, dtype=np.int64),
        exposure_ms=np.ones(n),
        time_s=np.zeros(n),
    )


def _unusable(measured: FloatArray, spread: FloatArray) -> ValueError | None:
    """Return what says which value, if any, can't be used."""
    if not (spread > 0).all():
        where = tuple(int(i) for i in np.argwhere(~(spread > 0))[0])
        return ValueError(f"variance{list(where)} is {spread[where]}; it must be above 0")
    bad = ~np.isfinite(measured) & np.isfinite(spread)
    if bad.any():
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        return ValueError(
            f"radiance{list(where)} is {measured[where]}; give values that can't be used an "
            f"infinite variance ({int(bad.sum())} such values)"
        )
    return None


def _in_order(problem: Problem, internal: FloatArray) -> FloatArray:
    """Return coordinates (p,) with lobes of one kind in order, as `fit_scan` has them."""
    order = lobe_order(problem, internal)
    return internal if order is None else internal[order]


def _solve_each(
    problem: Problem, measured: FloatArray, spread: FloatArray, rows: IntArray, method: str
) -> tuple[FloatArray, FloatArray, IntArray, BoolArray]:
    problems = []
    for values, variance in zip(measured, np.broadcast_to(spread, measured.shape), strict=True):
        if (fault := _unusable(values, variance)) is not None:
            raise fault
        weight = 1 / np.sqrt(variance[rows].T)
        radiance = np.where(weight > 0, values[rows].T, 0.0)
        problems.append(replace(problem, radiance=radiance, weight=weight))
    solutions = [SOLVERS[method](each) for each in problems]
    return (
        np.array([_in_order(problem, s.internal) for s in solutions]),
        np.array([p.cost(s.internal) for p, s in zip(problems, solutions, strict=True)]),
        np.array([s.evaluations for s in solutions], dtype=np.int64),
        np.ones(len(solutions), dtype=bool),
    )
