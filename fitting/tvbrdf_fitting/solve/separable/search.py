"""Compiled search: every valley of the reduced cost over the lobe's width, each descended.

With c the cosine of the light, the radiance of a channel is ::

    kd (C1(s) c + B(s) g1 c) + kd^2 E(s) g2 c + ks f exp(-q exp(2 u)),   u = log(1/sigma_s)

where g1, g2, f, q belong to the directions alone. At a given u the best s = sigma_d^2 and
amplitudes cost next to nothing (`amplitudes`), so a grid over u shows every valley. Each is then
descended by damped Newton steps on all coordinates, with true residuals, column scaling and bounds;
after every step the amplitudes are made the best ones again (variable projection), because they
follow s and u in a bend.

Coordinates are (kd_b, kd_g, kd_r, s, ks, u), or with three ks. Equal bounds fix a coordinate.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from .amplitudes import (
    COLD_ROUNDS,
    WARM_ROUNDS,
    best_at_width,
    improve_amplitudes,
    lower_bound,
    triangulate,
)
from .elementary import JIT, bounded_step, clip, dot, weigh
from .equations import (
    nearest,
    normal_equations,
    write_diffuse_products,
    write_lobe_products,
    zero_outside,
)

WIDTHS = 20
"""Values of u tried; neighbours' widths have a ratio of 1.35."""
VALLEYS = 6
MAX_STEPS, SECOND_STEPS = 100, 25
"""Steps at most in the valley that looks deepest, and in others."""
CONVERGED, STALLED, EXHAUSTED = 0, 1, 2
_APART = 0.05
"""Relative distance of two values of s that can lie in different valleys."""
_BEND = 1e-5
"""Relative step above which amplitudes are made the best again."""


@njit(**JIT)
def descend(x, form, data, blocks, diffuse, lower, upper, columns, tolerance, steps):
    """Newton steps, damped, from x, in place, within bounds; return (cost, evaluations, status).

    Where the second derivatives are not positive, the Gauss-Newton matrix stands in for them.
    """
    size = x.shape[0]
    gradient, trial_gradient, step = np.empty(size), np.empty(size), np.empty(size)
    trial, scale, work = np.empty(size), np.empty(size), np.empty((2, size))
    matrix, trial_matrix = np.empty((size, size)), np.empty((size, size))
    curvature, trial_curvature = np.empty((size, size)), np.empty((size, size))
    factor, products, forms = np.empty((size, size)), np.empty((3, 5)), np.empty((3, 9))
    free, held = np.ones(size, np.bool_), np.ones(size, np.bool_)
    cost = normal_equations(x, form, data, columns, gradient, matrix, curvature)
    evaluations, damping, growth, previous, rate = 1, 0.0, 2.0, np.inf, 1.0
    for _ in range(steps):
        for i in range(size):
            scale[i] = math.sqrt(matrix[i, i]) if matrix[i, i] > 0 else 1.0
            outward = (x[i] <= lower[i] and gradient[i] >= 0) or (
                x[i] >= upper[i] and gradient[i] <= 0
            )
            free[i] = matrix[i, i] > 0 and not outward and lower[i] < upper[i]
        model = curvature
        held[:] = free
        if not bounded_step(
            curvature, gradient, scale, x, lower, upper, damping, free, factor, work, step
        ):
            model = matrix
            free[:] = held
            if not bounded_step(
                matrix, gradient, scale, x, lower, upper, damping, free, factor, work, step
            ):
                damping = max(10 * damping, 1e-10)
                continue
        length = extent = predicted = 0.0
        for i in range(size):
            trial[i] = clip(x[i] + step[i], lower[i], upper[i])
            length += (step[i] * scale[i]) ** 2
            extent += (x[i] * scale[i]) ** 2
            along = 0.0
            for j in range(size):
                along += model[i, j] * step[j]
            predicted -= step[i] * (gradient[i] + 0.5 * along)
        length, extent = math.sqrt(length), math.sqrt(extent)
        if length <= 1e-15 * extent:
            return cost, evaluations, CONVERGED
        if length > _BEND * extent:
            write_lobe_products(trial[size - 1], data, blocks, columns[0], products)
            improve_amplitudes(trial, form, diffuse, products, lower, upper, WARM_ROUNDS, forms)
        trial_cost = normal_equations(
            trial, form, data, columns, trial_gradient, trial_matrix, trial_curvature
        )
        evaluations += 1
        reduction = cost - trial_cost
        # where the reduction drowns in rounding, shrinking steps still tell the way
        noise = 1e-14 * cost
        lost = abs(predicted) <= noise and abs(reduction) <= 16 * noise
        if reduction > 0 or (lost and length < 0.5 * previous):
            ratio = reduction / predicted if predicted > 0 and not lost else 1.0
            cost = trial_cost
            x[:] = trial
            gradient[:] = trial_gradient
            matrix[:, :] = trial_matrix
            curvature[:, :] = trial_curvature
            if damping == 0.0 and ratio < 0.25:
                damping = 1e-3
            damping *= max(0.1, 1 - (2 * ratio - 1) ** 3)
            if damping < 1e-9:
                damping = 0.0
            # steps to come shrink at least as fast as the last two did
            rate, before = length / previous if previous < np.inf else 1.0, rate
            shrunk = max(rate, before) * length <= tolerance * extent
            growth, previous = 2.0, length
            if (shrunk and damping == 0.0) or length <= tolerance * extent:
                return cost, evaluations, CONVERGED
        else:
            if lost or length <= tolerance * extent:
                return cost, evaluations, CONVERGED if lost else STALLED
            damping = max(damping, 1e-4) * growth
            growth *= 2.0
    return cost, evaluations, EXHAUSTED


@njit(**JIT)
def width_at(k, widths, lower, upper):
    """Return the k-th value of u of the grid."""
    low, high = lower[lower.shape[0] - 1], upper[upper.shape[0] - 1]
    return low + (high - low) * k / (widths - 1) if widths > 1 else low


@njit(**JIT)
def width_count(lower, upper):
    """Return how many values of u are tried: one where it is fixed."""
    last = lower.shape[0] - 1
    return WIDTHS if upper[last] > lower[last] else 1


@njit(**JIT)
def search(x, form, data, blocks, diffuse, lobes, energy, lower, upper, columns, tolerance):
    """Descend every valley that could hold the optimum, given all products; see `solve`."""
    size, widths = x.shape[0], lobes.shape[0]
    triangles, products, room = np.empty((3, 9)), np.empty((3, 5)), np.empty((6, 9))
    costs, floors, points = np.full(widths, np.inf), np.empty(widths), np.empty((widths, size))
    triangulate(diffuse, triangles)
    for k in range(widths):
        floors[k] = 0.5 * energy + lower_bound(triangles, lobes[k], size == 8)
        for i in range(size):
            points[k, i] = clip(0.0, lower[i], upper[i])
        points[k, size - 1] = width_at(k, widths, lower, upper)

    first = int(np.argmin(floors))
    costs[first], _ = best_at_width(points[first], form, diffuse, lobes[first], lower, upper, room)
    x[:] = points[first]
    best, evaluations, status = descend(
        x, form, data, blocks, diffuse, lower, upper, columns, tolerance, MAX_STEPS
    )
    valleys = 1
    # only widths whose bound lies below what was found can hide a deeper valley
    margin = 1e-9 * best + 1e-13 * energy
    for k in range(widths):
        if k != first and floors[k] < best + margin:
            costs[k], _ = best_at_width(points[k], form, diffuse, lobes[k], lower, upper, room)
    bottoms = np.full(widths, np.inf)  # of a plateau its last point
    for k in range(widths):
        if (k == 0 or costs[k] <= costs[k - 1]) and (k == widths - 1 or costs[k] < costs[k + 1]):
            bottoms[k] = costs[k]
    bottoms[first] = np.inf
    start = np.empty(size)
    for _ in range(VALLEYS - 1):
        chosen = int(np.argmin(bottoms))
        if bottoms[chosen] == np.inf:
            break
        bottoms[chosen] = np.inf
        start[:] = points[chosen]
        # a valley is nearly as deep at its best grid point as at its bottom
        cost, spent, state = descend(
            start, form, data, blocks, diffuse, lower, upper, columns, tolerance, SECOND_STEPS
        )
        valleys += 1
        evaluations += spent
        if cost < best:
            best, status = cost, state
            x[:] = start
    # dark surfaces can have two valleys of s at one width
    start[:] = x
    write_lobe_products(x[size - 1], data, blocks, columns[0], products)
    _, elsewhere = best_at_width(start, form, diffuse, products, lower, upper, room)
    other = abs(start[3] - x[3]) > _APART * (0.1 + x[3])
    if not other and elsewhere >= 0:
        other = True
        start[3] = elsewhere
        improve_amplitudes(start, form, diffuse, products, lower, upper, COLD_ROUNDS, room[:3])
    if other:
        cost, spent, state = descend(
            start, form, data, blocks, diffuse, lower, upper, columns, tolerance, SECOND_STEPS
        )
        valleys += 1
        evaluations += spent
        if cost < best:
            best, status = cost, state
            x[:] = start
    return best, evaluations, status, valleys


@njit(**JIT)
def solve(x, form, data, lower, upper, tolerance):
    """Find the global optimum within the bounds and write it into x.

    Parameters
    ----------
    x
        (6,) or (8,) coordinates, written.
    form
        (2,) constant of C1 and factor of E: (0.33, 0.17) for the full Oren-Nayar model.
    data
        vectors (3, n): c, g1 c, g2 c; f (n,): pi c times the lobe's geometric factor; q (n,):
        theta_h squared; radiance (3, n); weight (3, n): 1 / standard deviation, 0 where not used.
    lower, upper
        (6,) or (8,); equal ones fix a coordinate.
    tolerance
        Relative step at which a descent ends.

    Returns
    -------
    (cost, evaluations, status, valleys descended)
    """
    vectors, f, q, radiance, weight = data
    diffuse, columns, blocks, energy = np.empty((3, 9)), np.empty((5, f.shape[0])), nearest(q), 0.0
    for c in range(3):
        energy += write_diffuse_products(weight[c], vectors, radiance[c], diffuse[c])
    widths = width_count(lower, upper)
    lobes = np.empty((widths, 3, 5))
    for k in range(widths):
        u = width_at(k, widths, lower, upper)
        write_lobe_products(u, data, blocks, columns[0], lobes[k])
    return search(x, form, data, blocks, diffuse, lobes, energy, lower, upper, columns, tolerance)


@njit(**JIT)
def refine(x, form, data, lower, upper, tolerance):
    """Descend from x, in place, and nowhere else; parameters and result as for `solve`."""
    vectors, f, q, radiance, weight = data
    diffuse, columns = np.empty((3, 9)), np.empty((5, f.shape[0]))
    for c in range(3):
        write_diffuse_products(weight[c], vectors, radiance[c], diffuse[c])
    cost, evaluations, status = descend(
        x, form, data, nearest(q), diffuse, lower, upper, columns, tolerance, MAX_STEPS
    )
    return cost, evaluations, status, 1


@njit(**JIT)
def solve_alike(xs, form, vectors, f, q, radiances, weight, lower, upper, tolerance, costs, counts):
    """Like `solve` for scans (m, 3, n) that share directions and weights (3, n).

    `xs` is (m, 6) or (m, 8), `costs` (m,); `counts` (m, 3) gets evaluations, status and valleys.
    """
    n = f.shape[0]
    columns, blocks, widths = np.empty((5, n)), nearest(q), width_count(lower, upper)
    lobes, table = np.empty((widths, 3, 5)), np.empty((widths, n))
    diffuse, weighted = np.empty((3, 9)), np.empty(n)
    data = (vectors, f, q, radiances[0], weight)
    for k in range(widths):
        u = width_at(k, widths, lower, upper)
        write_lobe_products(u, data, blocks, table[k], lobes[k])
        zero_outside(u, q, blocks, table[k])
    for c in range(3):
        write_diffuse_products(weight[c], vectors, radiances[0, c], diffuse[c])
    for m in range(xs.shape[0]):
        energy = 0.0
        for c in range(3):
            energy += weigh(weight[c], radiances[m, c], weighted)
            for j in range(3):
                diffuse[c, 6 + j] = dot(vectors[j], weighted)
            for k in range(widths):
                lobes[k, c, 4] = dot(table[k], weighted)
        data = (vectors, f, q, radiances[m], weight)
        costs[m], counts[m, 0], counts[m, 1], counts[m, 2] = search(
            xs[m], form, data, blocks, diffuse, lobes, energy, lower, upper, columns, tolerance
        )
