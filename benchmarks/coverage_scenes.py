"""Scenes for `coverage`: random materials, noise, and errors that frames share.

Each scene has its own material, noise, gains of cameras and channels, and light offsets of sweeps,
all drawn at random. Its observations know of the noise alone; how large the others are, `ERRORS`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

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

GAIN_STD, OFFSET_STD_DEG = 0.005, 0.02
ERRORS = CommonErrors(light_angle_std_deg=OFFSET_STD_DEG, gain_relative_std=GAIN_STD)
NONE = 0.1
"""Share of scenes without a lobe, and of Lambertian ones."""
EXPOSURES_MS = (0.2, 4.0, 32.0)
SATURATION = 48.0
"""Radiance x exposure in ms: at 32 ms, 1.5 white."""
LOBE = "torrance_sparrow"


@dataclass(frozen=True, eq=False)
class Scene:
    """A material (published values of ON+TS) and how it is measured."""

    truth: FloatArray
    observations: Observations

    @property
    def rung(self) -> str:
        """The simplest model that has no error."""
        diffuse = "oren_nayar" if self.truth[3] > 0 else "lambert"
        return f"{diffuse}+{LOBE}" if self.truth[4] > 0 else diffuse


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


def weak_scene(rng: np.random.Generator) -> Scene:
    """Return a scene whose lobe or roughness is about as large as its Cramer-Rao deviation."""
    truth = np.array(
        [
            *(log_uniform(rng, 0.02, 0.9) for _ in range(3)),
            math.sqrt(rng.uniform(0.0, 0.05)),
            1e-4,
            1 / log_uniform(rng, 0.02, 0.8),
        ]
    )
    noise, step = log_uniform(rng, 0.002, 0.02), int(rng.integers(4, 9))
    gains = 1 + GAIN_STD * rng.normal(size=(4, 3))
    offsets = OFFSET_STD_DEG * rng.normal(size=3)
    kind, factor, others = int(rng.integers(2)), rng.uniform(0, 8), rng.random()
    again = int(rng.integers(1 << 30))

    def taken() -> Observations:
        return simulate(np.random.default_rng(again), truth, noise, step, gains, offsets)

    known = cramer_rao(Scene(truth, taken()))
    of_square, of_lobe = known[3] * truth[3] ** 2, known[4] * truth[4]
    if kind:
        truth[3:5] = math.sqrt(factor * of_square), of_lobe * 10.0 ** (1 + 2 * others)
    else:
        truth[3:5] = math.sqrt(0.05 + 0.75 * others), factor * of_lobe
    return Scene(truth, taken())


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


def cramer_rao(scene: Scene) -> FloatArray:
    """Relative deviations (6,) that the data allow at the truth; of log(1/sigma_s) absolute."""
    model = get_model(SURFACE)
    problem = make_problem(scene.observations, model, {}, {})
    posterior = Posterior(problem, make_nuisances(problem, scene.observations, ERRORS))
    internal = model.to_internal(scene.truth)
    linearised = linearise_at(posterior, posterior.point(internal))
    known = estimate(problem, posterior.nuisances, linearised)
    deviation = np.sqrt(np.diag(known.random + known.common))
    size = np.where(np.char.startswith(model.internal_names, "log"), 1.0, internal)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(deviation / size)
