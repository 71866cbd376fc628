"""Compiled sums over the observations: residuals, normal equations, products with a lobe."""

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
def write_diffuse_products(weight, vectors, radiance, products):
    """Write the weighted vectors' products 00, 01, 02, 11, 12, 22, and with the data 0, 1, 2.

    Return the data's product with themselves.
    """
    energy = p0 = p1 = p2 = p3 = p4 = p5 = p6 = p7 = p8 = 0.0
    for i in range(radiance.shape[0]):
        w = weight[i] * weight[i]
        a, b, c, y = vectors[0, i], vectors[1, i], vectors[2, i], w * radiance[i]
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
def write_lobe_products(u, data, blocks, lobe, products):
    """Write the weighted lobe's products at width u with the vectors (3), itself and the data.

    `products` is (3, 5), a channel first. Blocks of rows in which a narrow lobe is 0 to all digits
    are left out; `lobe` (n,) is overwritten.
    """
    vectors, f, q, radiance, weight = data
    scale = math.exp(2 * u)
    products[:, :] = 0.0
    k = 0
    while k < blocks.shape[0]:
        first = k
        while k < blocks.shape[0] and blocks[k] * scale < _OUT:
            k += 1
        if k > first:
            a, z = first * BLOCK, min(k * BLOCK, f.shape[0])
            part = lobe[a:z]
            _write_lobe(f[a:z], q[a:z], scale, part)
            for c in range(3):
                # one-dimensional slices are known to be contiguous, so the sums vectorise
                _add_products(
                    weight[c, a:z],
                    part,
                    vectors[0, a:z],
                    vectors[1, a:z],
                    vectors[2, a:z],
                    radiance[c, a:z],
                    products[c],
                )
        k += 1


@njit(**JIT)
def zero_outside(u, q, blocks, lobe):
    """Write zeros into the blocks of rows that `write_lobe_products` leaves out."""
    scale = math.exp(2 * u)
    for k in range(blocks.shape[0]):
        if not blocks[k] * scale < _OUT:
            lobe[k * BLOCK : min((k + 1) * BLOCK, q.shape[0])] = 0.0


@njit(fastmath=SUMS, **JIT)
def _write_lobe(f, q, scale, lobe):
    for i in range(f.shape[0]):
        lobe[i] = f[i] * exp_negative(q[i] * scale)


@njit(fastmath=SUMS, **JIT)
def _add_products(weight, lobe, x0, x1, x2, radiance, products):
    p0 = p1 = p2 = p3 = p4 = 0.0
    for i in range(lobe.shape[0]):
        t = weight[i] * weight[i] * lobe[i]
        p0 += t * x0[i]
        p1 += t * x1[i]
        p2 += t * x2[i]
        p3 += t * lobe[i]
        p4 += t * radiance[i]
    products[0] += p0
    products[1] += p1
    products[2] += p2
    products[3] += p3
    products[4] += p4


@njit(fastmath=SUMS, **JIT)
def _write_columns(vectors, f, q, c1, b, slope_c1, slope_b, scale, columns):
    """Write the diffuse vector, its slope by s, the lobe, its slope and second slope by u."""
    for i in range(f.shape[0]):
        exponent = q[i] * scale
        lobe = f[i] * exp_negative(exponent)
        columns[0, i] = c1 * vectors[0, i] + b * vectors[1, i]
        columns[1, i] = slope_c1 * vectors[0, i] + slope_b * vectors[1, i]
        columns[2, i] = lobe
        # far out the lobe is 0 to all digits, and 0 x inf must not arise
        exponent = min(exponent, 1e3)
        columns[3, i] = -2.0 * exponent * lobe
        columns[4, i] = 4.0 * exponent * (exponent - 1.0) * lobe


@njit(fastmath=SUMS, **JIT)
def _write_sums(radiance, weight, columns, g2, kd, ks, e, slope_e, sums):
    """Write a channel's squares, gradient and matrix by (kd, s, ks, u), and what the residuals add.

    That is, to the second derivatives by (ks, u) and (u, u): 17 sums in all.
    """
    o0 = o1 = o2 = o3 = o4 = o5 = o6 = o7 = o8 = o9 = o10 = o11 = o12 = o13 = o14 = 0.0
    p0 = p1 = 0.0
    diffuse, diffuse_slope, lobe = columns[0], columns[1], columns[2]
    lobe_slope, lobe_curve = columns[3], columns[4]
    for i in range(radiance.shape[0]):
        w = weight[i]
        r = w * (kd * (diffuse[i] + kd * e * g2[i]) + ks * lobe[i] - radiance[i])
        a = w * (diffuse[i] + 2 * kd * e * g2[i])
        b = w * kd * (diffuse_slope[i] + kd * slope_e * g2[i])
        c = w * lobe[i]
        d = w * ks * lobe_slope[i]
        o0 += r * r
        o1 += a * r
        o2 += b * r
        o3 += c * r
        o4 += d * r
        o5 += a * a
        o6 += a * b
        o7 += a * c
        o8 += a * d
        o9 += b * b
        o10 += b * c
        o11 += b * d
        o12 += c * c
        o13 += c * d
        o14 += d * d
        p0 += r * w * lobe_slope[i]
        p1 += r * w * lobe_curve[i]
    sums[0], sums[1], sums[2], sums[3], sums[4] = o0, o1, o2, o3, o4
    sums[5], sums[6], sums[7], sums[8], sums[9] = o5, o6, o7, o8, o9
    sums[10], sums[11], sums[12], sums[13], sums[14] = o10, o11, o12, o13, o14
    sums[15], sums[16] = p0, ks * p1


@njit(**JIT)
def normal_equations(x, form, data, columns, gradient, matrix, curvature):
    """Return half the sum of squares at x; write its gradient and Gauss-Newton matrix.

    `curvature` is the matrix with what the residuals add to the lobe's second derivatives: without
    it steps creep where a lobe is as weak as the noise. `data` are vectors (3, n), f (n,), q (n,),
    radiance (3, n), weight (3, n); `columns` (5, n) is overwritten.
    """
    vectors, f, q, radiance, weight = data
    last = x.shape[0] - 1
    c1, b, e, slope_c1, slope_b, slope_e = diffuse_coefficients(x[3], form)
    _write_columns(vectors, f, q, c1, b, slope_c1, slope_b, math.exp(2 * x[last]), columns)
    gradient[:] = 0.0
    matrix[:, :] = 0.0
    cost = 0.0
    sums = np.empty(17)
    curvature[:, :] = 0.0
    for c in range(3):
        k = 4 + c if last == 7 else 4
        _write_sums(radiance[c], weight[c], columns, vectors[2], x[c], x[k], e, slope_e, sums)
        cost += 0.5 * sums[0]
        gradient[c] += sums[1]
        gradient[3] += sums[2]
        gradient[k] += sums[3]
        gradient[last] += sums[4]
        matrix[c, c] += sums[5]
        matrix[3, c] += sums[6]
        matrix[k, c] += sums[7]
        matrix[last, c] += sums[8]
        matrix[3, 3] += sums[9]
        matrix[k, 3] += sums[10]
        matrix[last, 3] += sums[11]
        matrix[k, k] += sums[12]
        matrix[last, k] += sums[13]
        matrix[last, last] += sums[14]
        curvature[last, k] += sums[15]
        curvature[last, last] += sums[16]
    for i in range(last + 1):
        for j in range(i + 1):
            matrix[j, i] = matrix[i, j]
            curvature[i, j] += matrix[i, j]
            curvature[j, i] = curvature[i, j]
    return cost
