"""Rough surfaces of tiny mirror facets: how their slopes are distributed, how they hide each other.

Sources: P. Beckmann and A. Spizzichino, "The Scattering of Electromagnetic Waves from Rough
Surfaces", 1963; B. G. Smith, "Geometrical Shadowing of a Random Rough Surface", 1967; B. Walter,
S. R. Marschner, H. Li and K. E. Torrance, "Microfacet Models for Refraction through Rough
Surfaces", EGSR 2007 (equations 23 to 28 and 33 to 34).

Parameter: alpha, the facets' slope (sqrt(2) times its deviation along one tangent for Beckmann).
With t = tan(theta), a = 1 / (alpha t)::

    Beckmann  P = exp(-t^2 / alpha^2) / (pi alpha^2)
              G1 = 2 / (1 + erf(a) + alpha t exp(-a^2) / sqrt(pi))
    GGX       P = alpha^2 / (pi (alpha^2 + t^2)^2)
              G1 = 2 / (1 + sqrt(1 + alpha^2 t^2))

P is the density of slopes (1 over the plane of slopes); facets' normals have D = P / cos^4(theta_h)
in 1/sr, and the integral of D cos(theta_h) over the hemisphere is 1. G1 is Smith's masking, exact
where Walter et al. give a rational approximation (0.35 % off) for Beckmann.

Light and view are masked independently, G = G1(l) G1(v), as in Walter et al. and in the renderers
that a fit is compared with or handed to. Masking that knows of the facets' height (with Lambda =
1 / G1 - 1, G = 1 / (1 + Lambda_l + Lambda_v)) is brighter at grazing, and makes the BRDF infinite
where both directions graze; the product stays finite everywhere::

    D G / (4 cos cos) = P(t_h) (1 + t_h^2)^2 G1(t_i) G1(t_r) / (4 cos(theta_i) cos(theta_r))
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from ..geometry import FloatArray, IntArray
from .torrance_sparrow import half_vector

_LOWEST_COSINE = 1e-40  # below any cosine in practice; keeps tangents and their powers finite
_LOWEST_PRODUCT = 0.025  # of alpha and tangent: below, erf(a) is 1 and exp(-a^2) is 0


@dataclass(frozen=True)
class Basis:
    """What the directions determine.

    Attributes
    ----------
    tan_squared_h
        (n,) square of tan(theta_h).
    factor
        (n,) 1 / (4 cos^4(theta_h) cos(theta_i) cos(theta_r)).
    tangents
        Distinct values of tan(theta_i) and tan(theta_r): a rig has few.
    where
        (2, n) positions in `tangents` of light and view.
    cos_d, cos_d_squared
        (n,) cosine of light or view to the half vector, and its square.
    """

    tan_squared_h: FloatArray
    factor: FloatArray
    tangents: FloatArray
    where: IntArray
    cos_d: FloatArray
    cos_d_squared: FloatArray


def basis(light: FloatArray, view: FloatArray) -> Basis:
    """Return the functions of unit directions (n, 3) above the horizon."""
    radius, height = half_vector(light, view)
    height = np.maximum(height, _LOWEST_COSINE)
    tan_squared_h = np.square(radius / height)
    directions = np.stack([light, view])
    cosines = np.maximum(directions[..., 2], _LOWEST_COSINE)
    tangents = np.hypot(directions[..., 0], directions[..., 1]) / cosines
    distinct, where = np.unique(tangents, return_inverse=True)
    cos_d_squared = 0.25 * (radius * radius + height * height)
    return Basis(
        tan_squared_h=tan_squared_h,
        factor=np.square(1 + tan_squared_h) / (4 * cosines[0] * cosines[1]),
        tangents=distinct,
        where=where.reshape(tangents.shape),
        cos_d=np.sqrt(cos_d_squared),
        cos_d_squared=cos_d_squared,
    )


class Facets(ABC):
    """A distribution of facets' slopes, with the masking that belongs to it."""

    @abstractmethod
    def density(self, tan_squared: FloatArray, alpha: float) -> FloatArray:
        """Return P at squared tangents of the facets' angle to the normal."""

    @abstractmethod
    def masking(self, tangent: FloatArray, alpha: float) -> FloatArray:
        """Return G1, the visible share of the facets, at tangents of a direction's angle."""

    @abstractmethod
    def changes(self, prepared: Basis, alpha: float) -> tuple[FloatArray, FloatArray]:
        """Return how P (n,) and G1 (at `tangents`) change with alpha.

        The sum for P, light and view is the derivative of log(P G1 G1) by log(alpha). Constants
        that cancel in this sum are left out: where all graze, nothing else would be left of it.
        """

    def reflected(self, prepared: Basis, alpha: float) -> FloatArray:
        """D G / (4 cos cos) (n,): the BRDF of facets that reflect everything once."""
        masking = self.masking(prepared.tangents, alpha).take(prepared.where)
        product = masking[0]
        product *= masking[1]  # first of all, so that light and view may be exchanged
        product *= prepared.factor
        # the density last: it may be next to the smallest number, and the factor large
        product *= self.density(prepared.tan_squared_h, alpha)
        return np.asarray(product)

    def reflected_slope(self, prepared: Basis, alpha: float) -> tuple[FloatArray, FloatArray]:
        """Return `reflected`, and the derivative of its logarithm by log(alpha)."""
        slope, masking = self.changes(prepared, alpha)
        masking = masking.take(prepared.where)
        slope += masking[0]
        slope += masking[1]
        return self.reflected(prepared, alpha), slope


class Beckmann(Facets):
    """Gaussian slopes."""

    def density(self, tan_squared: FloatArray, alpha: float) -> FloatArray:
        """Return P at squared tangents."""
        density = tan_squared * (-1 / alpha**2)
        np.exp(density, out=density)
        density *= 1 / (math.pi * alpha**2)
        return density

    def masking(self, tangent: FloatArray, alpha: float) -> FloatArray:
        """Return G1 at tangents."""
        total, _ = _beckmann_masking(tangent, alpha)
        return np.asarray(2 / total)

    def changes(self, prepared: Basis, alpha: float) -> tuple[FloatArray, FloatArray]:
        """2 (t^2 / alpha^2 - 1), and the share of the exponential in 1 / G1 with a minus."""
        total, tail = _beckmann_masking(prepared.tangents, alpha)
        density = prepared.tan_squared_h * (2 / alpha**2)
        density -= 2
        # in that of 1 / G1, the derivatives of erf and of the exponential cancel exactly
        return np.asarray(density), np.asarray(-tail / total)


class GGX(Facets):
    """Trowbridge and Reitz's slopes: a lobe with a long tail."""

    def density(self, tan_squared: FloatArray, alpha: float) -> FloatArray:
        """Return P at squared tangents."""
        density = tan_squared + alpha**2
        np.divide(alpha / math.sqrt(math.pi), density, out=density)
        density *= density
        return density

    def masking(self, tangent: FloatArray, alpha: float) -> FloatArray:
        """Return G1 at tangents."""
        return np.asarray(2 / (1 + np.sqrt(1 + np.square(alpha * tangent))))

    def changes(self, prepared: Basis, alpha: float) -> tuple[FloatArray, FloatArray]:
        """Return -4 alpha^2 / (alpha^2 + t^2) and 1 / sqrt(1 + alpha^2 t^2).

        Of 2 - 4 alpha^2 / ... and of 1 / sqrt(...) - 1, twice, the constants cancel.
        """
        masking = 1 / np.sqrt(1 + np.square(alpha * prepared.tangents))
        density = prepared.tan_squared_h + alpha**2
        np.divide(-4 * alpha**2, density, out=density)
        return np.asarray(density), np.asarray(masking)


def _beckmann_masking(tangent: FloatArray, alpha: float) -> tuple[FloatArray, FloatArray]:
    """Return 2 / G1, and the part of it that has the exponential."""
    product = alpha * tangent
    a = 1 / np.maximum(product, _LOWEST_PRODUCT)
    tail = product * np.exp(-a * a) * (1 / math.sqrt(math.pi))
    from scipy.special import erf  # takes longer to load than all models together

    return 1 + erf(a) + tail, tail
