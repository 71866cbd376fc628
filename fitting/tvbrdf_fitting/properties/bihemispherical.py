"""Bihemispherical reflectance: both directions of the reflectance equation integrated.

In half vector h (theta_h, phi_h) and difference angles d (theta_d, phi_d: the light's direction
about h), d omega_l d omega_v = 4 cos(theta_d) d omega_h d omega_d, and lobes are narrow in theta_h
alone. With s = sin(theta_h) |cos(phi_d)|, R = hypot(cos(theta_h), s) and
last = atan2(cos(theta_h), s)::

    cosines of light and view to the normal:  R sin(last -+ theta_d),  0 <= theta_d < last
    theta_r = theta_i                         phi_d = pi/2
    V-cavities: shadowing or masking begins   tan(theta_d) = cot(2 theta_h) / |cos(phi_d)|
    cos(phi_r - phi_i) = 0      tan(theta_d) = sin(theta_h) / sqrt(1 - sin^2(theta_h) cos^2(phi_d))

so that again every kink of the published models is a known break. Independent of `albedo` but for
the rule. Coordinates: S. M. Rusinkiewicz, "A New Change of Variables for Efficient BRDF
Representation", 1998.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import FloatArray, IntArray
from ..models.base import ReflectanceModel
from .albedo import BLOCK, SCAN, Symmetries, check_tolerance, delta_weight, symmetries, turned
from .quadrature import RULE_7, RULE_15, Integral, Rule, integrate, peaks

_TIGHTER = 0.3
"""Tolerance of each integral relative to the one around it."""
_OWNERS = 256
"""Integrals over phi_d made at once; each has some 10 000 directions."""
_HALF_BREAKS = 0.5 * np.pi * np.array([[0.0, 1 / 128, 1 / 8, 1 / 2, 1.0]])
_QUARTER_BREAKS = np.pi * np.array([0.0, 1 / 64, 31 / 64, 1 / 2])


def hemispherical_reflectance(
    model: ReflectanceModel, parameters: ArrayLike, *, tolerance: float = 1e-6
) -> Integral:
    """Bihemispherical reflectance: the share of uniform light that is scattered.

    The integral of BRDF cos(theta_i) cos(theta_r) / pi over both hemispheres; also that of the
    albedo x 2 cos(theta) sin(theta) over theta, averaged over the light's azimuth.

    Parameters
    ----------
    model, parameters
        Reflectance model and its published values (p,). Delta lobes count with their weight.
    tolerance
        Wanted relative error.

    Returns
    -------
    value and estimated error (3,), channels B, G, R

    Raises
    ------
    ValueError
        Tolerance below 1e-12, wrong number of parameters.
    """
    check_tolerance(tolerance)
    values = np.asarray(parameters, dtype=np.float64)
    found = _Uniform(model, values, tolerance, symmetries(model, values)).integral()
    if not model.delta:
        return found

    def delta(theta: FloatArray, _: IntArray) -> Integral:
        weight = delta_weight(model, values, theta.ravel()).reshape(*theta.shape, 3)
        value = np.sin(2 * theta)[..., None] * weight
        return Integral(value, np.zeros_like(value))

    ideal = integrate(delta, np.array([[0.0, np.pi / 4, np.pi / 2]]), tolerance)
    return Integral(found.value + ideal.value[0], found.error + ideal.error[0])


class _Nodes(NamedTuple):
    """Azimuth and angle of half vectors (n,), and phi_d (n,)."""

    phi_h: FloatArray
    theta_h: FloatArray
    phi_d: FloatArray

    def at(self, which: IntArray | slice) -> _Nodes:
        return _Nodes(*(part[which] for part in self))


@dataclass
class _Uniform:
    """The nested integrals, from the outside: phi_h (not if isotropic), theta_h, phi_d, theta_d."""

    model: ReflectanceModel
    parameters: FloatArray
    tolerance: float
    symmetries: Symmetries
    largest: FloatArray = field(default_factory=lambda: np.zeros(3))
    """Largest integrals over theta_d met so far: others matter relative to them."""

    spent: int = 0
    """Pairs of directions evaluated so far."""

    def stop(self) -> bool:
        """Whether that is enough for the outermost integral: nobody is to wait for many minutes."""
        return self.spent > (30_000_000 if self.symmetries.isotropic else 300_000_000)

    @property
    def rule(self) -> Rule:
        """Few points where there are four integrals."""
        return RULE_15 if self.symmetries.isotropic else RULE_7

    def integral(self) -> Integral:
        """Return the reflectance (3,)."""
        if self.symmetries.isotropic:
            found = self._over_half_angle(np.zeros((1, 1)), 2 * np.pi)
            return Integral(found.value[0, 0], found.error[0, 0])
        half = self.symmetries.half_turn

        def over_azimuth(phi_h: FloatArray, _: IntArray) -> Integral:
            return self._over_half_angle(phi_h, 2.0 if half else 1.0)

        breaks = np.pi * np.array([[0.0, 0.5, 1.0] if half else [-1.0, -0.5, 0.0, 0.5, 1.0]])
        found = integrate(over_azimuth, breaks, self.tolerance, rule=self.rule, stop=self.stop)
        return Integral(found.value[0], found.error[0])

    def _over_half_angle(self, phi_h: FloatArray, factor: float) -> Integral:
        """Return `factor` times the integrals over theta_h at azimuths (m, k) of half vectors."""
        flat = phi_h.ravel()

        def over_turn(theta_h: FloatArray, owner: IntArray) -> Integral:
            found = self._over_turn(np.repeat(flat[owner], theta_h.shape[1]), theta_h.ravel())
            return Integral(*(factor * part.reshape(*theta_h.shape, 3) for part in found))

        breaks = np.repeat(_HALF_BREAKS, flat.size, axis=0)
        found = integrate(
            over_turn,
            breaks,
            _TIGHTER * self.tolerance,
            group=np.zeros(flat.size, dtype=np.intp),
            rule=self.rule,
            stop=self.stop if self.symmetries.isotropic else lambda: False,
        )
        return Integral(*(part.reshape(*phi_h.shape, 3) for part in found))

    def _over_turn(self, phi_h: FloatArray, theta_h: FloatArray) -> Integral:
        """Return the integrals (n, 3) over phi_d for half vectors (n,), in blocks."""
        parts = []
        for start in range(0, phi_h.size, _OWNERS):
            block = slice(start, start + _OWNERS)
            azimuth, half = phi_h[block], theta_h[block]
            narrow = self._peaks(azimuth, half)
            breaks, copies = self._turns(half)

            def over_difference(
                phi_d: FloatArray,
                owner: IntArray,
                azimuth: FloatArray = azimuth,
                half: FloatArray = half,
                narrow: FloatArray = narrow,
            ) -> Integral:
                where = np.repeat(owner, phi_d.shape[1])
                flat = phi_d.ravel()
                side = (np.abs(flat) > np.pi / 2).astype(int)
                nodes = _Nodes(azimuth[where], half[where], flat)
                found = self._over_difference(nodes, narrow[where, side])
                return Integral(*(part.reshape(*phi_d.shape, 3) for part in found))

            parts.append(
                integrate(
                    over_difference,
                    breaks,
                    _TIGHTER**2 * self.tolerance,
                    group=np.zeros(half.size, dtype=np.intp),
                    floor=1e-3 * self.largest,
                    rule=self.rule,
                )
            )
        return Integral(*(copies * np.concatenate(part) for part in zip(*parts, strict=True)))

    def _turns(self, theta_h: FloatArray) -> tuple[FloatArray, float]:
        """Return the first panels of phi_d (n, m), and how many such parts the whole turn has.

        Exchange of light and view adds pi to phi_d; reflection, if isotropic, changes its sign.
        """
        # where cos(phi_r - phi_i) = 0 meets the horizon
        meets = np.arccos(np.minimum(np.cos(theta_h) / np.sin(theta_h), 1.0))
        fixed = np.tile(_QUARTER_BREAKS, (theta_h.size, 1))
        quarter = np.sort(np.concatenate([fixed, meets[:, None]], axis=1), axis=1)
        half = np.concatenate([quarter, np.pi - quarter[:, -2::-1]], axis=1)
        if self.symmetries.isotropic and self.symmetries.exchange:
            return quarter, 4.0
        if self.symmetries.isotropic or self.symmetries.exchange:
            return half, 2.0
        return np.concatenate([-half[:, :0:-1], half], axis=1), 1.0

    def _over_difference(self, nodes: _Nodes, narrow: FloatArray) -> Integral:
        """Return the integrals (n, 3) over theta_d, given narrow peaks (n, 2)."""

        def scattered(theta_d: FloatArray, owner: IntArray) -> Integral:
            value = self._integrand(nodes.at(owner), theta_d)
            return Integral(value, np.zeros_like(value))

        found = integrate(
            scattered,
            _breaks(nodes, narrow),
            _TIGHTER**3 * self.tolerance,
            group=np.zeros(nodes.phi_d.size, dtype=np.intp),
            floor=1e-3 * self.largest,
            rule=self.rule,
        )
        np.maximum(self.largest, np.abs(found.value).max(axis=0), out=self.largest)
        return found

    def _peaks(self, phi_h: FloatArray, theta_h: FloatArray) -> FloatArray:
        """Return theta_d (n, 2, 2) of narrow peaks at phi_d = 0 and pi."""
        sides = []
        for phi_d in (0.0, np.pi):
            nodes = _Nodes(phi_h, theta_h, np.full_like(phi_h, phi_d))
            theta_d = _last(nodes)[:, None] * SCAN
            sides.append(peaks(np.abs(self._integrand(nodes, theta_d)).sum(axis=2), theta_d))
        return np.stack(sides, axis=1)

    def _integrand(self, nodes: _Nodes, theta_d: FloatArray) -> FloatArray:
        """BRDF times cosines and Jacobian (n, k, 3) at theta_d (n, k)."""
        self.spent += theta_d.size
        out = np.empty((*theta_d.shape, 3))
        step = max(1, BLOCK // theta_d.shape[1])
        for start in range(0, theta_d.shape[0], step):
            block = slice(start, start + step)
            light, view, weight = _directions(nodes.at(block), theta_d[block])
            if not self.symmetries.isotropic:
                azimuth = nodes.phi_h[block][:, None]
                light, view = turned(light, azimuth), turned(view, azimuth)
            value = self.model.evaluate(light.reshape(-1, 3), view.reshape(-1, 3), self.parameters)
            np.multiply(value.reshape(*weight.shape, 3), weight[..., None], out=out[block])
        return out


def _last(nodes: _Nodes) -> FloatArray:
    """Return theta_d (n,) at which light or view reaches the horizon."""
    tilt = np.sin(nodes.theta_h) * np.abs(np.cos(nodes.phi_d))
    return np.asarray(np.arctan2(np.cos(nodes.theta_h), tilt))


def _breaks(nodes: _Nodes, narrow: FloatArray) -> FloatArray:
    """Return theta_d (n, m), ascending: ends, kinks, peaks (n, 2), close to retro-reflection."""
    last = _last(nodes)
    sine, turn = np.sin(nodes.theta_h), np.abs(np.cos(nodes.phi_d))
    cavity = np.arctan2(np.cos(2 * nodes.theta_h), np.sin(2 * nodes.theta_h) * turn)
    across = np.arctan2(sine, np.sqrt(np.maximum(1 - (sine * turn) ** 2, 0.0)))
    points = [np.zeros_like(last), last / 64, last * (63 / 64), cavity, across, *narrow.T, last]
    return np.sort(np.clip(np.stack(points, axis=1), 0.0, last[:, None]), axis=1)


def _directions(nodes: _Nodes, theta_d: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return light and view (n, k, 3), half vectors towards x, and the integrand's factor (n, k).

    The factor is 4 cos(theta_d) sin(theta_d) sin(theta_h) cos(theta_i) cos(theta_r) / pi.
    """
    sin_h, cos_h = np.sin(nodes.theta_h)[:, None], np.cos(nodes.theta_h)[:, None]
    sin_d, cos_d = np.sin(theta_d), np.cos(theta_d)
    turn = np.cos(nodes.phi_d)[:, None]
    tilt = sin_h * np.abs(turn)
    last = np.arctan2(cos_h, tilt)
    radius = np.hypot(cos_h, tilt)
    low = radius * np.sin(last - theta_d)
    high = low + 2 * tilt * sin_d
    leans = turn > 0  # the light lies on the far side of h, closer to the horizon
    away, across = sin_d * turn * cos_h, sin_d * np.sin(nodes.phi_d)[:, None]
    light = np.stack([cos_d * sin_h + away, across, np.where(leans, low, high)], axis=-1)
    view = np.stack([cos_d * sin_h - away, -across, np.where(leans, high, low)], axis=-1)
    return light, view, (4 / np.pi) * cos_d * sin_d * sin_h * low * high
