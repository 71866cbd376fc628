"""Are stated deviations true? Random scenes with noise and errors that frames share, fitted.

Each scene has its own material, noise, gains of cameras and channels, and light offsets of sweeps,
all drawn at random; the fit is told how large they are, not what they are. Counted is how often the
truth lies within three deviations of the fitted value, in the coordinates in which errors are
nearly normal: sigma_d^2, log(1/sigma_s) and the amplitudes.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tvbrdf_fitting.fit import fit_scan
from tvbrdf_fitting.geometry import (
    CAMERA_ANGLES_DEG,
    FloatArray,
    above_horizon,
    light_direction,
    view_direction,
)
from tvbrdf_fitting.inference.nuisances import CommonErrors, make_nuisances
from tvbrdf_fitting.inference.posterior import Posterior, linearise_at
from tvbrdf_fitting.inference.uncertainty import estimate
from tvbrdf_fitting.models import SURFACE, get_model
from tvbrdf_fitting.observations import Observations
from tvbrdf_fitting.problem import make_problem
from tvbrdf_fitting.result import FitResult

SCENES = 2000
GAIN_STD, OFFSET_STD_DEG = 0.005, 0.02
NONE = 0.1
"""Share of scenes without a lobe, and of Lambertian ones."""
EXPOSURES_MS = (0.2, 4.0, 32.0)
SATURATION = 48.0
"""Radiance x exposure in ms: at 32 ms, 1.5 white."""
WELL_KNOWN = 0.2
"""A relative Cramer-Rao deviation below which a parameter should be called determined."""
TARGET = (0.990, 0.999)
TARGET_AT_BOUND = 0.97
TARGET_MISSED = 0.05


@dataclass
class Scene:
    """A material (published values) and how it is measured."""

    truth: FloatArray
    observations: Observations


@dataclass
class Tally:
    """Counts of parameters, by name."""

    determined: Counter[str] = field(default_factory=Counter)
    inside: Counter[str] = field(default_factory=Counter)
    with_bound: Counter[str] = field(default_factory=Counter)
    with_bound_inside: Counter[str] = field(default_factory=Counter)
    at_bound: Counter[str] = field(default_factory=Counter)
    at_bound_inside: Counter[str] = field(default_factory=Counter)
    well_known: Counter[str] = field(default_factory=Counter)
    well_known_lost: Counter[str] = field(default_factory=Counter)
    squares: list[float] = field(default_factory=list)
    invented_lobes: int = 0
    without_lobe: int = 0
    model_errors: int = 0


def random_scene(rng: np.random.Generator) -> Scene:
    """Return a scene as the rig takes it, with errors that its observations do not know of."""
    specular = 0.0 if rng.random() < NONE else log_uniform(rng, 0.01, 20.0)
    truth = np.array(
        [
            *(log_uniform(rng, 0.02, 0.9) for _ in range(3)),
            0.0 if rng.random() < NONE else math.sqrt(rng.uniform(0.0, 0.8)),
            specular,
            1 / log_uniform(rng, 0.01, 0.8),
        ]
    )
    noise, step = log_uniform(rng, 0.002, 0.02), int(rng.integers(4, 9))
    gains = 1 + GAIN_STD * rng.normal(size=(4, 3))
    offsets = OFFSET_STD_DEG * rng.normal(size=3)
    return Scene(truth, simulate(rng, truth, noise, step, gains, offsets))


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def simulate(
    rng: np.random.Generator,
    truth: FloatArray,
    noise: float,
    step: int,
    gains: FloatArray,
    offsets_deg: FloatArray,
) -> Observations:
    """Three sweeps of 361 / step lights, four cameras; shot noise, `noise` at white and 4 ms."""
    model = get_model(SURFACE)
    parts = []
    for sweep, exposure_ms in enumerate(EXPOSURES_MS, start=1):
        angle = np.linspace(-90.0, 90.0, 361)[::step] + rng.uniform(-0.2, 0.2)
        stated, true = light_direction(angle), light_direction(angle + offsets_deg[sweep - 1])
        for camera, camera_angle in enumerate(CAMERA_ANGLES_DEG, start=1):
            keep = above_horizon(stated) & above_horizon(true)
            if camera == 1:
                keep &= np.abs(angle) > 1.6  # behind the arm
            n = int(keep.sum())
            view = np.broadcast_to(view_direction(camera_angle), (n, 3))
            brdf = model.evaluate(true[keep], view, truth)
            radiance = np.pi * brdf * true[keep][:, 2:] * gains[camera - 1]
            scale = noise**2 * 4.0 / exposure_ms
            variance = scale * (np.abs(radiance) + 0.01 * 4.0 / exposure_ms)
            parts.append(
                Observations(
                    light_direction=stated[keep],
                    view_direction=view,
                    radiance=radiance + np.sqrt(variance) * rng.normal(size=(n, 3)),
                    variance=variance,
                    valid=radiance * exposure_ms < SATURATION,
                    camera=np.full(n, camera),
                    sweep=np.full(n, sweep),
                    exposure_ms=np.full(n, exposure_ms),
                    time_s=12.0 * sweep + angle[keep] / 15.0,
                )
            )
    return Observations.concatenate(parts)


def cramer_rao(scene: Scene, errors: CommonErrors) -> FloatArray:
    """Relative deviations (6,) that the data allow at the truth; of log(1/sigma_s) absolute."""
    model = get_model(SURFACE)
    problem = make_problem(scene.observations, model, {}, {})
    posterior = Posterior(problem, make_nuisances(problem, scene.observations, errors))
    internal = model.to_internal(scene.truth)
    linearised = linearise_at(posterior, posterior.point(internal))
    known = estimate(problem, posterior.nuisances, linearised)
    deviation = np.sqrt(np.diag(known.random + known.common))
    size = np.where(np.char.startswith(model.internal_names, "log"), 1.0, internal)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(deviation / size)


def count(tally: Tally, scene: Scene, result: FitResult, relative: FloatArray) -> None:
    """Add one fit."""
    truth = get_model(SURFACE).to_internal(scene.truth)
    deviation = np.sqrt(np.diag(result.internal_covariance))
    score = np.abs(result.internal_values - truth) / deviation
    tally.model_errors += result.model_error_std > 0
    no_lobe = scene.truth[4] == 0
    if no_lobe:
        tally.without_lobe += 1
        tally.invented_lobes += "inverse_sigma_s" not in result.undetermined
    for i, name in enumerate(result.parameter_names):
        if no_lobe and name == "inverse_sigma_s":
            continue  # there is no truth
        lost = name in result.undetermined
        if relative[i] < WELL_KNOWN:
            tally.well_known[name] += 1
            tally.well_known_lost[name] += lost
        if lost:
            continue
        if name in result.at_bound:
            low, high = result.interval(name)
            tally.at_bound[name] += 1
            tally.at_bound_inside[name] += low <= scene.truth[i] <= high
        else:
            tally.determined[name] += 1
            tally.inside[name] += bool(score[i] <= 3)
            tally.squares.append(float(score[i]) ** 2)
            if result.at_bound:
                tally.with_bound[name] += 1
                tally.with_bound_inside[name] += bool(score[i] <= 3)


def measure(scenes: int = SCENES, seed: int = 2024) -> dict[str, Any]:
    """Fit random scenes; return the shares that `main` prints, and the counts by parameter."""
    errors = CommonErrors(light_angle_std_deg=OFFSET_STD_DEG, gain_relative_std=GAIN_STD)
    tally = Tally()
    for number in range(scenes):
        scene = random_scene(np.random.default_rng((seed, number)))
        result = fit_scan(scene.observations, common_errors=errors)
        count(tally, scene, result, cramer_rao(scene, errors))
    return {
        "scenes": scenes,
        "parameters": tally.determined.total(),
        "coverage": _share(tally.inside, tally.determined),
        "root_mean_square_score": math.sqrt(float(np.mean(tally.squares))),
        "with_bound": tally.with_bound.total(),
        "coverage_with_bound": _share(tally.with_bound_inside, tally.with_bound),
        "at_bound": tally.at_bound.total(),
        "coverage_at_bound": _share(tally.at_bound_inside, tally.at_bound),
        "well_known": tally.well_known.total(),
        "well_known_lost": _share(tally.well_known_lost, tally.well_known),
        "without_lobe": tally.without_lobe,
        "invented_lobes": tally.invented_lobes,
        "model_errors": tally.model_errors,
        "by_parameter": {
            name: {
                "determined": tally.determined[name],
                "outside": tally.determined[name] - tally.inside[name],
                "at_bound": tally.at_bound[name],
                "at_bound_outside": tally.at_bound[name] - tally.at_bound_inside[name],
                "well_known": tally.well_known[name],
                "well_known_lost": tally.well_known_lost[name],
            }
            for name in get_model(SURFACE).parameter_names
        },
    }


def _share(part: Counter[str], whole: Counter[str]) -> float:
    return part.total() / whole.total() if whole.total() else math.nan


def main(scenes: int = SCENES) -> dict[str, Any]:
    """Print and return the figures."""
    figures = measure(scenes)
    low, high = TARGET
    print(
        f"Coverage of stated deviations ({scenes} scenes; noise 0.2-2 %, gains {GAIN_STD:.1%}, "
        f"light offsets {OFFSET_STD_DEG} deg)"
    )
    rows = (
        (
            "truth within 3 deviations, determined parameters",
            "coverage",
            "parameters",
            f"{low:.1%} to {high:.1%}",
        ),
        (
            "  of these, in scans with another one at a bound",
            "coverage_with_bound",
            "with_bound",
            f">= {TARGET_AT_BOUND:.0%}",
        ),
        (
            "truth within the interval, parameters at a bound",
            "coverage_at_bound",
            "at_bound",
            f">= {TARGET_AT_BOUND:.0%}",
        ),
        (
            f"called undetermined though known to {WELL_KNOWN:.0%}",
            "well_known_lost",
            "well_known",
            f"<= {TARGET_MISSED:.0%}",
        ),
    )
    for label, key, whole, target in rows:
        print(f"  {label:50} {figures[key]:7.2%} of {figures[whole]:6}   target {target}")
    print(
        f"  {'root mean square of error / deviation':50} {figures['root_mean_square_score']:7.3f}"
    )
    print(
        f"  {'a lobe where there is none':50} {figures['invented_lobes']:7} of "
        f"{figures['without_lobe']:6}"
    )
    print("  parameter         outside / determined   outside / at a bound   lost / well known")
    for name, c in figures["by_parameter"].items():
        print(
            f"  {name:16} {c['outside']:9} / {c['determined']:6} "
            f"{c['at_bound_outside']:13} / {c['at_bound']:4} "
            f"{c['well_known_lost']:12} / {c['well_known']:4}"
        )
    return figures


if __name__ == "__main__":
    main()
