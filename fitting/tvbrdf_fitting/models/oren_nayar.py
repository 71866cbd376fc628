"""Oren-Nayar diffuse reflectance: V-shaped Lambertian facets, with inter-reflection.

Source: M. Oren and S. K. Nayar, "Generalization of Lambert's Reflectance Model", SIGGRAPH 1994,
full form; the short ("qualitative") form is another model.

Parameters: Kd (one a channel), sigma_d, standard deviation of the facets' slope angle in radians.
With alpha = max(theta_i, theta_r), beta = min(theta_i, theta_r), c = cos(phi_r - phi_i) and
s = sigma_d^2::

    C1 = 1 - 0.5 s / (s + 0.33)
    C2 = 0.45 s / (s + 0.09) (sin alpha - [c < 0] (2 beta / pi)^3)
    C3 = 0.125 s / (s + 0.09) (4 alpha beta / pi^2)^2
    rho_1 = Kd / pi (C1 + c C2 tan beta + (1 - |c|) C3 tan((alpha + beta) / 2))
    rho_2 = 0.17 Kd^2 / pi  s / (s + 0.13) (1 - c (2 beta / pi)^2)
    BRDF = rho_1 + rho_2

C2 and C3 share their factor of s, so three functions of the directions carry everything::

    pi BRDF = Kd C1(s) + Kd B(s) g1 + Kd^2 E(s) g2,  B = s / (s + 0.09), E = 0.17 s / (s + 0.13)

g1 and g2 are evaluated without azimuths and without differences of nearly equal numbers (the
printed forms lose up to 11 digits at grazing). sigma_d = 0 is Lambert. Albedo can exceed 1
for light Kd at grazing; values can be slightly negative for sigma_d >= 0.67.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry import FloatArray
from .base import SQUARE, Parameter, ReflectanceModel, Term
from .registry import Registration

KD = Parameter("kd", "1", 0.0, np.inf, full_scale=1.0)
_KD = KD.one_a_channel()
KD_NAMES = tuple(p.name for p in _KD)
SIGMA_D = Parameter(
    "sigma_d",
    "rad",
    0.0,
    1.5,
    transform=SQUARE,
    carried_by=(KD_NAMES,),
    grid=(0.0, 0.02, 0.07, 0.2, 0.6, 1.5),
    full_scale=2.25,
    typical=0.4,
)


@dataclass(frozen=True)
class Basis:
    """g1 and g2 (n,) of the module's header."""

    g1: FloatArray
    g2: FloatArray


class OrenNayar(ReflectanceModel):
    """The full model of 1994; parameters `kd_b, kd_g, kd_r, sigma_d`."""

    name = "oren_nayar"
    diffuse = True
    nonnegative = False
    parameters = (*_KD, SIGMA_D)

    def __init__(self) -> None:
        self.terms = (Term(KD_NAMES, ("sigma_d",), _diffuse_vector),)

    def prepare(self, light: FloatArray, view: FloatArray) -> Basis:
        """Return the functions of the directions that all parameter values share."""
        return basis(light, view)

    def value(self, prepared: Basis, internal: FloatArray) -> FloatArray:
        """BRDF (3, n)."""
        kd, (c1, b, e) = internal[:3, None], _coefficients(float(internal[3]))
        single = (c1 + b * prepared.g1) / np.pi
        return np.asarray(kd * single + (kd * kd) * (e / np.pi * prepared.g2))

    def add_jacobian(self, prepared: Basis, internal: FloatArray, out: FloatArray) -> None:
        """Write the derivatives by Kd and sigma_d^2."""
        s = float(internal[3])
        c1, b, e = _coefficients(s)
        slope_c1, slope_b, slope_e = _coefficient_slopes(s)
        single = (c1 + b * prepared.g1) / np.pi
        multiple = prepared.g2 / np.pi
        slope = (slope_c1 + slope_b * prepared.g1) / np.pi
        for channel in range(3):
            kd = float(internal[channel])
            np.multiply(multiple, 2.0 * kd * e, out=out[channel, channel])
            out[channel, channel] += single
            np.multiply(multiple, kd * kd * slope_e, out=out[3, channel])
            out[3, channel] += kd * slope


def basis(light: FloatArray, view: FloatArray) -> Basis:
    """g1 and g2 (n,) for unit directions (n, 3) above the horizon.

    Stable forms: ``c sin(alpha) tan(beta)`` as ``l_xy . v_xy / cos(beta)``; C2's bracket for
    c < 0 as ``-cos^2(alpha)/(1 + sin(alpha)) + x (3 - 3 x + x^2)``, x = 1 - 2 beta/pi;
    ``1 - |c|`` as ``sin^2(dphi)/(1 + |c|)``; the tangent of the half sum as a quotient of sums.
    """
    (lx, ly, lz), (vx, vy, vz) = np.ascontiguousarray(light.T), np.ascontiguousarray(view.T)
    # tilts below 1e-154 underflow to 0, and make no difference
    sine_light, sine_view = np.sqrt(lx * lx + ly * ly), np.sqrt(vx * vx + vy * vy)
    cos_a, cos_b = np.minimum(lz, vz), np.maximum(lz, vz)
    sin_a, sin_b = np.maximum(sine_light, sine_view), np.minimum(sine_light, sine_view)
    x = np.arctan2(cos_b, sin_b) * (2 / np.pi)
    # in units of pi/2; where beta is small its digits do not count beside C1
    alpha, beta = np.arctan2(sin_a, cos_a) * (2 / np.pi), 1 - x

    in_plane = lx * vx + ly * vy
    # Where either direction is the normal, azimuth is undefined, and beta = 0 removes its terms.
    product = np.maximum(sin_a * sin_b, 1e-150)
    cosine, sine = in_plane / product, (lx * vy - ly * vx) / product

    bracket = x * (3 - x * (3 - x)) - cos_a * cos_a / (1 + sin_a)
    single = np.where(cosine < 0, cosine * sin_b * bracket, in_plane) * (0.45 / cos_b)
    half_sum = (sin_a + sin_b) / (cos_a + cos_b)
    single += 0.125 * (sine * sine) / (1 + np.abs(cosine)) * np.square(alpha * beta) * half_sum
    return Basis(single, 1 - cosine * (beta * beta))


def single_bounce(s: float, constant: float = 0.33) -> tuple[float, float]:
    """C1 and B at s = sigma_d^2; for s < 0, where a solver may step, their tangents."""
    if s < 0:
        return 1 - 0.5 * s / constant, s / 0.09
    return 1 - 0.5 * s / (s + constant), s / (s + 0.09)


def single_bounce_slopes(s: float, constant: float = 0.33) -> tuple[float, float]:
    """Return the derivatives of C1 and B by s."""
    s = max(s, 0.0)
    return -0.5 * constant / (s + constant) ** 2, 0.09 / (s + 0.09) ** 2


def _coefficients(s: float) -> tuple[float, float, float]:
    return *single_bounce(s), 0.17 * s / (max(s, 0.0) + 0.13)


def _coefficient_slopes(s: float) -> tuple[float, float, float]:
    return *single_bounce_slopes(s), 0.17 * 0.13 / (max(s, 0.0) + 0.13) ** 2


def _diffuse_vector(prepared: Basis, shapes: Sequence[float], typical_kd: float) -> FloatArray:
    c1, b, e = _coefficients(shapes[0])
    return np.asarray((c1 + b * prepared.g1 + (typical_kd * e) * prepared.g2) / np.pi)


REGISTERED = (
    Registration(
        "oren_nayar", "diffuse: V-shaped Lambertian facets, full form", OrenNayar, alias="ON"
    ),
)
