"""Is it the global optimum? Our cost against the best of a trust region from 20 starts.

Both have the same data, weights and bounds. The trust region is scipy's, with analytic
derivatives, scaled by them, ftol and xtol 1e-15; its starts are stratified over the lobe's whole
range of widths, half of them with the best amplitudes at those shapes, half with random ones. Where
the data are of the fitted model, it is started from the truth as well, which is told apart.

"Within" means: our cost is at most 1e-6 of the best one above it. Without noise the best cost is 0
to rounding, or nearly; there, 1e-6 of the cost that the stated noise (0.1 % at white) would make,
half a unit a degree of freedom, is allowed on top.

Amplitudes have no upper bound. Where no camera sees a lobe's peak, some amplitude up to 1e300 can
lift its furthest flank into the noise of a single value and lower the cost a little. Such answers
count, but a second column leaves out those whose peak is `OUT_OF_SIGHT` times the brightest value.

The reference's results are kept in a cache, so that an interrupted run goes on, and a changed
solver is checked in seconds.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import multiprocessing
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares, nnls
from scipy.stats import beta

from benchmarks.fit_scenes import TRUE, VERSION, WRONGS, hard_scenes, make_scene
from benchmarks.fit_timing import on_one_thread, write_figures
from tvbrdf_fitting.geometry import FloatArray
from tvbrdf_fitting.models import SURFACE, get_model
from tvbrdf_fitting.problem import Problem, make_problem
from tvbrdf_fitting.solve.solvers import SOLVERS

STARTS = 20
SCENES, FULL = 120, 2000
"""Random scenes of each kind, true and wrong: in `make bench`, and with --full."""
HARD_SHARE = 6
"""`make bench` takes every so many-th of the hard scenes."""
WITHIN = 1e-6
OUT_OF_SIGHT = 1e6
"""Amplitude of a lobe, of the largest measured value, that no surface has."""
PROCESSES = 2
SHOWN = 5
REFERENCE = f"trf 20 stratified starts, ftol 1e-15, scenes {VERSION}"


@dataclass(frozen=True)
class Reference:
    """What the trust region found in one scene.

    Attributes
    ----------
    digest
        Of the data.
    costs, lobes
        At the end of each start: cost, and the lobe's amplitude over the largest measured value.
    from_truth
        Cost from the truth, where there is one.
    took_s
        For all starts.
    """

    digest: str
    costs: tuple[float, ...]
    lobes: tuple[float, ...]
    from_truth: float
    took_s: float


@dataclass(frozen=True)
class Outcome:
    """One scene: our cost beside the reference's."""

    key: str
    cost: float
    solve_s: float
    allowed: float
    half_freedom: float
    reference: Reference

    @property
    def best(self) -> float:
        """The reference's best cost from its 20 starts."""
        return min(self.reference.costs)

    @property
    def best_in_sight(self) -> float:
        """The reference's best cost, but for lobes that no surface has."""
        ends = zip(self.reference.costs, self.reference.lobes, strict=True)
        return min((cost for cost, lobe in ends if lobe < OUT_OF_SIGHT), default=math.inf)

    @property
    def within(self) -> bool:
        """Whether ours is as low."""
        return self.cost <= self.best + self.allowed

    @property
    def within_in_sight(self) -> bool:
        """Whether ours is as low as the best one of a lobe that a surface can have."""
        return self.cost <= self.best_in_sight + self.allowed

    @property
    def better(self) -> bool:
        """Whether ours is lower by more than is allowed above."""
        return self.cost < self.best - self.allowed

    @property
    def truth_is_lower(self) -> bool:
        """Whether a descent from the truth ends lower than ours."""
        return self.reference.from_truth < self.cost - self.allowed

    @property
    def excess(self) -> float:
        """Our cost over the best one, relative to what 1e-6 is taken of."""
        return (self.cost - self.best) / (self.allowed / WITHIN)


def problem_of(key: str) -> tuple[Problem, FloatArray | None, bool]:
    """Return a scene's problem, its truth (internal), and whether it is free of noise."""
    scene, model = make_scene(key), get_model(SURFACE)
    truth = None if scene.truth is None else model.to_internal(scene.truth)
    return make_problem(scene.observations, model, {}, {}), truth, scene.noise_free


def starts(problem: Problem, rng: np.random.Generator) -> Iterator[FloatArray]:
    """Yield 20 starts (6,), the widths stratified; every other has the best amplitudes."""
    low, high = problem.lower[5], problem.upper[5]
    size = largest(problem)
    for turn, stratum in enumerate(rng.permutation(STARTS)):
        x = problem.values.copy()
        x[:3] = size * rng.random(3)
        x[3] = problem.upper[3] * rng.random() ** 2
        x[4] = size * math.exp(rng.uniform(-7.0, 2.0))
        x[5] = low + (high - low) * (stratum + rng.random()) / STARTS
        if turn % 2 == 0:
            amplitudes = [i for i in (0, 1, 2, 4) if i in problem.free]
            columns = problem.jacobian(x, tuple(amplitudes))
            x[amplitudes] = nnls(columns, (problem.weight * problem.radiance).ravel())[0]
        held = [i for i in range(len(x)) if i not in problem.free]
        x[held] = problem.values[held]
        yield x


def largest(problem: Problem) -> float:
    """Return the largest measured value; not quite 0 where all are."""
    return max(float(np.abs(problem.radiance[problem.weight > 0]).max()), 1e-12)


def descend(problem: Problem, start: FloatArray) -> tuple[float, float]:
    """Return cost and amplitude of the lobe at the end of a trust region's descent."""
    free = list(problem.free)
    lower, upper = problem.lower[free], problem.upper[free]
    margin = 1e-8 * np.where(np.isfinite(upper - lower), upper - lower, 1.0)

    def whole(x: FloatArray) -> FloatArray:
        point = problem.values.copy()
        point[free] = x
        return point

    with np.errstate(all="ignore"):  # it tries absurd amplitudes, and finds back
        answer: Any = least_squares(
            lambda x: problem.residual(whole(x)),
            np.clip(start[free], lower + margin, upper - margin),
            jac=lambda x: problem.jacobian(whole(x)),
            bounds=(lower, upper),
            x_scale="jac",
            ftol=1e-15,
            xtol=1e-15,
            gtol=None,
            max_nfev=400,
        )
        end = problem.clamp(whole(answer.x))
        return problem.cost(end), float(end[4])


def digest_of(problem: Problem) -> str:
    """Return a short digest of the data and the bounds, blind to their last digits."""
    total = hashlib.sha256()
    for array in (problem.radiance, problem.weight, problem.lower, problem.upper):
        total.update(array.astype(np.float32).tobytes())
    return total.hexdigest()[:16]


def look_up(problem: Problem, truth: FloatArray | None) -> Reference:
    """Run the trust region from all its starts."""
    began = time.perf_counter()
    rng = np.random.default_rng(23)
    ends = [descend(problem, start) for start in starts(problem, rng)]
    took_s = time.perf_counter() - began
    size = largest(problem)
    return Reference(
        digest=digest_of(problem),
        costs=tuple(cost for cost, _ in ends),
        lobes=tuple(lobe / size for _, lobe in ends),
        from_truth=math.inf if truth is None else descend(problem, problem.clamp(truth))[0],
        took_s=took_s,
    )


def try_scene(key: str, known: Reference | None) -> Outcome:
    """Solve one scene with ours, and with the reference unless it is known."""
    problem, truth, noise_free = problem_of(key)
    solve = SOLVERS["separable"]
    times = []
    for _ in range(3):
        began = time.perf_counter()
        solution = solve(problem)
        times.append(time.perf_counter() - began)
    if known is None or known.digest != digest_of(problem):
        known = look_up(problem, truth)
    half_freedom = 0.5 * max(problem.degrees_of_freedom, 1)
    floor = half_freedom if noise_free else 0.0
    return Outcome(
        key=key,
        cost=problem.cost(solution.internal),
        solve_s=min(times),
        allowed=WITHIN * (min(known.costs) + floor),
        half_freedom=half_freedom,
        reference=known,
    )


def _try_many(keys: Sequence[str], known: dict[str, Reference]) -> list[Outcome]:
    return [try_scene(key, known.get(key)) for key in keys]


def _lower_priority(by: int) -> None:
    os.nice(by)


def run(keys: Sequence[str], cache: Path | None, nice: int = 0) -> list[Outcome]:
    """Try scenes in two processes, keeping the reference's results as they come."""
    known = read_cache(cache)
    chunks = [keys[i : i + 8] for i in range(0, len(keys), 8)]
    outcomes: list[Outcome] = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(PROCESSES, context, _lower_priority, (nice,)) as pool:
        futures = [
            pool.submit(_try_many, chunk, {k: known[k] for k in chunk if k in known})
            for chunk in chunks
        ]
        for future in futures:
            found = future.result()
            outcomes += found
            new = [o for o in found if known.get(o.key) != o.reference]
            append_cache(cache, new)
    return outcomes


def read_cache(path: Path | None) -> dict[str, Reference]:
    """Return the reference's results by scene; none where there is no cache."""
    found: dict[str, Reference] = {}
    if path is None or not path.exists():
        return found
    for line in path.read_text().splitlines():
        try:
            row = json.loads(line)
        except ValueError:
            continue  # cut off when an earlier run was stopped
        if row.pop("what", None) == REFERENCE:
            key = row.pop("key")
            found[key] = Reference(
                **row | {"costs": tuple(row["costs"]), "lobes": tuple(row["lobes"])}
            )
    return found


def append_cache(path: Path | None, outcomes: Iterable[Outcome]) -> None:
    """Add results to the cache."""
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        for outcome in outcomes:
            row = {"what": REFERENCE, "key": outcome.key} | asdict(outcome.reference)
            file.write(json.dumps(row) + "\n")


def keys_of(scenes: int, hard_share: int) -> dict[str, list[str]]:
    """Return the keys of the scenes by group."""
    wrong = [f"random {n} {WRONGS[n % len(WRONGS)]}" for n in range(scenes)]
    return {
        "random, true model": [f"random {n} {TRUE}" for n in range(scenes)],
        "random, wrong model": wrong,
        "hard, true model": [*hard_scenes((TRUE,))][::hard_share],
        "hard, wrong model": [*hard_scenes(WRONGS)][::hard_share],
    }


def upper_bound(failures: int, count: int, confidence: float = 0.95) -> float:
    """Clopper and Pearson's one-sided bound on the share of failures."""
    return 1.0 if failures >= count else float(beta.ppf(confidence, failures + 1, count - failures))


def summarise(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return the figures of a group of scenes."""
    single = [np.mean([c <= o.best + o.allowed for c in o.reference.costs]) for o in outcomes]
    missed = [o.key for o in outcomes if not o.within]
    return {
        "scenes": len(outcomes),
        "within": len(outcomes) - len(missed),
        "within_in_sight": sum(o.within_in_sight for o in outcomes),
        "bound": upper_bound(len(missed), len(outcomes)),
        "missed": missed,
        "missed_in_sight": [o.key for o in outcomes if not o.within_in_sight],
        "better": [o.key for o in outcomes if o.better],
        "truth_is_lower": [o.key for o in outcomes if o.truth_is_lower],
        "worst_excess": max(o.excess for o in outcomes),
        "single_start": float(np.mean(single)),
        "solve_ms": 1e3 * float(np.median([o.solve_s for o in outcomes])),
        "slowest_ms": 1e3 * max(o.solve_s for o in outcomes),
        "reference_s": float(np.median([o.reference.took_s for o in outcomes])),
    }


def report(groups: dict[str, dict[str, Any]]) -> None:
    """Print a table."""
    print(
        f"Global optimum: ours against the best of {STARTS} trust-region starts, same bounds; "
        f"within {WITHIN:g}"
    )
    print(
        "                       scenes  within    share  missed at most  in sight  better"
        "  worst excess  one start finds it  ours ms  slowest  20 starts s"
    )
    for name, g in groups.items():
        print(
            f"  {name:20} {g['scenes']:6} {g['within']:7} {g['within'] / g['scenes']:8.2%} "
            f"{g['bound']:15.2%} {g['within_in_sight']:9} {len(g['better']):7} "
            f"{g['worst_excess']:13.1e} {g['single_start']:19.0%} {g['solve_ms']:8.3f} "
            f"{g['slowest_ms']:8.2f} {g['reference_s']:12.2f}"
        )
    print(
        "  missed at most: 95 % Clopper-Pearson bound on the share of all such scenes\n"
        "  in sight: within, but for answers with a lobe that no surface has"
    )
    for name, g in groups.items():
        beyond = [key for key in g["missed"] if key not in g["missed_in_sight"]]
        for what, keys in (
            ("missed", g["missed_in_sight"]),
            ("missed, out of sight", beyond),
            ("a descent from the truth ends lower", g["truth_is_lower"]),
        ):
            if keys:
                more = f" and {len(keys) - SHOWN} more" if len(keys) > SHOWN else ""
                print(f"  {name}: {what}: {'; '.join(keys[:SHOWN])}{more}")


def main() -> dict[str, Any]:
    """Print and return the figures of the short run."""
    return on_one_thread("benchmarks.fit_optimum")


def _run() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    parser.add_argument("--scenes", type=int, default=SCENES, help="random ones of each kind")
    parser.add_argument("--full", action="store_true", help=f"{FULL} of each, all hard ones")
    parser.add_argument("--cache", type=Path, metavar="FILE", help="the reference's results")
    parser.add_argument("--nice", type=int, default=0, help="added to the processes' niceness")
    parser.add_argument("--scene", metavar="KEY", help="only this one, with all costs")
    chosen = parser.parse_args()
    if chosen.scene:
        outcome = try_scene(chosen.scene, None)
        print(json.dumps(asdict(outcome), indent=1))
        return
    groups = keys_of(FULL if chosen.full else chosen.scenes, 1 if chosen.full else HARD_SHARE)
    began = time.perf_counter()
    outcomes = run([key for keys in groups.values() for key in keys], chosen.cache, chosen.nice)
    by_key = {o.key: o for o in outcomes}
    figures = {name: summarise([by_key[key] for key in keys]) for name, keys in groups.items()}
    report(figures)
    print(f"  took {time.perf_counter() - began:.0f} s in {PROCESSES} processes")
    write_figures(chosen.json, figures)


if __name__ == "__main__":
    _run()
