"""Simulated scans at radiance level: random materials as the rig would see them, and their noise.

One sweep a scan, with a random phase; what lies below the sample's horizon is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tvbrdf_fitting.geometry import (
    CAMERA_ANGLES_DEG,
    FloatArray,
    above_horizon,
    light_direction,
    view_direction,
)
from tvbrdf_fitting.models import SURFACE, get_model
from tvbrdf_fitting.observations import Observations

CAMERAS = (1, 2, 3, 4)
LIGHTS = 361
"""Positions of the light in a sweep of half a circle; 336 of them are above the horizon."""
READ_NOISE = 0.01
"""Part of the variance that does not grow with the radiance, of that at white."""
STATED_NOISE = 1e-3
"""Relative deviation at white that noise-free scans state."""
HIDDEN_DEG = 1.6
"""The arm hides the sample from camera 1 this far around the vertical."""


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a number whose logarithm is uniform."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def random_material(rng: np.random.Generator) -> FloatArray:
    """Return published values (6,) of Oren-Nayar + Torrance-Sparrow, from matte to glossy."""
    return np.array(
        [
            *(log_uniform(rng, 0.05, 0.9) for _ in range(3)),
            math.sqrt(rng.uniform(0.0, 0.8)),
            log_uniform(rng, 0.05, 5.0),
            1 / log_uniform(rng, 0.03, 0.5),
        ]
    )


def measure(
    rng: np.random.Generator,
    truth: Sequence[float] | FloatArray,
    *,
    model: str = SURFACE,
    noise: float = 0.005,
    lights: int = LIGHTS,
    cameras: Sequence[int] = CAMERAS,
    phase: float = 0.0,
    gains: FloatArray | None = None,
    arm: bool = True,
) -> Observations:
    """Return one scan.

    Parameters
    ----------
    rng
        Draws the noise.
    truth, model
        Published values, and of which model.
    noise
        Relative deviation at white, shot noise; 0: none, and `STATED_NOISE` is stated.
    lights
        Positions in half a circle, evenly spaced.
    cameras
        Numbers of those that look.
    phase
        Shift of all positions, in steps.
    gains
        (4, 3) factors of cameras and channels that the observations do not know of.
    arm
        Whether the arm hides the sample from camera 1 for a while.
    """
    angle = np.linspace(-90.0, 90.0, lights)
    angle = angle + phase * (angle[1] - angle[0] if lights > 1 else 0.0)
    light = light_direction(angle)
    brdf = get_model(model)
    parts = []
    for camera in cameras:
        keep = above_horizon(light)
        if arm and camera == 1:
            keep &= np.abs(angle) > HIDDEN_DEG
        n = int(keep.sum())
        view = np.broadcast_to(view_direction(CAMERA_ANGLES_DEG[camera - 1]), (n, 3))
        radiance = np.pi * brdf.evaluate(light[keep], view, truth) * light[keep][:, 2:]
        if gains is not None:
            radiance = radiance * gains[camera - 1]
        variance = (noise or STATED_NOISE) ** 2 * (np.abs(radiance) + READ_NOISE)
        noisy = radiance + np.sqrt(variance) * rng.normal(size=(n, 3)) if noise else radiance
        parts.append(
            Observations(
                light_direction=light[keep],
                view_direction=view,
                radiance=noisy,
                variance=variance,
                valid=np.ones((n, 3), dtype=bool),
                camera=np.full(n, camera),
                sweep=np.ones(n, dtype=np.int64),
                exposure_ms=np.full(n, 4.0),
                time_s=angle[keep] / 15.0,
            )
        )
    return Observations.concatenate(parts)
