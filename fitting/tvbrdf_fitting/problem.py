"""A fit as a solver sees it: weighted residuals, their Jacobian, bounds, and what may move."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .geometry import BoolArray, FloatArray
from .models import ReflectanceModel
from .observations import Observations


class FitError(ValueError):
    """The observations or the request cannot be fitted; the message says why."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Least squares over the free internal coordinates of a model.

    Rows without a usable channel are left out; a value that is not usable has weight 0. Channel
    first: arrays are (3, n) and contiguous.

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
        Indices of the coordinates whose values were given. One that is in neither belongs to a
        channel that was not measured.
    lower, upper
        (p,) internal bounds.
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
    """Internal coordinates by index from which a solver must start instead of searching."""

    @property
    def value_count(self) -> int:
        """Number of values with a weight."""
        return int(np.count_nonzero(self.weight))

    @property
    def degrees_of_freedom(self) -> int:
        """Number of values less that of free coordinates."""
        return self.value_count - len(self.free)

    def predict(self, internal: FloatArray) -> FloatArray:
        """Radiance (3, n) of the model at internal coordinates (p,)."""
        value = self.model.value(self.prepared, internal) * self.to_radiance
        return np.asarray(np.broadcast_to(value, self.radiance.shape))

    def residual(self, internal: FloatArray) -> FloatArray:
        """Weighted residual (3 n,), prediction less measurement."""
        out = self.model.value(self.prepared, internal) * self.to_radiance - self.radiance
        out *= self.weight
        return out.ravel()

    def jacobian(self, internal: FloatArray, columns: tuple[int, ...] | None = None) -> FloatArray:
        """Return derivatives (3 n, q) of the residual by some coordinates, by default the free."""
        count = len(self.model.parameters)
        out = np.zeros((count, *self.radiance.shape))
        self.model.add_jacobian(self.prepared, internal, out)
        chosen = self.free if columns is None else columns
        if len(chosen) < count:
            out = out[list(chosen)]
        out *= self.to_radiance * self.weight
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
) -> Problem:
    """Return the problem of one scan.

    Parameters of a channel without any usable value are not free: nothing can be said of them.

    Raises
    ------
    FitError
        Unknown or impossible `fixed` or `initial` values, or fewer values than free parameters.
    """
    usable = observations.usable
    rows = np.flatnonzero(usable.any(axis=1))
    light, view = observations.light_direction[rows], observations.view_direction[rows]
    mask = usable[rows].T
    seen = [bool(channel.any()) for channel in mask]
    fixed_internal = _named_internal(model, fixed, "fixed")
    free = tuple(
        index
        for index, p in enumerate(model.parameters)
        if index not in fixed_internal and (p.channel is None or seen[p.channel])
    )
    values = model.to_internal(np.array([_placeholder(p.lower, p.upper) for p in model.parameters]))
    for index, value in fixed_internal.items():
        values[index] = value
    count = int(mask.sum())
    if count < len(free) or not count:
        raise FitError(
            f"{count} usable values cannot determine {len(free)} free parameters of {model.name} "
            f"({', '.join(model.parameter_names[i] for i in free)}); of {len(observations)} rows "
            f"{len(rows)} have a usable channel: check masks and the horizon, or fix parameters"
        )
    lower, upper = model.internal_bounds
    return Problem(
        model=model,
        prepared=model.prepare(light, view),
        to_radiance=np.pi * light[:, 2],
        radiance=_masked(observations.radiance[rows].T, mask),
        weight=_masked(1 / np.sqrt(np.where(mask, observations.variance[rows].T, 1.0)), mask),
        values=values,
        free=free,
        fixed=frozenset(fixed_internal),
        lower=lower,
        upper=upper,
        initial=_named_internal(model, initial, "initial"),
    )


def _masked(array: FloatArray, mask: BoolArray) -> FloatArray:
    return np.ascontiguousarray(np.where(mask, array, 0.0))


def _placeholder(lower: float, upper: float) -> float:
    return 0.0 if lower <= 0.0 <= upper else lower


def _named_internal(
    model: ReflectanceModel, given: Mapping[str, float], what: str
) -> dict[int, float]:
    unknown = [name for name in given if name not in model.parameter_names]
    if unknown:
        raise FitError(
            f"{what}: {model.name} has no parameter {', '.join(map(repr, unknown))}; "
            f"it has {', '.join(model.parameter_names)}"
        )
    chosen: dict[int, float] = {}
    for name, value in given.items():
        index = model.parameter_names.index(name)
        parameter, number = model.parameters[index], float(value)
        # a rounding's width: a bound read back from a file with few digits must be accepted
        slack = 1e-9 * max(1.0, abs(number))
        if not parameter.lower - slack <= number <= parameter.upper + slack:
            raise FitError(
                f"{what}: {name} = {value} is outside [{parameter.lower:.6g}, "
                f"{parameter.upper:.6g}] {parameter.unit}"
            )
        inside = min(max(number, parameter.lower), parameter.upper)
        chosen[index] = parameter.transform.to_internal(inside)
    return chosen
