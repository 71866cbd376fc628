"""How often does one start find the global optimum, and what does it cost to be certain?

Random materials within the bounds, with 4 cameras x 121 lights; every other scene is of a wrong
model. Peers run in a careful setting (bounds where they have them, tight tolerances, compiled
residuals), from the generic start and from the 20 starts of `fit_optimum`, stratified over the
lobe's widths. An answer outside the bounds is none.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fit_optimum import STARTS, WITHIN, starts
from benchmarks.fit_peers import Contender, contenders, missing
from benchmarks.fit_residuals import Residuals
from benchmarks.fit_scenes import GAIN_STD, GGX, any_material, as_ggx
from benchmarks.fit_timing import on_one_thread, take_turns, write_figures
from tvbrdf_fitting.geometry import FloatArray
from tvbrdf_fitting.models import SURFACE, get_model
from tvbrdf_fitting.problem import Problem, make_problem
from tvbrdf_fitting.solve.separable import compile_all
from tvbrdf_fitting.solve.solvers import SOLVERS
from tvbrdf_launch.cli.bench.rig_scenes import log_uniform, measure

SCENES = 40
LIGHTS = 121


def scene(number: int) -> Problem:
    """Return a problem; the directions are the same in all, so that jax compiles once."""
    rng = np.random.default_rng((37, number))
    truth, wrong = any_material(rng), number % 2 == 1
    observations = measure(
        rng,
        as_ggx(rng, truth) if wrong else truth,
        model=GGX if wrong else SURFACE,
        noise=log_uniform(rng, 0.0005, 0.05),
        lights=LIGHTS,
        gains=1 + GAIN_STD * rng.normal(size=(4, 3)) if wrong else None,
    )
    return make_problem(observations, get_model(SURFACE), {}, {})


def attempt(contender: Contender, residuals: Residuals, start: FloatArray) -> tuple[float, float]:
    """Return cost and time of one descent; no cost where the peer breaks down."""
    began = time.perf_counter()
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # peers overflow where a step leads far out
        try:
            end = contender.run(start)
            cost = residuals.cost(end) if np.isfinite(end).all() else np.inf
        except (ValueError, ArithmeticError):
            cost = np.inf
    return cost, time.perf_counter() - began


def measure_starts(scenes: int) -> dict[str, Any]:
    """Return, by peer, costs (scenes, 1 + starts) over the best and times."""
    solve = SOLVERS["separable"]
    costs: dict[str, list[list[float]]] = {}
    seconds: dict[str, list[list[float]]] = {}
    settings: dict[str, str] = {}
    ours, ours_s = [], []
    for number in range(scenes):
        problem = scene(number)
        residuals = Residuals(problem)
        ours.append(problem.cost(solve(problem).internal))
        ours_s.append(take_turns({"it": lambda p=problem: solve(p)}, 3).least("it"))  # type: ignore[misc]
        begin = [residuals.start, *starts(problem, np.random.default_rng((41, number)))]
        for contender in contenders(residuals):
            if not contender.careful:
                continue
            settings[contender.peer] = contender.setting
            contender.run(residuals.start)
            ends = [attempt(contender, residuals, start) for start in begin]
            costs.setdefault(contender.peer, []).append([cost for cost, _ in ends])
            seconds.setdefault(contender.peer, []).append([took for _, took in ends])
    best = np.minimum(ours, np.min([np.min(c, axis=1) for c in costs.values()], axis=0))
    rows = {
        peer: summary(np.array(costs[peer]), np.array(seconds[peer]), best) | {"setting": setting}
        for peer, setting in settings.items()
    }
    share = float(np.mean(np.array(ours) <= best * (1 + WITHIN)))
    return {"scenes": scenes, "ours": share, "ours_ms": 1e3 * float(np.mean(ours_s)), "peers": rows}


def summary(costs: FloatArray, seconds: FloatArray, best: FloatArray) -> dict[str, Any]:
    """Return shares of scenes that are right after so many starts, and what that takes."""
    right = costs <= best[:, None] * (1 + WITHIN)
    after = np.logical_or.accumulate(right[:, 1:], axis=1)
    sure = [int(k) + 1 for k in np.flatnonzero(after.all(axis=0))]
    return {
        "generic": float(right[:, 0].mean()),
        "after": {k: float(after[:, k - 1].mean()) for k in (1, 5, STARTS)},
        "starts_for_all": sure[0] if sure else None,
        "generic_ms": 1e3 * float(seconds[:, 0].mean()),
        "all_starts_ms": 1e3 * float(seconds[:, 1:].sum(axis=1).mean()),
    }


def main() -> dict[str, Any]:
    """Print and return the figures, with one thread for every library."""
    return on_one_thread("benchmarks.fit_starts")


def _run() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    parser.add_argument("--scenes", type=int, default=SCENES)
    chosen = parser.parse_args()
    compile_all()
    figures = measure_starts(chosen.scenes)
    print(f"Certainty: share of {chosen.scenes} random scenes within {WITHIN:g} of the best cost")
    print(
        "                                     generic    random starts         starts      "
        "mean ms of\n"
        "                                     start      1      5     20       for all     "
        "1 start  20 starts  ours x"
    )
    print(f"  {'ours, no start':34} {figures['ours']:7.1%} {figures['ours_ms']:52.3f}")
    for peer, row in figures["peers"].items():
        after, sure = row["after"], row["starts_for_all"]
        print(
            f"  {peer:34} {row['generic']:7.1%} {after[1]:6.1%} {after[5]:6.1%} "
            f"{after[STARTS]:6.1%} {sure or f'> {STARTS}':>9} {row['generic_ms']:12.2f} "
            f"{row['all_starts_ms']:10.1f} {row['all_starts_ms'] / figures['ours_ms']:7.0f}"
        )
        print(f"    {row['setting']}")
    for reason in missing().values():
        print(f"  {reason}")
    write_figures(chosen.json, figures)


if __name__ == "__main__":
    _run()
