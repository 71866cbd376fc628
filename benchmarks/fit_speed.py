"""How fast is a fit? One scan, a batch, and other people's solvers on the same data, in one run.

One scan is 4 cameras x 336 lights x 3 channels with 0.5 % noise, fitted with Oren-Nayar +
Torrance-Sparrow. The reference is scipy's ``least_squares(method="lm")`` with 2-point derivatives,
all defaults, from a start that one would write down for any scan, its residual either the library's
own (`Problem.residual`, geometry prepared) or written out by hand for this one model.

Peers are timed in the fastest of many settings that still reaches the best cost to 1e-6, from the
same single start. A local solver finds the bottom of the valley it starts in; `fit_starts` says how
often that is the right one.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from benchmarks.fit_peers import Contender, contenders, missing, reference
from benchmarks.fit_residuals import Residuals
from benchmarks.fit_timing import Times, on_one_thread, take_turns, write_figures
from tvbrdf_fitting.batch import fit_parameters
from tvbrdf_fitting.fit import fit_scan
from tvbrdf_fitting.geometry import FloatArray
from tvbrdf_fitting.models import SURFACE, get_model
from tvbrdf_fitting.observations import Observations
from tvbrdf_fitting.problem import Problem, make_problem
from tvbrdf_fitting.solve.separable import compile_all
from tvbrdf_fitting.solve.solvers import SOLVERS
from tvbrdf_launch.cli.bench.rig_scenes import measure, random_material

SATIN = (0.3, 0.5, 0.7, 0.4, 0.8, 6.0)
NOISE = 0.005
SCANS, BATCH = 16, 1000
ROUNDS, PEER_ROUNDS, BATCH_ROUNDS = 25, 40, 9
SAME_COST = 1e-6
TARGET_SCAN, TARGET_BATCH = 50, 150
OURS, WHOLE, REPORT = "solve", "prepare and solve", "fit_scan"
BY_HAND, GENERAL = "lm by hand", "lm general"


def a_scan(truth: Sequence[float] | FloatArray, seed: int) -> Observations:
    """Return a scan with all 336 lights for each camera."""
    return measure(np.random.default_rng((7, seed)), truth, noise=NOISE, arm=False)


def materials(count: int) -> list[FloatArray]:
    """Return random materials, from matte to glossy."""
    rng = np.random.default_rng(11)
    return [random_material(rng) for _ in range(count)]


def time_scan(observations: Observations, rounds: int) -> tuple[Times, dict[str, float]]:
    """Time our fits of one scan and the reference; return also their costs."""
    model, solve = get_model(SURFACE), SOLVERS["separable"]
    problem = make_problem(observations, model, {}, {})
    residuals = Residuals(problem)
    by_hand, start = reference(residuals), residuals.start

    def general() -> FloatArray:
        return np.asarray(least_squares(problem.residual, start, method="lm").x)

    calls: dict[str, Callable[[], object]] = {
        OURS: lambda: solve(problem),
        WHOLE: lambda: solve(make_problem(observations, model, {}, {})),
        REPORT: lambda: fit_scan(observations, method="separable"),
        BY_HAND: lambda: by_hand.run(start),
        GENERAL: general,
    }
    costs = {
        OURS: problem.cost(solve(problem).internal),
        BY_HAND: residuals.cost(by_hand.run(start)),
        GENERAL: residuals.cost(general()),
    }
    return take_turns(calls, rounds), costs


def single(rounds: int = ROUNDS, scans: int = SCANS) -> dict[str, Any]:
    """Target 1: one satin, and random materials."""
    rows = []
    for seed, truth in enumerate([np.array(SATIN), *materials(scans)]):
        times, costs = time_scan(a_scan(truth, seed), rounds)
        rows.append(
            {
                "truth": truth.tolist(),
                "ms": {name: 1e3 * times.least(name) for name in times.rounds},
                "by_hand": times.ratio(BY_HAND, OURS),
                "general": times.ratio(GENERAL, OURS),
                "excess": {n: costs[n] / costs[OURS] - 1 for n in (BY_HAND, GENERAL)},
            }
        )
    print(f"One scan, single call, {rounds} rounds in turns, least time; ms")
    satin, others = rows[0], rows[1:]
    for name, text in (
        (OURS, "ours: solve a prepared problem"),
        (WHOLE, "ours: prepare the geometry and solve"),
        (REPORT, "ours: fit_scan, with uncertainties and error measures"),
        (GENERAL, "scipy lm, 2-point, the library's residual"),
        (BY_HAND, "scipy lm, 2-point, residual written by hand"),
    ):
        spread = [row["ms"][name] for row in others]
        print(
            f"  {text:56} satin {satin['ms'][name]:7.3f}   {len(others)} materials: "
            f"median {np.median(spread):7.3f}, {min(spread):.3f} to {max(spread):.3f}"
        )
    for key, text in (("general", "library's residual"), ("by_hand", "residual by hand")):
        ratios = [row[key][0] for row in others]
        ratio, low, high = satin[key]
        print(
            f"  {'ours (solve) faster than lm, ' + text:56} satin {ratio:6.1f}x "
            f"({low:.0f} to {high:.0f} by round)   median {np.median(ratios):.1f}x, "
            f"{min(ratios):.1f} to {max(ratios):.1f}   target {TARGET_SCAN}x"
        )
    excess = [value for row in rows for value in row["excess"].values()]
    wrong = sum(value > SAME_COST for value in excess)
    print(
        f"  cost of lm over ours: {min(excess):+.0e} to {max(excess):+.0e} relative; "
        f"in another valley in {wrong} of {len(excess)}"
    )
    return {"single": rows}


def batch(scans: int = BATCH, rounds: int = BATCH_ROUNDS) -> dict[str, Any]:
    """Target 2: many scans with the same directions, on one core and on two."""
    some = a_scan(SATIN, 0)
    light, view = some.light_direction, some.view_direction
    rng = np.random.default_rng(5)
    radiance = np.empty((scans, len(some), 3))
    for m, truth in enumerate(materials(scans)):
        radiance[m] = np.pi * get_model(SURFACE).evaluate(light, view, truth) * light[:, 2:]
    own = NOISE**2 * (radiance + 0.01)
    shared = NOISE**2 * (np.median(radiance, axis=0) + 0.01)
    noisy = radiance + np.sqrt(shared) * rng.normal(size=radiance.shape)
    noisy_own = radiance + np.sqrt(own) * rng.normal(size=radiance.shape)
    sample = [
        Residuals(make_problem(_scan(some, noisy[m], shared), get_model(SURFACE), {}, {}))
        for m in range(0, scans, max(scans // 20, 1))
    ]

    def lm_general() -> None:
        for residuals in sample:
            least_squares(residuals.problem.residual, residuals.start, method="lm")

    def lm_by_hand() -> None:
        for residuals in sample:
            least_squares(residuals.residual, residuals.start, method="lm")

    times = take_turns(
        {
            "one": lambda: fit_parameters(light, view, noisy, shared),
            "two": lambda: fit_parameters(light, view, noisy, shared, jobs=2),
            "own": lambda: fit_parameters(light, view, noisy_own, own),
            "own two": lambda: fit_parameters(light, view, noisy_own, own, jobs=2),
            GENERAL: lm_general,
            BY_HAND: lm_by_hand,
        },
        rounds,
    )
    each_us = {name: 1e6 * times.least(name) / scans for name in ("one", "two", "own", "own two")}
    lm_us = {name: 1e6 * times.least(name) / len(sample) for name in (GENERAL, BY_HAND)}
    found = fit_parameters(light, view, noisy, shared)
    excess = [
        2 * r.cost(least_squares(r.residual, r.start, method="lm").x) / chi_square - 1
        for r, chi_square in zip(
            sample, found.chi_square[:: max(scans // 20, 1)].tolist(), strict=True
        )
    ]
    print(f"Batch of {scans} scans of random materials, {rounds} rounds; microseconds a scan")
    for name, text in (
        ("one", "directions and weights shared, one core"),
        ("two", "directions and weights shared, two cores"),
        ("own", "directions shared, weights of their own, one core"),
        ("own two", "directions shared, weights of their own, two cores"),
    ):
        ratios = [lm_us[kind] / each_us[name] for kind in (GENERAL, BY_HAND)]
        print(
            f"  {text:52} {each_us[name]:7.1f}   lm takes {ratios[0]:.0f}x (library's residual), "
            f"{ratios[1]:.0f}x (by hand)   target {TARGET_BATCH}x"
        )
    for one, two in (("one", "two"), ("own", "own two")):
        speedup, low, high = times.ratio(one, two)
        print(f"  two cores: {speedup:.2f}x one core's speed ({low:.2f} to {high:.2f} by round)")
    print(
        f"  {'scipy lm, 2-point: library residual, by hand':52} {lm_us[GENERAL]:7.0f} "
        f"{lm_us[BY_HAND]:7.0f}   its cost over ours {min(excess):+.0e} to {max(excess):+.0e}"
    )
    return {"batch": {"scans": scans, "us": each_us, "lm_us": lm_us, "excess": excess}}


def _scan(some: Observations, radiance: FloatArray, variance: FloatArray) -> Observations:
    return Observations(
        light_direction=some.light_direction,
        view_direction=some.view_direction,
        radiance=radiance,
        variance=variance,
        valid=some.valid,
        camera=some.camera,
        sweep=some.sweep,
        exposure_ms=some.exposure_ms,
        time_s=some.time_s,
    )


def peers(rounds: int = PEER_ROUNDS, scans: int = 3) -> dict[str, Any]:
    """Target 3: each peer in its best setting, on the satin and on random materials."""
    rows: list[dict[str, Any]] = []
    for seed, truth in enumerate([np.array(SATIN), *materials(scans - 1)]):
        rows += beside_peers(make_problem(a_scan(truth, seed), get_model(SURFACE), {}, {}), rounds)
    print(f"Peers, each in its fastest setting that reaches the best cost to {SAME_COST:g}")
    print(f"  one start, the same for all; {rounds} rounds in turns; satin and {scans - 1} others")
    for peer in dict.fromkeys(row["peer"] for row in rows):
        own = [row for row in rows if row["peer"] == peer]
        ratios = ", ".join(
            f"{r['ratio'][0]:.1f}x ({r['ratio'][1]:.1f} to {r['ratio'][2]:.1f})" for r in own
        )
        print(f"  {peer:34} {own[0]['ms']:7.3f} ms   ours is faster {ratios}")
        print(f"    {own[0]['setting']}")
    for reason in missing().values():
        print(f"  {reason}")
    return {"peers": rows}


def beside_peers(problem: Problem, rounds: int) -> list[dict[str, Any]]:
    """Time ours and the best setting of each peer on one problem, in turns."""
    residuals, solve = Residuals(problem), SOLVERS["separable"]
    best, start = problem.cost(solve(problem).internal), residuals.start
    chosen = best_settings(residuals, best)
    calls: dict[str, Callable[[], object]] = {OURS: lambda: solve(problem)}
    calls |= {contender.peer: partial(contender.run, start) for contender in chosen}
    times = take_turns(calls, rounds)
    return [
        {
            "peer": contender.peer,
            "setting": contender.setting,
            "ms": 1e3 * times.least(contender.peer),
            "ours_ms": 1e3 * times.least(OURS),
            "ratio": times.ratio(contender.peer, OURS),
            "excess": residuals.cost(contender.run(start)) / best - 1,
        }
        for contender in chosen
    ]


def best_settings(residuals: Residuals, best: float, tries: int = 5) -> list[Contender]:
    """Return of each peer the fastest contender that reaches the best cost."""
    fastest: dict[str, tuple[float, Contender]] = {}
    for contender in (reference(residuals), *contenders(residuals)):
        if not residuals.cost(contender.run(residuals.start)) <= best * (1 + SAME_COST):
            continue
        took = take_turns({"it": partial(contender.run, residuals.start)}, tries).least("it")
        if contender.peer not in fastest or took < fastest[contender.peer][0]:
            fastest[contender.peer] = (took, contender)
    return [contender for _, contender in fastest.values()]


def main() -> dict[str, Any]:
    """Print and return the figures, with one thread for every library."""
    return on_one_thread("benchmarks.fit_speed")


def _run() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    parser.add_argument("--only", choices=("single", "batch", "peers"), help="one part")
    chosen = parser.parse_args()
    seconds = compile_all()
    print(f"Speed of a fit (solver loaded or compiled in {seconds:.2f} s)")
    figures: dict[str, Any] = {"load_s": seconds}
    for part in (single, batch, peers):
        if chosen.only in (None, part.__name__):
            figures |= part()
    write_figures(chosen.json, figures)


if __name__ == "__main__":
    _run()
