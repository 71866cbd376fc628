"""Compiled: a lobe's products at any width near one that was tried, and Newton steps on them alone.

As a function of u a lobe is smooth enough that a polynomial through few widths tells all its
products between them, and their derivatives. Of scans that share their directions and weights all
but the products with the data are shared, and sums over the observations are not needed on the way:
only where it ends.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ...geometry import BoolArray, FloatArray
from .amplitudes import ROUGH, best_at_width
from .elementary import JIT, SUMS, bounded_step, clip, write_scale
from .equations import (
    add_curvature,
    add_gradient,
    cost_and_gradient,
    diffuse_bends,
    diffuse_coefficients,
    mirror,
)
from .products import write_data_products, write_lobe_products
from .widths import STEP

_NODES = 10
_REACH = 0.55 * STEP
"""Distance in u up to which a width's polynomials hold: to 1e-9 with so many nodes."""
_TS = -np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
_POWERS = np.linalg.inv(np.vander(_TS, increasing=True))
"""Chebyshev's nodes, and what turns values there into coefficients, of the lowest power first."""
_STEPS = 12
_NEAR, _THERE = 1e-5, 1e-7
"""Relative steps after which the last one is taken, and up to which it is the last: what an
undamped Newton step leaves is some square of it."""


class Nearby(NamedTuple):
    """Polynomials in t = (u - that of a width) / `_REACH`, written when a width is first needed.

    Attributes
    ----------
    ready
        (w,) whether a width's are written.
    lobes
        (w, k, n) lobes at the k nodes.
    products
        (w, 3, 5, k) coefficients of their products with the vectors, with themselves, and with the
        data of the scan that was last there.
    """

    ready: BoolArray
    lobes: FloatArray
    products: FloatArray


@njit(**JIT)
def new_nearby(widths, n):
    """Return polynomials for a number of widths and n observations, none of them written."""
    return Nearby(
        np.zeros(widths, np.bool_), np.empty((widths, _NODES, n)), np.empty((widths, 3, 5, _NODES))
    )


@njit(fastmath=SUMS, **JIT)
def _write_products(t, coefficients, products, slopes, bends):
    """Write a lobe's products (3, 5), and their derivatives by u."""
    for c in range(3):
        for kind in range(5):
            value = slope = bend = 0.0
            for k in range(_NODES - 1, -1, -1):
                bend = bend * t + slope
                slope = slope * t + value
                value = value * t + coefficients[c, kind, k]
            products[c, kind] = value
            slopes[c, kind], bends[c, kind] = slope / _REACH, 2 * bend / _REACH**2


@njit(**JIT)
def _write_sums(kd, ks, coefficients, g, p, d, b, sums):
    """Write all of a channel's sums but the first from products: as `normal_equations` has them.

    `g` are the diffuse products; `p`, `d`, `b` the lobe's and their derivatives by u.
    """
    one, two, three = (kd * coefficients[0], kd * coefficients[1], kd * kd * coefficients[2])
    # with v = 2 u, a lobe's slope is -exp(v) q times it: products of slopes follow from those of
    # lobes
    slopes = 0.25 * b[3] - 0.5 * d[3]
    sums[0] = 0.0
    sums[1] = one * g[0] + two * g[1] + three * g[2] + ks * p[0] - g[6]
    sums[2] = one * g[1] + two * g[3] + three * g[4] + ks * p[1] - g[7]
    sums[3] = one * g[2] + two * g[4] + three * g[5] + ks * p[2] - g[8]
    sums[4] = one * p[0] + two * p[1] + three * p[2] + ks * p[3] - p[4]
    sums[5] = one * d[0] + two * d[1] + three * d[2] + 0.5 * ks * d[3] - d[4]
    sums[6] = one * b[0] + two * b[1] + three * b[2] + ks * (0.5 * b[3] - slopes) - b[4]
    sums[7], sums[8], sums[9], sums[10] = p[0], p[1], p[2], p[3]
    sums[11], sums[12], sums[13] = d[0], d[1], d[2]
    sums[14], sums[15] = 0.5 * d[3], slopes


@njit(**JIT)
def _write_equations(x, scan, products, slopes, bends, sums, gradient, matrix, hessian):
    """Do what `normal_equations` does, from products; there is no cost."""
    coefficients = diffuse_coefficients(x[3], scan.form)
    diffuse_bend = diffuse_bends(x[3], scan.form, coefficients)
    gradient[:] = 0.0
    matrix[:, :] = 0.0
    hessian[:, :] = 0.0
    for c in range(3):
        ks = x[4 + c] if x.shape[0] == 8 else x[4]
        _write_sums(x[c], ks, coefficients, scan.diffuse[c], products[c], slopes[c], bends[c], sums)
        add_gradient(x, c, coefficients, sums, gradient)
        add_curvature(x, c, scan.diffuse, coefficients, diffuse_bend, sums, matrix, hessian)
    mirror(matrix, hessian)


@njit(**JIT)
def _write_polynomials(near, chosen, centre, scan):
    """Write the polynomials of a width's lobes with the data; those of lobes alone if need be."""
    scales, values = np.exp(2 * (centre + _REACH * _TS)), np.empty((_NODES, 3, 5))
    lobes, first = near.lobes[chosen], 4
    if not near.ready[chosen]:
        first = 0
        for j in range(_NODES):
            write_lobe_products(scales[j], 1, scan, lobes[j], values[j])
            for i in range(scan.f.shape[0]):
                lobes[j, i] *= scan.f[i]
        near.ready[chosen] = True
    write_data_products(scales, lobes, scan.nearest, scan.weighted, values)
    for c in range(3):
        for kind in range(first, 5):
            for k in range(_NODES):
                total = 0.0
                for j in range(_NODES):
                    total += _POWERS[k, j] * values[j, c, kind]
                near.products[chosen, c, kind, k] = total


@njit(**JIT)
def approach(x, scan, us, near, lower, upper, columns, room):
    """Take x from its width to the bottom of its valley by polynomials, and one last step by sums.

    Return (cost, another valley's s or -1); the cost is inf where that is no bottom.
    """
    size, last = x.shape[0], x.shape[0] - 1
    chosen = int(np.argmin(np.abs(us - x[last])))
    _write_polynomials(near, chosen, us[chosen], scan)
    products, slopes, bends = np.empty((3, 5)), np.empty((3, 5)), np.empty((3, 5))
    sums = np.empty(16)
    t = (x[last] - us[chosen]) / _REACH
    _write_products(t, near.products[chosen], products, slopes, bends)
    _, elsewhere = best_at_width(x, scan.form, scan.diffuse, products, lower, upper, ROUGH, room)
    step, scale, free = np.empty(size), np.empty(size), np.ones(size, np.bool_)
    gradient, work, factor = np.empty(size), np.empty((2, size)), np.empty((size, size))
    matrix, hessian = np.empty((size, size)), np.empty((size, size))
    cost, there = 0.0, False
    for _ in range(_STEPS):
        if there:
            cost = cost_and_gradient(x, scan, columns[0], gradient)
        else:
            _write_equations(x, scan, products, slopes, bends, sums, gradient, matrix, hessian)
        write_scale(x, matrix, gradient, lower, upper, scale, free)
        if not bounded_step(
            hessian, gradient, scale, x, lower, upper, 0.0, free, factor, work, step
        ):
            break
        length = extent = downhill = 0.0
        for i in range(size):
            length += (step[i] * scale[i]) ** 2
            extent += (x[i] * scale[i]) ** 2
            downhill -= 0.5 * gradient[i] * step[i]
        if not length < np.inf or (there and length > (_THERE * _THERE) * extent):
            break
        # within reach the whole step, else so much of it
        t = (x[last] + step[last] - us[chosen]) / _REACH
        part = min(1.0, _REACH / abs(step[last])) if abs(t) > 1 else 1.0
        for i in range(size):
            x[i] = clip(x[i] + part * step[i], lower[i], upper[i])
        if there:
            return cost - downhill, elsewhere
        there = length <= (_NEAR * _NEAR) * extent
        if abs(t) > 1:
            chosen = int(np.argmin(np.abs(us - x[last])))
            _write_polynomials(near, chosen, us[chosen], scan)
            t = (x[last] - us[chosen]) / _REACH
            if abs(t) > 1:
                break
        _write_products(t, near.products[chosen], products, slopes, bends)
    return np.inf, elsewhere
