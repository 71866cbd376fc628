"""Models against references of 110 digits: checks of value and Jacobian.

A reference is a function ``terms(light, view, parameters, channel) -> list`` of numbers whose sum
is the BRDF, written in mpmath from the model's printed formulas, as they are printed (angles,
azimuths, min, max); `angles` has what most of them need. Terms are the summands of the printed
formula. Numbers are `mpf`, parameters in published units and order.

The bound: ``|error| <= 16 eps (sum |terms| + sum |input x derivative by that input|)``, inputs
being the six components of the directions and the parameters: the error that a few roundings, or
inputs that are a few roundings off, would make. Below 1e-300 any error is allowed. For a derivative
by a parameter (published units) the terms are the derivatives of the terms, and so on.

**A vector means its direction.** Model and reference take the same float64 components, of vectors
whose length is 1 only up to rounding. The checks normalise them in 110 digits before the reference
sees them, and derive by the components as given. So the length of a vector carries nothing, and a
model must not let it in: ``cos = z`` and ``sin = hypot(x, y)`` are good to eps, but ``l + v`` where
both graze from opposite sides, or ``1 - sin`` at grazing, are not (`torrance_sparrow.half_vector`
has the first without its loss). A reference that took lengths seriously would have sensitivities
of 1e12 there, and the bound would hold for anything.

Derivatives are differences with relative steps of 1e-30, 1e-55 for parameters near 0. Those of the
bound are one-sided, upward. Where the two one-sided derivatives by a parameter differ (a kink of
min, max or |.|), either is right. A reference must keep 80 digits itself: 1 - T for a T of 1e-300
has lost T, unless it is returned as two terms.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from mpmath import mp, mpf
from numpy.typing import ArrayLike

from tvbrdf_fitting.geometry import CHANNELS, FloatArray
from tvbrdf_fitting.models import ReflectanceModel, get_model

__all__ = [
    "EPS",
    "EPS_32",
    "LIMIT_EPS",
    "Angles",
    "Float32Cost",
    "Number",
    "Terms",
    "Vector",
    "angles",
    "check_jacobian",
    "check_value",
    "float32_cost",
    "mp",
    "mpf",
]

DIGITS = 110
LIMIT_EPS = 16.0
SMALLEST = 1e-300
EPS = float(np.finfo(np.float64).eps)
EPS_32 = float(np.finfo(np.float32).eps)
STEP = 30  # digits of relative steps

Number = Any  # mpf, which has no types
Vector = tuple[Number, Number, Number]
Terms = Callable[[Vector, Vector, list[Number], int], list[Number]]


# ---- for references


@dataclass(frozen=True)
class Angles:
    """Angles of unit light, view and half vector, in radians, as printed formulas have them.

    Attributes
    ----------
    theta_i, theta_r, theta_h
        To the normal: light, view, half vector.
    phi
        Azimuth of view less that of light; an azimuth that is undefined counts as 0.
    theta_d
        Half the angle between light and view.
    cos_i, cos_r, cos_h, cos_d, cos_phi
        Their cosines.
    """

    theta_i: Number
    theta_r: Number
    theta_h: Number
    theta_d: Number
    phi: Number
    cos_i: Number
    cos_r: Number
    cos_h: Number
    cos_d: Number
    cos_phi: Number


def angles(light: Vector, view: Vector) -> Angles:
    """Return the angles of unit vectors, remembered for the next call."""
    return _angles(light, view, mp.prec)


@lru_cache(maxsize=20_000)
def _angles(light: Vector, view: Vector, _precision: int) -> Angles:
    half = tuple(a + b for a, b in zip(light, view, strict=True))
    apart = tuple(a - b for a, b in zip(light, view, strict=True))
    turned = mp.atan2(view[1], view[0]) - mp.atan2(light[1], light[0])
    between = mp.atan2(_length(apart), _length(half))
    found = (_polar(light), _polar(view), _polar(half), between, turned)
    return Angles(*found, *map(mp.cos, found))


def _length(vector: Sequence[Number]) -> Number:
    return mp.sqrt(mp.fsum((c * c for c in vector), absolute=False))


def _polar(vector: Sequence[Number]) -> Number:
    return mp.atan2(mp.hypot(vector[0], vector[1]), vector[2])


# ---- checks


@dataclass(frozen=True)
class Miss:
    """One number of a model against its reference; `eps` is the error in units of the bound's."""

    eps: float
    text: str


def check_value(
    model_name: str,
    reference: Terms,
    parameters: ArrayLike,
    light: FloatArray,
    view: FloatArray,
    channels: Sequence[int] | None = None,
) -> float:
    """Assert that a model's values are within the bound; return the largest error in eps.

    Parameters
    ----------
    parameters
        (p,) published values.
    light, view
        (n, 3).
    channels
        To check in all directions. Default: one channel a direction, in turn.
    """
    model, values = get_model(model_name), np.asarray(parameters, dtype=np.float64)
    got = model.evaluate(light, view, values)
    misses = []
    with mp.workdps(DIGITS):
        for i in range(len(light)):
            for channel in channels or (i % 3,):
                point = _Point(model, reference, values, (light[i], view[i]), channel)
                total, eps = point.value_error(got[i, channel])
                misses.append(Miss(eps, f"{point} {_error(got[i, channel], total, eps)}"))
    return _worst(misses)


def check_jacobian(
    model_name: str,
    reference: Terms,
    parameters: ArrayLike,
    light: FloatArray,
    view: FloatArray,
    channels: Sequence[int] | None = None,
) -> float:
    """Assert that all derivatives by published parameters are within the bound.

    Derivatives by another channel's parameters must be 0. Parameters as `check_value`; returns the
    largest error in eps.
    """
    model, values = get_model(model_name), np.asarray(parameters, dtype=np.float64)
    got = model.jacobian(light, view, values)
    misses = []
    with mp.workdps(DIGITS):
        for i in range(len(light)):
            for channel in channels or (i % 3,):
                point = _Point(model, reference, values, (light[i], view[i]), channel)
                for k, parameter in enumerate(model.parameters):
                    number = got[i, channel, k]
                    if parameter.channel not in {None, channel}:
                        wanted, eps = mpf(0), 0.0 if number == 0 else np.inf
                    else:
                        wanted, eps = point.derivative_error(k, number)
                    text = f"{point} d/d {parameter.name} {_error(number, wanted, eps)}"
                    misses.append(Miss(eps, text))
    return _worst(misses)


@dataclass(frozen=True)
class Float32Cost:
    """Error of values whose inputs were rounded to float32.

    Attributes
    ----------
    median, largest
        Relative error over directions and channels.
    largest_eps
        Largest error in units of ``eps32 (sum |terms| + sum |input x derivative|)``; inputs alone
        explain 0.5. Where it is below 1, an upper estimate.
    """

    median: float
    largest: float
    largest_eps: float


def float32_cost(
    model_name: str,
    reference: Terms,
    parameters: ArrayLike,
    light: FloatArray,
    view: FloatArray,
) -> Float32Cost:
    """Measure what it costs to hand a model directions and parameters of float32.

    The model still computes in float64; the reference takes the inputs as they were.
    """
    model, values = get_model(model_name), np.asarray(parameters, dtype=np.float64)
    got = model.evaluate(*(np.float32(a).astype(np.float64) for a in (light, view, values)))
    relative, in_eps = [], []
    with mp.workdps(DIGITS):
        for i in range(len(light)):
            point = _Point(model, reference, values, (light[i], view[i]), i % 3)
            total, eps = point.value_error(got[i, i % 3], EPS_32)
            relative.append(float(abs(mpf(float(got[i, i % 3])) - total) / abs(total)))
            in_eps.append(eps)
    return Float32Cost(float(np.median(relative)), max(relative), max(in_eps))


class _Point:
    """A reference at one pair of directions, one set of parameters and one channel."""

    def __init__(
        self,
        model: ReflectanceModel,
        reference: Terms,
        parameters: FloatArray,
        vectors: tuple[FloatArray, FloatArray],
        channel: int,
    ) -> None:
        self._model, self._reference, self._channel = model, reference, channel
        self._published, self._vectors = parameters, vectors
        self._count = len(parameters)
        components = (*parameters, *vectors[0], *vectors[1])
        self._inputs = [mpf(float(c)) for c in components]
        own = {k for k, p in enumerate(model.parameters) if p.channel in {None, channel}} | set(
            range(self._count, self._count + 6)
        )
        self._varied = [j for j in sorted(own) if self._inputs[j] != 0]

    def __str__(self) -> str:
        named = ", ".join(f"{n} {v:g}" for n, v in self._model.as_mapping(self._published).items())
        light, view = (np.array2string(v, precision=17, separator=", ") for v in self._vectors)
        letter = CHANNELS[self._channel]
        return f"{self._model.name}: light {light}, view {view}, {named}, channel {letter}:"

    def value_error(self, got: float, eps: float = EPS) -> tuple[Number, float]:
        """Return the BRDF, and the error of `got` in units of the bound's eps."""
        terms = self._terms(self._inputs)
        return mp.fsum(terms), _in_eps(got, terms, lambda: self._sensitivity(self._terms), eps)

    def derivative_error(self, k: int, got: float) -> tuple[Number, float]:
        """Return the derivative by parameter k, and the error of `got` in eps."""
        up, here, down = (self._terms(self._moved(self._inputs, k, side)) for side in (1, 0, -1))
        step = self._step(k)
        sides = [_slopes(up, here, step), _slopes(here, down, step)]
        jump = abs(mp.fsum(sides[0]) - mp.fsum(sides[1]))
        kink = jump > mpf(10) ** -12 * mp.fsum([*here, *sides[0], *sides[1]], absolute=True)
        candidates = sides if kink else [_slopes(up, down, 2 * step)]

        def central(inputs: list[Number]) -> list[Number]:
            one, other = (self._terms(self._moved(inputs, k, side)) for side in (1, -1))
            return _slopes(one, other, 2 * step)

        errors = [_in_eps(got, terms, lambda: self._sensitivity(central)) for terms in candidates]
        best = errors.index(min(errors))
        return mp.fsum(candidates[best]), errors[best]

    def _sensitivity(self, function: Callable[[list[Number]], list[Number]]) -> Number:
        """Return the sum of |input x derivative by it of the terms' sum| over all inputs not 0."""
        step, total, here = mpf(10) ** -STEP, mpf(0), function(self._inputs)
        for j in self._varied:
            moved = list(self._inputs)
            moved[j] *= 1 + step
            total += abs(mp.fsum(_slopes(function(moved), here, step)))
        return total

    def _step(self, k: int) -> Number:
        return mpf(10) ** -STEP * max(abs(self._inputs[k]), mpf(10) ** (STEP - DIGITS // 2))

    def _moved(self, inputs: list[Number], k: int, side: int) -> list[Number]:
        moved = list(inputs)
        moved[k] += side * self._step(k)
        return moved

    def _terms(self, inputs: list[Number]) -> list[Number]:
        light, view = (
            _unit(tuple(inputs[first : first + 3]), mp.prec)
            for first in (self._count, self._count + 3)
        )
        return self._reference(light, view, inputs[: self._count], self._channel)


def _slopes(up: list[Number], down: list[Number], step: Number) -> list[Number]:
    """Term by term: a small one's difference must not drown in the digits of a large one."""
    return [(a - b) / step for a, b in zip(up, down, strict=True)]


@lru_cache(maxsize=20_000)
def _unit(vector: Vector, _precision: int) -> Vector:
    length = _length(vector)
    return vector[0] / length, vector[1] / length, vector[2] / length


def _in_eps(
    got: float, terms: list[Number], sensitivity: Callable[[], Number], eps: float = EPS
) -> float:
    """Return the error in units of the bound's eps; an upper estimate where it is below 1.

    The sensitivity takes long, and is not asked for where the terms alone explain the error.
    """
    if not np.isfinite(got):
        return np.inf
    error, scale = abs(mpf(float(got)) - mp.fsum(terms)), mp.fsum(terms, absolute=True)
    if error <= SMALLEST:
        return 0.0
    if error > eps * scale:
        scale += sensitivity()
    return float(error / scale) / eps if scale else np.inf


def _error(got: float, wanted: Number, eps: float) -> str:
    return f"is {got!r}, should be {mp.nstr(wanted, 20)}, {eps:.3g} eps off ({LIMIT_EPS:g} allowed)"


def _worst(misses: list[Miss]) -> float:
    worst = max(misses, key=lambda miss: miss.eps)
    failed = sum(miss.eps > LIMIT_EPS for miss in misses)
    assert not failed, f"{failed} of {len(misses)} numbers miss the bound; worst: {worst.text}"
    return worst.eps
