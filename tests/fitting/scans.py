"""Simulated scans at radiance level, real materials, and what must hold for every fit of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from tvbrdf_fitting import FitResult, Observations, get_model
from tvbrdf_fitting.geometry import (
    CAMERA_ANGLES_DEG,
    above_horizon,
    light_direction,
    view_direction,
)

EXPOSURES_MS = (0.2, 4.0, 32.0)
LARGEST_SIGNAL = 48.0
"""Radiance x exposure in ms at which the simulated camera saturates: at 32 ms, 1.5 white."""

Simulate = Callable[..., Observations]

GLOSSY = [0.05, 0.12, 0.4, 0.1, 3.0, 25.0]
SATIN = [0.3, 0.5, 0.7, 0.4, 0.8, 6.0]
ROUGH = [0.6, 0.55, 0.5, 0.9, 0.15, 2.0]
LAMBERT = [0.3, 0.5, 0.7, 0.0, 0.8, 6.0]
METAL = [0.05, 0.06, 0.08, 0.3, 0.5, 1.5, 3.0, 9.0]
"""Oren-Nayar + Torrance-Sparrow, coloured."""
DUSTY = [*SATIN, 0.05, 0.06, 0.07, 0.35, 0.6]


def simulate(
    parameters: Sequence[float],
    model: str = "ON+TS",
    *,
    noise: float = 0.0,
    seed: int = 0,
    step: int = 1,
    light_offset_deg: Sequence[float] = (0.0, 0.0, 0.0),
    gains: np.ndarray | None = None,
) -> Observations:
    """Return one scan as the rig takes it.

    Three sweeps of 361 / step lights, each with its own phase, four cameras, what lies below the
    horizon and behind the arm left out. The variance is that of shot noise, `noise` relative at
    white and 4 ms, plus a read noise of a tenth of that; saturated values are masked.
    `light_offset_deg` and `gains` (4, 3) are common errors that the observations do not know of.
    """
    rng = np.random.default_rng(seed)
    brdf = get_model(model)
    parts = []
    for sweep, exposure in enumerate(EXPOSURES_MS, start=1):
        angle = np.linspace(-90.0, 90.0, 361)[::step] + rng.uniform(-0.2, 0.2)
        stated, true = light_direction(angle), light_direction(angle + light_offset_deg[sweep - 1])
        for camera, camera_angle in enumerate(CAMERA_ANGLES_DEG, start=1):
            keep = above_horizon(stated) & above_horizon(true)
            if camera == 1:
                keep &= np.abs(angle) > 1.6
            n = int(keep.sum())
            view = np.broadcast_to(view_direction(camera_angle), (n, 3))
            radiance = np.pi * brdf.evaluate(true[keep], view, parameters) * true[keep][:, 2:]
            if gains is not None:
                radiance *= gains[camera - 1]
            scale = (noise or 1e-3) ** 2 * 4.0 / exposure
            variance = scale * (np.abs(radiance) + 0.01 * 4.0 / exposure)
            noisy = radiance + np.sqrt(variance) * rng.normal(size=(n, 3)) * (noise > 0)
            parts.append(
                Observations(
                    light_direction=stated[keep],
                    view_direction=view,
                    radiance=noisy,
                    variance=variance,
                    valid=radiance * exposure < LARGEST_SIGNAL,
                    camera=np.full(n, camera),
                    sweep=np.full(n, sweep),
                    exposure_ms=np.full(n, exposure),
                    time_s=12.0 * sweep + angle[keep] / 15.0,
                )
            )
    return Observations.concatenate(parts)


def read_material(folder: Path) -> Observations:
    """Return a scan of measured reflectance in the published layout, with uniform weights."""
    parts = []
    for camera in range(1, 5):
        path = folder / "tvBrdf-data" / f"scan01_brdf_camera{camera}_allexposures.txt"
        lines = [line.split() for line in path.read_text().splitlines()[1:]]
        radiance, light, view = (
            np.array([line[1:] for line in lines if line[0] == letter], dtype=float)
            for letter in "FLV"
        )
        n = len(radiance)
        parts.append(
            Observations(
                light_direction=light,
                view_direction=view,
                radiance=radiance,
                variance=np.full((n, 3), 1e-4),
                valid=np.ones((n, 3), dtype=bool),
                camera=np.full(n, camera),
                sweep=np.ones(n, dtype=int),
                exposure_ms=np.full(n, 4.0),
                time_s=np.zeros(n),
            )
        )
    return Observations.concatenate(parts)


def sound(result: FitResult) -> FitResult:
    """Check what holds for every result, and return it."""
    assert json.loads(json.dumps(result.as_dict(), allow_nan=False))["model"] == result.model
    lower, upper = get_model(result.model).bounds
    seen = np.isfinite(result.values)
    slack = 1e-9 * np.abs(result.values[seen])
    assert (result.values[seen] >= lower[seen] - slack).all()
    assert (result.values[seen] <= upper[seen] + slack).all()
    variance = np.diag(result.covariance)
    assert (variance[np.isfinite(variance)] >= 0).all()
    unknown = ~np.isfinite(result.standard_deviations)
    assert set(np.array(result.parameter_names)[unknown]) <= set(result.undetermined)
    assert result.evaluations > 0 or len(result.fixed) == len(result.values)
    assert result.reason
    return result
