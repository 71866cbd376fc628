"""The rig's geometry as transforms, in metres.

Frame ``rig``: z up, x in the light's plane, y in the cameras' plane, its origin in the plate's
centre. ``sample``: turned about y by the plate's tilt, z is the sample's normal; so directions
in it are those of :mod:`tvbrdf_fitting.geometry`. Cameras and ``light`` look to the centre along
their z; a camera's x is the rig's, its y points down in the picture.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from tvbrdf_fitting.measurement.calibration import Calibration

    from .rig import Rig

RIG, SAMPLE, LIGHT = "rig", "sample", "light"


class Transform(NamedTuple):
    """Where a frame is in its parent: translation (m), and rotation as a quaternion x, y, z, w."""

    parent: str
    child: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


def fixed_transforms(rig: Rig) -> list[Transform]:
    """Return where sample and cameras are."""
    half = math.radians(rig.calibration.tilt_deg) / 2
    found = [Transform(RIG, SAMPLE, (0.0, 0.0, 0.0), (0.0, math.sin(half), 0.0, math.cos(half)))]
    distance_m = rig.calibration.camera_distance_cm / 100
    for name, number in rig.cameras.items():
        angle = math.radians(rig.calibration.camera(number).camera_angle_deg)
        place = (0.0, distance_m * math.sin(angle), distance_m * math.cos(angle))
        turn = (math.pi - angle) / 2
        found.append(Transform(RIG, name, place, (math.sin(turn), 0.0, 0.0, math.cos(turn))))
    return found


def light_transform(calibration: Calibration, angle_deg: float) -> Transform:
    """Return where the light is at a world angle."""
    angle, radius_m = math.radians(angle_deg), calibration.light_radius_cm / 100
    turn = (angle + math.pi) / 2
    place = (radius_m * math.sin(angle), 0.0, radius_m * math.cos(angle))
    return Transform(RIG, LIGHT, place, (0.0, math.sin(turn), 0.0, math.cos(turn)))
