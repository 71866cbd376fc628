"""The rig's directions against the published files' numbers and against each other."""

from __future__ import annotations

import numpy as np
import pytest

from tvbrdf_fitting.geometry import (
    CAMERA_ANGLES_DEG,
    above_horizon,
    light_direction,
    light_world_angle_deg,
    view_direction,
)


def test_views_are_those_of_the_published_files() -> None:
    # rounded to the six decimals that the files have
    published = [
        (-0.207912, 0.0, 0.978148),
        (-0.188432, 0.422618, 0.886503),
        (-0.133643, 0.766044, 0.628741),
        (-0.053812, 0.965926, 0.253163),
    ]
    for angle, expected in zip(CAMERA_ANGLES_DEG, published, strict=True):
        np.testing.assert_allclose(view_direction(angle), expected, atol=5.1e-7)


def test_a_sweep_has_336_lights_above_the_horizon() -> None:
    light = light_direction(np.linspace(-90, 90, 361))
    assert light.shape == (361, 3)
    assert int(above_horizon(light).sum()) == 336
    np.testing.assert_allclose(light[above_horizon(light)][0], (-0.999962, 0, 0.008727), atol=1e-6)
    np.testing.assert_allclose(light[-1], (0.978148, 0, 0.207912), atol=5.1e-7)


def test_a_light_angle_survives_the_way_there_and_back() -> None:
    angle = np.linspace(-90, 90, 1801)
    for tilt in (0.0, 12.0, -5.0):
        back = light_world_angle_deg(light_direction(angle, tilt), tilt)
        np.testing.assert_allclose(back, angle, atol=1e-12)


def test_one_angle_gives_one_vector() -> None:
    assert light_direction(30.0).shape == (3,)
    np.testing.assert_array_equal(light_direction(30.0), light_direction([30.0])[0])
    assert light_world_angle_deg(light_direction(30.0)) == pytest.approx(30.0, abs=1e-12)


def test_mirror_of_camera_1_is_at_twelve_degrees_in_the_sample_frame() -> None:
    half = light_direction(24.0) + view_direction(0.0)
    np.testing.assert_allclose(half[:2], 0.0, atol=1e-15)


def test_smallest_half_angles_are_those_of_the_facts() -> None:
    light = light_direction(np.linspace(-90, 90, 36001))
    smallest = []
    for angle in CAMERA_ANGLES_DEG:
        half = light + view_direction(angle)
        smallest.append(np.rad2deg(np.arctan2(np.hypot(half[:, 0], half[:, 1]), half[:, 2]).min()))
    # the facts give one decimal; the sweep's step is 0.005 degrees
    np.testing.assert_allclose(smallest, (0.0, 12.7, 25.3, 37.6), atol=0.06)


def test_directions_of_a_wrong_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"three components last, got shape \(4, 2\)"):
        above_horizon(np.zeros((4, 2)))
