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
    EXACT,
    ROUGH,
    WARM_ROUNDS,
    best_at_width,
    improve_amplitudes,
    lower_bound,
    reduce_lobe,
    reduced_lobes,
    settle,
    triangulate,
)
from .elementary import JIT, bounded_step, clip, squared, write_scale
from .equations import normal_equations
from .nearby import approach
from .products import new_scan, write_diffuse_products, write_lobe_products
from .widths import (
    Sweep,
    nearest_seen,
    seen_amplitudes,
    shifted,
    width_between,
    widths_between,
    write_sweep,
)

VALLEYS = 6
MAX_STEPS, SECOND_STEPS = 100, 25
"""Steps at most in the valley that looks deepest, and in others."""
CONVERGED, STALLED, EXHAUSTED = 0, 1, 2
_APART = 0.05
"""Relative distance of two values of s that can lie in different valleys."""
_BEND, _FAR = 1e-5, 1e-2
"""Relative steps above which amplitudes, and the roughness, are made the best again."""
_FAITHFUL, _SHRINKING = 0.3, 1e-3
"""How well a step must have been foreseen before the next is, and by how much it can shrink."""
_CLOSER, _NEARLY = 4, 1.05
"""Parts of a step of the grid where valleys can be narrow, and the ratio of costs that says so."""
_SAME = 0.1
"""Distance in u along which no second valley of s opens, away from the bounds."""


@njit(**JIT)
def descend(x, scan, lower, upper, columns, tolerance, steps):
    """Newton steps, damped, from x, in place, within bounds; return (cost, evaluations, status).

    Where the second derivatives are not positive, the Gauss-Newton matrix stands in for them.
    `columns` (3, n) is overwritten.
    """
    form, diffuse = scan.form, scan.diffuse
    size = x.shape[0]
    gradient, trial_gradient, step = np.empty(size), np.empty(size), np.empty(size)
    trial, scale, work = np.empty(size), np.empty(size), np.empty((2, size))
    matrix, trial_matrix = np.empty((size, size)), np.empty((size, size))
    curvature, trial_curvature = np.empty((size, size)), np.empty((size, size))
    factor, products, forms = np.empty((size, size)), np.empty((3, 5)), np.empty((3, 9))
    free, held = np.ones(size, np.bool_), np.ones(size, np.bool_)
    cost = normal_equations(x, scan, False, columns, gradient, matrix, curvature)
    evaluations, damping, growth, previous, rate = 1, 0.0, 2.0, np.inf, 1.0
    faithful = False
    for _ in range(steps):
        write_scale(x, matrix, gradient, lower, upper, scale, free)
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
        # undamped steps with true second derivatives square the distance to the bottom: where the
        # next one would be nothing, this one's end need not be looked at
        after = max(10 * (length / previous) ** 2, _SHRINKING) * length
        last = faithful and model is curvature and damping == 0.0 and after <= tolerance * extent
        if last and predicted * length <= 1e-11 * cost * previous:
            x[:] = trial
            return cost - predicted, evaluations, CONVERGED
        known = length > _BEND * extent
        if known:
            scale_u = math.exp(2 * trial[size - 1])
            write_lobe_products(scale_u, 1, scan, columns[0], products)
            if length > _FAR * extent:
                settle(trial, step[3], form, diffuse, products, lower, upper, forms)
            else:
                improve_amplitudes(trial, form, diffuse, products, lower, upper, WARM_ROUNDS, forms)
        trial_cost = normal_equations(
            trial, scan, known, columns, trial_gradient, trial_matrix, trial_curvature
        )
        evaluations += 1
        reduction = cost - trial_cost
        # where the reduction drowns in rounding, shrinking steps still tell the way
        noise = 1e-14 * cost
        lost = abs(predicted) <= noise and abs(reduction) <= 16 * noise
        if reduction > 0 or (lost and length < 0.5 * previous):
            ratio = reduction / predicted if predicted > 0 and not lost else 1.0
            faithful = abs(ratio - 1) < _FAITHFUL
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
            if ((shrunk or last) and damping == 0.0) or length <= tolerance * extent:
                return cost, evaluations, CONVERGED
        else:
            if lost or length <= tolerance * extent:
                return cost, evaluations, CONVERGED if lost else STALLED
            damping = max(damping, 1e-4) * growth
            growth *= 2.0
    return cost, evaluations, EXHAUSTED


@njit(**JIT)
def find_bottoms(best, scan, sweep, triangles, floors, energy, lower, upper, falloff):
    """Return the best points (k, 6) or (k, 8) at suspicious widths, in order, and their costs (k,).

    Only widths whose bound lies below what was found can hide a deeper valley. Where such a width's
    own cost is far above it, a valley can be narrower than the grid: it is looked for in between.
    Costs of what is no local minimum are inf.
    """
    us, form, diffuse = sweep.us, scan.form, scan.diffuse
    size, widths = lower.shape[0], us.shape[0]
    count = (widths - 1) * _CLOSER + 1
    costs, bottoms, points = np.full(count, np.inf), np.full(count, np.inf), np.empty((count, size))
    products, reduced, room = np.empty((3, 5)), np.empty((3, 4)), np.empty((6, 9))
    margin = 1e-9 * best + 1e-10 * energy
    coloured = size == 8
    for turn in range(_CLOSER):  # the grid, then what lies between
        for k in range(turn, count, _CLOSER):
            node, u = k // _CLOSER, us[k // _CLOSER]
            if turn == 0:
                suspicious = floors[node] < best + margin
                products[:, :] = sweep.lobes[node]
            else:
                suspicious = floors[node] < best + margin or floors[node + 1] < best + margin
                ends = costs[node * _CLOSER], costs[(node + 1) * _CLOSER]
                if not suspicious or max(ends[0], ends[1]) < _NEARLY * best:
                    continue
                u += (us[node + 1] - u) * turn / _CLOSER
                write_lobe_products(math.exp(2 * u), 1, scan, falloff, products)
                reduce_lobe(triangles, products, reduced)
                floor = 0.5 * energy + lower_bound(triangles, products, reduced, coloured)
                suspicious = floor < best + margin
            if suspicious:
                for i in range(size):
                    points[k, i] = clip(0.0, lower[i], upper[i])
                points[k, size - 1] = u
                cost, _ = best_at_width(
                    points[k], form, diffuse, products, lower, upper, EXACT, room
                )
                costs[k] = cost + 0.5 * energy
    before = np.inf
    for k in range(count):
        if costs[k] == np.inf and k % _CLOSER:
            continue  # was not looked at: no neighbour
        j = k + 1
        while j < count and costs[j] == np.inf and j % _CLOSER:
            j += 1
        # of a plateau its last point
        if costs[k] <= before and (j >= count or costs[k] < costs[j]):
            bottoms[k] = costs[k]
        before = costs[k]
    return points, bottoms


@njit(**JIT)
def search(x, scan, sweep, near, energy, lower, upper, columns, tolerance):
    """Descend every valley that could hold the optimum, given all products; see `solve`.

    `near` tells the products between the widths that were tried, or is None.
    """
    us, size = sweep.us, x.shape[0]
    triangles, products, room = np.empty((3, 9)), np.empty((3, 5)), np.empty((6, 9))
    floors, start, falloff = np.empty(us.shape[0]), np.empty(size), columns[0]
    triangulate(scan.diffuse, triangles)
    for k in range(us.shape[0]):
        bound = lower_bound(triangles, sweep.lobes[k], sweep.reduced[k], size == 8)
        floors[k] = 0.5 * energy + bound
    for i in range(size):
        x[i] = clip(0.0, lower[i], upper[i])
    x[size - 1] = began = width_between(us, floors, int(np.argmin(floors)))
    best, evaluations, status, valleys = np.inf, 1, CONVERGED, 1
    if near is None:
        elsewhere = _begin(x, scan, lower, upper, ROUGH, falloff, products, room)
    else:
        best, elsewhere = approach(x, scan, us, near, lower, upper, columns, room)
    if best == np.inf:
        best, evaluations, status = descend(x, scan, lower, upper, columns, tolerance, MAX_STEPS)
    if np.min(floors) < best * (1 + 1e-9) + 1e-10 * energy:
        points, bottoms = find_bottoms(
            best, scan, sweep, triangles, floors, energy, lower, upper, falloff
        )
        at = x[size - 1]
        for _ in range(VALLEYS - 1):
            chosen = int(np.argmin(bottoms))
            if bottoms[chosen] == np.inf:
                break
            # the nearest point of the valley that was descended is no other valley
            if bottoms[chosen] >= best and abs(points[chosen, size - 1] - at) < _SAME:
                bottoms[chosen] = np.inf
                continue
            bottoms[chosen] = np.inf
            start[:] = points[chosen]
            # a valley is nearly as deep at its best grid point as at its bottom
            cost, spent, state = descend(
                start, scan, lower, upper, columns, tolerance, SECOND_STEPS
            )
            valleys += 1
            evaluations += spent
            if cost < best:
                best, status = cost, state
                x[:] = start
    inside = True
    for i in range(4):
        inside &= lower[i] < x[i] < upper[i]
    if inside and valleys == 1 and elsewhere < 0 and abs(x[size - 1] - began) < _SAME:
        return best, evaluations, status, valleys
    # dark surfaces can have two valleys of s at one width
    start[:] = x
    elsewhere = _begin(start, scan, lower, upper, EXACT, falloff, products, room)
    other = abs(start[3] - x[3]) > _APART * (0.1 + x[3])
    if not other and elsewhere >= 0:
        other = True
        start[3] = elsewhere
        improve_amplitudes(
            start, scan.form, scan.diffuse, products, lower, upper, COLD_ROUNDS, room[:3]
        )
    if other:
        cost, spent, state = descend(start, scan, lower, upper, columns, tolerance, SECOND_STEPS)
        valleys += 1
        evaluations += spent
        if cost < best:
            best, status = cost, state
            x[:] = start
    return best, evaluations, status, valleys


@njit(**JIT)
def _begin(x, scan, lower, upper, refinements, falloff, products, room):
    """Make s and the amplitudes the best at the width of x; return another valley's s, or -1."""
    write_lobe_products(math.exp(2 * x[x.shape[0] - 1]), 1, scan, falloff, products)
    _, elsewhere = best_at_width(
        x, scan.form, scan.diffuse, products, lower, upper, refinements, room
    )
    return elsewhere


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
    geometry = (vectors, f, q)
    return solve_weighted(x, form, geometry, radiance, squared(weight), lower, upper, tolerance)


@njit(**JIT)
def solve_weighted(x, form, geometry, radiance, squares, lower, upper, tolerance):
    """Do what `solve` does for squares of weights."""
    vectors, f, q = geometry
    nearer, high = nearest_seen(q, squares, lower, upper)
    if nearer > 0:
        q = shifted(q, nearer)
    scan, columns = (new_scan(form, vectors, f, q, radiance, squares), np.empty(radiance.shape))
    energy = write_diffuse_products(scan)
    us = widths_between(lower, high)
    lobes = np.empty((us.shape[0], 3, 5))
    write_sweep(us, scan, columns[0], lobes)
    sweep = Sweep(us, lobes, reduced_lobes(scan.diffuse, lobes))
    found = search(x, scan, sweep, None, energy, lower, high, columns, tolerance)
    seen_amplitudes(x, nearer)
    return found


@njit(**JIT)
def refine(x, form, data, lower, upper, tolerance):
    """Descend from x, in place, and nowhere else; parameters and result as for `solve`."""
    vectors, f, q, radiance, weight = data
    squares, last = squared(weight), x.shape[0] - 1
    nearer, high = nearest_seen(q, squares, lower, upper)
    scan = new_scan(form, vectors, f, shifted(q, nearer), radiance, squares)
    columns = np.empty(radiance.shape)
    write_diffuse_products(scan)
    x[last] = min(x[last], high[last])
    seen_amplitudes(x, -nearer)
    cost, evaluations, status = descend(x, scan, lower, high, columns, tolerance, MAX_STEPS)
    seen_amplitudes(x, nearer)
    return cost, evaluations, status, 1
