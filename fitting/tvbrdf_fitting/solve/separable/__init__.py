"""The separable solver: compiled, and certain of the global optimum.

`layout` says which models it can fit, `search` finds every valley over the lobe's width and
descends each, `many` does so for scans that share their directions, `nearby` with next to no sums
where they share their weights too. `products`, `equations`, `amplitudes`, `widths` and `elementary`
are what they are made of.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np

from ...geometry import BoolArray, FloatArray, IntArray
from ...problem import Problem, Solution
from .layout import Layout, data_of, geometry_of, layout_of

TOLERANCE = 1e-9
"""Relative step at which a descent ends; the one after it would be its square."""
_STATUS = (
    "converged: the last relative step is below 1e-9",
    "no step lowers the cost any more",
    "stopped after the largest number of steps",
)


def fits(problem: Problem) -> bool:
    """Whether the compiled search can solve a problem: by its model, its metric and its gains."""
    alike = problem.to_radiance.ndim == 1
    return problem.separable and alike and layout_of(problem.model) is not None


def solve(problem: Problem) -> Solution:
    """Find the global optimum of a problem that it `fits`.

    With `problem.initial`, the search is over what that leaves open, and only one valley is
    descended, from there.
    """
    layout = layout_of(problem.model)
    if layout is None:
        raise ValueError(f"{problem.model.name} has no separable form")
    if not problem.free:
        return Solution(problem.values.copy(), "no parameter is free", "none", 0)
    forget_stale_code()
    from .search import refine
    from .search import solve as search

    lower, upper = limits(problem, layout)
    data = data_of(problem, layout)
    x, spent, run = np.zeros(len(lower)), 0, search
    if problem.initial:
        held = {k: problem.initial[i] for k, i in enumerate(layout.where) if i in problem.initial}
        start_lower, start_upper = lower.copy(), upper.copy()
        for k, value in held.items():
            start_lower[k] = start_upper[k] = min(max(value, lower[k]), upper[k])
        _, spent, _, _ = search(x, layout.form, data, start_lower, start_upper, TOLERANCE)
        run = refine
    _, evaluations, status, valleys = run(x, layout.form, data, lower, upper, TOLERANCE)
    return Solution(
        whole(problem, layout, x),
        _STATUS[status],
        f"separable least squares, {valleys} valley{'' if valleys == 1 else 's'} descended",
        int(evaluations + spent),
    )


def solve_many(
    problem: Problem, radiances: FloatArray, variances: FloatArray, rows: IntArray
) -> tuple[FloatArray, FloatArray, IntArray, BoolArray]:
    """Solve scans (m, n, 3) that share a problem's directions; variances are (n, 3) or (m, n, 3).

    `rows` are those of the n that the problem's directions are.

    Returns internal coordinates (m, p), costs (m,), evaluations (m,), and whether each converged.

    Raises
    ------
    ValueError
        Names the first scan with a value that is not finite, or a variance that is not positive.
    """
    layout = layout_of(problem.model)
    if layout is None:
        raise ValueError(f"{problem.model.name} has no separable form")
    forget_stale_code()
    from .many import solve_alike, solve_each
    from .search import EXHAUSTED

    lower, upper = limits(problem, layout)
    geometry = geometry_of(problem, layout)
    radiances, variances = np.ascontiguousarray(radiances), np.ascontiguousarray(variances)
    xs = np.zeros((len(radiances), len(lower)))
    costs, counts = np.zeros(len(radiances)), np.zeros((len(radiances), 3), dtype=np.int64)
    run = solve_alike if variances.ndim == 2 else solve_each
    bad = run(
        xs,
        layout.form,
        geometry,
        radiances,
        variances,
        rows,
        lower,
        upper,
        TOLERANCE,
        costs,
        counts,
    )
    if bad >= 0:
        raise ValueError(f"scan {bad} of the batch has a value that can't be used")
    internal = np.tile(problem.values, (len(xs), 1))
    for k, index in enumerate(layout.where):
        if index >= 0:
            internal[:, index] = xs[:, k]
    return internal, costs, counts[:, 0], counts[:, 1] != EXHAUSTED


def limits(problem: Problem, layout: Layout) -> tuple[FloatArray, FloatArray]:
    """Return the bounds of the search's coordinates; equal ones for what is not free."""
    lower, upper = np.zeros(len(layout.where)), np.zeros(len(layout.where))
    free = set(problem.free)
    for k, index in enumerate(layout.where):
        if index in free:
            lower[k], upper[k] = problem.lower[index], problem.upper[index]
        elif index >= 0:
            lower[k] = upper[k] = problem.values[index]
    return lower, upper


def whole(problem: Problem, layout: Layout, x: FloatArray) -> FloatArray:
    """Return the model's internal coordinates (p,) of the search's."""
    internal = problem.values.copy()
    for k, index in enumerate(layout.where):
        if index >= 0:
            internal[index] = x[k]
    return internal


def compile_all() -> float:
    """Compile or load everything, by solving a tiny problem; return how long it took, in s.

    For programs that must not wait at their first fit.
    """
    began = time.perf_counter()
    forget_stale_code()
    from .many import solve_alike, solve_each
    from .search import refine
    from .search import solve as search

    ones, form, tolerance = np.ones((3, 8)), np.array([0.33, 0.17]), TOLERANCE
    lower, upper = np.zeros(6), np.array([1.0, 1.0, 1.0, 2.0, 1.0, 1.0])
    f, x = np.ones(8), np.zeros(6)
    search(x, form, (ones, f, f, ones, ones), lower, upper, tolerance)
    refine(x, form, (ones, f, f, ones, ones), lower, upper, tolerance)
    xs, costs, counts = np.zeros((1, 6)), np.zeros(1), np.zeros((1, 3), dtype=np.int64)
    rows, values = np.arange(8), np.ones((1, 8, 3))
    for run, variance in ((solve_alike, values[0]), (solve_each, values)):
        geometry = (ones, f, f)
        run(xs, form, geometry, values, variance, rows, lower, upper, tolerance, costs, counts)
    return time.perf_counter() - began


@cache
def forget_stale_code() -> None:
    """Give all sources of this folder the time of the newest one; remove what is older.

    numba recompiles a function when the file that it stands in has another time than before; it
    does not look at the files of what the function calls. And it reads what an index names before
    it looks at the time, which fails where a class of ours has moved.
    """
    sources = {path: path.stat().st_mtime_ns for path in Path(__file__).parent.glob("*.py")}
    newest = max(sources.values())
    for path, changed_ns in sources.items():
        if changed_ns != newest:
            with suppress(OSError):  # an installation that can't be written is of one piece
                os.utime(path, ns=(newest, newest))
    from .search import solve as compiled

    if newest > time.time_ns():  # by a clock that was wrong: nothing is newer
        return
    for index in Path(compiled.stats.cache_path).glob("*.nbi"):
        with suppress(OSError):
            if index.stat().st_mtime_ns < newest:
                index.unlink()
