"""Smooth interfaces: Fresnel reflectance, Snell's law, total reflection, the eta^2 of radiance.

The interface is the plane z = 0, its normal z; light is unpolarised. `eta` is the refractive index
of what lies below divided by that of what lies above; cos(theta) > 0 means incidence from above,
< 0 from below. Formulas and their sources: `fresnel`, with c = |cos(theta)|.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import BoolArray, FloatArray, as_vectors
from .fresnel import conductor_reflectance, conductor_reflectance_slopes, g_squared, wave_of


class DielectricSlopes(NamedTuple):
    """Reflectance of a dielectric and its derivatives by cos(theta) and eta, all of one shape."""

    reflectance: FloatArray
    by_cos: FloatArray
    by_eta: FloatArray


class ConductorSlopes(NamedTuple):
    """Reflectance of a conductor and its derivatives by cos(theta), eta and k, all of one shape."""

    reflectance: FloatArray
    by_cos: FloatArray
    by_eta: FloatArray
    by_k: FloatArray


class Refraction(NamedTuple):
    """Refracted directions (..., 3), and where (...) there is one.

    Where the light is totally reflected, `transmitted` is False and the direction is (0, 0, 0).
    """

    direction: FloatArray
    transmitted: BoolArray


def fresnel_dielectric(cos_theta: ArrayLike, eta: ArrayLike) -> FloatArray:
    """Fresnel reflectance of an interface between two dielectrics, for unpolarised light.

    Parameters
    ----------
    cos_theta
        Cosine of the angle of incidence, any shape; negative from below.
    eta
        Refractive index of below over above, > 0; broadcasts with `cos_theta`.

    Returns
    -------
    reflectance in [0, 1]; 1 where the light is totally reflected, 0 where eta is 1
    """
    side = _incidence(cos_theta, eta)
    factor = side.m / side.total
    inverse = 1 / side.total
    brewster = _brewster(side)
    value = 0.5 * factor * factor * (inverse * inverse + brewster * brewster)
    return np.asarray(np.where(side.refracts, value, 1.0))


def transmittance_dielectric(cos_theta: ArrayLike, eta: ArrayLike) -> FloatArray:
    """Return 1 - `fresnel_dielectric` without loss of digits where nearly all is reflected.

    The share of the power that crosses the interface: (t_s^2 + t_p^2) / 2 times the ratio of
    indices and cosines. 0 where the light is totally reflected.
    """
    side = _incidence(cos_theta, eta)
    value = 2 * side.c * side.g * (1 / side.total**2 + side.squared / side.parallel**2)
    return np.asarray(np.where(side.refracts, value, 0.0))


def fresnel_dielectric_slopes(cos_theta: ArrayLike, eta: ArrayLike) -> DielectricSlopes:
    """Return `fresnel_dielectric` and its derivatives by cos(theta) and eta.

    The derivatives are 0 where the light is totally reflected, the critical angle included (from
    the other side of it they are infinite).
    """
    side = _incidence(cos_theta, eta)
    by_cos, by_n = _dielectric_slopes(side)
    signed = np.where(side.from_above, by_cos, -by_cos)
    # from below the relative index is 1 / eta
    by_eta = np.where(side.from_above, by_n, -by_n * side.squared)
    return DielectricSlopes(
        fresnel_dielectric(cos_theta, eta),
        np.where(side.refracts, signed, 0.0),
        np.where(side.refracts, by_eta, 0.0),
    )


def fresnel_conductor(cos_theta: ArrayLike, eta: ArrayLike, k: ArrayLike) -> FloatArray:
    """Fresnel reflectance of a conductor, for unpolarised light.

    Parameters
    ----------
    cos_theta
        Cosine of the angle of incidence, in [0, 1], any shape.
    eta, k
        Real and imaginary part of the conductor's refractive index over that of what lies above;
        eta > 0, k >= 0; they broadcast with `cos_theta`.
    """
    return conductor_reflectance(*_metal(cos_theta, eta, k))


def fresnel_conductor_slopes(cos_theta: ArrayLike, eta: ArrayLike, k: ArrayLike) -> ConductorSlopes:
    """Return `fresnel_conductor` and its derivatives by cos(theta), eta and k."""
    cos, index, extinction = _metal(cos_theta, eta, k)
    value, by_eta, by_k = conductor_reflectance_slopes(cos, index, extinction)
    wave = wave_of(cos, index, extinction)
    # dF/dc = 2 |r_s|^2 / |g|^2 (Re(n^2 g* X* Y*) / |Y|^4 - a), where X Y = c^2 g^2 - sin^4
    square, twice = (index - extinction) * (index + extinction), 2 * index * extinction
    xy_real = cos * cos * wave.g_real - wave.sine_squared**2
    real = (square * wave.a + twice * wave.b) * xy_real
    real += (twice * wave.a - square * wave.b) * (cos * cos * twice)
    by_cos = (2 * wave.perpendicular) / wave.modulus * (real / wave.y_squared**2 - wave.a)
    return ConductorSlopes(value, np.asarray(by_cos), by_eta, by_k)


def normal_reflectance(eta: ArrayLike, k: ArrayLike = 0.0) -> FloatArray:
    """Reflectance F0 at normal incidence, ((eta - 1)^2 + k^2) / ((eta + 1)^2 + k^2)."""
    index, extinction = _positive("eta", eta), _not_negative("k", k)
    squared = extinction * extinction
    return np.asarray(((index - 1) ** 2 + squared) / ((index + 1) ** 2 + squared))


def eta_of_normal_reflectance(f0: ArrayLike) -> FloatArray:
    """Refractive index >= 1 of the dielectric that reflects F0 in [0, 1) at normal incidence.

    From below, or where the thinner medium lies below, the index is its inverse.
    """
    reflectance = np.asarray(f0, dtype=np.float64)
    _require("f0", reflectance, (reflectance >= 0) & (reflectance < 1), "in [0, 1)")
    root = np.sqrt(reflectance)
    return np.asarray((1 + root) / (1 - root))


def reflect(direction: ArrayLike) -> FloatArray:
    """Mirror directions (..., 3) of directions that point away from the interface."""
    vectors = as_vectors(direction)
    return np.asarray(vectors * np.array([-1.0, -1.0, 1.0]))


def refract(direction: ArrayLike, eta: ArrayLike) -> Refraction:
    """Refract directions by Snell's law.

    Parameters
    ----------
    direction
        (..., 3) unit vectors from the interface to where light comes from; z < 0: from below.
    eta
        Refractive index of below over above, > 0; broadcasts with `direction[..., 0]`.

    Returns
    -------
    Unit vectors from the interface to where the refracted light goes, on its other side; and where
    there is refracted light at all.
    """
    vectors = as_vectors(direction)
    side = _incidence(vectors[..., 2], eta)
    n = np.sqrt(side.squared)
    onward = np.stack(
        np.broadcast_arrays(
            -vectors[..., 0] / n,
            -vectors[..., 1] / n,
            np.where(side.from_above, -side.g, side.g) / n,
        ),
        axis=-1,
    )
    crosses = side.refracts
    return Refraction(np.where(crosses[..., None], onward, 0.0), crosses)


def radiance_scale(cos_theta: ArrayLike, eta: ArrayLike) -> FloatArray:
    """Factor by which an interface changes the radiance of the light that crosses it.

    Power is kept but solid angles are squeezed, so radiance is multiplied by the square of the
    relative index: eta^2 for light from above (cos_theta > 0), 1 / eta^2 from below.
    """
    cos, index = np.asarray(cos_theta, dtype=np.float64), _positive("eta", eta)
    return np.asarray(np.where(cos < 0, 1 / (index * index), index * index))


# --- incidence from either side


class _Incidence(NamedTuple):
    """`fresnel`'s c, g, m and n^2, c + g, n^2 c + g, and masks; g is 1 where not refracted."""

    c: FloatArray
    g: FloatArray
    m: FloatArray
    squared: FloatArray
    total: FloatArray
    parallel: FloatArray
    from_above: BoolArray
    refracts: BoolArray


def _incidence(cos_theta: ArrayLike, eta: ArrayLike) -> _Incidence:
    cos, index = np.broadcast_arrays(np.asarray(cos_theta, dtype=np.float64), _positive("eta", eta))
    from_above = cos >= 0
    c = np.abs(cos)
    m = (index - 1) * (index + 1)
    m = np.where(from_above, m, -m / (index * index))
    squared = np.where(from_above, index * index, 1 / (index * index))
    squared_g = g_squared(c * c, (1 - c) * (1 + c), squared, m)
    # where there is no interface (eta = 1) grazing light goes on as well
    refracts = ~(squared_g <= 0) | (m == 0)
    g = np.sqrt(np.where(squared_g > 0, squared_g, 1.0))
    return _Incidence(c, g, m, squared, c + g, squared * c + g, from_above, refracts)


def _brewster(side: _Incidence) -> FloatArray:
    """(c (c + g) - 1) / (n^2 c + g): 0 at Brewster's angle."""
    return np.asarray((side.c * side.total - 1) / side.parallel)


def _dielectric_slopes(side: _Incidence) -> tuple[FloatArray, FloatArray]:
    """Derivatives of F by c and by n."""
    fourth = 1 / side.total**4
    cross = _brewster(side) / (side.total * side.parallel**2)
    scale = 2 * side.m / side.g
    by_c = scale * side.m * (side.squared * cross - fourth)
    by_n = scale * side.c * np.sqrt(side.squared)
    by_n = by_n * (fourth + (2 * side.c**2 + side.m - 1) * cross)
    return by_c, by_n


def _metal(
    cos_theta: ArrayLike, eta: ArrayLike, k: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    cos = _not_negative("cos_theta of a conductor", cos_theta)
    return cos, _positive("eta", eta), _not_negative("k", k)


def _positive(name: str, value: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(value, dtype=np.float64)
    _require(name, array, (array > 0) & (array < np.inf), "finite and > 0")
    return array


def _not_negative(name: str, value: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(value, dtype=np.float64)
    _require(name, array, (array >= 0) & (array < np.inf), "finite and >= 0")
    return array


def _require(name: str, array: FloatArray, valid: NDArray[np.bool_], what: str) -> None:
    if not valid.all():
        raise ValueError(f"{name} must be {what}, got {float(array[~valid].flat[0])}")
