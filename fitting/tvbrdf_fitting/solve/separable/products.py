"""Compiled sums over the observations: products of the vectors, the data and a lobe.

Rows without weight have 0 in a scan's `squares`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ...geometry import FloatArray
from .elementary import JIT, SUMS, exp_negative


class Scan(NamedTuple):
    """What the compiled functions know of a scan.

    Attributes
    ----------
    form
        (2,) constant of C1 and factor of E.
    vectors
        (3, n): c, g1 c, g2 c.
    f, q
        (n,) pi c times the lobe's geometric factor; theta_h squared, less what nobody saw.
    nearest
        Smallest q of each block of `BLOCK` rows.
    radiance, squares, weighted
        (3, n), squares those of the weights, weighted the radiance times squares.
    diffuse
        (3, 9) for each channel the products 00, 01, 02, 11, 12, 22 of the vectors, and theirs with
        the data.
    """

    form: FloatArray
    vectors: FloatArray
    f: FloatArray
    q: FloatArray
    nearest: FloatArray
    radiance: FloatArray
    squares: FloatArray
    weighted: FloatArray
    diffuse: FloatArray


BLOCK = 32
_TOGETHER = 5
_OUT = 40.0
"""Exponent beyond which a lobe is 0 to all digits beside its peak: exp(-40) = 4e-18."""


@njit(**JIT)
def new_scan(form, vectors, f, q, radiance, squares):
    """Return a scan whose products are still to be written."""
    return Scan(
        form,
        vectors,
        f,
        q,
        _nearest(q),
        radiance,
        squares,
        np.empty(radiance.shape),
        np.zeros((3, 9)),
    )


@njit(**JIT)
def _nearest(q):
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
def write_diffuse_products(scan):
    """Write a scan's weighted data and its products; return the data's with themselves."""
    x, energy = scan.vectors, 0.0
    for c in range(3):
        energy += _add_diffuse_products(
            scan.squares[c], x[0], x[1], x[2], scan.radiance[c], scan.weighted[c], scan.diffuse[c]
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
def write_diffuse_data(scan):
    """Do what `write_diffuse_products` does where the vectors' own products are written already."""
    x, energy = scan.vectors, 0.0
    for c in range(3):
        energy += _add_diffuse_data(
            scan.squares[c], x[0], x[1], x[2], scan.radiance[c], scan.weighted[c], scan.diffuse[c]
        )
    return energy


@njit(fastmath=SUMS, **JIT)
def write_exponentials(q, scale, out):
    """Write exp(-q scale)."""
    for i in range(q.shape[0]):
        out[i] = exp_negative(q[i] * scale)


@njit(fastmath=SUMS, **JIT)
def _add_lobe_products(
    scale, power, nearest, f, q, falloff, x0, x1, x2, s0, s1, s2, y0, y1, y2, products
):
    k = 0
    while k < nearest.shape[0]:
        first = k
        while k < nearest.shape[0] and nearest[k] * scale < _OUT:
            k += 1
        # unsigned, so that no index can mean one from the end, and the loops vectorise
        begin, end = np.uint64(first * BLOCK), np.uint64(min(k * BLOCK, f.shape[0]))
        if power == 2:
            for i in range(begin, end):
                # no denormals, which are slow
                falloff[i] = falloff[i] * falloff[i] if falloff[i] > 1e-140 else 0.0
        else:
            for i in range(begin, end):
                falloff[i] = exp_negative(q[i] * scale)
        a0 = a1 = a2 = a3 = a4 = 0.0
        b0 = b1 = b2 = b3 = b4 = 0.0
        c0 = c1 = c2 = c3 = c4 = 0.0
        for i in range(begin, end):
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
        for m, (a, b, c) in enumerate(
            ((a0, b0, c0), (a1, b1, c1), (a2, b2, c2), (a3, b3, c3), (a4, b4, c4))
        ):
            products[0, m] += a
            products[1, m] += b
            products[2, m] += c
        if k < nearest.shape[0]:
            for i in range(np.uint64(k * BLOCK), np.uint64(min((k + 1) * BLOCK, f.shape[0]))):
                falloff[i] = 0.0
        k += 1


@njit(**JIT)
def write_lobe_products(scale, power, scan, falloff, products):
    """Write the weighted lobe's products with the vectors (3), itself and the data: (3, 5).

    The lobe is f times exp(-q scale), the falloff. With `power` 1 it is computed, with 2 it is the
    square of what `falloff` (n,) holds, that of half the scale. Blocks of rows in which a narrow
    lobe is 0 to all digits are left out; there the falloff gets 0.
    """
    x, squares, weighted = scan.vectors, scan.squares, scan.weighted
    products[:, :] = 0.0
    _add_lobe_products(
        scale,
        power,
        scan.nearest,
        scan.f,
        scan.q,
        falloff,
        x[0],
        x[1],
        x[2],
        squares[0],
        squares[1],
        squares[2],
        weighted[0],
        weighted[1],
        weighted[2],
        products,
    )


@njit(fastmath=SUMS, **JIT)
def _add_data_products(scale, nearest, lobe0, lobe1, lobe2, lobe3, lobe4, y0, y1, y2, lobes):
    k = 0
    while k < nearest.shape[0]:
        first = k
        while k < nearest.shape[0] and nearest[k] * scale < _OUT:
            k += 1
        a0 = a1 = a2 = a3 = a4 = 0.0
        b0 = b1 = b2 = b3 = b4 = 0.0
        c0 = c1 = c2 = c3 = c4 = 0.0
        for i in range(np.uint64(first * BLOCK), np.uint64(min(k * BLOCK, y0.shape[0]))):
            one, two, three = y0[i], y1[i], y2[i]
            v = lobe0[i]
            a0 += one * v
            b0 += two * v
            c0 += three * v
            v = lobe1[i]
            a1 += one * v
            b1 += two * v
            c1 += three * v
            v = lobe2[i]
            a2 += one * v
            b2 += two * v
            c2 += three * v
            v = lobe3[i]
            a3 += one * v
            b3 += two * v
            c3 += three * v
            v = lobe4[i]
            a4 += one * v
            b4 += two * v
            c4 += three * v
        for c, channel in enumerate(
            ((a0, a1, a2, a3, a4), (b0, b1, b2, b3, b4), (c0, c1, c2, c3, c4))
        ):
            # where the last group repeats the last lobe, what comes of that is not added
            for m in range(lobes.shape[0]):
                lobes[m, c, 4] += channel[m]
        k += 1


@njit(**JIT)
def write_data_products(scales, table, nearest, weighted, lobes):
    """Write only the products with the data, of lobes (w, n) whose scales ascend, into (w, 3, 5).

    Five at a time: reading the data takes longer than multiplying them.
    """
    lobes[:, :, 4] = 0.0
    last = scales.shape[0] - 1
    for m in range(0, last + 1, _TOGETHER):
        _add_data_products(
            scales[m],
            nearest,
            table[m],
            table[min(m + 1, last)],
            table[min(m + 2, last)],
            table[min(m + 3, last)],
            table[min(m + 4, last)],
            weighted[0],
            weighted[1],
            weighted[2],
            lobes[m : m + _TOGETHER],
        )
