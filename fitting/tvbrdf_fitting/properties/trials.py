"""Trials of a model: pairs of directions for reciprocity and sign, angles for the largest albedo.

The pairs fill the space evenly; half of them have the half vector close to the normal, where lobes
are. The smallest value found is followed downhill.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..geometry import CHANNELS, FloatArray
from ..models.base import ReflectanceModel
from .albedo import HalfPlanes, directional_albedo, spread, unit

RECIPROCITY_LIMIT = 1e-9
"""Largest relative difference that is rounding: a lobe's exponent carries its own error on."""
ENERGY_LIMIT = 1e-6
"""By as much an albedo must be above 1 to count."""
SEARCH_DEG = (*np.arange(0.0, 88.0, 3.0).tolist(), 88.0, 89.0, 89.5, 89.9, 89.99)
"""Angles at which the albedo is taken; maxima and crossings of 1 are looked for between them."""

_SEARCH_TOLERANCE = 1e-7
_PAIRS = 1 << 14
_STEEPEST = np.deg2rad(89.99)
_NEGLIGIBLE = 1e-12


@dataclass(frozen=True)
class Pair:
    """A BRDF value or difference in one channel, and where: angles to the normal, azimuths."""

    value: float
    channel: str
    theta_light_deg: float
    theta_view_deg: float
    phi_light_deg: float
    phi_view_deg: float

    def __str__(self) -> str:
        turn = (self.phi_view_deg - self.phi_light_deg + 180.0) % 360.0 - 180.0
        return (
            f"channel {self.channel}, light at {self.theta_light_deg:.1f}, view at "
            f"{self.theta_view_deg:.1f} degrees, {abs(turn):.0f} degrees of azimuth apart"
        )


@dataclass(frozen=True)
class EnergyRange:
    """Angles of the light between which one channel's albedo is above 1, and the largest there."""

    channel: str
    phi_deg: float
    from_deg: float
    to_deg: float
    largest: float
    largest_at_deg: float


class Tried(NamedTuple):
    """What was found over many pairs of directions; see `ModelReport`."""

    defect: Pair
    smallest: Pair
    negative_share: float


def try_pairs(model: ReflectanceModel, parameters: FloatArray) -> Tried:
    """Look for differences on exchange, and for the smallest value, over many directions."""
    light, view = _pairs(_PAIRS)
    forth = model.evaluate(unit(*light), unit(*view), parameters)
    back = model.evaluate(unit(*view), unit(*light), parameters)
    size = np.maximum(np.abs(forth), np.abs(back))
    difference = np.where(size > _NEGLIGIBLE * size.max(), np.abs(forth - back), 0.0)
    relative = difference / np.where(size > 0, size, 1.0)
    row, channel = np.unravel_index(np.argmax(relative), relative.shape)
    defect = _pair(relative[row, channel], int(channel), light[:, row], view[:, row])
    weight = np.sin(light[0]) * np.sin(view[0])
    # every second pair only: the others lie where lobes are
    negative = (forth < -_NEGLIGIBLE * size.max()).any(axis=1)
    share = float(np.average(negative[1::2], weights=weight[1::2]))
    smallest = _polish(model, parameters, light, view, forth)
    if smallest.value < 0 and smallest.value > -_NEGLIGIBLE * size.max():
        smallest = replace(smallest, value=0.0)
    return Tried(defect, smallest, share)


def _pairs(number: int) -> tuple[FloatArray, FloatArray]:
    """Angles and azimuths (2, n) of lights and of views, which fill the hemispheres evenly.

    Every second view is chosen by the half vector, its angle evenly in the logarithm.
    """
    points = spread(number, 4).T
    light = np.stack([points[0] * _STEEPEST, 2 * np.pi * points[1]])
    view = np.stack([points[2] * _STEEPEST, 2 * np.pi * points[3]])
    turn = 2 * np.pi * points[3, ::2]
    planes = HalfPlanes.of(light[0, ::2], turn)
    half = planes.last * 10.0 ** (-4 * points[2, ::2])
    other = planes.directions(np.arange(half.size), half[:, None])[1][:, 0]
    view[0, ::2] = np.minimum(
        np.arctan2(np.hypot(other[:, 0], other[:, 1]), other[:, 2]), _STEEPEST
    )
    view[1, ::2] = light[1, ::2] + np.arctan2(other[:, 1], other[:, 0])
    return light, view


def _polish(
    model: ReflectanceModel,
    parameters: FloatArray,
    light: FloatArray,
    view: FloatArray,
    values: FloatArray,
) -> Pair:
    """Return the smallest value, from the smallest of those tried (n, 3) and steps downhill."""
    from scipy.optimize import minimize

    def lowest(x: FloatArray) -> float:
        theta = np.clip(x[:2], 0.0, _STEEPEST)
        found = model.evaluate(unit(theta[0], x[2]), unit(theta[1], x[3]), parameters)
        return float(found.min())

    best, at = np.inf, np.zeros(4)
    for row in np.argsort(values.min(axis=1), kind="stable")[:3]:
        start = np.array([light[0, row], view[0, row], light[1, row], view[1, row]])
        found = minimize(lowest, start, method="Nelder-Mead", options={"maxiter": 200})
        for value, x in ((values[row].min(), start), (found.fun, found.x)):
            if value < best:
                best, at = float(value), x
    at[:2] = np.clip(at[:2], 0.0, _STEEPEST)
    channels = model.evaluate(unit(at[0], at[2]), unit(at[1], at[3]), parameters)[0]
    return _pair(best, int(np.argmin(channels)), at[[0, 2]], at[[1, 3]])


def _pair(value: float, channel: int, light: FloatArray, view: FloatArray) -> Pair:
    degrees = np.rad2deg([light[0], view[0], light[1], view[1]]).tolist()
    degrees[2:] = [phi % 360.0 for phi in degrees[2:]]
    return Pair(float(value), CHANNELS[channel], *degrees)


class AlbedoCurve:
    """Albedo over the angle of the light, at one azimuth; channels that agree are worked once."""

    def __init__(self, model: ReflectanceModel, parameters: FloatArray, phi_deg: float) -> None:
        self._model, self._parameters, self._phi_deg = model, parameters, phi_deg
        self._known: dict[int, list[tuple[float, float]]] = {}
        self._values = self._albedo(np.array(SEARCH_DEG))

    def largest(self, channel: int) -> tuple[float, float]:
        """Return the angle in degrees of the largest albedo, and the latter."""
        return _largest(self._points(channel))

    def above_1(self, channel: int) -> Iterator[EnergyRange]:
        """Yield the ranges of angles in which the albedo is above 1."""
        points = self._points(channel)
        inside: list[tuple[float, float]] = []
        start = 0.0
        for index, (angle, value) in enumerate(points):
            above, last = value > 1 + ENERGY_LIMIT, index == len(points) - 1
            crossing = angle
            if index and above != bool(inside):
                crossing = self._crossing(points[index - 1], points[index], channel)
            if above:
                start = start if inside else crossing
                inside.append((angle, value))
            if inside and (last or not above):
                end = 90.0 if above else crossing
                at, largest = _largest(inside)
                yield EnergyRange(CHANNELS[channel], self._phi_deg, start, end, largest, at)
                inside = []

    def _crossing(
        self, one: tuple[float, float], other: tuple[float, float], channel: int
    ) -> float:
        """Return the angle between two points at which the albedo goes through 1."""
        from scipy.optimize import brentq

        known = dict((one, other))  # evaluated among others they may differ by rounding

        def excess(angle_deg: float) -> float:
            value = known.get(angle_deg)
            return (self._one(angle_deg, channel) if value is None else value) - 1 - ENERGY_LIMIT

        return float(brentq(excess, one[0], other[0], xtol=1e-4))

    def _points(self, channel: int) -> list[tuple[float, float]]:
        """Return angles and albedos, with the maxima between the angles searched."""
        same = next(k for k in range(3) if (self._values[:, k] == self._values[:, channel]).all())
        if same not in self._known:
            self._known[same] = sorted(self._with_maxima(same))
        return self._known[same]

    def _with_maxima(self, channel: int) -> Iterator[tuple[float, float]]:
        from scipy.optimize import minimize_scalar

        values = self._values[:, channel]
        yield from zip(SEARCH_DEG, values.tolist(), strict=True)
        for i in range(1, len(values) - 1):
            if values[i] > max(values[i - 1], values[i + 1]) + _SEARCH_TOLERANCE:
                around = (SEARCH_DEG[i - 1], SEARCH_DEG[i + 1])
                found = minimize_scalar(
                    lambda a: -self._one(a, channel),
                    bounds=around,
                    method="bounded",
                    options={"xatol": 1e-3},
                )
                if -found.fun > values[i]:
                    yield float(found.x), float(-found.fun)

    def _one(self, angle_deg: float, channel: int) -> float:
        return float(self._albedo(np.array([angle_deg]))[0, channel])

    def _albedo(self, angles_deg: FloatArray) -> FloatArray:
        return directional_albedo(
            self._model,
            self._parameters,
            np.deg2rad(angles_deg),
            phi_i=np.deg2rad(self._phi_deg),
            tolerance=_SEARCH_TOLERANCE,
        ).value


def _largest(points: list[tuple[float, float]]) -> tuple[float, float]:
    """Return the first of (angle, albedo) that has the largest albedo but for rounding."""
    limit = max(value for _, value in points) - _SEARCH_TOLERANCE
    return next(point for point in points if point[1] >= limit)
