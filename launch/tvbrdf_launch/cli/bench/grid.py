"""Speed against error: solvers x precision x lights x cameras x noise, simulated or on real data.

A time is that of one fit, from the observations to the parameters, on one core: preparing the
geometry and solving, without uncertainties; the lesser of two calls if it is short.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from tvbrdf_fitting.error_measures import measure_errors
from tvbrdf_fitting.geometry import FloatArray, light_world_angle_deg
from tvbrdf_fitting.models import SURFACE, get_model
from tvbrdf_fitting.observations import Observations
from tvbrdf_fitting.problem import make_problem
from tvbrdf_fitting.solve.separable import compile_all
from tvbrdf_fitting.solve.solvers import SOLVERS

from .contestants import CONTESTANTS, Contestant
from .hemisphere import Hemisphere
from .rig_scenes import CAMERAS, measure, random_material

LIGHTS = (12, 24, 48, 96, 181, 361)
NOISES = (0.001, 0.005, 0.02)
SCENES = 20
QUICK_LIGHTS, QUICK_CAMERAS, QUICK_SCENES = (12, 48, 361), (1, 4), 6
MOST_SUBSETS = 12
"""Of a real scan that has so many more lights than are chosen."""
QUANTILE = 0.95
SAME_ERROR, LEAST_ERROR = 0.02, 1e-5
"""Errors that differ by less, relative or absolute, count as equal, as where solvers agree."""
SLOW_S = 0.005
"""A fit that takes longer is timed once."""
FULL_PRECISION = "float64"
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Plan:
    """What is varied."""

    lights: tuple[int, ...] = LIGHTS
    cameras: tuple[int, ...] = CAMERAS
    noises: tuple[float, ...] = NOISES
    scenes: int = SCENES
    contestants: tuple[Contestant, ...] = CONTESTANTS


QUICK = Plan(lights=QUICK_LIGHTS, cameras=QUICK_CAMERAS, scenes=QUICK_SCENES)


@dataclass(frozen=True)
class Cell:
    """One combination, over several fits: medians, and what 95 % of the fits stay below.

    Attributes
    ----------
    solver, precision, lights, cameras
        The combination. Simulated lights are the positions of a sweep, also those below the
        horizon; of a real scan, those that its files have.
    noise
        Relative deviation at white; None for real data.
    fits
        How many.
    time_ms
        Median time of a fit.
    brdf, brdf_95
        Relative error of the BRDF over the hemisphere (see `Hemisphere`).
    kd, kd_95, ks, ks_95
        Relative error of the albedos (the largest of three) and of the lobe's amplitude.
    sigma_d_squared, log_sigma_s
        Absolute errors, with their _95.
    rms_percent, rms_percent_95
        Of the residual of all that was measured; None where simulated.
    fast
        No other combination of this noise, at full precision, is both faster and, in `brdf_95`,
        better.
    few
        None needs fewer images (lights x cameras) and is better; of equals, the fastest.
    """

    solver: str
    precision: str
    lights: int
    cameras: int
    noise: float | None
    fits: int
    time_ms: float
    brdf: float
    brdf_95: float
    kd: float
    kd_95: float
    ks: float
    ks_95: float
    sigma_d_squared: float
    sigma_d_squared_95: float
    log_sigma_s: float
    log_sigma_s_95: float
    rms_percent: float | None = None
    rms_percent_95: float | None = None
    fast: bool = False
    few: bool = False

    @property
    def images(self) -> int:
        """Images that must be taken, an exposure."""
        return self.lights * self.cameras

    def as_dict(self) -> dict[str, object]:
        """Return plain values by name, None for a number that is not finite."""
        return {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in asdict(self).items()
        }


@dataclass(frozen=True)
class _Fit:
    """One fit: where it belongs, how long it took, and its errors."""

    contestant: Contestant
    lights: int
    cameras: int
    noise: float | None
    time_ms: float
    errors: dict[str, float]


def simulate(plan: Plan, progress: Progress = lambda done, of: None) -> list[Cell]:
    """Return the cells over random materials, against their true parameters."""
    compile_all()
    model = get_model(SURFACE)
    hemisphere = Hemisphere(model)
    fits: list[_Fit] = []
    done, of = 0, plan.scenes * len(plan.noises) * len(plan.lights)
    for scene in range(plan.scenes):
        rng = np.random.default_rng((31, scene))
        material = random_material(rng)
        truth = model.to_internal(material)
        for noise in plan.noises:
            for lights in plan.lights:
                whole = measure(
                    rng, material, noise=noise, lights=lights, phase=rng.uniform(-0.5, 0.5)
                )
                for cameras in plan.cameras:
                    seen = whole.select(whole.camera <= cameras)
                    for contestant in plan.contestants:
                        internal, time_ms = timed(contestant, seen)
                        errors = errors_of(internal, truth, hemisphere)
                        fits.append(_Fit(contestant, lights, cameras, noise, time_ms, errors))
                done += 1
                progress(done, of)
    return cells_of(fits)


def on_scan(
    whole: Observations, plan: Plan, progress: Progress = lambda done, of: None
) -> list[Cell]:
    """Return the cells over parts of one real scan, against the fit of all of it."""
    compile_all()
    model = get_model(SURFACE)
    hemisphere = Hemisphere(model)
    truth = SOLVERS["separable"](make_problem(whole, model, {}, {})).internal
    angles, position = np.unique(
        np.round(light_world_angle_deg(whole.light_direction), 3), return_inverse=True
    )
    present = np.unique(whole.camera)
    counts = [n for n in plan.lights if n < len(angles)] + [len(angles)]
    chosen_cameras = sorted({min(n, len(present)) for n in plan.cameras})
    fits: list[_Fit] = []
    for done, lights in enumerate(counts, start=1):
        for subset in subsets(len(angles), lights):
            lit = np.isin(position, subset)
            for cameras in chosen_cameras:
                seen = whole.select(lit & np.isin(whole.camera, present[:cameras]))
                for contestant in plan.contestants:
                    internal, time_ms = timed(contestant, seen)
                    errors = errors_of(internal, truth, hemisphere)
                    errors["rms_percent"] = _rms_percent(whole, internal)
                    fits.append(_Fit(contestant, lights, cameras, None, time_ms, errors))
        progress(done, len(counts))
    return cells_of(fits)


def subsets(whole: int, count: int) -> Iterator[np.ndarray]:
    """Yield evenly spaced choices of `count` out of `whole`, each shifted a little further."""
    step = whole / count
    turns = max(min(int(step), MOST_SUBSETS), 1)
    for turn in range(turns):
        yield np.floor(np.arange(count) * step + turn * step / turns).astype(np.int64)


def timed(contestant: Contestant, observations: Observations) -> tuple[FloatArray, float]:
    """Return internal coordinates and the time of the fit, ms."""
    given, model = contestant.given(observations), get_model(SURFACE)
    times = []
    for _ in range(2):
        began = time.perf_counter()
        internal = contestant.solve(make_problem(given, model, {}, {}))
        times.append(time.perf_counter() - began)
        if times[0] > SLOW_S:
            break
    return internal, 1e3 * min(times)


def errors_of(internal: FloatArray, truth: FloatArray, hemisphere: Hemisphere) -> dict[str, float]:
    """Return the errors of internal coordinates (6,), by name."""
    off = np.abs(internal - truth)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = off / np.abs(truth)
    return {
        "brdf": hemisphere.relative_error(internal, truth),
        "kd": float(relative[:3].max()),
        "ks": float(relative[4]),
        "sigma_d_squared": float(off[3]),
        "log_sigma_s": float(off[5]),
    }


def _rms_percent(whole: Observations, internal: FloatArray) -> float:
    problem = make_problem(whole, get_model(SURFACE), {}, {})
    rows = whole.usable.any(axis=1)
    predicted = np.zeros(whole.radiance.shape)
    predicted[rows] = problem.predict(internal).T
    return measure_errors(whole, predicted).rms_percent


def cells_of(fits: Iterable[_Fit]) -> list[Cell]:
    """Gather fits into cells, and mark the fronts."""
    groups: dict[tuple[Contestant, int, int, float | None], list[_Fit]] = {}
    for fit in fits:
        key = (fit.contestant, fit.lights, fit.cameras, fit.noise)
        groups.setdefault(key, []).append(fit)
    cells = []
    for (contestant, lights, cameras, noise), own in groups.items():
        figures: dict[str, Any] = {}
        for name in own[0].errors:
            values = np.array([fit.errors[name] for fit in own])
            figures[name], figures[f"{name}_95"] = _quantile(values, 0.5), _quantile(values)
        cells.append(
            Cell(
                solver=contestant.solver,
                precision=contestant.precision,
                lights=lights,
                cameras=cameras,
                noise=noise,
                fits=len(own),
                time_ms=float(np.median([fit.time_ms for fit in own])),
                **figures,
            )
        )
    return mark_fronts(cells)


def _quantile(values: FloatArray, share: float = QUANTILE) -> float:
    """Return an observed value that at least this share does not exceed; NaN is the worst."""
    ordered = np.sort(np.where(np.isnan(values), math.inf, values))
    return float(ordered[math.ceil(share * len(ordered)) - 1])


def mark_fronts(cells: Sequence[Cell]) -> list[Cell]:
    """Return cells with `fast` and `few` set, for each noise on its own, all at full precision."""
    marked = []
    for cell in cells:
        rivals = [
            c for c in cells if (c.noise, c.precision) == (cell.noise, FULL_PRECISION) and c != cell
        ]
        own = cell.precision == FULL_PRECISION
        marked.append(
            replace(
                cell,
                fast=own and not any(_beats(c, cell, c.time_ms, cell.time_ms) for c in rivals),
                few=own and not any(_beats(c, cell, c.images, cell.images) for c in rivals),
            )
        )
    return marked


def alike(one: float, other: float) -> bool:
    """Whether two errors count as equal."""
    return one == other or abs(one - other) <= SAME_ERROR * min(one, other) + LEAST_ERROR


def _beats(one: Cell, other: Cell, cost: float, other_cost: float) -> bool:
    """Whether one is nowhere worse and somewhere better, faster where costs and errors agree."""
    same = alike(one.brdf_95, other.brdf_95)
    if cost > other_cost or (one.brdf_95 > other.brdf_95 and not same):
        return False
    return not same or cost < other_cost or one.time_ms < other.time_ms
