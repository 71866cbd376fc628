"""What the rig sees of a surface, as calibrated radiance and on the published grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tvbrdf_fitting import Observations
from tvbrdf_fitting.models import SURFACE
from tvbrdf_fitting.published import CameraScan
from tvbrdf_launch.cli.bench.rig_scenes import CAMERAS, READ_NOISE, measure

EXPOSURES_MS = (0.2, 4.0, 32.0)
NOISE = 0.005
"""Relative deviation at white."""


def observe(
    truth: Sequence[float],
    model: str = SURFACE,
    *,
    seed: int = 1,
    lights: int = 361,
    noise: float = NOISE,
) -> Observations:
    """One sweep, four cameras, the arm's gap in camera 1; see `deviation` for the noise."""
    rng = np.random.default_rng(seed)
    scan = measure(rng, truth, model=model, noise=noise, lights=lights)
    return replace(scan, sweep=np.zeros_like(scan.sweep))  # the rig's first


def deviation(radiance: np.ndarray | float, noise: float = NOISE) -> np.ndarray:
    """Standard deviation of a measured radiance."""
    return np.asarray(noise * np.sqrt(READ_NOISE + radiance))


def grid_of(observations: Observations) -> dict[int, CameraScan]:
    """Radiance as the published files have it."""
    grid = {}
    for camera in CAMERAS:
        rows = observations.camera == camera
        grid[camera] = CameraScan(
            EXPOSURES_MS,
            observations.light_direction[rows],
            observations.view_direction[rows][0],
            observations.radiance[rows],
        )
    return grid
