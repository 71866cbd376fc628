"""Smooth interfaces: Fresnel reflectance, Snell's law, total reflection, the eta^2 of radiance.

Source: M. Born and E. Wolf, "Principles of Optics", sections 1.5 and 14.2; R. L. Cook and
K. E. Torrance, "A Reflectance Model for Computer Graphics", 1982, for the unpolarised form.

The interface is the plane z = 0, its normal z; light is unpolarised. `eta` is the refractive index
of what lies below divided by that of what lies above; cos(theta) > 0 means incidence from above,
< 0 from below. With n the index relative to the side of incidence, c = |cos(theta)| and
g = n cos(theta_t)::

    g^2 = c^2 + m,  m = n^2 - 1                               (total reflection where g^2 <= 0)
    r_s = (c - g) / (c + g)                = -m / (c + g)^2
    r_p = (n^2 c - g) / (n^2 c + g)        =  m (c (c + g) - 1) / ((c + g) (n^2 c + g))
    F   = (r_s^2 + r_p^2) / 2

The right-hand forms keep all digits also for n near 1, as m is (n - 1)(n + 1). A conductor is the
same with n = eta + i k and moduli.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import BoolArray, FloatArray

Numbers = float | FloatArray

_TINY = np.finfo(np.float64).tiny


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
    wave = _wave(cos, index, extinction)
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
    vectors = _vectors(direction)
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
    vectors = _vectors(direction)
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


# --- inner loops of the models: no checks, arguments as prepared


def dielectric_reflectance(cos: FloatArray, cos_squared: FloatArray, excess: float) -> FloatArray:
    """Reflectance (n,) from above, for cosines (n,) > 0, their squares, and eta - 1 > 0."""
    m = excess * (excess + 2)
    g = np.sqrt(cos_squared + m)
    total = cos + g
    parallel = (1 + m) * cos
    parallel += g
    brewster = cos * total
    brewster -= 1
    brewster /= parallel
    brewster *= brewster
    total *= total
    np.divide(1, total, out=total)
    brewster += total
    brewster *= total
    brewster *= 0.5 * m * m
    return brewster


def dielectric_reflectance_slope(
    cos: FloatArray, cos_squared: FloatArray, excess: float
) -> tuple[FloatArray, FloatArray]:
    """`dielectric_reflectance` (n,) and its derivative by eta, arguments as there."""
    m = excess * (excess + 2)
    n = 1 + excess
    g = np.sqrt(cos_squared + m)
    inverse = 1 / (cos + g)
    parallel = 1 / ((1 + m) * cos + g)
    brewster = (cos * (cos + g) - 1) * parallel
    squared = inverse * inverse
    value = (0.5 * m * m) * squared * (squared + brewster * brewster)
    bracket = squared * squared + brewster * (2 * cos_squared + (m - 1)) * inverse * parallel**2
    return value, (2 * n * m) * cos / g * bracket


def conductor_reflectance(cos: FloatArray, eta: Numbers, k: Numbers) -> FloatArray:
    """Reflectance of a conductor, arguments as for `fresnel_conductor`."""
    wave = _wave(cos, eta, k)
    return np.asarray(0.5 * wave.perpendicular * (1 + wave.x_squared / wave.y_squared))


def conductor_reflectance_slopes(
    cos: FloatArray, eta: Numbers, k: Numbers
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`conductor_reflectance` and its derivatives by eta and k.

    With n = eta + i k, z = n^2 / g and * for conjugates, F = 1 - (T_s + T_p) / 2, ::

        T_s = 4 c Re(g) / |c + g|^2,     q_s = -4 c / |c + g|^4 (n / g) m*
        T_p = 4 c Re(z) / |1 + c z|^2,   q_p = 4 c / |1 + c z|^4 (dz/dn) (1 - c^2 z^2)*

    and dT/deta = Re(q), dT/dk = -Im(q). The parts of n / g, z and dz/dn are sums that hardly cancel
    for a metal; there F depends on k so little that complex products would lose the derivative.
    """
    wave = _wave(cos, eta, k)
    value = 0.5 * wave.perpendicular * (1 + wave.x_squared / wave.y_squared)
    a, b, square, sine = wave.a, wave.b, cos * cos, wave.sine_squared
    inverse = 1 / wave.modulus
    twice, norm = 2 * eta * k, eta**2 + k**2
    m = (eta - 1) * (eta + 1) - k**2
    share = sine / (b * b + eta**2)
    # n / g = u + i v
    u = (eta * a + k * b) * inverse
    v = -eta * share * b * inverse
    # z = n^2 / g, and 1 - c^2 z^2 = m (sin^2 - c^2 n^2) / g^2
    z_real = a * (norm + 2 * share * b * b) * inverse
    z_imaginary = b * (norm - 2 * share * eta**2) * inverse
    difference = (eta - k) * (eta + k)
    first = m * (sine - square * difference) + square * twice**2
    second = twice * (1 - 2 * square * difference)
    rest_real = (first * wave.g_real + second * twice) * inverse**2
    rest_imaginary = -2 * square * z_real * z_imaginary
    # dz/dn = n (n^2 - 2 sin^2) / g^3
    bend = 2 * sine * inverse**2
    first = u * u - v * v - bend * wave.g_real
    second = 2 * u * v + bend * twice
    turn_real, turn_imaginary = u * first - v * second, u * second + v * first
    parallel = (wave.modulus / wave.y_squared) ** 2
    scale = -2 * cos / wave.total**2
    by_eta = parallel * (turn_real * rest_real + turn_imaginary * rest_imaginary)
    by_eta -= m * u + twice * v
    by_k = parallel * (turn_real * rest_imaginary - turn_imaginary * rest_real)
    by_k += m * v - twice * u
    return np.asarray(value), np.asarray(scale * by_eta), np.asarray(scale * by_k)


class _Wave(NamedTuple):
    """Parts of the header's numbers for a conductor, where g = a + i b is complex.

    Besides a and b: sin^2, g^2's real part, |g|^2, |c + g|^2, |r_s|^2; and |X|^2 and |Y|^2 of
    X = c g - sin^2 and Y = c g + sin^2, for which r_p = -r_s X / Y.
    """

    a: FloatArray
    b: FloatArray
    sine_squared: FloatArray
    g_real: FloatArray
    modulus: FloatArray
    total: FloatArray
    perpendicular: FloatArray
    x_squared: FloatArray
    y_squared: FloatArray


def _g_squared(
    cos_squared: FloatArray, sine_squared: FloatArray, n_squared: Numbers, m: Numbers
) -> FloatArray:
    """c^2 + m as c^2 + m for n near 1 at grazing, as n^2 - sin^2 for small n near the normal."""
    return np.asarray(np.where(cos_squared < 0.5, cos_squared + m, n_squared - sine_squared))


def _wave(cos: FloatArray, eta: Numbers, k: Numbers) -> _Wave:
    square, sine = cos * cos, (1 - cos) * (1 + cos)
    real = _g_squared(square, sine, eta * eta, (eta - 1) * (eta + 1)) - k * k
    imaginary = 2 * eta * k
    modulus = np.maximum(np.sqrt(real * real + imaginary * imaginary), _TINY)
    large = np.sqrt(0.5 * (modulus + np.abs(real)))
    small = 0.5 * imaginary / large
    a, b = np.where(real >= 0, large, small), np.where(real >= 0, small, large)
    total = (cos + a) ** 2 + b * b
    along, across = cos * a, square * (b * b)
    m_squared = ((eta - 1) ** 2 + k * k) * ((eta + 1) ** 2 + k * k)
    return _Wave(
        a=a,
        b=b,
        sine_squared=sine,
        g_real=real,
        modulus=modulus,
        total=total,
        perpendicular=m_squared / (total * total),
        x_squared=(along - sine) ** 2 + across,
        y_squared=(along + sine) ** 2 + across,
    )


# --- incidence from either side


class _Incidence(NamedTuple):
    """The header's c, g, m and n^2, c + g, n^2 c + g, and masks; g is 1 where not refracted."""

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
    g_squared = _g_squared(c * c, (1 - c) * (1 + c), squared, m)
    # where there is no interface (eta = 1) grazing light goes on as well
    refracts = ~(g_squared <= 0) | (m == 0)
    g = np.sqrt(np.where(g_squared > 0, g_squared, 1.0))
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


def _vectors(direction: ArrayLike) -> FloatArray:
    vectors = np.asarray(direction, dtype=np.float64)
    if vectors.ndim == 0 or vectors.shape[-1] != 3:
        raise ValueError(f"directions must have three components last, got shape {vectors.shape}")
    return vectors
