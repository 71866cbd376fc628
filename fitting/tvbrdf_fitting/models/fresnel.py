"""Fresnel reflectance as the models' inner loops need it: from above, arguments unchecked.

Source: M. Born and E. Wolf, "Principles of Optics", sections 1.5 and 14.2; R. L. Cook and
K. E. Torrance, "A Reflectance Model for Computer Graphics", 1982, for the unpolarised form.

With n the refractive index relative to the side of incidence, c = cos(theta) and
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

from ..geometry import FloatArray

Numbers = float | FloatArray

_TINY = np.finfo(np.float64).tiny


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
    wave = wave_of(cos, eta, k)
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
    wave = wave_of(cos, eta, k)
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


class Wave(NamedTuple):
    """Parts of the numbers in the module's header for a conductor, where g = a + i b is complex.

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


def g_squared(
    cos_squared: FloatArray, sine_squared: FloatArray, n_squared: Numbers, m: Numbers
) -> FloatArray:
    """c^2 + m as c^2 + m for n near 1 at grazing, as n^2 - sin^2 for small n near the normal."""
    return np.asarray(np.where(cos_squared < 0.5, cos_squared + m, n_squared - sine_squared))


def wave_of(cos: FloatArray, eta: Numbers, k: Numbers) -> Wave:
    """Return a conductor's parts, arguments as for `conductor_reflectance`."""
    square, sine = cos * cos, (1 - cos) * (1 + cos)
    real = g_squared(square, sine, eta * eta, (eta - 1) * (eta + 1)) - k * k
    imaginary = 2 * eta * k
    modulus = np.maximum(np.sqrt(real * real + imaginary * imaginary), _TINY)
    large = np.sqrt(0.5 * (modulus + np.abs(real)))
    small = 0.5 * imaginary / large
    a, b = np.where(real >= 0, large, small), np.where(real >= 0, small, large)
    total = (cos + a) ** 2 + b * b
    along, across = cos * a, square * (b * b)
    m_squared = ((eta - 1) ** 2 + k * k) * ((eta + 1) ** 2 + k * k)
    return Wave(
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
