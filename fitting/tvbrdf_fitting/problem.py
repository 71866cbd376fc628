"""A fit as a solver sees it: weighted residuals, their Jacobian, bounds, and what may move."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .geometry import BoolArray, FloatArray
from .metrics import METRICS, Metric, make_metric
from .models import Parameter, ReflectanceModel
from .observations import Observations


class FitError(ValueError):
    """The observations or the request cannot be fitted; the message says why."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Least squares over the free internal coordinates of a model.

    Rows without a usable channel are left out; a value that is not usable has weight 0. Channel
    first: arrays are (3, n) and contiguous.

    With the metric "log" residuals are not linear in the radiance. They are given in its units, so
    that `radiance` and `weight` are the linear problem that agrees with them to first order: what a
    coarse search needs. All else must ask `residual`, `residual_of`, `slope_of`, `jacobian`,
    `cost`, which are right for every metric and for tied parameters.

    Attributes
    ----------
    model
        What is fitted.
    prepared
        The model's functions of the directions.
    to_radiance
        (n,) pi cos(theta_i), from BRDF to radiance.
    radiance, weight
        (3, n) measured radiance, and 1 / standard deviation, 0 where not usable.
    values
        (p,) internal coordinates; the fixed ones are taken from here.
    free
        (q,) indices of the coordinates that a solver moves.
    fixed
        Indices of the coordinates that are known once the free ones are: their values were given,
        or they are tied. One that is in neither belongs to a channel that was not measured.
    lower, upper
        (p,) internal bounds.
    initial
        Internal coordinates by index from which a solver must start instead of searching.
    metric
        What counts as equal misfit.
    tied
        Coordinates that follow another one: index by index. A solver need not move them: `predict`
        and all that builds on it take them from the coordinate that they follow.
    """

    model: ReflectanceModel
    prepared: Any
    to_radiance: FloatArray
    radiance: FloatArray
    weight: FloatArray
    values: FloatArray
    free: tuple[int, ...]
    fixed: frozenset[int]
    lower: FloatArray
    upper: FloatArray
    initial: Mapping[int, float] = field(default_factory=dict)
    metric: Metric = field(default_factory=Metric)
    tied: Mapping[int, int] = field(default_factory=dict)

    @property
    def separable(self) -> bool:
        """Whether residuals are linear in the model's terms, each with an amplitude of its own."""
        return self.metric.curve is None and not self.tied

    @property
    def value_count(self) -> int:
        """Number of values with a weight."""
        return int(np.count_nonzero(self.weight))

    @property
    def degrees_of_freedom(self) -> int:
        """Number of values less that of free coordinates."""
        return self.value_count - len(self.free)

    def whole(self, internal: FloatArray) -> FloatArray:
        """Coordinates (p,) with the tied ones taken from those that they follow."""
        if not self.tied:
            return internal
        out = internal.copy()
        for index, leader in self.tied.items():
            out[index] = internal[leader]
        return out

    def predict(self, internal: FloatArray) -> FloatArray:
        """Radiance (3, n) of the model at internal coordinates (p,)."""
        value = self.model.value(self.prepared, self.whole(internal)) * self.to_radiance
        return np.asarray(np.broadcast_to(value, self.radiance.shape))

    def misfit_of(self, radiance: FloatArray) -> FloatArray:
        """Residual (3, n) without weights, in units of radiance, of a predicted radiance."""
        curve = self.metric.curve
        return radiance - self.radiance if curve is None else curve.residual(radiance)

    def residual_of(self, radiance: FloatArray) -> FloatArray:
        """Weighted residual (3, n) of a predicted radiance."""
        out = self.misfit_of(radiance)
        out *= self.weight
        return out

    def slope_of(self, radiance: FloatArray) -> FloatArray:
        """Derivative (3, n) of the weighted residual by the predicted radiance."""
        curve = self.metric.curve
        return self.weight if curve is None else self.weight * curve.slope(radiance)

    def residual(self, internal: FloatArray) -> FloatArray:
        """Weighted residual (3 n,), prediction less measurement."""
        value = self.model.value(self.prepared, self.whole(internal)) * self.to_radiance
        return self.residual_of(value).ravel()

    def jacobian(self, internal: FloatArray, columns: tuple[int, ...] | None = None) -> FloatArray:
        """Return derivatives (3 n, q) of the residual by some coordinates, by default the free."""
        count = len(self.model.parameters)
        internal = self.whole(internal)
        out = np.zeros((count, *self.radiance.shape))
        self.model.add_jacobian(self.prepared, internal, out)
        for index, leader in self.tied.items():
            out[leader] += out[index]
        chosen = self.free if columns is None else columns
        if len(chosen) < count:
            out = out[list(chosen)]
        linear = self.metric.curve is None
        slope = self.weight if linear else self.slope_of(self.predict(internal))
        out *= self.to_radiance * slope
        return out.reshape(len(chosen), self.radiance.size).T

    def cost(self, internal: FloatArray) -> float:
        """Half the sum of squared weighted residuals."""
        residual = self.residual(internal)
        return 0.5 * float(residual @ residual)

    def clamp(self, internal: FloatArray) -> FloatArray:
        """Return coordinates moved inside the bounds."""
        return np.clip(internal, self.lower, self.upper)


@dataclass(frozen=True)
class Solution:
    """What a solver found.

    Attributes
    ----------
    internal
        (p,) coordinates, within the bounds.
    reason
        Why it stopped.
    solver
        What ran, in words.
    evaluations
        Residual evaluations in all.
    """

    internal: FloatArray
    reason: str
    solver: str
    evaluations: int


Solver = Callable[[Problem], Solution]


def make_problem(
    observations: Observations,
    model: ReflectanceModel,
    fixed: Mapping[str, float],
    initial: Mapping[str, float],
    *,
    metric: str = "radiance",
    bounds: Mapping[str, tuple[float, float]] | None = None,
    tied: Mapping[str, str] | None = None,
) -> Problem:
    """Return the problem of one scan.

    Parameters of a channel without any value are not free: nothing can be said of them.

    Raises
    ------
    FitError
        Unknown or impossible `fixed`, `initial`, `bounds`, `tied` or `metric`, directions that
        cannot determine the model, or fewer values than free parameters.
    """
    if metric not in METRICS:
        raise FitError(f"unknown metric {metric!r}; known metrics: {', '.join(METRICS)}")
    usable = observations.usable
    rows = np.flatnonzero(usable.any(axis=1))
    light, view = observations.light_direction[rows], observations.view_direction[rows]
    reason = model.refuse(light, view) if len(rows) else None
    if reason is not None:
        raise FitError(
            f"{model.name} cannot be fitted to these {len(rows)} directions: {reason}; "
            f"choose another model, or measure what it needs"
        )
    radiance, variance = observations.radiance[rows].T, observations.variance[rows].T
    chosen, mask = make_metric(metric, light, view, radiance, variance, usable[rows].T)
    lower, upper = _narrowed(model, bounds or {})
    known = _named_internal(model, fixed, "fixed", lower, upper)
    followers = _tied(model, tied or {}, {*fixed, *initial, *(bounds or {})})
    seen = [bool(channel.any()) for channel in mask]
    free = tuple(
        index
        for index in range(len(model.parameters))
        if index not in known
        and index not in followers
        and _has_data(model, index, followers, seen)
    )
    values = np.clip(model.to_internal([_placeholder(p) for p in model.parameters]), lower, upper)
    for index, value in known.items():
        values[index] = value
    count = int(mask.sum())
    if count < len(free) or not count:
        raise FitError(
            f"{count} usable values cannot determine {len(free)} free parameters of {model.name} "
            f"({', '.join(model.parameter_names[i] for i in free)}); of {len(observations)} rows "
            f"{len(rows)} have a usable channel{_lost(usable, count, metric)}: check masks and the "
            f"horizon, or fix parameters"
        )
    return Problem(
        model=model,
        prepared=model.prepare(light, view),
        to_radiance=np.pi * light[:, 2],
        radiance=_masked(radiance, mask),
        weight=_masked(1 / np.sqrt(np.where(mask, variance, 1.0)), mask),
        values=values,
        free=free,
        fixed=frozenset({*known, *followers}),
        lower=lower,
        upper=upper,
        initial=_named_internal(model, initial, "initial", lower, upper),
        metric=chosen,
        tied=followers,
    )


def _masked(array: FloatArray, mask: BoolArray) -> FloatArray:
    return np.ascontiguousarray(np.where(mask, array, 0.0))


def _placeholder(parameter: Parameter) -> float:
    return 0.0 if parameter.lower <= 0.0 <= parameter.upper else parameter.lower


def _has_data(
    model: ReflectanceModel, index: int, tied: Mapping[int, int], seen: list[bool]
) -> bool:
    """Whether a channel of a parameter, or of one that follows it, has any value."""
    group = [index, *(follower for follower, leader in tied.items() if leader == index)]
    channels = [model.parameters[i].channel for i in group]
    return any(channel is None or seen[channel] for channel in channels)


def _lost(usable: BoolArray, count: int, metric: str) -> str:
    left_out = int(usable.sum()) - count
    return f", but the metric {metric!r} leaves out {left_out} values" if left_out else ""


def _index(model: ReflectanceModel, name: str, what: str) -> int:
    if name not in model.parameter_names:
        raise FitError(
            f"{what}: {model.name} has no parameter {name!r}; "
            f"it has {', '.join(model.parameter_names)}"
        )
    return model.parameter_names.index(name)


def _narrowed(
    model: ReflectanceModel, bounds: Mapping[str, tuple[float, float]]
) -> tuple[FloatArray, FloatArray]:
    """Return internal bounds, some of them narrowed to published ones; infinite means no more."""
    lower, upper = (bound.copy() for bound in model.internal_bounds)
    for name, interval in bounds.items():
        index = _index(model, name, "bounds")
        parameter = model.parameters[index]
        low, high = (float(bound) for bound in interval)
        low = parameter.lower if low == -np.inf else low
        high = parameter.upper if high == np.inf else high
        if not (parameter.lower <= low and high <= parameter.upper):
            raise FitError(
                f"bounds: {name} in [{low:.6g}, {high:.6g}] leaves the range of {model.name}, "
                f"[{parameter.lower:.6g}, {parameter.upper:.6g}] {parameter.unit}"
            )
        if not low < high:
            raise FitError(
                f"bounds: {name} in [{low:.6g}, {high:.6g}] is empty or a single value; "
                f"use fixed for a known value"
            )
        lower[index] = parameter.transform.to_internal(low)
        upper[index] = parameter.transform.to_internal(high)
    return lower, upper


def _tied(model: ReflectanceModel, tied: Mapping[str, str], requested: set[str]) -> dict[int, int]:
    followers: dict[int, int] = {}
    for name, leader in tied.items():
        index, other = _index(model, name, "tied"), _index(model, leader, "tied")
        one, two = model.parameters[index], model.parameters[other]
        if leader in tied or index == other:
            raise FitError(f"tied: {name} follows {leader}, which must itself be free or fixed")
        if name in requested:
            raise FitError(f"tied: {name} follows {leader}; fix, bound or start {leader} instead")
        if (one.transform, one.unit, one.lower, one.upper) != (
            two.transform,
            two.unit,
            two.lower,
            two.upper,
        ):
            raise FitError(f"tied: {name} and {leader} are not of one kind")
        followers[index] = other
    return followers


def _named_internal(
    model: ReflectanceModel,
    given: Mapping[str, float],
    what: str,
    lower: FloatArray,
    upper: FloatArray,
) -> dict[int, float]:
    chosen: dict[int, float] = {}
    for name, value in given.items():
        index, number = _index(model, name, what), float(value)
        parameter = model.parameters[index]
        low, high = (parameter.transform.to_published(b[index]) for b in (lower, upper))
        # a rounding's width: a bound read back from a file with few digits must be accepted
        slack = 1e-9 * max(1.0, abs(number))
        if not low - slack <= number <= high + slack:
            raise FitError(
                f"{what}: {name} = {value} is outside [{low:.6g}, {high:.6g}] {parameter.unit}"
            )
        inside = min(max(number, parameter.lower), parameter.upper)
        chosen[index] = min(
            max(parameter.transform.to_internal(inside), lower[index]), upper[index]
        )
    return chosen
