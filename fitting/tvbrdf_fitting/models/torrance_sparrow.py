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

    def lobe_slopes(
        self, prepared: Basis, shapes: Sequence[float]
    ) -> tuple[FloatArray, tuple[FloatArray]]:
        """Return the lobe and its derivative by log(1/sigma_s)."""
        lobe, exponent = _lobe(prepared, shapes[0])
        return lobe, (-2.0 * exponent * lobe,)


def basis(light: FloatArray, view: FloatArray) -> Basis:
    """Geometric factor and theta_h (n,) for unit directions (n, 3) above the horizon."""
    half = light + view
    squared = np.einsum("ij,ij->i", half, half)
    cos_light, cos_view = light[:, 2], view[:, 2]
    shadowed = half[:, 2] / (squared * np.maximum(cos_light, cos_view))
    factor = np.minimum(0.25 / (cos_light * cos_view), shadowed)
    # arctan2 keeps its digits where theta_h is small; arccos loses half of them
    theta_h = np.arctan2(np.hypot(half[:, 0], half[:, 1]), half[:, 2])
    return Basis(factor, theta_h)


def _lobe(prepared: Basis, log_inverse_sigma_s: float) -> tuple[FloatArray, FloatArray]:
    inverse = math.exp(min(log_inverse_sigma_s, _LARGEST_LOG))
    # beyond 1e3 the exponential is 0 anyway, and 0 x inf in the derivative must not arise
    exponent = np.minimum(np.square(prepared.theta_h * inverse), 1e3)
    return prepared.factor * np.exp(-exponent), exponent


REGISTERED = (
    Registration(
        "torrance_sparrow",
        "specular: Gaussian facets in V-cavities, no Fresnel factor",
        TorranceSparrow,
        options=("coloured",),
    ),
)
