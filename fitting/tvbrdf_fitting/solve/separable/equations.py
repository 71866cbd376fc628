"""Compiled: the cost of a point, its gradient and its second derivatives, of true residuals.

What a channel's 16 sums make of gradient and matrices is apart from how they come about: `nearby`
has them from products.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from .elementary import JIT, SUMS, exp_negative
from .products import write_exponentials


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
def diffuse_bends(s, form, coefficients):
    """Return second derivatives of C1, B, E, each of which is a quotient with s + constant."""
    return (
        -2 * coefficients[3] / (s + form[0]),
        -2 * coefficients[4] / (s + 0.09),
        -2 * coefficients[5] / (s + 0.13),
    )


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


@njit(fastmath=SUMS, **JIT)
def _with_row(sums, a, value, square, one, two, three, p, d):
    """Return a channel's six sums with those of a row; `a` are the factors of its vectors."""
    r = (a[0] * one + a[1] * two + a[2] * three + a[3] * p) - value
    w = square * r
    return (
        sums[0] + w * r,
        sums[1] + w * one,
        sums[2] + w * two,
        sums[3] + w * three,
        sums[4] + w * p,
        sums[5] + w * d,
    )


@njit(fastmath=SUMS, **JIT)
def _residual_sums(a, b, c, f, q, scale, r0, r1, r2, s0, s1, s2, x0, x1, x2, lobe):
    """Return for each channel the sums of r with r, the vectors, the lobe and its slope.

    `a`, `b`, `c` are the channels' factors of the vectors and of the lobe, which is written. All
    channels are summed in one pass: what they share is read once.
    """
    for i in range(f.shape[0]):
        lobe[i] = f[i] * exp_negative(q[i] * scale)
    one = two = three = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for i in range(f.shape[0]):
        u, v, w, p = x0[i], x1[i], x2[i], lobe[i]
        # far out the lobe is 0 to all digits, and 0 x inf must not arise
        d = -2.0 * min(q[i] * scale, 1e3) * p
        one = _with_row(one, a, r0[i], s0[i], u, v, w, p, d)
        two = _with_row(two, b, r1[i], s1[i], u, v, w, p, d)
        three = _with_row(three, c, r2[i], s2[i], u, v, w, p, d)
    return one, two, three


@njit(**JIT)
def _inner(a, b, g):
    """Return the product of two combinations of the vectors, whose own are g: 00 01 02 11 12 22."""
    return (
        a[0] * (b[0] * g[0] + b[1] * g[1] + b[2] * g[2])
        + a[1] * (b[0] * g[1] + b[1] * g[3] + b[2] * g[4])
        + a[2] * (b[0] * g[2] + b[1] * g[4] + b[2] * g[5])
    )


@njit(**JIT)
def add_gradient(x, c, coefficients, sums, gradient):
    """Add a channel's part to the gradient; return its half of squares."""
    c1, b, e, slope_c1, slope_b, slope_e = coefficients
    last = x.shape[0] - 1
    k = 4 + c if last == 7 else 4
    kd = x[c]
    gradient[c] += c1 * sums[1] + b * sums[2] + 2 * kd * e * sums[3]
    gradient[3] += kd * (slope_c1 * sums[1] + slope_b * sums[2] + kd * slope_e * sums[3])
    gradient[k] += sums[4]
    gradient[last] += x[k] * sums[5]
    return 0.5 * sums[0]


@njit(**JIT)
def add_curvature(x, c, diffuse, coefficients, bends, sums, matrix, hessian):
    """Add a channel's part to the lower triangles."""
    c1, b, e, slope_c1, slope_b, slope_e = coefficients
    last = x.shape[0] - 1
    k = 4 + c if last == 7 else 4
    kd, ks, own = x[c], x[k], diffuse[c]
    by_kd = (c1, b, 2 * kd * e)
    by_s = (kd * slope_c1, kd * slope_b, kd * kd * slope_e)
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
    hessian[3, 3] += kd * (bends[0] * sums[1] + bends[1] * sums[2] + kd * bends[2] * sums[3])
    hessian[last, k] += sums[5]
    hessian[last, last] += ks * sums[6]


@njit(**JIT)
def mirror(matrix, hessian):
    """Write the upper triangles; add the matrix of first derivatives to that of the second."""
    for i in range(matrix.shape[0]):
        for j in range(i + 1):
            matrix[j, i] = matrix[i, j]
            hessian[i, j] += matrix[i, j]
            hessian[j, i] = hessian[i, j]


@njit(**JIT)
def normal_equations(x, scan, known, columns, gradient, matrix, hessian):
    """Return half the sum of squares at x; write its gradient and its second derivatives.

    `matrix` gets those of Gauss and Newton, from first derivatives alone, `hessian` the true ones:
    without what the residuals add, steps creep where a lobe is as weak as the noise. Cost and
    gradient are sums of true residuals; the matrices, which only aim steps, use the vectors'
    products. `columns` (3, n) is overwritten; its first row has the falloff if `known`.
    """
    last = x.shape[0] - 1
    coefficients = diffuse_coefficients(x[3], scan.form)
    bends = diffuse_bends(x[3], scan.form, coefficients)
    c1, b, e = coefficients[0], coefficients[1], coefficients[2]
    scale = math.exp(2 * x[last])
    if not known:
        write_exponentials(scan.q, scale, columns[0])
    _write_columns(scan.f, scan.q, scale, columns[0], columns[1], columns[2])
    gradient[:] = 0.0
    matrix[:, :] = 0.0
    hessian[:, :] = 0.0
    cost, sums = 0.0, np.empty(16)
    for c in range(3):
        kd = x[c]
        _write_sums(
            kd * c1,
            kd * b,
            kd * kd * e,
            x[4 + c] if last == 7 else x[4],
            scan.radiance[c],
            scan.squares[c],
            scan.vectors[0],
            scan.vectors[1],
            scan.vectors[2],
            columns[0],
            columns[1],
            columns[2],
            sums,
        )
        cost += add_gradient(x, c, coefficients, sums, gradient)
        add_curvature(x, c, scan.diffuse, coefficients, bends, sums, matrix, hessian)
    mirror(matrix, hessian)
    return cost


@njit(**JIT)
def _factors(x, c, coefficients):
    kd, ks = x[c], x[4 + c] if x.shape[0] == 8 else x[4]
    return kd * coefficients[0], kd * coefficients[1], kd * kd * coefficients[2], ks


@njit(**JIT)
def cost_and_gradient(x, scan, falloff, gradient):
    """Return what `normal_equations` does, of true residuals; write only the gradient.

    `falloff` (n,) is overwritten.
    """
    coefficients = diffuse_coefficients(x[3], scan.form)
    r, s, v = scan.radiance, scan.squares, scan.vectors
    sums = _residual_sums(
        _factors(x, 0, coefficients),
        _factors(x, 1, coefficients),
        _factors(x, 2, coefficients),
        scan.f,
        scan.q,
        math.exp(2 * x[x.shape[0] - 1]),
        r[0],
        r[1],
        r[2],
        s[0],
        s[1],
        s[2],
        v[0],
        v[1],
        v[2],
        falloff,
    )
    gradient[:] = 0.0
    cost = 0.0
    for c in range(3):
        cost += add_gradient(x, c, coefficients, sums[c], gradient)
    return cost
