"""Albedos: the reflectance equation integrated over the hemisphere, with the error controlled.

The integral over outgoing directions is taken over half vectors h = (l + v)/|l + v| instead, polar
angle theta and azimuth phi from the light's, since lobes are centred on the normal there, however
the light grazes. With R = hypot(cos(theta_i), sin(theta_i) cos(phi)) and
x = atan2(sin(theta_i) cos(phi), cos(theta_i)), for a given phi::

    l.h = R cos(theta - x),   v_z = R cos(2 theta - x),   d omega_v = 4 (l.h) d omega_h
    v is above the horizon for 0 <= theta < pi/4 + x/2

and all lines where published models have a kink are known::

    theta_r = theta_i (Oren-Nayar's alpha and beta change places)     theta = x
    V-cavities: shadowing begins, masking begins               theta = pi/2 - x, pi/6 + x/3
    cos(phi_r - phi_i) = 0       theta = (x + asin(sin(theta_i) sin^2(phi) / (R cos(phi)))) / 2

So each integral over theta is one of smooth pieces, and the integral over phi that of a smooth
function. Both are adaptive Gauss-Kronrod rules, many integrals at once. (A cubature of rectangles,
as scipy has, must cover every curved kink with ever smaller rectangles.)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import FloatArray, IntArray
from ..models.base import ReflectanceModel
from ..models.ideal import delta_lobes
from .quadrature import Integral, integrate, peaks

Kind = Literal["directional-hemispherical", "hemispherical-directional"]
KINDS: tuple[Kind, ...] = get_args(Kind)

INNER = 0.1
"""Tolerance of the integrals over theta, relative to that of the integral over phi."""
SCAN = np.linspace(0.0, 1.0, 402)[1:-1]
"""Where narrow peaks are looked for, relative to the last angle."""
_MOST_DIRECTIONS = 3_000_000
"""For one albedo; some 40 000 do in most cases."""
BLOCK = 1 << 14
"""Directions evaluated at once: the arrays stay in the cache."""
AZIMUTH_BREAKS = np.pi * np.array([0.0, 1 / 64, 1 / 8, 1 / 2, 7 / 8, 63 / 64, 1.0])
"""Close to the plane of incidence lie all narrow peaks that are not at the mirror direction."""


def directional_albedo(
    model: ReflectanceModel,
    parameters: ArrayLike,
    theta_i: ArrayLike,
    *,
    tolerance: float = 1e-8,
    kind: Kind = "directional-hemispherical",
    phi_i: ArrayLike = 0.0,
) -> Integral:
    """Albedo: the share of light from one direction that is scattered into all directions.

    Parameters
    ----------
    model, parameters
        Reflectance model and its published values (p,). Delta lobes count with their weight, that
        of ideal refraction too.
    theta_i
        Angle(s) of the direction to the normal in radians, in [0, pi/2); any shape.
    tolerance
        Wanted error, relative to the value.
    kind
        "directional-hemispherical": light comes from theta_i, the integral of BRDF cos(theta_r)
        goes over all views. "hemispherical-directional": theta_i is the view's, the integral of
        BRDF cos(theta) goes over all lights. Equal for reciprocal models.
    phi_i
        Azimuth(s) of that direction, in radians, for models that are not isotropic; broadcast
        against theta_i.

    Returns
    -------
    value and error (..., 3), channels B, G, R. The error can exceed what was asked for; it then
    says so.

    Raises
    ------
    ValueError
        Angles outside [0, pi/2), unknown kind, tolerance below 1e-12, wrong number of parameters.
    """
    theta, phi = np.broadcast_arrays(
        np.asarray(theta_i, dtype=np.float64), np.asarray(phi_i, dtype=np.float64)
    )
    if not ((theta >= 0) & (theta < np.pi / 2)).all() or not np.isfinite(phi).all():
        raise ValueError("theta_i must lie in [0, pi/2) radians, and phi_i be finite")
    if kind not in KINDS:
        raise ValueError(f"unknown kind {kind!r} of albedo; known kinds: {', '.join(KINDS)}")
    check_tolerance(tolerance)
    scatter = _Scattering(
        model,
        np.asarray(parameters, dtype=np.float64),
        theta.ravel(),
        phi.ravel(),
        tolerance,
        swapped=kind == "hemispherical-directional",
    )
    found = scatter.integral()
    value = found.value + delta_weight(model, parameters, theta.ravel())
    return Integral(*(part.reshape(*theta.shape, 3) for part in (value, found.error)))


def delta_weight(model: ReflectanceModel, parameters: ArrayLike, theta_i: FloatArray) -> FloatArray:
    """Share (n, 3) of light at angles (n,) that ideal mirrors and refractions scatter.

    Their throughput is a ratio of radiances; that of the beams' projected solid angles belongs to
    it, which for mirrors and Snell's law is the same at every angle: taken close to the normal.
    """
    total = np.zeros((theta_i.size, 3))
    for lobe, values in delta_lobes(model, parameters):
        close = unit(1e-3, 0.0)
        beam = lobe.scattered(close, values).direction[0]
        spread_ = (beam[0] ** 2 + beam[1] ** 2) / close[0] ** 2
        total += spread_ * lobe.scattered(unit(theta_i, 0.0), values).throughput
    return total


class Symmetries(NamedTuple):
    """What may be done to light and view without changing the BRDF, tried on a few directions."""

    isotropic: bool
    """Turning both by any angle, and mirroring."""
    half_turn: bool
    """Turning both by pi."""
    exchange: bool
    """Exchanging them: reciprocity."""


def symmetries(model: ReflectanceModel, parameters: ArrayLike) -> Symmetries:
    """Return the symmetries of a model at published values (p,)."""
    light, view, phi = (0.5 * np.pi * spread(64, 3).T) * [[0.98], [0.98], [2.0]]
    # some pairs close to the mirror direction, where narrow lobes are
    view[::2] = light[::2] * (1 + 0.02 * (view[::2] - 0.8))
    phi[::2] = np.pi - 0.02 * phi[::2]

    def values(turn: float, sign: float = 1.0) -> FloatArray:
        return model.evaluate(unit(light, turn), unit(view, turn + sign * phi), parameters)

    first = values(0.0)
    atol = 1e-12 * float(np.abs(first).max())

    def same(other: FloatArray) -> bool:
        return bool(np.allclose(first, other, rtol=1e-7, atol=atol))

    turned_ = ((0.0, -1.0), (1.0, 1.0), (2.5, -1.0))
    return Symmetries(
        isotropic=model.isotropic and all(same(values(*t)) for t in turned_),
        half_turn=same(values(np.pi)),
        exchange=same(model.evaluate(unit(view, phi), unit(light, 0.0), parameters)),
    )


@dataclass
class _Scattering:
    """The integrals over phi for directions (n,): owners are these, x is phi."""

    model: ReflectanceModel
    parameters: FloatArray
    theta_i: FloatArray
    phi_i: FloatArray
    tolerance: float
    swapped: bool = False
    spent: int = 0
    """Pairs of directions evaluated so far."""

    @cached_property
    def isotropic(self) -> bool:
        return symmetries(self.model, self.parameters).isotropic

    @cached_property
    def peaks(self) -> FloatArray:
        """Return the half angles (n, 2, 2) of narrow peaks at phi = 0 and at phi = pi."""
        owner = np.arange(self.theta_i.size)
        sides = []
        for phi in (0.0, np.pi):
            planes = HalfPlanes.of(self.theta_i, np.full(owner.size, phi))
            theta = planes.last[:, None] * SCAN
            height = np.abs(self._integrand(planes, owner, theta, owner)).sum(axis=2)
            sides.append(peaks(height, theta))
        return np.stack(sides, axis=1)

    def integral(self) -> Integral:
        """Return the albedos (n, 3)."""
        if self.theta_i.size == 0:
            return Integral(np.empty((0, 3)), np.empty((0, 3)))
        most = _MOST_DIRECTIONS * self.theta_i.size
        breaks, copies = _azimuth_breaks(self.theta_i), 2
        if not self.isotropic:
            breaks, copies = np.concatenate([-breaks[:, :0:-1], breaks], axis=1), 1
        found = integrate(self._over_theta, breaks, self.tolerance, stop=lambda: self.spent > most)
        return Integral(copies * found.value, copies * found.error)

    def _over_theta(self, phi: FloatArray, owner: IntArray) -> Integral:
        """Return the integrals over theta at azimuths (m, 15) of the owners (m,)."""
        direction = np.repeat(owner, phi.shape[1])
        flat = phi.ravel()
        planes = HalfPlanes.of(self.theta_i[direction], flat)
        narrow = self.peaks[direction, (np.abs(flat) > np.pi / 2).astype(int)]

        def scattered(theta: FloatArray, plane: IntArray) -> Integral:
            value = self._integrand(planes, plane, theta, direction[plane])
            return Integral(value, np.zeros_like(value))

        found = integrate(scattered, planes.breaks(narrow), INNER * self.tolerance, group=direction)
        return Integral(*(part.reshape(*phi.shape, 3) for part in found))

    def _integrand(
        self, planes: HalfPlanes, plane: IntArray, theta: FloatArray, direction: IntArray
    ) -> FloatArray:
        """BRDF v_z 4 (l.h) sin(theta) (m, k, 3) at half angles (m, k) in the planes (m,)."""
        self.spent += theta.size
        out = np.empty((*theta.shape, 3))
        step = max(1, BLOCK // theta.shape[1])
        for start in range(0, theta.shape[0], step):
            block = slice(start, start + step)
            one, view, weight = planes.directions(plane[block], theta[block])
            if not self.isotropic:
                phi = self.phi_i[direction[block]][:, None]
                one, view = turned(one, phi), turned(view, phi)
            light, view = (view, one) if self.swapped else (one, view)
            value = self.model.evaluate(light.reshape(-1, 3), view.reshape(-1, 3), self.parameters)
            np.multiply(value.reshape(*weight.shape, 3), weight[..., None], out=out[block])
        return out


def _azimuth_breaks(theta_i: FloatArray) -> FloatArray:
    """Return azimuths (n, m) in [0, pi], ascending: ends, and where kinks begin or cross.

    These are x = pi/6 and pi/4, and where cos(phi_r - phi_i) = 0 meets the horizon.
    """
    sine, cosine = np.sin(theta_i), np.cos(theta_i)
    with np.errstate(divide="ignore"):
        cotangent = cosine / sine
    cosines = [cotangent / np.sqrt(3), cotangent, sine / np.hypot(1.0, sine)]
    inner = np.arccos(np.minimum(np.stack(cosines, axis=1), 1.0))
    fixed = np.tile(AZIMUTH_BREAKS, (theta_i.size, 1))
    return np.sort(np.concatenate([fixed, inner], axis=1), axis=1)


@dataclass(frozen=True)
class HalfPlanes:
    """Half vectors of one azimuth each, for planes (n,); see the header."""

    sin_i: FloatArray
    cos_i: FloatArray
    phi: FloatArray
    x: FloatArray
    r: FloatArray

    @classmethod
    def of(cls, theta_i: FloatArray, phi: FloatArray) -> HalfPlanes:
        """Return the planes at azimuths (n,) from directions at theta_i (n,)."""
        sin_i, cos_i = np.sin(theta_i), np.cos(theta_i)
        along = sin_i * np.cos(phi)
        return cls(sin_i, cos_i, phi, np.arctan2(along, cos_i), np.hypot(along, cos_i))

    @property
    def last(self) -> FloatArray:
        """Half angle (n,) at which the other direction reaches the horizon."""
        return np.asarray(np.pi / 4 + self.x / 2)

    def breaks(self, peaks: FloatArray) -> FloatArray:
        """Return half angles (n, m), ascending: ends, kinks, peaks (n, k), close to a lobe."""
        last, cos_phi = self.last, np.cos(self.phi)
        # cos(phi_r - phi_i) = 0 is only crossed where the half vector leans towards the light
        rise, run = self.sin_i * np.sin(self.phi) ** 2, self.r * cos_phi
        crosses = rise < run
        sine = np.where(crosses, rise, 0.0) / np.where(crosses, run, 1.0)
        across = np.where(crosses, 0.5 * (self.x + np.arcsin(sine)), last)
        points = [
            np.zeros_like(last),
            last / 128,
            last / 16,
            self.x,
            np.pi / 2 - self.x,
            np.pi / 6 + self.x / 3,
            across,
            *peaks.T,
            last,
        ]
        return np.sort(np.clip(np.stack(points, axis=1), 0.0, last[:, None]), axis=1)

    def directions(
        self, plane: IntArray, theta: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return both directions (m, k, 3) and v_z 4 (l.h) sin(theta) (m, k)."""
        sin_i, cos_i, phi, x, r = (
            part[plane][:, None] for part in (self.sin_i, self.cos_i, self.phi, self.x, self.r)
        )
        sine = np.sin(theta)
        along = 2 * r * np.cos(theta - x)
        view_z = r * np.cos(2 * theta - x)
        view = np.stack(
            [along * sine * np.cos(phi) - sin_i, along * sine * np.sin(phi), view_z], axis=-1
        )
        one = np.empty_like(view)
        one[..., 0], one[..., 1], one[..., 2] = sin_i, 0.0, cos_i
        return one, view, 2 * along * sine * view_z


def unit(theta: ArrayLike, phi: ArrayLike) -> FloatArray:
    """Unit vectors (..., 3) at polar angles and azimuths in radians."""
    theta, phi = np.broadcast_arrays(np.asarray(theta, float), np.asarray(phi, float))
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], axis=-1)


def turned(direction: FloatArray, phi: FloatArray) -> FloatArray:
    """Directions (..., 3) turned about the normal by angles in radians that broadcast to (...)."""
    cosine, sine = np.cos(phi), np.sin(phi)
    x, y, z = np.moveaxis(direction, -1, 0)
    across, along = cosine * x - sine * y, sine * x + cosine * y
    return np.stack([across, along, np.broadcast_to(z, across.shape)], axis=-1)


def spread(number: int, dimensions: int) -> FloatArray:
    """Points (number, dimensions) that fill the unit cube evenly: an additive recurrence.

    Steps are the powers of 1/phi_d, phi_d the root of x^(d+1) = x + 1 (the plastic constant's
    generalisation; M. Roberts, "The Unreasonable Effectiveness of Quasirandom Sequences", 2018).
    """
    root = 2.0
    for _ in range(40):
        root = (1 + root) ** (1 / (dimensions + 1))
    steps = root ** -np.arange(1.0, dimensions + 1)
    return np.asarray((0.5 + np.arange(1, number + 1)[:, None] * steps) % 1.0)


def check_tolerance(tolerance: float) -> None:
    """Raise for a relative error that double precision cannot give."""
    if not 1e-12 <= tolerance < 1:
        raise ValueError(f"tolerance is {tolerance}, expected at least 1e-12 and below 1")
