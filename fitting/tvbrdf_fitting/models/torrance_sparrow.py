"""Torrance-Sparrow specular reflectance: mirror facets in V-cavities, Fresnel factor 1.

Source: K. E. Torrance and E. M. Sparrow, "Theory for Off-Specular Reflection From Roughened
Surfaces", 1967, in the form of Sun et al., "Time-Varying BRDFs": Gaussian facets, not normalised.

Parameters: Ks, sigma_s in radians, both shared by the channels; published is 1/sigma_s. With h the
half vector and theta_h its angle to the normal n::

    BRDF = Ks D G / (4 cos(theta_i) cos(theta_r)),   D = exp(-(theta_h / sigma_s)^2)
    G = min(1, 2 (n.h)(n.l) / (v.h), 2 (n.h)(n.v) / (v.h))

Evaluated jointly, so that it stays finite unless light and view both graze: with H = l + v and
v.h = |H| / 2 for unit vectors, ::

    G / (4 cos cos) = min(1 / (4 cos(theta_i) cos(theta_r)),  H_z / (|H|^2 max(cos, cos)))

H is not added up from components, which loses up to 9 digits where light and view graze from
opposite sides: see `chords`.

D is not normalised: Ks > 1 is legal (albedo at normal incidence is about Ks pi sigma_s^2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry import FloatArray
from .base import LOG, Parameter
from .lobe import Lobe
from .registry import Registration

SIGMA_S_BOUNDS = (0.005, 1.5)
_TINY = 1e-150  # for denominators that vanish with their numerators
_LARGEST_LOG = 300.0  # keeps (1/sigma_s)^2 finite when a solver steps far out

KS = Parameter("ks", "1/sr", 0.0, np.inf, typical=0.8)
_INVERSE_SIGMA_S = Parameter(
    "inverse_sigma_s",
    "1/rad",
    1 / SIGMA_S_BOUNDS[1],
    1 / SIGMA_S_BOUNDS[0],
    transform=LOG,
    carried_by=(("ks",),),
    grid=tuple(-np.linspace(math.log(SIGMA_S_BOUNDS[1]), math.log(SIGMA_S_BOUNDS[0]), 20)),
    full_scale=1.0,
    typical=6.0,
)


@dataclass(frozen=True)
class Basis:
    """Geometric factor G / (4 cos cos) and theta_h (n,), the latter in radians."""

    factor: FloatArray
    theta_h: FloatArray


class TorranceSparrow(Lobe):
    """Gaussian facets with the V-cavity factor; parameters `ks, inverse_sigma_s`.

    Coloured, as metals and car paint are: `ks_b, ks_g, ks_r, inverse_sigma_s`.
    """

    amplitude = KS
    shapes = (_INVERSE_SIGMA_S,)

    def __init__(self, *, coloured: bool = False) -> None:
        super().__init__(coloured=coloured)
        self.name = "torrance_sparrow(coloured)" if coloured else "torrance_sparrow"

    def prepare(self, light: FloatArray, view: FloatArray) -> Basis:
        """Return the functions of the directions that all parameter values share."""
        return basis(light, view)

    def lobe(self, prepared: Basis, shapes: Sequence[float]) -> FloatArray:
        """D G / (4 cos cos) (n,) at log(1/sigma_s)."""
        return _lobe(prepared, shapes[0])[0]

    def sharpness(self, shapes: Sequence[float]) -> float:
        """Return log(1/sigma_s)."""
        return shapes[0]

    def lobe_slopes(
        self, prepared: Basis, shapes: Sequence[float]
    ) -> tuple[FloatArray, tuple[FloatArray]]:
        """Return the lobe and its derivative by log(1/sigma_s)."""
        lobe, exponent = _lobe(prepared, shapes[0])
        return lobe, (-2.0 * exponent * lobe,)


def basis(light: FloatArray, view: FloatArray) -> Basis:
    """Geometric factor and theta_h (n,) for unit directions (n, 3) above the horizon."""
    together, cos_light, cos_view = chords(light, view).together, light[:, 2], view[:, 2]
    height = cos_light + cos_view
    squared = together + height * height
    shadowed = height / (squared * np.maximum(cos_light, cos_view))
    factor = np.minimum(0.25 / (cos_light * cos_view), shadowed)
    # arctan2 keeps its digits where theta_h is small; arccos loses half of them
    return Basis(factor, np.arctan2(np.sqrt(together), height))


def half_vector(light: FloatArray, view: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Radius |H_xy| and height H_z (n,) of H = l + v, with the digits that `chords` keeps."""
    return np.sqrt(chords(light, view).together), light[:, 2] + view[:, 2]


@dataclass(frozen=True)
class Chords:
    """|l_xy + v_xy|^2, |l_xy - v_xy|^2 and l_xy . v_xy (n,)."""

    together: FloatArray
    apart: FloatArray
    in_plane: FloatArray


def chords(light: FloatArray, view: FloatArray) -> Chords:
    """Squared sum and difference of the directions (n, 3) in the sample's plane.

    Sums of components would lose digits where the two nearly cancel: they carry the rounding of
    the vectors' lengths, 1e-16, against a sum of 1e-12 where both graze from opposite sides. Here
    ``|l_xy +- v_xy|^2 = (sin_i - sin_r)^2 + 2 sin_i sin_r (1 +- c)``, c the cosine of the azimuths'
    difference; ``1 - |c| = sin^2 / (1 + |c|)``; the sines' difference is, at grazing,
    ``(cos_r - cos_i)(cos_r + cos_i) / (sin_i + sin_r)``.
    """
    (lx, ly, lz), (vx, vy, vz) = np.ascontiguousarray(light.T), np.ascontiguousarray(view.T)
    sine_light, sine_view = np.sqrt(lx * lx + ly * ly), np.sqrt(vx * vx + vy * vy)
    sines, cosines = sine_light + sine_view, lz + vz
    by_cosines = (vz - lz) * cosines / np.maximum(sines, _TINY)
    difference = np.where(sines > cosines, by_cosines, sine_light - sine_view)
    in_plane, across = lx * vx + ly * vy, lx * vy - ly * vx
    more = sine_light * sine_view + np.abs(in_plane)
    less = across * across / np.maximum(more, _TINY)
    square, opposite = difference * difference, in_plane < 0
    return Chords(
        together=square + 2 * np.where(opposite, less, more),
        apart=square + 2 * np.where(opposite, more, less),
        in_plane=in_plane,
    )


def _lobe(prepared: Basis, log_inverse_sigma_s: float) -> tuple[FloatArray, FloatArray]:
    inverse = math.exp(min(log_inverse_sigma_s, _LARGEST_LOG))
    # beyond 2e3 both halves are 0 anyway, and 0 x inf in the derivative must not arise
    exponent = np.minimum(np.square(prepared.theta_h * inverse), 2e3)
    # in halves: where the factor is large, the product is a number when exp(-exponent) is not yet
    half = np.exp(-0.5 * exponent)
    return prepared.factor * half * half, exponent


REGISTERED = (
    Registration(
        "torrance_sparrow",
        "specular: Gaussian facets in V-cavities, no Fresnel factor",
        TorranceSparrow,
        options=("coloured",),
        alias="TS",
    ),
)
