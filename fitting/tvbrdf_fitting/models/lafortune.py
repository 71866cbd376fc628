"""Lafortune's specular reflectance, one isotropic lobe: a power of a weighted inner product.

Source: E. P. F. Lafortune, S.-C. Foo, K. E. Torrance and D. P. Greenberg, "Non-Linear Approximation
of Reflectance Functions", SIGGRAPH 1997, with C_x = C_y::

    BRDF = rho_s max(0, C_xy (l_x v_x + l_y v_y) + C_z l_z v_z)^n

The scale of C and rho_s say the same twice. Here C_z = 1, which leaves three numbers that data can
determine, all shared by the channels: Ks = rho_s C_z^n in 1/sr, the BRDF of light and view along
the normal; cxy = C_xy / C_z, without a unit; and the exponent n. ::

    BRDF = Ks max(0, cxy (l_x v_x + l_y v_y) + l_z v_z)^n

cxy = -1 is the reciprocal Phong lobe around the mirror direction; below -1 the lobe leans towards
grazing and grows there (off-specular peak), between -1 and 0 towards the normal; 0 is a power of
both cosines; above 0 it faces the light (retro-reflection). All are reciprocal. Lobes with
C_z <= 0, seen towards grazing only, are not in the family. The width near the normal is Phong's,
1/e at sqrt(2 / n) rad. Nothing normalises it: for |cxy| > 1 it grows without bound in n.

Evaluated as exp(n log x) with x = b + t, b = l_z v_z and t = cxy (l_x v_x + l_y v_y). n multiplies
every error of log x, and near the normal, where x is close to 1, that of b's rounding and of the
vectors' lengths would be left. So both roundings are taken back::

    log x = log(fl(b + t)) + (e + beta) / b,   e = (b - fl(b + t)) + t,   beta = (1 - b) - d
    d = 1 - l_z v_z = ((1 - l_z)(1 + v_z) + (1 + l_z)(1 - v_z)) / 2,   1 - z = (x^2 + y^2) / (1 + z)

for steep directions (b > 1/2); elsewhere the error is that of the directions themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..geometry import FloatArray
from .base import Parameter
from .lobe import Lobe
from .phong import EXPONENT, exponent_of
from .registry import Registration

_LARGEST_LOBE_LOG = 200.0  # sharp lobes that lean far outgrow all numbers; no surface's does
_FAINTEST = 1e-60
_SMALLEST = 5e-324  # stands for a product that is not positive; its powers above 1 are exactly 0

EXPONENT_BOUNDS = (1.0, 1e4)
"""A plain cosine; and 0.014 rad: beyond, Ks lies ever further from what is seen of the lobe."""
_EXPONENT = replace(
    EXPONENT,
    lower=EXPONENT_BOUNDS[0],
    upper=EXPONENT_BOUNDS[1],
    grid=tuple(np.log(np.geomspace(*EXPONENT_BOUNDS, 16)).tolist()),
    typical=20.0,
)
_CXY = Parameter(
    "cxy",
    "1",
    -2.0,
    2.0,
    carried_by=(("ks",),),
    grid=(-1.5, -1.2, -1.1, -1.0, -0.9, -0.8, -0.6, -0.3, 0.0, 0.5, 1.0),
    full_scale=1.0,
    typical=-0.9,
)


@dataclass(frozen=True)
class Basis:
    """l_x v_x + l_y v_y, b = l_z v_z, its correction beta and 1 / b (n,); 0 where not steep."""

    tangential: FloatArray
    normal: FloatArray
    correction: FloatArray
    inverse: FloatArray


class Lafortune(Lobe):
    """One isotropic lobe; parameters `ks, cxy, exponent`.

    Coloured: `ks_b, ks_g, ks_r, cxy, exponent`.
    """

    amplitude = Parameter("ks", "1/sr", 0.0, np.inf, typical=0.8)
    shapes = (_CXY, _EXPONENT)

    def __init__(self, *, coloured: bool = False) -> None:
        super().__init__(coloured=coloured)
        self.name = "lafortune(coloured)" if coloured else "lafortune"

    def prepare(self, light: FloatArray, view: FloatArray) -> Basis:
        """Return the functions of the directions that all parameter values share."""
        (lx, ly, lz), (vx, vy, vz) = light.T, view.T
        normal = lz * vz
        light_from_one = (lx * lx + ly * ly) / (1 + lz)
        view_from_one = (vx * vx + vy * vy) / (1 + vz)
        from_one = 0.5 * (light_from_one * (1 + vz) + (1 + lz) * view_from_one)
        steep = normal > 0.5
        return Basis(
            lx * vx + ly * vy,
            normal,
            np.where(steep, (1 - normal) - from_one, 0.0),
            np.where(steep, 1 / np.where(steep, normal, 1.0), 0.0),
        )

    def lobe(self, prepared: Basis, shapes: Sequence[float]) -> FloatArray:
        """Return the lobe (n,) at cxy and log n."""
        cxy, exponent = shapes[0], exponent_of(shapes[1])
        log_power = _product(prepared, cxy)[1]
        log_power *= exponent
        return _exp(log_power, cxy, exponent)

    def sharpness(self, shapes: Sequence[float]) -> float:
        """Return log n."""
        return shapes[1]

    def lobe_slopes(
        self, prepared: Basis, shapes: Sequence[float]
    ) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
        """Return the lobe, and its derivatives by cxy and log n."""
        cxy, exponent = shapes[0], exponent_of(shapes[1])
        product, by_exponent = _product(prepared, cxy)
        by_exponent *= exponent
        lobe = _exp(by_exponent.copy(), cxy, exponent)
        by_exponent *= lobe
        by_cxy = prepared.tangential * exponent
        by_cxy *= product > _SMALLEST
        by_cxy *= lobe
        by_cxy /= product
        return lobe, (by_cxy, by_exponent)

    def _vector(self, prepared: Basis, shapes: Sequence[float], _typical: float) -> FloatArray:
        """Return the lobe (n,), or zeros where only an absurd amplitude could make it seen."""
        lobe = self.lobe(prepared, shapes)
        return lobe if lobe.max(initial=0.0) > _FAINTEST else np.zeros_like(lobe)


def _product(prepared: Basis, cxy: float) -> tuple[FloatArray, FloatArray]:
    """Return x (n,), or `_SMALLEST` where it is not positive, and its logarithm."""
    tangential = prepared.tangential * cxy
    product = prepared.normal + tangential
    rest = prepared.normal - product
    rest += tangential
    rest += prepared.correction
    rest *= prepared.inverse
    np.maximum(product, _SMALLEST, out=product)
    rest += np.log(product, out=tangential)
    return product, rest


def _exp(log_power: FloatArray, cxy: float, exponent: float) -> FloatArray:
    """Return the exponential of n log x (n,), which it overwrites."""
    if exponent * math.log(max(abs(cxy), 1.0)) > _LARGEST_LOBE_LOG:
        np.minimum(log_power, _LARGEST_LOBE_LOG, out=log_power)
    return np.asarray(np.exp(log_power, out=log_power))


REGISTERED = (
    Registration(
        "lafortune",
        "specular: one lobe of a weighted inner product, off-specular or retro-reflecting",
        Lafortune,
        options=("coloured",),
    ),
)
