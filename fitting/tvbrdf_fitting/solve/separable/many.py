"""Compiled: many scans that share their directions, taken from their arrays as they are."""

from __future__ import annotations

import numpy as np
from numba import njit

from .amplitudes import reduced_lobes
from .elementary import JIT, SUMS
from .nearby import new_nearby
from .products import (
    new_scan,
    write_data_products,
    write_diffuse_data,
    write_diffuse_products,
    write_lobe_products,
)
from .search import search, solve_weighted
from .widths import Sweep, nearest_seen, seen_amplitudes, shifted, widths_between

_USUAL = 1e100
"""No sum of squares of smaller values is inf, with any weight but an absurd one."""


@njit(fastmath=SUMS, **JIT)
def _all_positive(values):
    good = True
    for i in range(values.shape[0]):
        good &= values[i] > 0  # False for NaN
    return good


@njit(fastmath=SUMS, **JIT)
def _all_usual(values):
    good = True
    for i in range(values.shape[0]):
        good &= abs(values[i]) < _USUAL  # False for NaN
    return good


@njit(**JIT)
def _transpose(values, one, two, three):
    for i in range(one.shape[0]):
        one[i], two[i], three[i] = values[i, 0], values[i, 1], values[i, 2]


@njit(**JIT)
def _take_squares(variance, rows, squares):
    """Write 1 / variance (n, 3) of some rows as (3, n); return whether all can be used."""
    n = rows.shape[0]
    if rows[n - 1] - rows[0] == n - 1:
        some = variance[rows[0] : rows[0] + n]
        good = _all_positive(some.reshape(3 * n))  # see `_take_radiance`
        _transpose(some, squares[0], squares[1], squares[2])
    else:
        good = True
        for i in range(n):
            for c in range(3):
                squares[c, i] = variance[rows[i], c]
                good &= squares[c, i] > 0
    for c in range(3):
        for i in range(n):
            squares[c, i] = 1 / squares[c, i]
    return good


@njit(fastmath=SUMS, **JIT)
def _blank(squares, values):
    """Write 0 where there is no weight; say whether all others are finite."""
    total = 0.0
    for i in range(values.shape[0]):
        value = values[i] if squares[i] > 0 else 0.0
        values[i] = value
        total += 0.0 * value
    return total == 0


@njit(**JIT)
def _take_radiance(values, rows, squares, radiance):
    """Write values (n, 3) of some rows as (3, n); say whether those with a weight are finite.

    Without weight they become 0 where any is not finite or its square may not be.
    """
    n = rows.shape[0]
    if rows[n - 1] - rows[0] == n - 1:
        some = values[rows[0] : rows[0] + n]
        # reading it straight on first also brings it near: transposing takes long from afar
        usual = _all_usual(some.reshape(3 * n))
        _transpose(some, radiance[0], radiance[1], radiance[2])
        if usual:
            return True
    else:
        for i in range(n):
            for c in range(3):
                radiance[c, i] = values[rows[i], c]
    return (
        _blank(squares[0], radiance[0])
        & _blank(squares[1], radiance[1])
        & _blank(squares[2], radiance[2])
    )


@njit(**JIT)
def solve_each(
    xs, form, geometry, radiances, variances, rows, lower, upper, tolerance, costs, counts
):
    """Solve scans (m, n, 3) with variances of their own; see `solve_alike`."""
    radiance, squares = np.empty((3, rows.shape[0])), np.empty((3, rows.shape[0]))
    for m in range(xs.shape[0]):
        if not _take_squares(variances[m], rows, squares):
            return m
        if not _take_radiance(radiances[m], rows, squares, radiance):
            return m
        costs[m], counts[m, 0], counts[m, 1], counts[m, 2] = solve_weighted(
            xs[m], form, geometry, radiance, squares, lower, upper, tolerance
        )
    return -1


@njit(**JIT)
def solve_alike(
    xs, form, geometry, radiances, variance, rows, lower, upper, tolerance, costs, counts
):
    """Solve scans (m, n, 3) that share their variance (n, 3), and with it most of the work.

    `rows` are those that the vectors of `geometry` belong to. `xs` is (m, 6) or (m, 8), `costs`
    (m,); `counts` (m, 3) gets evaluations, status and valleys. Return the first scan that can't be
    used, or -1.
    """
    vectors, f, q = geometry
    n = f.shape[0]
    radiance, squares, columns = np.zeros((3, n)), np.empty((3, n)), np.empty((3, n))
    if not _take_squares(variance, rows, squares):
        return 0
    nearer, high = nearest_seen(q, squares, lower, upper)
    scan = new_scan(form, vectors, f, shifted(q, nearer), radiance, squares)
    us = widths_between(lower, high)
    lobes, table = np.empty((us.shape[0], 3, 5)), np.empty((us.shape[0], n))
    write_diffuse_products(scan)
    scales = np.exp(2 * us)
    for k in range(us.shape[0]):
        write_lobe_products(scales[k], 1, scan, table[k], lobes[k])
        for i in range(n):
            table[k, i] *= f[i]
    sweep = Sweep(us, lobes, reduced_lobes(scan.diffuse, lobes))
    near = new_nearby(us.shape[0], n)
    for m in range(xs.shape[0]):
        if not _take_radiance(radiances[m], rows, squares, radiance):
            return m
        energy = write_diffuse_data(scan)
        write_data_products(scales, table, scan.nearest, scan.weighted, lobes)
        costs[m], counts[m, 0], counts[m, 1], counts[m, 2] = search(
            xs[m], scan, sweep, near, energy, lower, high, columns, tolerance
        )
        seen_amplitudes(xs[m], nearer)
    return -1
