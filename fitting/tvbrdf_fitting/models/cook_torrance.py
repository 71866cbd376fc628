"""Cook-Torrance specular reflectance: Beckmann or GGX facets, Smith masking, exact Fresnel.

Sources: R. L. Cook and K. E. Torrance, "A Reflectance Model for Computer Graphics", ACM TOG 1982;
B. Walter, S. R. Marschner, H. Li and K. E. Torrance, "Microfacet Models for Refraction through
Rough Surfaces", EGSR 2007 (equation 20).

Parameters, all shared by the channels: Ks without a unit, 1 for a physical surface; alpha, the
facets' slope; eta, the refractive index. `conductor` has eta and k, the parts of a complex index.
With h the half vector and theta_d the angle of light or view to it::

    BRDF = Ks D(theta_h) F(theta_d) G / (4 cos(theta_i) cos(theta_r))

D is normalised and the denominator has a 4, as in Walter et al. (Cook and Torrance print pi, with
another scale of D). G is Smith's product of two maskings, for their V-cavities; formulas in
`facets`. F is Fresnel's reflectance of unpolarised light, in `fresnel`. Facets reflect once, so the
albedo is at most Ks.

Ks and eta are nearly confounded: at angles theta_d below some 50 degrees F is nearly its value at
normal incidence, ((eta - 1) / (eta + 1))^2, and only the rise towards grazing tells them apart.
Inside, eta is log(eta - 1): F goes to 0 with eta - 1, and no step leads to an index below 1, where
light is totally reflected. `coloured`: the colour of a metal is in Ks, its eta and k are shared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..geometry import FloatArray
from .base import LOG, Parameter, Transform
from .facets import GGX, Basis, Beckmann, Facets, basis
from .fresnel import (
    conductor_reflectance,
    conductor_reflectance_slopes,
    dielectric_reflectance,
    dielectric_reflectance_slope,
)
from .lobe import Lobe
from .registry import Registration, label

ALPHA_BOUNDS = (0.005, 1.5)
ETA_BOUNDS = (1.05, 3.0)
_LARGEST_LOG = 50.0  # keeps powers of the shapes finite when a solver steps far out

_LOG_LESS_1 = Transform(
    "log({} - 1)",
    lambda v: math.log(v - 1.0),
    lambda x: 1.0 + math.exp(x),
    lambda v: 1.0 / (v - 1.0),
)
_CARRIED = (("ks",),)
_ALPHA = Parameter(
    "alpha",
    "1",
    *ALPHA_BOUNDS,
    transform=LOG,
    carried_by=_CARRIED,
    grid=tuple(np.log(np.geomspace(*ALPHA_BOUNDS, 18)).tolist()),
    full_scale=1.0,
    typical=0.2,
)
_ETA = Parameter(
    "eta",
    "1",
    *ETA_BOUNDS,
    transform=_LOG_LESS_1,
    carried_by=_CARRIED,
    grid=tuple(math.log(eta - 1) for eta in (1.12, 1.35, 1.7, 2.4)),
    full_scale=1.0,
    typical=1.5,
)
_METAL = (
    Parameter(
        "eta",
        "1",
        0.05,
        6.0,
        transform=LOG,
        carried_by=_CARRIED,
        grid=tuple(math.log(eta) for eta in (0.2, 0.8, 3.0)),
        full_scale=1.0,
        typical=1.1,
    ),
    Parameter(
        "k",
        "1",
        0.1,
        12.0,
        transform=LOG,
        carried_by=_CARRIED,
        grid=tuple(math.log(k) for k in (1.5, 3.0, 6.0)),
        full_scale=1.0,
        typical=4.0,
    ),
)


class CookTorrance(Lobe):
    """Facets with Fresnel reflectance; parameters `ks, alpha, eta`, or `ks, alpha, eta, k`.

    Coloured: `ks_b, ks_g, ks_r` for `ks`.
    """

    amplitude = Parameter("ks", "1", 0.0, np.inf, typical=0.9)

    def __init__(
        self, *, ggx: bool = False, conductor: bool = False, coloured: bool = False
    ) -> None:
        self.shapes = (_ALPHA, *_METAL) if conductor else (_ALPHA, _ETA)
        super().__init__(coloured=coloured)
        self._conductor = conductor
        self._facets: Facets = GGX() if ggx else Beckmann()
        amplitudes = self.terms[0].amplitudes
        self.confounded = tuple((name, p.name) for p in self.shapes[1:] for name in amplitudes)
        if conductor:
            self.confounded += (("eta", "k"),)
        given = {"ggx": ggx, "conductor": conductor, "coloured": coloured}
        self.name = label("cook_torrance", *(option for option, is_on in given.items() if is_on))

    def prepare(self, light: FloatArray, view: FloatArray) -> Basis:
        """Return the functions of the directions that all parameter values share."""
        return basis(light, view)

    def lobe(self, prepared: Basis, shapes: Sequence[float]) -> FloatArray:
        """D F G / (4 cos cos) (n,) at log(alpha) and log(eta - 1), or log(eta) and log(k)."""
        alpha, *index = (_exp(shape) for shape in shapes)
        lobe = self._facets.reflected(prepared, alpha)
        if self._conductor:
            lobe *= conductor_reflectance(prepared.cos_d, *index)
        else:
            lobe *= dielectric_reflectance(prepared.cos_d, prepared.cos_d_squared, *index)
        return lobe

    def sharpness(self, shapes: Sequence[float]) -> float:
        """Return -log(alpha)."""
        return -shapes[0]

    def lobe_slopes(
        self, prepared: Basis, shapes: Sequence[float]
    ) -> tuple[FloatArray, Sequence[FloatArray]]:
        """Return the lobe, and its derivatives by the shapes."""
        alpha, *index = (_exp(shape) for shape in shapes)
        lobe, slope = self._facets.reflected_slope(prepared, alpha)
        if self._conductor:
            fresnel, *by_index = conductor_reflectance_slopes(prepared.cos_d, *index)
        else:
            cosines = prepared.cos_d, prepared.cos_d_squared
            fresnel, *by_index = dielectric_reflectance_slope(*cosines, *index)
        # the internal coordinate's derivative is the exponential itself
        turns = [by * (exp * lobe) for by, exp in zip(by_index, index, strict=True)]
        lobe *= fresnel
        slope *= lobe
        return lobe, (slope, *turns)


def _exp(shape: float) -> float:
    return math.exp(min(max(shape, -_LARGEST_LOG), _LARGEST_LOG))


REGISTERED = (
    Registration(
        "cook_torrance",
        "specular: Beckmann or GGX facets, Smith masking, Fresnel of dielectrics or conductors",
        CookTorrance,
        options=("ggx", "conductor", "coloured"),
    ),
)
