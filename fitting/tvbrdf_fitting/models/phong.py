"""Phong's specular reflectance: a power of the cosine to the mirror direction.

Sources: B. T. Phong, "Illumination for Computer Generated Pictures", CACM 1975; E. P. Lafortune
and Y. D. Willems, "Using the Modified Phong Reflectance Model for Physically Based Rendering",
report CW 197, KU Leuven, 1994 (option `energy_conserving`).

Parameters: Ks, and the exponent n without a unit, shared by the channels. With r the light's mirror
direction (-l_x, -l_y, l_z), ::

    original            BRDF = Ks max(0, r.v)^n / cos(theta_i)          Ks in 1/sr
    energy_conserving   BRDF = Ks (n + 2) / (2 pi) max(0, r.v)^n        Ks without a unit

The original is a formula for the light that leaves, Ks (r.v)^n times what arrives facing the light,
so as a BRDF it is divided by the cosine of the light's angle and is not reciprocal. The other is,
and its albedo is Ks at normal incidence and less elsewhere: it conserves energy for Ks <= 1.

The lobe falls to 1/e at an angle of sqrt(2 / n) rad from the mirror direction; seen in the half
angle it is as wide as Torrance and Sparrow's with sigma_s = 1 / sqrt(2 n): n = 1e5 is 0.0045 rad
from the mirror direction, sigma_s = 0.0022.

Evaluated as exp(n log(r.v)), the logarithm taken once for all exponents, since n multiplies its
error. Up to 60 degrees from the mirror direction it is log1p(-|r - v|^2 / 2), which keeps its
digits however near that is, with |r - v|^2 = |H_xy|^2 + (l_z - v_z)^2, H = l + v without loss as in
the module of Torrance and Sparrow's model; further away log(l_z v_z - (l_x v_x + l_y v_y)), which
keeps those of a small r.v.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry import FloatArray
from .base import LOG, Parameter
from .lobe import Lobe
from .registry import Registration, label
from .torrance_sparrow import half_vector

EXPONENT_BOUNDS = (1.0, 1e5)
"""A plain cosine, the broadest lobe that ends with a finite slope; and 0.0045 rad."""
_LARGEST_LOG = 300.0  # keeps products with the exponent finite when a solver steps far out
_HIDDEN = -1e150  # logarithm of 0: its power is exactly 0, and its products are finite
_LOWEST_COSINE = 1e-200

EXPONENT = Parameter(
    "exponent",
    "1",
    *EXPONENT_BOUNDS,
    transform=LOG,
    carried_by=(("ks",),),
    grid=tuple(np.log(np.geomspace(*EXPONENT_BOUNDS, 20)).tolist()),
    full_scale=2.0,
    typical=40.0,
)


@dataclass(frozen=True)
class Basis:
    """Logarithm of r.v (n,), and 1 / cos(theta_i) (n,) where the form has it."""

    log_cosine: FloatArray
    inverse_cosine: FloatArray | None


class Phong(Lobe):
    """Phong's lobe; parameters `ks, exponent`.

    Coloured: `ks_b, ks_g, ks_r, exponent`. `energy_conserving`: the reciprocal form of 1994.
    """

    shapes = (EXPONENT,)

    def __init__(self, *, energy_conserving: bool = False, coloured: bool = False) -> None:
        self.energy_conserving = energy_conserving
        self.reciprocal = energy_conserving
        unit = "1" if energy_conserving else "1/sr"
        self.amplitude = Parameter("ks", unit, 0.0, np.inf, typical=0.2)
        super().__init__(coloured=coloured)
        given = {"energy_conserving": energy_conserving, "coloured": coloured}
        self.name = label("phong", *(option for option, is_on in given.items() if is_on))

    def prepare(self, light: FloatArray, view: FloatArray) -> Basis:
        """Return the functions of the directions that all parameter values share."""
        log_cosine = _log_mirror_cosine(light, view)
        if self.energy_conserving:
            return Basis(log_cosine, None)
        return Basis(log_cosine, 1 / np.maximum(light[:, 2], _LOWEST_COSINE))

    def lobe(self, prepared: Basis, shapes: Sequence[float]) -> FloatArray:
        """Return the lobe (n,) at log n."""
        exponent = exponent_of(shapes[0])
        return _scaled(np.exp(prepared.log_cosine * exponent), prepared, exponent)

    def sharpness(self, shapes: Sequence[float]) -> float:
        """Return log n."""
        return shapes[0]

    def lobe_slopes(
        self, prepared: Basis, shapes: Sequence[float]
    ) -> tuple[FloatArray, tuple[FloatArray]]:
        """Return the lobe and its derivative by log n."""
        exponent = exponent_of(shapes[0])
        slope = prepared.log_cosine * exponent
        lobe = _scaled(np.exp(slope), prepared, exponent)
        if prepared.inverse_cosine is None:
            slope += exponent / (exponent + 2)
        slope *= lobe
        return lobe, (slope,)


def _log_mirror_cosine(light: FloatArray, view: FloatArray) -> FloatArray:
    """Return log(r.v) (n,), and `_HIDDEN` where r.v is not positive."""
    (lx, ly, lz), (vx, vy, vz) = light.T, view.T
    cosine = lz * vz - (lx * vx + ly * vy)
    out = np.full(cosine.shape, _HIDDEN)
    np.log(cosine, out=out, where=cosine > 0)
    radius, height = half_vector(light, view)[0], lz - vz
    from_one = 0.5 * (radius * radius + height * height)
    np.log1p(-from_one, out=out, where=from_one < 0.5)
    return out


def exponent_of(log_exponent: float) -> float:
    """Return n of log n, within limits that keep its products finite."""
    return math.exp(min(max(log_exponent, -_LARGEST_LOG), _LARGEST_LOG))


def _scaled(power: FloatArray, prepared: Basis, exponent: float) -> FloatArray:
    if prepared.inverse_cosine is None:
        power *= (exponent + 2) / (2 * np.pi)
    else:
        power *= prepared.inverse_cosine
    return power


REGISTERED = (
    Registration(
        "phong",
        "specular: power of the cosine to the mirror direction, original or energy-conserving",
        Phong,
        options=("energy_conserving", "coloured"),
    ),
)
