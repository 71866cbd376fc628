"""Analytic materials that change with time, as scenes use them and fits are tested against.

Source: Sun, Sunkavalli, Ramamoorthi, Belhumeur, Nayar, "Time-Varying BRDFs", the sections on
drying paint, drying wet surfaces and dust. Time runs in seconds from the start of the process
(paint put on, water sprayed, dust begins to settle); rates are per minute, as in the paper.
Earlier times have the values of time 0.

Transfer, as in the paper: `dataclasses.replace` the colours or the specular values of a material
and keep its course in time.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from .geometry import CHANNELS, FloatArray
from .models import DUST, SURFACE, get_model

Colour = tuple[float, float, float]
"""B, G, R."""

_ANY = (-math.inf, math.inf)
_NOT_NEGATIVE = (0.0, math.inf)
_POSITIVE = (math.nextafter(0.0, 1.0), math.inf)


@dataclass(frozen=True)
class TimeVaryingMaterial(ABC):
    """A material whose published parameters are functions of time."""

    kind: ClassVar[str]
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {}
    """Smallest and largest value allowed of each field that is a number or a colour."""

    def __post_init__(self) -> None:
        colours = {f.name for f in fields(self) if f.type == "Colour"}
        for name, (low, high) in self.ranges.items():
            value = getattr(self, name)
            check = _colour if name in colours else _number
            checked = check(self.kind, name, value)
            object.__setattr__(self, name, checked)
            numbers = checked if isinstance(checked, tuple) else (checked,)
            if not all(low <= number <= high for number in numbers):
                wanted = "positive" if low == _POSITIVE[0] else f"in [{low:g}, {high:g}]"
                raise ValueError(f"{self.kind}: {name} = {value} must be {wanted}")

    @property
    @abstractmethod
    def model(self) -> str:
        """Name of the reflectance model that the parameters belong to."""

    @abstractmethod
    def parameters_at(self, time_s: float) -> dict[str, float]:
        """Published parameters by name, in the model's order, at a time in seconds."""

    def brdf(self, light: ArrayLike, view: ArrayLike, time_s: ArrayLike) -> FloatArray:
        """BRDF in 1/sr.

        Parameters
        ----------
        light, view
            (n, 3) unit vectors in the sample's frame.
        time_s
            Seconds since the start: one for all, or (n,), one for each direction.

        Returns
        -------
        (n, 3), channels B, G, R
        """
        model = get_model(self.model)
        times = np.asarray(time_s, dtype=np.float64)
        if times.ndim == 0:
            values = model.from_mapping(self.parameters_at(float(times)))
            return model.evaluate(light, view, values)
        lights, views = np.broadcast_arrays(
            np.atleast_2d(np.asarray(light, dtype=np.float64)),
            np.atleast_2d(np.asarray(view, dtype=np.float64)),
        )
        if times.shape != lights.shape[:1]:
            raise ValueError(f"{times.shape} times for {lights.shape[0]} directions")
        out = np.empty(lights.shape)
        for moment in np.unique(times):
            rows = times == moment
            values = model.from_mapping(self.parameters_at(float(moment)))
            out[rows] = model.evaluate(lights[rows], views[rows], values)
        return out


@dataclass(frozen=True)
class DryingPaint(TimeVaryingMaterial):
    """Paint that dries: highlight fades and widens, colour moves between surface and paint.

    With e = exp(-rate t)::

        Ks(t) = (Ks_wet - Ks_dry) e + Ks_dry
        sigma_s(t) = sigma_s_wet sigma_s_dry / ((sigma_s_dry - sigma_s_wet) e + sigma_s_wet)
        Kd(t) = alpha(t) Kd_surface + beta(t) Kd_paint

    so that 1/sigma_s decays with the same rate. alpha and beta go from wet to dry exponentially,
    at `diffuse_rate_per_min` where given, else at `rate_per_min`.
    """

    kd_surface: Colour
    kd_paint: Colour
    ks_wet: float
    ks_dry: float
    sigma_s_wet: float
    sigma_s_dry: float
    rate_per_min: float
    sigma_d: float = 0.0
    alpha_wet: float = 0.0
    alpha_dry: float = 0.0
    beta_wet: float = 1.0
    beta_dry: float = 1.0
    diffuse_rate_per_min: float | None = None

    kind: ClassVar[str] = "drying_paint"
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "kd_surface": _NOT_NEGATIVE,
        "kd_paint": _NOT_NEGATIVE,
        "ks_wet": _NOT_NEGATIVE,
        "ks_dry": _NOT_NEGATIVE,
        "sigma_s_wet": _POSITIVE,
        "sigma_s_dry": _POSITIVE,
        "rate_per_min": _NOT_NEGATIVE,
        "sigma_d": _NOT_NEGATIVE,
        "alpha_wet": _ANY,
        "alpha_dry": _ANY,
        "beta_wet": _ANY,
        "beta_dry": _ANY,
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.diffuse_rate_per_min is not None:
            rate = _number(self.kind, "diffuse_rate_per_min", self.diffuse_rate_per_min)
            if rate < 0:
                raise ValueError(f"{self.kind}: diffuse_rate_per_min = {rate} must not be negative")
        # alpha and beta move on a straight line, so its two ends decide
        for state, alpha, beta in (
            ("wet", self.alpha_wet, self.beta_wet),
            ("dry", self.alpha_dry, self.beta_dry),
        ):
            colour = _mix(alpha, self.kd_surface, beta, self.kd_paint)
            if min(colour) < 0:
                raise ValueError(f"{self.kind}: Kd when {state} is {colour}, below 0")

    @property
    def model(self) -> str:
        """Oren-Nayar + Torrance-Sparrow."""
        return SURFACE

    def parameters_at(self, time_s: float) -> dict[str, float]:
        """Published parameters at a time in seconds."""
        left = _decay(self.rate_per_min, time_s)
        rate = self.rate_per_min if self.diffuse_rate_per_min is None else self.diffuse_rate_per_min
        diffuse_left = _decay(rate, time_s)
        alpha = self.alpha_dry + (self.alpha_wet - self.alpha_dry) * diffuse_left
        beta = self.beta_dry + (self.beta_wet - self.beta_dry) * diffuse_left
        ks = (self.ks_wet - self.ks_dry) * left + self.ks_dry
        wet, dry = self.sigma_s_wet, self.sigma_s_dry
        sigma_s = wet * dry / ((dry - wet) * left + wet)
        return _surface(
            _mix(alpha, self.kd_surface, beta, self.kd_paint), self.sigma_d, ks, sigma_s
        )


@dataclass(frozen=True)
class DryingSurface(TimeVaryingMaterial):
    """A wet surface (cloth, paper, stone) that dries: soon no highlight, then a lighter colour.

    ::

        Kd(t) = alpha(t) Kd_dry + (1 - alpha(t)) Kd_wet
        alpha(t) = 1 / (1 + exp(-(t - dry_at_min) / dry_width_min))
        Ks(t) = Ks_wet exp(-specular_rate t),  sigma_s constant
    """

    kd_wet: Colour
    kd_dry: Colour
    dry_at_min: float
    dry_width_min: float
    ks_wet: float = 0.0
    sigma_s: float = 0.3
    specular_rate_per_min: float = 1.0
    sigma_d: float = 0.0

    kind: ClassVar[str] = "drying_surface"
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "kd_wet": _NOT_NEGATIVE,
        "kd_dry": _NOT_NEGATIVE,
        "dry_at_min": _ANY,
        "dry_width_min": _POSITIVE,
        "ks_wet": _NOT_NEGATIVE,
        "sigma_s": _POSITIVE,
        "specular_rate_per_min": _NOT_NEGATIVE,
        "sigma_d": _NOT_NEGATIVE,
    }

    @property
    def model(self) -> str:
        """Oren-Nayar + Torrance-Sparrow."""
        return SURFACE

    def parameters_at(self, time_s: float) -> dict[str, float]:
        """Published parameters at a time in seconds."""
        minutes = max(time_s, 0.0) / 60
        # the logistic function, without overflow
        alpha = 0.5 * (1 + math.tanh(0.5 * (minutes - self.dry_at_min) / self.dry_width_min))
        ks = self.ks_wet * _decay(self.specular_rate_per_min, time_s)
        return _surface(
            _mix(alpha, self.kd_dry, 1 - alpha, self.kd_wet), self.sigma_d, ks, self.sigma_s
        )


@dataclass(frozen=True)
class SettlingDust(TimeVaryingMaterial):
    """Dust that settles evenly on a surface.

    tau(t) = tau_start + tau_per_min t; the highlight goes as exp(-attenuation tau), the rest as in
    `models.dust` (reciprocal form). `attenuation` is above 1 and a property of the dust: the paper
    prints "about 11" for joint compound and "10 3", probably 10/3, for household dust.
    """

    kd: Colour
    w: Colour
    g: float
    tau_per_min: float
    sigma_d: float = 0.0
    ks: float = 0.0
    sigma_s: float = 0.3
    tau_start: float = 0.0
    attenuation: float = 11.0

    kind: ClassVar[str] = "settling_dust"
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "kd": _NOT_NEGATIVE,
        "w": _NOT_NEGATIVE,
        "g": (-0.999, 0.999),
        "tau_per_min": _NOT_NEGATIVE,
        "sigma_d": _NOT_NEGATIVE,
        "ks": _NOT_NEGATIVE,
        "sigma_s": _POSITIVE,
        "tau_start": _NOT_NEGATIVE,
        "attenuation": _NOT_NEGATIVE,
    }

    @property
    def model(self) -> str:
        """Dust over Oren-Nayar + Torrance-Sparrow."""
        return DUST

    def parameters_at(self, time_s: float) -> dict[str, float]:
        """Published parameters at a time in seconds."""
        tau = self.tau_start + self.tau_per_min * max(time_s, 0.0) / 60
        ks = self.ks * math.exp(-self.attenuation * tau)
        return (
            _surface(self.kd, self.sigma_d, ks, self.sigma_s)
            | _named("w", self.w)
            | {"g": self.g, "tau": tau}
        )


@dataclass(frozen=True)
class ConstantMaterial(TimeVaryingMaterial):
    """A material that does not change: any model, with its published parameters by name."""

    model_name: str
    parameters: Mapping[str, float] = field(default_factory=dict)

    kind: ClassVar[str] = "constant"

    def __post_init__(self) -> None:
        model = get_model(self.model_name)
        values = model.from_mapping(self.parameters)
        for parameter, value in zip(model.parameters, values.tolist(), strict=True):
            if not parameter.lower <= value <= parameter.upper:
                raise ValueError(
                    f"{self.kind}: {parameter.name} = {value} must be in "
                    f"[{parameter.lower:g}, {parameter.upper:g}] {parameter.unit}"
                )
        object.__setattr__(self, "parameters", model.as_mapping(values))
        object.__setattr__(self, "model_name", model.name)

    @property
    def model(self) -> str:
        """Full name of the model."""
        return self.model_name

    def parameters_at(self, time_s: float) -> dict[str, float]:
        """Return the parameters, the same at all times."""
        return dict(self.parameters)


KINDS: dict[str, Callable[..., TimeVaryingMaterial]] = {
    cls.kind: cls for cls in (DryingPaint, DryingSurface, SettlingDust, ConstantMaterial)
}
"""Materials by the name that scene files use."""


def from_dict(kind: str, mapping: Mapping[str, Any]) -> TimeVaryingMaterial:
    """Return a material from a scene file's mapping.

    Parameters
    ----------
    kind
        A name of `KINDS`.
    mapping
        Its fields by name; colours as three numbers B, G, R. "constant" takes `model` and
        `parameters`.

    Raises
    ------
    ValueError
        Unknown kind; unknown, missing or impossible fields. The message lists the known ones.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown material {kind!r}; known materials: {', '.join(KINDS)}")
    given = dict(mapping)
    if kind == ConstantMaterial.kind and "model" in given:
        given["model_name"] = given.pop("model")
    cls: Any = KINDS[kind]
    known = {f.name: f for f in fields(cls)}
    unknown = [name for name in given if name not in known]
    missing = [
        name
        for name, f in known.items()
        if name not in given and f.default is MISSING and f.default_factory is MISSING
    ]
    if unknown or missing:
        problems = [f"unknown {', '.join(map(repr, unknown))}"] if unknown else []
        problems += [f"missing {', '.join(_public(missing))}"] if missing else []
        raise ValueError(f"{kind}: {'; '.join(problems)}; fields are {', '.join(_public(known))}")
    if kind == ConstantMaterial.kind and not isinstance(given.get("parameters", {}), Mapping):
        raise ValueError(f"{kind}: parameters must be a mapping of names to numbers")
    material: TimeVaryingMaterial = cls(**given)
    return material


def _public(names: Any) -> list[str]:
    return ["model" if name == "model_name" else name for name in names]


def _decay(rate_per_min: float, time_s: float) -> float:
    return math.exp(-rate_per_min * max(time_s, 0.0) / 60)


def _mix(first: float, one: Colour, second: float, other: Colour) -> Colour:
    blue, green, red = (first * a + second * b for a, b in zip(one, other, strict=True))
    return blue, green, red


def _named(name: str, colour: Colour) -> dict[str, float]:
    return {f"{name}_{letter}": v for letter, v in zip(CHANNELS, colour, strict=True)}


def _surface(kd: Colour, sigma_d: float, ks: float, sigma_s: float) -> dict[str, float]:
    rest = {"sigma_d": sigma_d, "ks": ks, "inverse_sigma_s": 1 / sigma_s}
    return _named("kd", kd) | rest


def _number(kind: str, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.floating, np.integer)):
        raise ValueError(f"{kind}: {name} = {value!r} must be a number")
    if not math.isfinite(value):
        raise ValueError(f"{kind}: {name} = {value} is not finite")
    return float(value)


def _colour(kind: str, name: str, value: Any) -> Colour:
    if not isinstance(value, (tuple, list, np.ndarray)) or len(value) != 3:
        raise ValueError(f"{kind}: {name} = {value!r} must be three numbers, B, G, R")
    blue, green, red = (_number(kind, name, v) for v in value)
    return blue, green, red
