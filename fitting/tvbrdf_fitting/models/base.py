"""What every reflectance model is: parameters, BRDF, derivatives, and the solver's view of them.

Two sets of coordinates describe the same parameters. *Published* values are those of the database's
files (sigma_d in radians, 1/sigma_s). *Internal* ones are what a solver steps in: sigma_d squared
(in sigma_d itself, 0 is a false stationary point), log(1/sigma_s), artanh(g).

Inside, arrays are channel first and contiguous: a value is (3, n), or (1, n) where the channels
share it, a Jacobian (p, 3, n). The public methods take and give (n, 3) and (n, 3, p).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import CHANNELS, FloatArray, paired

if TYPE_CHECKING:
    from .lobe import Twin


@dataclass(frozen=True)
class Transform:
    """How a published value becomes an internal one.

    Attributes
    ----------
    label
        Format of the internal name, as in "{}^2".
    to_internal, to_published
        The map and its inverse; the inverse takes values outside the bounds.
    slope
        d internal / d published at a published value.
    """

    label: str
    to_internal: Callable[[float], float]
    to_published: Callable[[float], float]
    slope: Callable[[float], float]


IDENTITY = Transform("{}", lambda v: v, lambda x: x, lambda _: 1.0)
SQUARE = Transform("{}^2", lambda v: v * v, lambda x: math.sqrt(max(x, 0.0)), lambda v: 2.0 * v)
LOG = Transform("log({})", math.log, math.exp, lambda v: 1.0 / v)
ARTANH = Transform("artanh({})", math.atanh, math.tanh, lambda v: 1.0 / ((1.0 - v) * (1.0 + v)))


@dataclass(frozen=True)
class Parameter:
    """One number of a model.

    Attributes
    ----------
    name, unit
        Published name and unit.
    lower, upper
        Bounds of a fit, published units. Evaluation is allowed outside.
    transform
        Map to the internal coordinate.
    channel
        0, 1, 2 for B, G, R where the parameter belongs to one channel; None where all share it.
    carried_by
        Groups of parameters: unless each group has a member that is significantly above 0, the data
        cannot determine this one (a lobe's width without its amplitude).
    grid
        Internal values that a coarse search tries; empty for amplitudes.
    full_scale
        Standard deviation (internal) above which the data say nothing useful of the parameter.
    typical
        A published value as met in practice, for examples and checks.
    """

    name: str
    unit: str
    lower: float
    upper: float
    transform: Transform = IDENTITY
    channel: int | None = None
    carried_by: tuple[tuple[str, ...], ...] = ()
    grid: tuple[float, ...] = ()
    full_scale: float = math.inf
    typical: float = 0.5

    @property
    def internal_name(self) -> str:
        """Name of the internal coordinate."""
        return self.transform.label.format(self.name)

    def one_a_channel(self) -> tuple[Parameter, ...]:
        """Return three copies of the parameter, `name_b`, `name_g` and `name_r`."""
        return tuple(
            replace(self, name=f"{self.name}_{letter}", channel=index)
            for index, letter in enumerate(CHANNELS)
        )


@dataclass(frozen=True)
class Term:
    """A part of a model that is an amplitude times a vector fixed by the shape parameters.

    A coarse search (and later a separable solver) uses it: the BRDF is the sum over terms of
    amplitude x vector.

    Attributes
    ----------
    amplitudes
        One name (shared by the channels) or three (one a channel).
    shapes
        Names of the shape parameters that the vector depends on.
    vector
        `vector(prepared, shape values (internal), typical amplitude) -> (n,)`. The typical
        amplitude stands in where a term is not quite linear (Oren-Nayar's inter-reflection).
    """

    amplitudes: tuple[str, ...]
    shapes: tuple[str, ...]
    vector: Callable[[Any, Sequence[float], float], FloatArray]


class ReflectanceModel(ABC):
    """A BRDF with named parameters and analytic derivatives.

    Subclasses give `name`, `parameters`, `terms`, and the three methods on internal coordinates.
    """

    name: str
    parameters: tuple[Parameter, ...]
    terms: tuple[Term, ...]
    confounded: tuple[tuple[str, str], ...] = ()
    """Pairs that data may be unable to tell apart; checked by their correlation after a fit."""
    twins: tuple[tuple[Twin, ...], ...] = ()
    """Lobes of one kind, kind by kind: any two of them may change places."""
    diffuse: bool = False
    """True for what scatters below a layer of dust, False for a lobe on the surface."""
    reciprocal: bool = True
    """False where exchanging light and view changes the BRDF, by the model's definition."""
    nonnegative: bool = True
    """False where the formula itself can go below 0 within the bounds."""
    isotropic: bool = True
    """False where turning light and view together about the normal changes the BRDF."""
    delta: bool = False
    """True for an ideal mirror or refraction: a renderer's, which no fit can use."""

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names in the published order."""
        return tuple(p.name for p in self.parameters)

    @cached_property
    def units(self) -> dict[str, str]:
        """Unit of each parameter."""
        return {p.name: p.unit for p in self.parameters}

    @cached_property
    def typical(self) -> FloatArray:
        """Published values (p,) as met in practice."""
        return np.array([p.typical for p in self.parameters])

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds (p,) of a fit, published units."""
        lower = np.array([p.lower for p in self.parameters])
        return lower, np.array([p.upper for p in self.parameters])

    @cached_property
    def internal_names(self) -> tuple[str, ...]:
        """Names of the internal coordinates."""
        return tuple(p.internal_name for p in self.parameters)

    @cached_property
    def internal_bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds (p,) of a fit, internal coordinates."""
        lower, upper = self.bounds
        return self.to_internal(lower), self.to_internal(upper)

    def to_internal(self, parameters: ArrayLike) -> FloatArray:
        """Internal coordinates (p,) of published values (p,)."""
        values = self._values(parameters)
        pairs = zip(self.parameters, values.tolist(), strict=True)
        try:
            return np.array([p.transform.to_internal(v) for p, v in pairs])
        except ValueError:
            raise ValueError(
                f"{self.name}: {self.as_mapping(values)} are outside the model's domain; "
                f"its bounds are {self._bounds_in_words()}"
            ) from None

    def to_published(self, internal: ArrayLike) -> FloatArray:
        """Published values (p,) of internal coordinates (p,)."""
        values = self._values(internal).tolist()
        return np.array(
            [p.transform.to_published(x) for p, x in zip(self.parameters, values, strict=True)]
        )

    def slopes(self, parameters: ArrayLike) -> FloatArray:
        """D internal / d published (p,) at published values (p,), for the chain rule."""
        values = self._values(parameters).tolist()
        return np.array(
            [p.transform.slope(v) for p, v in zip(self.parameters, values, strict=True)]
        )

    def as_mapping(self, parameters: ArrayLike) -> dict[str, float]:
        """Values (p,) by name."""
        return dict(zip(self.parameter_names, self._values(parameters).tolist(), strict=True))

    def from_mapping(self, mapping: Mapping[str, float]) -> FloatArray:
        """Return values (p,) in the model's order, from values by name; all must be there."""
        missing = [n for n in self.parameter_names if n not in mapping]
        unknown = [n for n in mapping if n not in self.parameter_names]
        if missing or unknown:
            raise ValueError(
                f"{self.name}: parameters missing: {missing}, unknown: {unknown}; "
                f"the model has {list(self.parameter_names)}"
            )
        return np.array([float(mapping[n]) for n in self.parameter_names])

    def evaluate(self, light: ArrayLike, view: ArrayLike, parameters: ArrayLike) -> FloatArray:
        """BRDF in 1/sr.

        Parameters
        ----------
        light, view
            (n, 3) unit vectors from the sample, z the normal; or one (3,) for all n.
        parameters
            (p,) published values.

        Returns
        -------
        (n, 3), channels B, G, R; 0 where light or view is not above the horizon
        """
        lights, views, above = _directions(light, view)
        value = self.value(self.prepare(lights, views), self.to_internal(parameters))
        out = np.empty((lights.shape[0], 3))
        out[:] = np.where(above, value, 0.0).T
        return out

    def jacobian(self, light: ArrayLike, view: ArrayLike, parameters: ArrayLike) -> FloatArray:
        """Return the derivatives (n, 3, p) of `evaluate` by the published parameters."""
        lights, views, above = _directions(light, view)
        out = np.zeros((len(self.parameters), 3, lights.shape[0]))
        self.add_jacobian(self.prepare(lights, views), self.to_internal(parameters), out)
        out *= above
        out *= self.slopes(parameters)[:, None, None]
        return np.ascontiguousarray(out.transpose(2, 1, 0))

    def refuse(self, light: FloatArray, view: FloatArray) -> str | None:
        """Return why directions (n, 3) cannot determine this model's parameters, or None.

        For what no fit of such data can see; what only noise hides is found by the covariance.
        """
        if self.delta:
            return "an ideal mirror or refraction has no BRDF value that a camera could measure"
        return None

    @abstractmethod
    def prepare(self, light: FloatArray, view: FloatArray) -> Any:
        """Everything that depends on the directions (n, 3) alone; all must be above the horizon."""

    @abstractmethod
    def value(self, prepared: Any, internal: FloatArray) -> FloatArray:
        """BRDF (3, n), or (1, n) where the channels share it, at internal coordinates (p,).

        Defined, finite and smooth also just outside the bounds, so that an unbounded solver may
        step there and come back.
        """

    @abstractmethod
    def add_jacobian(self, prepared: Any, internal: FloatArray, out: FloatArray) -> None:
        """Write the derivatives by the internal coordinates into `out` (p, 3, n), given as zeros.

        Zeros that the model leaves are derivatives that vanish.
        """

    def _bounds_in_words(self) -> str:
        return ", ".join(f"{p.name} {p.lower:.4g} to {p.upper:.4g}" for p in self.parameters)

    def _values(self, values: ArrayLike) -> FloatArray:
        array = np.asarray(values, dtype=np.float64)
        if array.shape != (len(self.parameters),):
            raise ValueError(
                f"{self.name}: parameters have shape {array.shape}, expected "
                f"({len(self.parameters)},) for {list(self.parameter_names)}"
            )
        return array


def _directions(light: ArrayLike, view: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return directions (n, 3) with the hidden ones replaced by the normal, and a mask (n,)."""
    lights, views = paired(light, view)
    above = (lights[:, 2] > 0) & (views[:, 2] > 0)
    if not above.all():
        normal = np.array([0.0, 0.0, 1.0])
        lights = np.where(above[:, None], lights, normal)
        views = np.where(above[:, None], views, normal)
    return lights, views, above.astype(np.float64)
