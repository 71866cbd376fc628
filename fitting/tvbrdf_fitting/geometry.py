"""Directions of light and cameras on the rig, in the sample's frame.

Frame: right-handed, unit vectors, z the sample's normal, x in the light's plane, y in the cameras'
plane. The light's plane is perpendicular to the cameras' plane; the plate that carries the sample
is tilted in the light's plane, so that the arm does not hide the specular peak from the top camera.

Source: Sun, Sunkavalli, Ramamoorthi, Belhumeur, Nayar, "Time-Varying BRDFs", section on the
acquisition system, and the published database, whose `L` and `V` lines these formulas reproduce.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

CAMERA_ANGLES_DEG = (0.0, 25.0, 50.0, 75.0)
"""Cameras 1 to 4, from the vertical."""
TILT_DEG = 12.0
"""Tilt of the sample plate in the light's plane."""
HORIZON_COSINE = 1e-3
"""A direction whose cosine to the normal is below this counts as below the sample's horizon."""
CHANNELS = ("b", "g", "r")
"""Order of the colour channels, everywhere."""


def light_direction(world_angle_deg: ArrayLike, tilt_deg: float = TILT_DEG) -> FloatArray:
    """Unit vectors from the sample to the light.

    Parameters
    ----------
    world_angle_deg
        Angle(s) of the light from the vertical, in [-90, 90] degrees over a sweep; any shape.
    tilt_deg
        Tilt of the plate in degrees.

    Returns
    -------
    array of shape (..., 3): (n, 3) for n angles, (3,) for a single number
    """
    angle = np.deg2rad(np.asarray(world_angle_deg, dtype=np.float64) - tilt_deg)
    return np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)


def view_direction(camera_angle_deg: float, tilt_deg: float = TILT_DEG) -> FloatArray:
    """Unit vector (3,) from the sample to a camera at an angle in degrees from the vertical."""
    angle, tilt = np.deg2rad(float(camera_angle_deg)), np.deg2rad(float(tilt_deg))
    return np.array([-np.cos(angle) * np.sin(tilt), np.sin(angle), np.cos(angle) * np.cos(tilt)])


def light_world_angle_deg(direction: ArrayLike, tilt_deg: float = TILT_DEG) -> FloatArray:
    """World angle in degrees of light directions (..., 3): the inverse of `light_direction`.

    A component out of the light's plane is ignored. The answer lies in (-180, 180] + tilt.
    """
    vectors = as_vectors(direction)
    return np.rad2deg(np.arctan2(vectors[..., 0], vectors[..., 2])) + tilt_deg


def above_horizon(direction: ArrayLike) -> BoolArray:
    """Mask (...) of the directions (..., 3) that are clearly above the sample's horizon."""
    return np.asarray(as_vectors(direction)[..., 2] >= HORIZON_COSINE)


def as_vectors(direction: ArrayLike) -> FloatArray:
    """Directions (..., 3) as an array; `ValueError` for another shape."""
    vectors = np.asarray(direction, dtype=np.float64)
    if vectors.ndim == 0 or vectors.shape[-1] != 3:
        raise ValueError(f"directions must have three components last, got shape {vectors.shape}")
    return vectors


def paired(light: ArrayLike, view: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Light and view directions as (n, 3) each, one of them repeated where it is single.

    Raises
    ------
    ValueError
        Other shapes.
    """
    lights, views = (np.atleast_2d(np.asarray(a, dtype=np.float64)) for a in (light, view))
    for name, array in (("light", lights), ("view", views)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"{name} directions have shape {array.shape}, expected (n, 3)")
    if 1 not in {len(lights), len(views)} and len(lights) != len(views):
        raise ValueError(f"{len(lights)} light directions but {len(views)} view directions")
    lights, views = np.broadcast_arrays(lights, views)
    return lights, views
