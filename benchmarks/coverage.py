"""Are stated deviations true? Random scenes with noise and errors that frames share, fitted.

The fit is told how large errors of gains and light offsets are, not what they are. Counted is how
often the truth lies within three deviations of the fitted value, in the coordinates in which errors
are nearly normal: sigma_d^2, log(1/sigma_s) and the amplitudes. A parameter at a bound is counted
apart, by its interval. A width has no truth where there is no lobe.

*True model*: Oren-Nayar with a Torrance-Sparrow lobe is fitted.

*After model choice*: the same scenes, their model chosen by `choose_model` with its own ladder.
Every parameter of the chosen model counts that means what one of the truth means: albedos always;
roughness in a model that has it, with a truth of 0 where the surface is Lambertian; amplitude and
width of the one lobe that is chosen if it is Torrance-Sparrow's, each of three amplitudes where
they are one a channel; an amplitude's truth is 0 where there is no lobe. Deviations are those that
`ModelChoice` states, with the spread over rungs that explain a scan as well; the fit's own ones, to
which the model is certain, are printed beside. A parameter of the truth that the chosen model lacks
(roughness in a Lambertian one, a lobe that is not there, of another shape, or one of two) has no
deviation that could be true: it is counted apart, and as lost where its Cramer-Rao deviation is
below 20 %, just as an undetermined one. A roughness or lobe that the truth lacks too is not lost.

*Weak effects* are other scenes, in which the lobe or the roughness is 0 to 8 of its own Cramer-Rao
deviations: where a model is chosen wrongly most often. No target was set for them.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.coverage_scenes import (
    ERRORS,
    GAIN_STD,
    LOBE,
    OFFSET_STD_DEG,
    Scene,
    cramer_rao,
    random_scene,
    weak_scene,
)
from benchmarks.fit_timing import ONE_THREAD, on_one_thread, write_figures
from tvbrdf_fitting.choice.choose import choose_model
from tvbrdf_fitting.fit import fit_scan
from tvbrdf_fitting.geometry import FloatArray
from tvbrdf_fitting.models import SURFACE, get_model
from tvbrdf_fitting.result import FitResult

SCENES, WEAK_SHARE = 2000, 4
"""Random ones; one in four as many with weak effects."""
JOBS = 2
WELL_KNOWN = 0.2
"""A relative Cramer-Rao deviation below which a parameter should be called determined."""
TARGET = (0.990, 0.999)
TARGET_CHOSEN = 0.97
"""After model choice, and at bounds."""
TARGET_MISSED = 0.05
NAMES = get_model(SURFACE).parameter_names
SEED = 2024


@dataclass(frozen=True)
class Seen:
    """A parameter of the truth in a fit.

    Attributes
    ----------
    name
        Of ON+TS.
    state
        "determined", "at a bound", "undetermined" or "lacking".
    score
        Error over stated deviation, of a determined one.
    score_alone
        The same by the fit's own deviation, to which the model is certain.
    inside
        Whether the truth is in the interval, of one at a bound.
    well_known
        Whether its Cramer-Rao deviation is below 20 %.
    beside_a_bound
        Whether another parameter of the fit ended at a bound.
    """

    name: str
    state: str
    score: float
    score_alone: float
    inside: bool
    well_known: bool
    beside_a_bound: bool


@dataclass(frozen=True)
class Outcome:
    """What became of a scene: parameters by the true model and after the choice, and the rungs."""

    plain: tuple[Seen, ...]
    chosen: tuple[Seen, ...]
    rung: str
    true_rung: str
    invented_lobe: bool
    model_error: bool


def counterparts(name: str, result: FitResult) -> list[str]:
    """Names of a fit's parameters that mean what one of ON+TS means; see the module's header."""
    lobes = [part for part in result.model.split("+") if part not in {"lambert", "oren_nayar"}]
    if name in {"ks", "inverse_sigma_s"} and (len(lobes) != 1 or not lobes[0].startswith(LOBE)):
        return []
    coloured = [f"{name}_{letter}" for letter in "bgr"]
    return [n for n in result.parameter_names if n == name or n in coloured]


def look(
    scene: Scene, result: FitResult, deviations: FloatArray, well_known: Sequence[bool]
) -> tuple[Seen, ...]:
    """Return every parameter of the truth as a fit has it, with these internal deviations."""
    internal = get_model(SURFACE).to_internal(scene.truth)
    alone = np.sqrt(np.diag(result.internal_covariance))
    found = []
    for true, value, published, known in zip(NAMES, internal, scene.truth, well_known, strict=True):
        if true == "inverse_sigma_s" and scene.truth[4] == 0:
            continue  # there is no truth
        names = counterparts(true, result)
        if not names and published > 0:
            found.append(Seen(true, "lacking", math.nan, math.nan, False, known, False))
        for name in names:
            i, score, score_alone, inside = result.index(name), math.nan, math.nan, False
            if name in result.undetermined:
                state = "undetermined"
            elif name in result.at_bound:
                state = "at a bound"
                low, high = result.interval(name)
                inside = bool(low <= published <= high)
            else:
                state, error = "determined", abs(float(result.internal_values[i] - value))
                score, score_alone = error / float(deviations[i]), error / float(alone[i])
            beside = bool({*result.at_bound} - {name})
            found.append(Seen(true, state, score, score_alone, inside, known, beside))
    return tuple(found)


def try_scene(number: int, weak: bool = False, seed: int = SEED) -> Outcome:
    """Make a scene, fit it with the true model and with a chosen one."""
    rng = np.random.default_rng((seed, number))
    scene = weak_scene(rng) if weak else random_scene(rng)
    well_known = [bool(relative < WELL_KNOWN) for relative in cramer_rao(scene)]
    plain = fit_scan(scene.observations, common_errors=ERRORS)
    choice = choose_model(scene.observations, common_errors=ERRORS)
    deviations = np.sqrt(np.diag(plain.internal_covariance))
    return Outcome(
        plain=look(scene, plain, deviations, well_known),
        chosen=look(scene, choice.result, choice.internal_deviations, well_known),
        rung=choice.model,
        true_rung=scene.rung,
        invented_lobe=LOBE not in scene.rung and "inverse_sigma_s" not in plain.undetermined,
        model_error=plain.model_error_std > 0,
    )


def _try_many(numbers: Sequence[int], weak: bool) -> list[Outcome]:
    return [try_scene(number, weak) for number in numbers]


def try_scenes(scenes: int, *, weak: bool = False, jobs: int = 1) -> list[Outcome]:
    """Try scenes in some processes, one thread a library."""
    if jobs < 2:
        return _try_many(range(scenes), weak)
    os.environ.update(ONE_THREAD)  # the processes inherit it
    chunks = [range(i, min(i + 20, scenes)) for i in range(0, scenes, 20)]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context) as pool:
        futures = [pool.submit(_try_many, chunk, weak) for chunk in chunks]
        return [outcome for future in futures for outcome in future.result()]


def summarise(found: Iterable[Seen]) -> dict[str, Any]:
    """Return the figures of some parameters."""
    seen = [*found]
    determined = [s for s in seen if s.state == "determined"]
    at_bound = [s for s in seen if s.state == "at a bound"]
    beside = [s for s in determined if s.beside_a_bound]
    known = [s for s in seen if s.well_known]
    return {
        "determined": len(determined),
        "coverage": _share(s.score <= 3 for s in determined),
        "coverage_alone": _share(s.score_alone <= 3 for s in determined),
        "outside": sum(s.score > 3 for s in determined),
        "root_mean_square_score": _root_mean_square(s.score for s in determined),
        "beside_a_bound": len(beside),
        "coverage_beside_a_bound": _share(s.score <= 3 for s in beside),
        "at_bound": len(at_bound),
        "coverage_at_bound": _share(s.inside for s in at_bound),
        "at_bound_outside": sum(not s.inside for s in at_bound),
        "undetermined": sum(s.state == "undetermined" for s in seen),
        "lacking": sum(s.state == "lacking" for s in seen),
        "well_known": len(known),
        "lost": sum(s.state in {"undetermined", "lacking"} for s in known),
        "share_lost": _share(s.state in {"undetermined", "lacking"} for s in known),
    }


def _share(right: Iterable[bool]) -> float:
    each = [*right]
    return sum(each) / len(each) if each else math.nan


def _root_mean_square(values: Iterable[float]) -> float:
    squares = [value * value for value in values]
    return math.sqrt(sum(squares) / len(squares)) if squares else math.nan


def _with_names(found: Sequence[Seen]) -> dict[str, Any]:
    by_name = {name: summarise(s for s in found if s.name == name) for name in NAMES}
    return summarise(found) | {"by_parameter": by_name}


def figures_of(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return all figures of some scenes, as plain types."""
    rungs = Counter((o.true_rung, o.rung) for o in outcomes)
    wrong = [o for o in outcomes if o.rung != o.true_rung]
    return {
        "scenes": len(outcomes),
        "plain": _with_names([*chain.from_iterable(o.plain for o in outcomes)]),
        "chosen": _with_names([*chain.from_iterable(o.chosen for o in outcomes)]),
        "chosen_wrong": summarise(chain.from_iterable(o.chosen for o in wrong)),
        "wrong_rungs": len(wrong),
        "rungs": [[*pair, count] for pair, count in sorted(rungs.items())],
        "without_lobe": sum(LOBE not in o.true_rung for o in outcomes),
        "invented_lobes": sum(o.invented_lobe for o in outcomes),
        "model_errors": sum(o.model_error for o in outcomes),
    }


def _row(label: str, share: float, count: int, target: str = "") -> None:
    aimed = f"   target {target}" if target else ""
    found = f"{share:7.2%}" if count else "      -"
    print(f"    {label:62} {found} of {count:6}{aimed}")


def _print_table(by_parameter: dict[str, dict[str, Any]]) -> None:
    print(
        "    parameter         outside / determined   outside / at a bound   undetermined  lacking"
        "   lost / well known"
    )
    for name, f in by_parameter.items():
        print(
            f"    {name:16} {f['outside']:9} / {f['determined']:6} {f['at_bound_outside']:15} / "
            f"{f['at_bound']:4} {f['undetermined']:14} {f['lacking']:8} {f['lost']:8} / "
            f"{f['well_known']:4}"
        )


def report_plain(f: dict[str, Any]) -> None:
    """Print the true model's figures."""
    plain, (low, high) = f["plain"], TARGET
    print("  the true model")
    within = "truth within 3 deviations, determined parameters"
    _row(within, plain["coverage"], plain["determined"], f"{low:.1%} to {high:.1%}")
    label, least = "  of these, in scans with another one at a bound", f">= {TARGET_CHOSEN:.0%}"
    _row(label, plain["coverage_beside_a_bound"], plain["beside_a_bound"], least)
    label = "truth within the interval, parameters at a bound"
    _row(label, plain["coverage_at_bound"], plain["at_bound"], least)
    label = f"called undetermined though known to {WELL_KNOWN:.0%}"
    _row(label, plain["share_lost"], plain["well_known"], f"<= {TARGET_MISSED:.0%}")
    spread = plain["root_mean_square_score"]
    print(f"    {'root mean square of error / deviation':62} {spread:7.3f}")
    lobes, without = f["invented_lobes"], f["without_lobe"]
    print(f"    {'a lobe where there is none':62} {lobes:7} of {without:6}")
    _print_table(plain["by_parameter"])


def report_chosen(f: dict[str, Any], *, targets: bool) -> None:
    """Print the figures after model choice."""
    chosen, wrong = f["chosen"], f["chosen_wrong"]
    least = f">= {TARGET_CHOSEN:.0%}" if targets else ""
    within = "truth within 3 deviations, determined parameters"
    _row(within, chosen["coverage"], chosen["determined"], least)
    _row("  by the fit's own deviations, without the choice's", chosen["coverage_alone"],
         chosen["determined"])  # fmt: skip
    label = f"  in the {f['wrong_rungs']} scans with another rung than the truth's"
    _row(label, wrong["coverage"], wrong["determined"])
    _row("    by the fit's own deviations", wrong["coverage_alone"], wrong["determined"])
    label = "truth within the interval, parameters at a bound"
    _row(label, chosen["coverage_at_bound"], chosen["at_bound"], least)
    label = f"not chosen or called undetermined though known to {WELL_KNOWN:.0%}"
    most = f"<= {TARGET_MISSED:.0%}" if targets else ""
    _row(label, chosen["share_lost"], chosen["well_known"], most)
    spread = chosen["root_mean_square_score"]
    print(f"    {'root mean square of error / deviation':62} {spread:7.3f}")
    _print_table(chosen["by_parameter"])
    print("    rungs                              chosen")
    for truth, rung, count in f["rungs"]:
        print(f"    {truth:34} {rung:60} {count:5}{'' if rung == truth else '   not the truth'}")


def main() -> dict[str, Any]:
    """Print and return the figures, with one thread for every library."""
    return on_one_thread("benchmarks.coverage")


def _run() -> None:
    parser = argparse.ArgumentParser(description="Are stated deviations true?")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    parser.add_argument("--scenes", type=int, default=SCENES, help=f"default {SCENES}")
    parser.add_argument("--jobs", type=int, default=JOBS, help=f"processes, default {JOBS}")
    given = parser.parse_args()
    print(
        f"Coverage of stated deviations ({given.scenes} scenes; noise 0.2-2 %, gains "
        f"{GAIN_STD:.1%}, light offsets {OFFSET_STD_DEG} deg)"
    )
    random = figures_of(try_scenes(given.scenes, jobs=given.jobs))
    report_plain(random)
    print("  after model choice, the same scenes")
    report_chosen(random, targets=True)
    few = max(1, given.scenes // WEAK_SHARE)
    weak = figures_of(try_scenes(few, weak=True, jobs=given.jobs))
    print(f"  after model choice, {few} scenes with weak effects")
    report_chosen(weak, targets=False)
    write_figures(given.json, {"random": random, "weak": weak})


if __name__ == "__main__":
    _run()
