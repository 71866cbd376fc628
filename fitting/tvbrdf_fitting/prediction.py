"""What a fit says of directions that were not measured, and how sure it is.

*From the parameters.* To first order, ``variance = J C J^T`` with J the BRDF's derivatives by the
internal coordinates and C their covariance (there, deviations are closest to normal). Two things
have no first order and are not left out:

- A parameter without information (a covariance of NaN) gives an infinite deviation wherever it
  matters.
- The width of a lobe whose amplitude is 0 within its noise can be anything. Then the deviation is
  the largest over the widths that the data allow (chi-square within 1 of the best): each is held,
  and the rest fitted again. It needs the data, as a fit has them until it is pickled; without them
  the deviation is infinite wherever the lobe's amplitude matters.

*From the models.* Models that explain the data equally well differ where no data are. With weights
w_i from the information criterion (Burnham and Anderson, "Model Selection and Multimodel
Inference", 2002, sections 2.9 and 6.4), ``value = sum w_i value_i`` and ``variance = sum w_i
(variance_i + (value_i - value)^2)``: within models plus between them.

Neither holds what *all* models get wrong. Where noise does not explain what a model leaves, the fit
states the model's own error (`FitResult.model_error_std`), one number for the whole scan; it is
given apart, as a deviation of the BRDF. In the metric "radiance" peaks decide it, and it overstates
what is wrong elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .choice.choose import ModelChoice
from .choice.ladder import DEFAULT_LADDER, Scan, as_ladder, find
from .choice.rule import DECISIVE
from .geometry import BoolArray, FloatArray
from .half_angle import unit_pairs
from .inference.nuisances import CommonErrors
from .inference.posterior import Posterior, maximise
from .inference.uncertainty import estimate
from .models import ReflectanceModel, get_model
from .observations import Observations
from .result import FitResult

_ALLOWED = 0.5
"""Rise of the cost, half of chi-square, up to which the data allow a lobe's width."""
_MATTERS = 1e-12
"""A derivative below this part of the largest value is rounding."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """A BRDF in n directions, channels B, G, R, in 1/sr; 0 below the horizon.

    Attributes
    ----------
    value
        (n, 3); NaN for a channel that was not measured.
    standard_deviation
        (n, 3) of parameters and models together; infinite where nothing is known.
    from_parameters, from_models
        (n, 3) the two, see the module's header.
    model_error
        (n, 3) what a measured value would differ by besides; 0 where noise explains the data.
    """

    value: FloatArray
    standard_deviation: FloatArray
    from_parameters: FloatArray
    from_models: FloatArray
    model_error: FloatArray

    @property
    def relative(self) -> FloatArray:
        """(n,) standard deviation over value, of the three channels together (root mean square).

        A dark channel of a coloured sample does not decide it. NaN below the horizon, infinite
        where nothing is known of a channel or the value is 0.
        """
        size = np.sqrt(np.square(np.nan_to_num(self.value)).sum(axis=1))
        deviation = np.sqrt(np.square(self.standard_deviation).sum(axis=1))
        nothing = (size == 0) & (deviation == 0)
        with np.errstate(divide="ignore"):
            quotient = deviation / np.where(nothing, np.nan, size)
        return np.asarray(quotient)


@dataclass(frozen=True, eq=False)
class Contender:
    """A fit, and its weight among those that explain the data as well; weights add up to 1."""

    result: FitResult
    weight: float


def predict(result: FitResult, light: ArrayLike, view: ArrayLike) -> Prediction:
    """Return the BRDF of a fit in any directions, with its standard deviation.

    Parameters
    ----------
    result
        Of `fit_scan`.
    light, view
        (n, 3) unit vectors in the sample's frame, or one (3,) for all n.

    Raises
    ------
    ValueError
        Other shapes, or no unit vectors.
    """
    directions = _Directions(get_model(result.model), light, view)
    here = result.internal_values
    value = directions.value(here)
    deviation = _by_covariance(result, directions, value)
    # a lobe out of sight can have an amplitude of 1e200, whose square is as good as infinite
    with np.errstate(over="ignore"):
        for index in _undetermined_shapes(result, directions.model):
            for internal, covariance in _widths(result, index):
                moved = directions.value(internal) - value
                variance = _variance(directions.slopes(internal), covariance) + np.square(moved)
                deviation = np.fmax(deviation, np.sqrt(variance))
    deviation = np.where(np.isnan(value), np.inf, deviation)
    error = np.nan_to_num(_model_error(result, directions, value))
    value, deviation, error = (
        np.where(directions.above, array, 0.0) for array in (value, deviation, error)
    )
    return _whole(value, deviation, np.zeros(value.shape), error)


def predict_over_models(
    fits: Sequence[FitResult] | Sequence[Contender], light: ArrayLike, view: ArrayLike
) -> Prediction:
    """Return the weighted mean of several models' BRDFs, with the spread within and between them.

    Parameters
    ----------
    fits
        Fits of the same data, which `weigh` weighs; or `contenders` of a model choice.
    light, view
        As for `predict`.

    Raises
    ------
    ValueError
        No fits, or fits of different data; directions as for `predict`.
    """
    chosen = [f for f in fits if isinstance(f, Contender)]
    if not chosen:
        chosen = [*weigh([f for f in fits if isinstance(f, FitResult)])]
    parts = [predict(c.result, light, view) for c in chosen]
    weight = np.array([c.weight for c in chosen])[:, None, None]

    def root_mean(arrays: Iterable[FloatArray]) -> FloatArray:
        return np.asarray(np.sqrt((weight * np.square(np.stack([*arrays]))).sum(axis=0)))

    values = np.stack([part.value for part in parts])
    value = (weight * values).sum(axis=0)
    return _whole(
        value.T,
        root_mean(part.from_parameters for part in parts).T,
        root_mean(np.nan_to_num(values - value)).T,
        root_mean(part.model_error for part in parts).T,
    )


def weigh(results: Sequence[FitResult]) -> tuple[Contender, ...]:
    """Weigh fits of the same data by Schwarz's criterion, and leave out those clearly worse.

    ``chi-square / c + k ln n`` with k free parameters of n values; c, at least 1, is what the best
    fit leaves per degree of freedom (Burnham and Anderson's variance factor). Weights are
    ``exp(-difference / 2)``; differences of `choice.rule.DECISIVE` and more are left out.

    Raises
    ------
    ValueError
        No fits, or of different values, metrics or losses.
    """
    if not results:
        raise ValueError("no fits to weigh")
    free = [_free_count(result) for result in results]
    counts = [r.degrees_of_freedom + k for r, k in zip(results, free, strict=True)]
    kinds = {(n, r.metric, r.loss) for r, n in zip(results, counts, strict=True)}
    if len(kinds) > 1:
        told = "; ".join(f"{n} values, {metric}, {loss}" for n, metric, loss in sorted(kinds))
        raise ValueError(f"fits of different data, metrics or losses can't be weighed: {told}")
    factor = max(1.0, min(r.chi_square / max(r.degrees_of_freedom, 1) for r in results))
    size = math.log(max(counts[0], 1))
    criteria = [r.chi_square / factor + k * size for r, k in zip(results, free, strict=True)]
    lowest = min(criteria)
    return _weighted({r: c - lowest for r, c in zip(results, criteria, strict=True)})


def contenders(
    choice: ModelChoice,
    observations: Observations,
    *,
    ladder: Mapping[Any, Iterable[Any]] | Sequence[Any] = DEFAULT_LADDER,
    common_errors: CommonErrors | None = None,
) -> tuple[Contender, ...]:
    """Return the fits that explain a scan as well as the one that was kept.

    Those are the rungs whose criterion is less than `choice.rule.DECISIVE` above the kept one's: of
    all that were tried for the choice, and of those with as many parameters, as another shape of
    lobe, that need not have been. One with a lower criterion counts the same as the kept one: by
    the rule the difference does not decide, or what it adds is no highlight.

    Parameters
    ----------
    choice
        Of `choose_model`, or of `choose_for_series` for one scan.
    observations
        The scan.
    ladder, common_errors
        As they were for the choice.

    Returns
    -------
    The kept one first.

    Raises
    ------
    ValueError
        A rung of the choice is not on the ladder.
    """
    rungs, result = as_ladder(ladder), choice.result
    options = {"metric": result.metric, "loss": result.loss, "common_errors": common_errors}
    scan = Scan(observations, options)
    kept = find(rungs, choice.model)
    criterion = next(rung.criterion for rung in choice.rungs if rung.model == choice.model)
    near = {r.model for r in choice.rungs if r.criterion < criterion + DECISIVE}
    for candidate in rungs:
        if candidate.label in near or candidate.size == kept.size or candidate is kept:
            scan.fit(candidate)
    criteria = scan.weigh().criteria
    above = {result: 0.0}
    for candidate, trial in scan.fitted.items():
        if candidate != kept:
            above[trial.fit] = max(criteria[candidate] - criteria[kept], 0.0)
    return _weighted(above)


def _weighted(differences: Mapping[FitResult, float]) -> tuple[Contender, ...]:
    weight = {r: math.exp(-0.5 * d) for r, d in differences.items() if d < DECISIVE}
    total = sum(weight.values())
    return tuple(Contender(r, w / total) for r, w in weight.items())


def _free_count(result: FitResult) -> int:
    if result.optimum is not None:
        return len(result.optimum.posterior.problem.free)
    measured = np.isfinite(result.values)
    free = {n for n, seen in zip(result.parameter_names, measured, strict=True) if seen}
    return len(free - set(result.tied) - set(result.fixed))


def _whole(
    value: FloatArray, parameters: FloatArray, models: FloatArray, error: FloatArray
) -> Prediction:
    """Return a prediction from arrays (3, n)."""
    total = np.hypot(parameters, models)
    return Prediction(
        *(np.ascontiguousarray(a.T) for a in (value, total, parameters, models, error))
    )


class _Directions:
    """A model in n directions, in internal coordinates; arrays are (3, n)."""

    def __init__(self, model: ReflectanceModel, light: ArrayLike, view: ArrayLike) -> None:
        lights, views = unit_pairs(light, view)
        above = (lights[:, 2] > 0) & (views[:, 2] > 0)
        normal = np.array([0.0, 0.0, 1.0])
        self.model = model
        self.above: BoolArray = above
        self._light = np.where(above[:, None], lights, normal)
        self._view = np.where(above[:, None], views, normal)

    @cached_property
    def _prepared(self) -> Any:
        return self.model.prepare(self._light, self._view)

    @property
    def cosine(self) -> FloatArray:
        """Cosine of the light's angle; of a reciprocal model the larger one of light and view."""
        light, view = self._light[:, 2], self._view[:, 2]
        return np.maximum(light, view) if self.model.reciprocal else light

    def value(self, internal: FloatArray) -> FloatArray:
        """BRDF."""
        value = self.model.value(self._prepared, internal)
        return np.array(np.broadcast_to(value, (3, len(self.above))))

    def slopes(self, internal: FloatArray) -> FloatArray:
        """Return the derivatives (p, 3, n) by the internal coordinates."""
        out = np.zeros((len(internal), 3, len(self.above)))
        self.model.add_jacobian(self._prepared, internal, out)
        return out


def _by_covariance(result: FitResult, directions: _Directions, value: FloatArray) -> FloatArray:
    """Deviation (3, n) to first order, infinite where a parameter without information matters."""
    model, covariance = directions.model, result.internal_covariance
    slopes = np.nan_to_num(directions.slopes(result.internal_values))
    widths = _undetermined_shapes(result, model)
    deviations = np.sqrt(np.diag(covariance))
    for index in widths:
        if not deviations[index] < model.parameters[index].full_scale:  # also where it is NaN
            slopes[index] = 0.0  # too far for a slope: all its widths are looked at
    deviation = np.sqrt(_variance(slopes, covariance))
    smallest = _MATTERS * float(np.nanmax(np.abs(value), initial=0.0))
    for index, parameter in enumerate(model.parameters):
        if index in widths or not np.isnan(deviations[index]):
            continue
        # with its carrier at 0 a parameter has no slope; unless the carrier is known to be 0, the
        # parameter would matter where the carrier does
        carriers = [model.parameter_names.index(n) for g in parameter.carried_by for n in g]
        unsure = [i for i in carriers if deviations[i] != 0]
        deviation[np.abs(slopes[[index, *unsure]]).max(axis=0) > smallest] = np.inf
        if unsure and parameter.grid:  # and it would matter elsewhere with another value
            for other in parameter.grid:
                internal = result.internal_values.copy()
                internal[index] = other
                reach = np.abs(directions.slopes(internal)[unsure]).max(axis=0)
                deviation[reach > smallest] = np.inf
    return np.asarray(deviation)


def _variance(slopes: FloatArray, covariance: FloatArray) -> FloatArray:
    """J C J^T (3, n) of derivatives (p, 3, n), leaving out what has no covariance."""
    deviation = np.sqrt(np.nan_to_num(np.diag(covariance)))
    known = np.flatnonzero(deviation > 0)
    scale = deviation[known]
    # as a sum of squares, which rounding can't make negative; of correlations, which are of size 1
    size, axes = np.linalg.eigh(covariance[np.ix_(known, known)] / np.outer(scale, scale))
    root = axes * np.sqrt(np.maximum(size, 0.0)) * scale[:, None]
    with np.errstate(over="ignore"):  # as good as infinite
        return np.asarray(np.square(np.tensordot(root.T, slopes[known], axes=1)).sum(axis=0))


def _undetermined_shapes(result: FitResult, model: ReflectanceModel) -> list[int]:
    """Widths and the like that the data do not determine, of fits that still have their data."""
    if result.optimum is None:
        return []
    free = result.optimum.posterior.problem.free
    return [
        i
        for i, parameter in enumerate(model.parameters)
        if i in free and parameter.grid and parameter.name in result.undetermined
    ]


def _widths(result: FitResult, index: int) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield coordinates and covariance for each value of a shape parameter that the data allow."""
    optimum = result.optimum
    if optimum is None:
        return
    posterior = optimum.posterior
    problem = posterior.problem
    held = replace(
        problem,
        free=tuple(i for i in problem.free if i != index),
        fixed=problem.fixed | {index},
    )
    within = Posterior(held, posterior.nuisances)
    for value in (float(optimum.internal[index]), *problem.model.parameters[index].grid):
        if not problem.lower[index] <= value <= problem.upper[index]:
            continue
        internal = optimum.internal.copy()
        internal[index] = value
        found = maximise(within, within.point(internal, optimum.values))
        if found.point.cost <= optimum.cost + _ALLOWED:
            uncertainty = estimate(held, posterior.nuisances, found.linearised)
            yield held.whole(found.point.internal), uncertainty.random + uncertainty.common


def _model_error(result: FitResult, directions: _Directions, value: FloatArray) -> FloatArray:
    """The model's own error (3, n) as a deviation of the BRDF.

    In "radiance" it is one number of pi BRDF cos(theta_i), in "cosine_weighted" of that by the root
    of the cosine (`metrics`). A reciprocal BRDF is also measured with light and view exchanged: the
    steeper of the two counts.
    """
    error = result.model_error_std
    if result.metric in {"log", "relative"}:
        return np.asarray(error * np.abs(value))
    power = 1.5 if result.metric == "cosine_weighted" else 1.0
    return np.asarray(np.broadcast_to(error / (np.pi * directions.cosine**power), value.shape))
