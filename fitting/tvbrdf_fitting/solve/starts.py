"""Where to start: a coarse search over the shape parameters, amplitudes by least squares.

At given shapes (sigma_d, sigma_s, g, tau) a model is a sum of amplitudes times fixed vectors, so
inner products of those vectors, taken once, give the best non-negative amplitudes at every point
of a grid of shapes at the cost of a tiny system. Inner products lose digits near a perfect fit;
that does not matter for a start.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import product

import numpy as np

from ..geometry import FloatArray, IntArray
from ..models import Term
from ..problem import Problem

_UNSEEN = 1e-24
_SWEEPS = 12
"""Coordinate descent rounds; the few, mostly local amplitudes need no more for a start."""


def find_starts(problem: Problem, count: int = 3) -> list[FloatArray]:
    """Return up to `count` internal starting points (p,), the most promising first.

    They are the best local minima of the coarse search, so they lie in different valleys.
    Deterministic.
    """
    if all(index in problem.initial for index in problem.free):
        return [_with_initial(problem, problem.values.copy())]
    shape_names, grids = _grids(problem)
    vectors = [_term_vectors(problem, term, shape_names, grids) for term in problem.model.terms]
    amplitudes, cost = _solve_grid(problem, shape_names, grids, vectors)
    starts = []
    for point in _local_minima(cost.reshape([len(g) for g in grids]), count):
        start = problem.values.copy()
        flat = int(np.ravel_multi_index(point, [len(g) for g in grids]))
        for name, grid, position in zip(shape_names, grids, point, strict=True):
            start[problem.model.parameter_names.index(name)] = grid[position]
        for name, value in zip(_amplitude_names(problem), amplitudes[flat], strict=True):
            start[problem.model.parameter_names.index(name)] = value
        starts.append(problem.clamp(_with_initial(problem, start)))
    return starts[:1] if problem.initial else starts


def other_valleys(problem: Problem, internal: FloatArray, count: int = 2) -> list[FloatArray]:
    """Return starts in valleys that look deeper than a solution, best first; mostly none.

    The coarse search ranks valleys with rough diffuse parameters, too roughly where a lobe is as
    weak as the noise. Here each lobe's width is scanned at the solution, its amplitude and all
    other coordinates answering to first order.
    """
    limit = problem.cost(internal) * (1 - 1e-7)
    on_bound = (internal <= problem.lower) | (internal >= problem.upper)
    held = set(np.flatnonzero(on_bound).tolist())
    found: list[tuple[float, FloatArray]] = []
    for term in problem.model.terms:
        scanned = _own_shapes(problem, term)
        amplitude = problem.model.parameter_names.index(term.amplitudes[0])
        if len(term.amplitudes) == 1 and scanned and amplitude in problem.free:
            found += _scan_lobe(problem, internal, term, amplitude, scanned, held)
    found = sorted((f for f in found if f[0] < limit), key=lambda f: f[0])
    return [problem.clamp(start) for _, start in found[:count]]


def _own_shapes(problem: Problem, term: Term) -> list[int]:
    """Return the free shape parameters that no other term depends on."""
    others = {name for t in problem.model.terms if t is not term for name in t.shapes}
    own = [problem.model.parameter_names.index(n) for n in term.shapes if n not in others]
    return [i for i in own if i in problem.free and i not in problem.initial]


def _scan_lobe(
    problem: Problem,
    internal: FloatArray,
    term: Term,
    amplitude: int,
    scanned: list[int],
    held: Collection[int],
) -> list[tuple[float, FloatArray]]:
    """Return predicted costs and starts at the local minima over one lobe's shapes."""
    parameters, names = problem.model.parameters, problem.model.parameter_names
    base = internal.copy()
    base[amplitude] = 0.0
    others = [i for i in problem.free if i not in {amplitude, *scanned, *held}]
    columns = problem.jacobian(base, tuple(others))
    scale = np.linalg.norm(columns, axis=0)
    others = [i for i, size in zip(others, scale, strict=True) if size > 0]
    basis, triangle = np.linalg.qr(columns[:, scale > 0] / scale[scale > 0])

    grids = [
        parameters[i].grid if i in scanned else (float(base[i]),)
        for i in (names.index(n) for n in term.shapes)
    ]
    shapes = list(product(*grids))
    lobes = np.array([term.vector(problem.prepared, s, 0.0) for s in shapes]) * problem.to_radiance
    weighted = (lobes[:, None, :] * problem.weight).reshape(len(shapes), -1)
    residual = problem.residual(base)
    rest = residual - basis @ (basis.T @ residual)
    energy = np.einsum("ij,ij->i", weighted, weighted)
    shared = weighted @ basis
    square = energy - np.einsum("ij,ij->i", shared, shared)
    useful = square > 1e-9 * energy
    downhill = np.where(useful, np.maximum(-(weighted @ rest), 0.0), 0.0)
    best = downhill / np.where(useful, square, 1.0)
    cost = 0.5 * float(rest @ rest) - 0.5 * downhill * best
    out = []
    for point in _local_minima(cost.reshape([len(g) for g in grids]), len(shapes)):
        k = int(np.ravel_multi_index(point, [len(g) for g in grids]))
        start = base.copy()
        start[amplitude] = best[k]
        for name, value in zip(term.shapes, shapes[k], strict=True):
            start[names.index(name)] = value
        answer = basis.T @ residual + best[k] * shared[k]
        if others:
            step = np.linalg.lstsq(triangle, -answer, rcond=1e-10)[0]
            start[others] += step / scale[scale > 0]
        out.append((float(cost[k]), start))
    return out


def _with_initial(problem: Problem, start: FloatArray) -> FloatArray:
    for index, value in problem.initial.items():
        if index in problem.free:
            start[index] = value
    return start


def _grids(problem: Problem) -> tuple[list[str], list[tuple[float, ...]]]:
    """Return shape parameters and the values tried: one where it is fixed or given."""
    names: list[str] = []
    grids: list[tuple[float, ...]] = []
    for index, parameter in enumerate(problem.model.parameters):
        if not parameter.grid:
            continue
        names.append(parameter.name)
        if index not in problem.free:
            grids.append((float(problem.values[index]),))
        elif index in problem.initial:
            grids.append((problem.initial[index],))
        else:
            grids.append(parameter.grid)
    return names, grids


def _amplitude_names(problem: Problem) -> list[str]:
    return [name for term in problem.model.terms for name in term.amplitudes]


def _term_vectors(
    problem: Problem, term: Term, shape_names: list[str], grids: list[tuple[float, ...]]
) -> FloatArray:
    """Return the term's vectors (k, n) as radiance, over the grid of its own shapes."""
    own = [grids[shape_names.index(name)] for name in term.shapes]
    # only Oren-Nayar's inter-reflection is not linear; half of a typical albedo is its secant
    seen = problem.weight > 0
    typical = float(np.median(problem.radiance[seen])) if seen.any() else 0.0
    typical = min(max(typical, 0.0), 1.0)
    rows = [term.vector(problem.prepared, shapes, typical) for shapes in product(*own)]
    return np.array(rows) * problem.to_radiance


def _solve_grid(
    problem: Problem,
    shape_names: list[str],
    grids: list[tuple[float, ...]],
    vectors: list[FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Best amplitudes (points, amplitudes) and half sums of squares (points,) on the grid."""
    terms = problem.model.terms
    stacked = np.concatenate(vectors)
    offsets = np.cumsum([0, *(len(v) for v in vectors)])
    where = [
        offsets[t] + _positions(term, shape_names, [len(g) for g in grids])
        for t, term in enumerate(terms)
    ]
    names = _amplitude_names(problem)
    points = len(where[0])
    gram = np.zeros((points, len(names), len(names)))
    projection = np.zeros((points, len(names)))
    energy = 0.0
    for channel in range(3):
        weight = problem.weight[channel]
        if not weight.any():
            continue
        weighted = stacked * weight
        target = problem.radiance[channel] * weight
        products, projections = weighted @ weighted.T, weighted @ target
        energy += float(target @ target)
        columns = [_column(term, channel, names) for term in terms]
        for t, column in enumerate(columns):
            projection[:, column] += projections[where[t]]
            for u, other in enumerate(columns):
                gram[:, column, other] += products[where[t], where[u]]
    amplitudes = _nonnegative(problem, names, gram, projection)
    fitted = np.einsum("kij,kj->ki", gram, amplitudes)
    cost = 0.5 * energy + np.einsum("ki,ki->k", amplitudes, 0.5 * fitted - projection)
    return amplitudes, cost


def _positions(term: Term, shape_names: list[str], sizes: list[int]) -> IntArray:
    """Return which of the term's vectors belongs to each point of the whole grid."""
    index = np.zeros(sizes, dtype=np.int64)
    for name in term.shapes:
        axis = shape_names.index(name)
        shape = [1] * len(sizes)
        shape[axis] = sizes[axis]
        index = index * sizes[axis] + np.arange(sizes[axis]).reshape(shape)
    return index.ravel()


def _column(term: Term, channel: int, names: list[str]) -> int:
    return names.index(term.amplitudes[channel if len(term.amplitudes) == 3 else 0])


def _nonnegative(
    problem: Problem, names: list[str], gram: FloatArray, projection: FloatArray
) -> FloatArray:
    """Non-negative least squares at all points at once, by coordinate descent."""
    indices = [problem.model.parameter_names.index(name) for name in names]
    moves = [i for i, index in enumerate(indices) if index in problem.free]
    amplitudes = np.zeros_like(projection)
    for i, index in enumerate(indices):
        if i not in moves:
            amplitudes[:, i] = problem.values[index]
    diagonal = np.einsum("kii->ki", gram)
    # a lobe that no direction sees, far out in its tail, has no amplitude that means anything
    seen = diagonal > _UNSEEN * diagonal.max(axis=0, initial=0.0)
    safe = np.where(seen, diagonal, 1.0)
    if moves:
        # the unconstrained answer, ridged where vectors vanish, is mostly the final one
        sub = gram[:, moves][:, :, moves].copy()
        ridge = 1e-12 * np.maximum(diagonal[:, moves], diagonal.max(initial=1e-300) * 1e-12)
        for i in range(len(moves)):
            sub[:, i, i] += ridge[:, i]
        held = np.einsum("kij,kj->ki", gram, amplitudes)[:, moves]
        solved = np.linalg.solve(sub, (projection[:, moves] - held)[..., None])[..., 0]
        amplitudes[:, moves] = np.where(seen[:, moves], np.maximum(solved, 0.0), 0.0)
    for _ in range(_SWEEPS):
        for i in moves:
            rest = np.einsum("kj,kj->k", gram[:, i], amplitudes) - diagonal[:, i] * amplitudes[:, i]
            better = np.maximum((projection[:, i] - rest) / safe[:, i], 0.0)
            amplitudes[:, i] = np.where(seen[:, i], better, 0.0)
    return amplitudes


def _local_minima(cost: FloatArray, count: int) -> list[tuple[int, ...]]:
    """Grid points no worse than their neighbours along each axis, best first."""
    lowest = np.ones(cost.shape, dtype=bool)
    for axis in range(cost.ndim):
        before = np.roll(cost, 1, axis=axis)
        after = np.roll(cost, -1, axis=axis)
        np.moveaxis(before, axis, 0)[0] = np.inf
        np.moveaxis(after, axis, 0)[-1] = np.inf
        lowest &= (cost <= before) & (cost <= after)
    candidates = np.argwhere(lowest)
    order = np.argsort(cost[lowest], kind="stable")
    return [tuple(int(i) for i in candidates[o]) for o in order[:count]]
