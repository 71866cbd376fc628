"""Compiled: the best amplitudes at a lobe's width and a roughness, and the best roughness.

For given s and u the model is amplitudes times vectors, so inner products of the vectors with each
other and with the data, taken once, make the number of observations irrelevant. Products of raw
vectors lose digits near a perfect fit (c and g2 c are nearly parallel), which is why they only rank
valleys and aim steps: costs and parameters that are reported come from true residuals.

`x` is (kd_b, kd_g, kd_r, s, ks (one or three), u). `diffuse` (3, 9) has for each channel the
products 00, 01, 02, 11, 12, 22 of the vectors X0, X1, X2, and theirs with the data; `lobes` (3, 5)
the lobe's with the vectors, with itself, and with the data. `forms` (3, 9) is overwritten.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from .elementary import JIT, clip
from .equations import diffuse_coefficients

ROUGHNESSES = 6
"""Values of s tried at every width."""
COLD_ROUNDS, WARM_ROUNDS = 4, 2
"""Gauss-Newton rounds from no amplitude at all, and from nearly the right ones."""
ROUGH, EXACT = 2, 25
"""Refinements of s, at most: to start a descent from, and to compare widths."""
_SECANTS = 3
_DARK = 1e-12


@njit(**JIT)
def improve_amplitudes(x, form, diffuse, lobes, lower, upper, rounds, forms):
    """Improve the amplitudes in x within their bounds; return (cost, its slope by s).

    By Gauss-Newton, the lobe's amplitude first, the albedos answering. The cost is half the
    squares, less a constant.
    """
    c1, b, e, slope_c1, slope_b, slope_e = diffuse_coefficients(x[3], form)
    groups = 3 if x.shape[0] == 8 else 1
    for c in range(3):
        g = diffuse[c]
        f = forms[c]
        f[0] = c1 * c1 * g[0] + 2 * c1 * b * g[1] + b * b * g[3]
        f[1] = e * (c1 * g[2] + b * g[4])
        f[2] = e * e * g[5]
        f[3] = c1 * lobes[c, 0] + b * lobes[c, 1]
        f[4] = e * lobes[c, 2]
        f[5] = c1 * g[6] + b * g[7]
        f[6] = e * g[8]
    for _ in range(rounds):
        for group in range(groups):
            first, end = (group, group + 1) if groups == 3 else (0, 3)
            curvature = downhill = 0.0
            k = x[4 + group]
            for c in range(first, end):
                f, kd = forms[c], x[c]
                own = f[0] + 4 * kd * (f[1] + kd * f[2])
                cross = f[3] + 2 * kd * f[4]
                pull = _pull(f, kd, k)
                # an albedo that its bound holds back does not answer to the lobe
                held = (kd <= lower[c] and pull > 0) or (kd >= upper[c] and pull < 0)
                answer = 0.0 if held or not own > 0 else cross / own
                curvature += max(lobes[c, 3] - cross * answer, _DARK * lobes[c, 3])
                downhill += pull * answer - (
                    kd * (f[3] + kd * f[4]) + k * lobes[c, 3] - lobes[c, 4]
                )
            if curvature > 0:
                k = clip(k + downhill / curvature, lower[4 + group], upper[4 + group])
                x[4 + group] = k
            for c in range(first, end):
                f, kd = forms[c], x[c]
                own = f[0] + 4 * kd * (f[1] + kd * f[2])
                if own > 0:
                    x[c] = clip(kd - _pull(f, kd, k) / own, lower[c], upper[c])
    cost = slope = 0.0
    for c in range(3):
        g, a = diffuse[c], lobes[c]
        kd, k = x[c], x[4 + c % groups]
        one, two, three = kd * c1, kd * b, kd * kd * e
        r0 = one * g[0] + two * g[1] + three * g[2] + k * a[0] - g[6]
        r1 = one * g[1] + two * g[3] + three * g[4] + k * a[1] - g[7]
        r2 = one * g[2] + two * g[4] + three * g[5] + k * a[2] - g[8]
        slope += kd * (slope_c1 * r0 + slope_b * r1 + kd * slope_e * r2)
        cost += 0.5 * (one * (r0 - g[6]) + two * (r1 - g[7]) + three * (r2 - g[8]))
        cost += 0.5 * k * (one * a[0] + two * a[1] + three * a[2] + k * a[3] - 2 * a[4])
    return cost, slope


@njit(**JIT)
def _pull(f, kd, ks):
    """Gradient by an albedo."""
    straight = kd * (f[0] + kd * f[1]) + ks * f[3] - f[5]
    curved = kd * (f[1] + kd * f[2]) + ks * f[4] - f[6]
    return straight + 2 * kd * curved


@njit(**JIT)
def best_at_width(x, form, diffuse, lobes, lower, upper, refinements, room):
    """Write the best s and amplitudes at the width of x; return the cost, less a constant.

    Also return an s in another valley of the grid, or -1 where there is none.

    s is bracketed on a grid, even in s / (s + 0.25), along which the model changes evenly, and
    found there as the root of the cost's slope by the Illinois rule. `room` (6, 9) is overwritten.
    """
    forms, costs, slopes = room[:3], room[3], room[4]
    best = room[5, : x.shape[0]]
    if not upper[3] > lower[3]:
        x[3] = lower[3]
        cost, _ = improve_amplitudes(x, form, diffuse, lobes, lower, upper, COLD_ROUNDS, forms)
        return cost, -1.0
    first, last = lower[3] / (lower[3] + 0.25), upper[3] / (upper[3] + 0.25)
    spacing = (last - first) / (ROUGHNESSES - 1)
    lowest, chosen = np.inf, 0
    for m in range(ROUGHNESSES):
        x[3] = _roughness(first + spacing * m, lower[3], upper[3])
        rounds = WARM_ROUNDS if m else COLD_ROUNDS
        costs[m], slopes[m] = improve_amplitudes(
            x, form, diffuse, lobes, lower, upper, rounds, forms
        )
        if costs[m] < lowest:
            lowest, chosen = costs[m], m
            best[:] = x
    x[:] = best
    elsewhere, second = -1.0, np.inf
    for m in range(ROUGHNESSES):
        before = costs[m - 1] if m > 0 else np.inf
        after = costs[m + 1] if m < ROUGHNESSES - 1 else np.inf
        if m != chosen and costs[m] < before and costs[m] < after and costs[m] < second:
            second, elsewhere = costs[m], _roughness(first + spacing * m, lower[3], upper[3])
    # the root lies on the side to which the slope at the lowest point falls
    other = chosen + (1 if slopes[chosen] < 0 else -1)
    if not 0 <= other < ROUGHNESSES or slopes[chosen] * slopes[other] >= 0:
        return lowest, elsewhere
    left, right = first + spacing * min(chosen, other), first + spacing * max(chosen, other)
    slope_left, slope_right = slopes[min(chosen, other)], slopes[max(chosen, other)]
    side = 0
    for _ in range(refinements):
        t = (left * slope_right - right * slope_left) / (slope_right - slope_left)
        x[3] = _roughness(t, lower[3], upper[3])
        cost, slope = improve_amplitudes(x, form, diffuse, lobes, lower, upper, WARM_ROUNDS, forms)
        gain = lowest - cost
        if gain > 0:
            lowest = cost
            best[:] = x
        if abs(gain) <= 1e-11 * abs(lowest):
            break
        # an end that stays twice is given half its weight
        if slope < 0:
            left, slope_left = t, slope
            if side < 0:
                slope_right *= 0.5
            side = -1
        else:
            right, slope_right = t, slope
            if side > 0:
                slope_left *= 0.5
            side = 1
    x[:] = best
    return lowest, elsewhere


@njit(**JIT)
def settle(x, moved, form, diffuse, lobes, lower, upper, forms):
    """Improve s and the amplitudes in x after s has moved, by the secant rule for the slope."""
    _, slope = improve_amplitudes(x, form, diffuse, lobes, lower, upper, WARM_ROUNDS, forms)
    before, slope_before = x[3], slope
    x[3] = clip(x[3] - math.copysign(0.2 * abs(moved), slope), lower[3], upper[3])
    for _ in range(_SECANTS):
        if x[3] == before:
            return
        _, slope = improve_amplitudes(x, form, diffuse, lobes, lower, upper, WARM_ROUNDS, forms)
        bend = (slope - slope_before) / (x[3] - before)
        if not bend > 0:
            return
        before, slope_before = x[3], slope
        x[3] = clip(x[3] - slope / bend, lower[3], upper[3])
    improve_amplitudes(x, form, diffuse, lobes, lower, upper, WARM_ROUNDS, forms)


@njit(**JIT)
def _roughness(t, lower, upper):
    return clip(0.25 * t / (1 - t), lower, upper)


@njit(**JIT)
def triangulate(diffuse, triangles):
    """Write Cholesky factors of the vectors' products (rows 0-5), and the data's coordinates (6-8).

    `triangles` is (3, 9) as `diffuse`; dependent or missing vectors get a pivot of 0.
    """
    for c in range(3):
        g, t = diffuse[c], triangles[c]
        t[0] = _pivot(g[0], g[0])
        t[1], t[2] = _quotient(g[1], t[0]), _quotient(g[2], t[0])
        t[3] = _pivot(g[3] - t[1] * t[1], g[3])
        t[4] = _quotient(g[4] - t[1] * t[2], t[3])
        t[5] = _pivot(g[5] - t[2] * t[2] - t[4] * t[4], g[5])
        t[6] = _quotient(g[6], t[0])
        t[7] = _quotient(g[7] - t[1] * t[6], t[3])
        t[8] = _quotient(g[8] - t[2] * t[6] - t[4] * t[7], t[5])


@njit(**JIT)
def reduce_lobe(triangles, lobes, reduced):
    """Write a lobe's coordinates along the vectors and what it is beyond them, squared: (3, 4)."""
    for c in range(3):
        t, a, r = triangles[c], lobes[c], reduced[c]
        r[0] = _quotient(a[0], t[0])
        r[1] = _quotient(a[1] - t[1] * r[0], t[3])
        r[2] = _quotient(a[2] - t[2] * r[0] - t[4] * r[1], t[5])
        r[3] = a[3] - r[0] * r[0] - r[1] * r[1] - r[2] * r[2]


@njit(**JIT)
def reduced_lobes(diffuse, lobes):
    """Return what `reduce_lobe` makes of lobes (w, 3, 5): (w, 3, 4)."""
    triangles, reduced = np.empty((3, 9)), np.empty((lobes.shape[0], 3, 4))
    triangulate(diffuse, triangles)
    for k in range(lobes.shape[0]):
        reduce_lobe(triangles, lobes[k], reduced[k])
    return reduced


@njit(**JIT)
def lower_bound(triangles, lobes, reduced, coloured):
    """Return what no s and no amplitudes can get the cost at a width below, less a constant.

    The three diffuse vectors of each channel are given free factors, which is a linear problem.
    `reduced` is what `reduce_lobe` makes of the lobe.
    """
    total, curvature, downhill = 0.0, 0.0, 0.0
    for c in range(3):
        t, r, square = triangles[c], reduced[c], reduced[c, 3]
        slope = lobes[c, 4] - r[0] * t[6] - r[1] * t[7] - r[2] * t[8]
        total -= 0.5 * (t[6] * t[6] + t[7] * t[7] + t[8] * t[8])
        if lobes[c, 3] > 0 and not square > 1e-7 * lobes[c, 3]:
            return -np.inf  # a lobe like the diffuse vectors: nothing can be said
        if coloured:
            if slope > 0 and square > 0:
                total -= 0.5 * slope * slope / square
        else:
            curvature += square
            downhill += slope
    if downhill > 0 and curvature > 0:
        total -= 0.5 * downhill * downhill / curvature
    return total


@njit(**JIT)
def _pivot(square, whole):
    return np.sqrt(square) if square > 1e-13 * whole else 0.0


@njit(**JIT)
def _quotient(value, pivot):
    return value / pivot if pivot > 0 else 0.0
