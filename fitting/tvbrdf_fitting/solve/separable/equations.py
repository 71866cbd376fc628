"""Compiled sums over the observations: residuals, normal equations, products with a lobe.

`data` are the vectors of one scan: vectors (3, n), f (n,), q (n,), radiance (3, n), squares (3, n)
of the weights, weighted (3, n) radiance times squares. Rows without weight have 0 in `squares`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from .elementary import JIT, SUMS, exp_negative

BLOCK = 32
_OUT = 40.0
"""Exponent beyond which a lobe is 0 to all digits beside its peak: exp(-40) = 4e-18."""


@njit(**JIT)
def diffuse_coefficients(s, form):
    """C1, B, E of Oren-Nayar and their slopes by s; `form` has C1's constant and E's factor."""
    a, e = form[0], form[1]
    return (
        1 - 0.5 * s / (s + a),
        s / (s + 0.09),
        e * s / (s + 0.13),
        -0.5 * a / (s + a) ** 2,
        0.09 / (s + 0.09) ** 2,
        e * 0.13 / (s + 0.13) ** 2,
    )


@njit(**JIT)
def nearest(q):
    """Return the smallest q of each block of `BLOCK` rows."""
    blocks = np.empty((q.shape[0] + BLOCK - 1) // BLOCK)
    for k in range(blocks.shape[0]):
        lowest = np.inf
        for i in range(k * BLOCK, min((k + 1) * BLOCK, q.shape[0])):
            lowest = min(lowest, q[i])
        blocks[k] = lowest
    return blocks


@njit(fastmath=SUMS, **JIT)
def _add_diffuse_products(squares, x0, x1, x2, radiance, weighted, products):
    energy = p0 = p1 = p2 = p3 = p4 = p5 = p6 = p7 = p8 = 0.0
    for i in range(radiance.shape[0]):
        w = squares[i]
        a, b, c, y = x0[i], x1[i], x2[i], w * radiance[i]
        weighted[i] = y
        p0 += w * a * a
        p1 += w * a * b
        p2 += w * a * c
        p3 += w * b * b
        p4 += w * b * c
        p5 += w * c * c
        p6 += a * y
        p7 += b * y
        p8 += c * y
        energy += y * radiance[i]
    products[0], products[1], products[2], products[3], products[4] = p0, p1, p2, p3, p4
    products[5], products[6], products[7], products[8] = p5, p6, p7, p8
    return energy


@njit(**JIT)
def write_diffuse_products(data, diffuse):
    """Write each channel's products 00, 01, 02, 11, 12, 22 of the vectors, and with the data 0-2.

    Also write the weighted data; return the data's product with themselves, of all channels.
    """
    vectors, _, _, radiance, squares, weighted = data
    energy = 0.0
    for c in range(3):
        energy += _add_diffuse_products(
            squares[c], vectors[0], vectors[1], vectors[2], radiance[c], weighted[c], diffuse[c]
        )
    return energy


@njit(fastmath=SUMS, **JIT)
def _add_diffuse_data(squares, x0, x1, x2, radiance, weighted, products):
    energy = p0 = p1 = p2 = 0.0
    for i in range(radiance.shape[0]):
        y = squares[i] * radiance[i]
        weighted[i] = y
        p0 += x0[i] * y
        p1 += x1[i] * y
        p2 += x2[i] * y
        energy += y * radiance[i]
    products[6], products[7], products[8] = p0, p1, p2
    return energy


@njit(**JIT)
def write_diffuse_data(data, diffuse):
    """Do what `write_diffuse_products` does where the vectors' own products are written already."""
    vectors, _, _, radiance, squares, weighted = data
    energy = 0.0
    for c in range(3):
        energy += _add_diffuse_data(
            squares[c], vectors[0], vectors[1], vectors[2], radiance[c], weighted[c], diffuse[c]
        )
    return energy


@njit(fastmath=SUMS, **JIT)
def _write_exponentials(q, scale, out):
    for i in range(q.shape[0]):
        out[i] = exp_negative(q[i] * scale)


@njit(fastmath=SUMS, **JIT)
def _square(values):
    for i in range(values.shape[0]):
        # no denormals, which are slow
        values[i] = values[i] * values[i] if values[i] > 1e-140 else 0.0


@njit(fastmath=SUMS, **JIT)
def _add_lobe_products(f, falloff, x0, x1, x2, s0, s1, s2, y0, y1, y2, products):
    a0 = a1 = a2 = a3 = a4 = 0.0
    b0 = b1 = b2 = b3 = b4 = 0.0
    c0 = c1 = c2 = c3 = c4 = 0.0
    for i in range(f.shape[0]):
        lobe = f[i] * falloff[i]
        u, v, w, square = lobe * x0[i], lobe * x1[i], lobe * x2[i], lobe * lobe
        a0 += s0[i] * u
        a1 += s0[i] * v
        a2 += s0[i] * w
        a3 += s0[i] * square
        a4 += y0[i] * lobe
        b0 += s1[i] * u
        b1 += s1[i] * v
        b2 += s1[i] * w
        b3 += s1[i] * square
        b4 += y1[i] * lobe
        c0 += s2[i] * u
        c1 += s2[i] * v
        c2 += s2[i] * w
        c3 += s2[i] * square
        c4 += y2[i] * lobe
    for k, (a, b, c) in enumerate(
        ((a0, b0, c0), (a1, b1, c1), (a2, b2, c2), (a3, b3, c3), (a4, b4, c4))
    ):
        products[0, k] += a
        products[1, k] += b
        products[2, k] += c


@njit(**JIT)
def write_lobe_products(scale, power, data, blocks, falloff, products):
    """Write the weighted lobe's products with the vectors (3), itself and the data: (3, 5).

    The lobe is f times exp(-q scale), the falloff. With `power` 1 it is computed, with 2 it is the
    square of what `falloff` (n,) holds, that of half the scale. Blocks of rows in which a narrow
    lobe is 0 to all digits are left out; there the falloff gets 0.
    """
    vectors, f, q, _, squares, weighted = data
    products[:, :] = 0.0
    k = 0
    while k < blocks.shape[0]:
        first = k
        while k < blocks.shape[0] and blocks[k] * scale < _OUT:
            k += 1
        if k > first:
            a, z = first * BLOCK, min(k * BLOCK, f.shape[0])
            part = falloff[a:z]
            if power == 2:
                _square(part)
            else:
                _write_exponentials(q[a:z], scale, part)
            # one-dimensional slices are known to be contiguous, so the sums vectorise
            _add_lobe_products(
                f[a:z],
                part,
                vectors[0, a:z],
                vectors[1, a:z],
                vectors[2, a:z],
                squares[0, a:z],
                squares[1, a:z],
                squares[2, a:z],
                weighted[0, a:z],
                weighted[1, a:z],
                weighted[2, a:z],
                products,
            )
        if k < blocks.shape[0]:
            falloff[k * BLOCK : min((k + 1) * BLOCK, f.shape[0])] = 0.0
        k += 1


@njit(fastmath=SUMS, **JIT)
def _add_data_products(one, other, y0, y1, y2, first, second):
    a = b = c = d = e = f = 0.0
    for i in range(one.shape[0]):
        a += y0[i] * one[i]
        b += y1[i] * one[i]
        c += y2[i] * one[i]
        d += y0[i] * other[i]
        e += y1[i] * other[i]
        f += y2[i] * other[i]
    first[0, 4] += a
    first[1, 4] += b
    first[2, 4] += c
    second[0, 4] += d
    second[1, 4] += e
    second[2, 4] += f


@njit(**JIT)
def write_data_products(scales, table, blocks, weighted, lobes):
    """Write only the products with the data, of lobes (w, n) whose scales ascend, into (w, 3, 5).

    Two at a time: reading the data takes longer than multiplying them.
    """
    lobes[:, :, 4] = 0.0
    for m in range(0, scales.shape[0], 2):
        other = min(m + 1, scales.shape[0] - 1)
        spare = lobes[other] if other > m else np.empty((3, 5))
        k = 0
        while k < blocks.shape[0]:
            first = k
            while k < blocks.shape[0] and blocks[k] * scales[m] < _OUT:
                k += 1
            if k > first:
                a, z = first * BLOCK, min(k * BLOCK, table.shape[1])
                y0, y1, y2 = weighted[0, a:z], weighted[1, a:z], weighted[2, a:z]
                _add_data_products(table[m, a:z], table[other, a:z], y0, y1, y2, lobes[m], spare)
            k += 1


@njit(fastmath=SUMS, **JIT)
def _write_columns(f, q, scale, lobe, slope, bend):
    """Turn the falloff into the lobe; write its slope and its second slope by u."""
    for i in range(f.shape[0]):
        exponent = q[i] * scale
        value = f[i] * lobe[i]
        lobe[i] = value
        # far out the lobe is 0 to all digits, and 0 x inf must not arise
        exponent = min(exponent, 1e3)
        slope[i] = -2.0 * exponent * value
        bend[i] = 4.0 * exponent * (exponent - 1.0) * value


@njit(fastmath=SUMS, **JIT)
def _write_sums(a0, a1, a2, ks, radiance, squares, x0, x1, x2, lobe, slope, bend, sums):
    """Write the sums of r with r and the six vectors, and of the lobe and its slope with theirs."""
    o0 = o1 = o2 = o3 = o4 = o5 = o6 = o7 = o8 = o9 = o10 = o11 = o12 = o13 = o14 = o15 = 0.0
    for i in range(radiance.shape[0]):
        w, one, two, three, p, d = squares[i], x0[i], x1[i], x2[i], lobe[i], slope[i]
        r = (a0 * one + a1 * two + a2 * three + ks * p) - radiance[i]
        wr, wp, wd = w * r, w * p, w * d
        o0 += wr * r
        o1 += wr * one
        o2 += wr * two
        o3 += wr * three
        o4 += wr * p
        o5 += wr * d
        o6 += wr * bend[i]
        o7 += wp * one
        o8 += wp * two
        o9 += wp * three
        o10 += wp * p
        o11 += wd * one
        o12 += wd * two
        o13 += wd * three
        o14 += wd * p
        o15 += wd * d
    sums[0], sums[1], sums[2], sums[3], sums[4] = o0, o1, o2, o3, o4
    sums[5], sums[6], sums[7], sums[8], sums[9] = o5, o6, o7, o8, o9
    sums[10], sums[11], sums[12], sums[13], sums[14], sums[15] = o10, o11, o12, o13, o14, o15


@njit(**JIT)
def _inner(a, b, g):
    """Return the product of two combinations of the vectors, whose own are g: 00 01 02 11 12 22."""
    return (
        a[0] * (b[0] * g[0] + b[1] * g[1] + b[2] * g[2])
        + a[1] * (b[0] * g[1] + b[1] * g[3] + b[2] * g[4])
        + a[2] * (b[0] * g[2] + b[1] * g[4] + b[2] * g[5])
    )


@njit(**JIT)
def normal_equations(x, form, data, diffuse, known, columns, gradient, matrix, hessian):
    """Return half the sum of squares at x; write its gradient and its second derivatives.

    `matrix` gets those of Gauss and Newton, from first derivatives alone, `hessian` the true ones:
    without what the residuals add, steps creep where a lobe is as weak as the noise. Cost and
    gradient are sums of true residuals; the matrices, which only aim steps, use the vectors'
    products `diffuse`. `columns` (3, n) is overwritten; its first row has the falloff if `known`.
    """
    vectors, f, q, radiance, squares, _ = data
    last = x.shape[0] - 1
    s = x[3]
    c1, b, e, slope_c1, slope_b, slope_e = diffuse_coefficients(s, form)
    # second derivatives of the coefficients, each a quotient with s + constant
    bend_c1 = -2 * slope_c1 / (s + form[0])
    bend_b, bend_e = -2 * slope_b / (s + 0.09), -2 * slope_e / (s + 0.13)
    scale = math.exp(2 * x[last])
    if not known:
        _write_exponentials(q, scale, columns[0])
    _write_columns(f, q, scale, columns[0], columns[1], columns[2])
    gradient[:] = 0.0
    matrix[:, :] = 0.0
    hessian[:, :] = 0.0
    cost, sums = 0.0, np.empty(16)
    for c in range(3):
        k = 4 + c if last == 7 else 4
        kd, ks, own = x[c], x[k], diffuse[c]
        _write_sums(
            kd * c1,
            kd * b,
            kd * kd * e,
            ks,
            radiance[c],
            squares[c],
            vectors[0],
            vectors[1],
            vectors[2],
            columns[0],
            columns[1],
            columns[2],
            sums,
        )
        by_kd = (c1, b, 2 * kd * e)
        by_s = (kd * slope_c1, kd * slope_b, kd * kd * slope_e)
        cost += 0.5 * sums[0]
        gradient[c] += by_kd[0] * sums[1] + by_kd[1] * sums[2] + by_kd[2] * sums[3]
        gradient[3] += by_s[0] * sums[1] + by_s[1] * sums[2] + by_s[2] * sums[3]
        gradient[k] += sums[4]
        gradient[last] += ks * sums[5]
        matrix[c, c] += _inner(by_kd, by_kd, own)
        matrix[3, c] += _inner(by_kd, by_s, own)
        matrix[3, 3] += _inner(by_s, by_s, own)
        matrix[k, c] += by_kd[0] * sums[7] + by_kd[1] * sums[8] + by_kd[2] * sums[9]
        matrix[k, 3] += by_s[0] * sums[7] + by_s[1] * sums[8] + by_s[2] * sums[9]
        matrix[k, k] += sums[10]
        matrix[last, c] += ks * (by_kd[0] * sums[11] + by_kd[1] * sums[12] + by_kd[2] * sums[13])
        matrix[last, 3] += ks * (by_s[0] * sums[11] + by_s[1] * sums[12] + by_s[2] * sums[13])
        matrix[last, k] += ks * sums[14]
        matrix[last, last] += ks * ks * sums[15]
        hessian[c, c] += 2 * e * sums[3]
        hessian[3, c] += slope_c1 * sums[1] + slope_b * sums[2] + 2 * kd * slope_e * sums[3]
        hessian[3, 3] += kd * (bend_c1 * sums[1] + bend_b * sums[2] + kd * bend_e * sums[3])
        hessian[last, k] += sums[5]
        hessian[last, last] += ks * sums[6]
    for i in range(last + 1):
        for j in range(i + 1):
            matrix[j, i] = matrix[i, j]
            hessian[i, j] += matrix[i, j]
            hessian[j, i] = hessian[i, j]
    return cost
