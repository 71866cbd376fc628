"""Torrance-Sparrow against its printed formula in 110 digits."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fitting.hard_directions import direction, every, hard_directions
from tests.fitting.precision import (
    Number,
    Vector,
    angles,
    check_jacobian,
    check_value,
    float32_cost,
    mp,
)
from tvbrdf_fitting.geometry import FloatArray


def torrance_sparrow(
    light: Vector, view: Vector, parameters: list[Number], channel: int
) -> list[Number]:
    """One Ks, or one a channel."""
    at = angles(light, view)
    ks, inverse_sigma_s = parameters[0 if len(parameters) == 2 else channel], parameters[-1]
    cos_i, cos_r, n_h, v_h = at.cos_i, at.cos_r, at.cos_h, at.cos_d
    g = min(1, 2 * n_h * cos_i / v_h, 2 * n_h * cos_r / v_h)
    return [ks * mp.exp(-((at.theta_h * inverse_sigma_s) ** 2)) * g / (4 * cos_i * cos_r)]


def near_the_peak(sigma_s: float) -> tuple[FloatArray, FloatArray]:
    """Return pairs whose half vector is about 0 to 26 sigma_s off the normal, where D > 1e-300."""
    rng = np.random.default_rng(3)
    lights, views = [], []
    for cosine in (1.0, 0.97, 0.5, 0.1, 3e-3):
        for off in (1e-3, 0.3, 1.0, 3.0, 12.0, 25.5):
            azimuth = rng.uniform(-3, 3)
            theta = np.arccos(cosine) + 2 * off * sigma_s * rng.uniform(0.5, 1)
            if theta < np.pi / 2:
                lights.append(direction(cosine, azimuth))
                views.append(direction(float(np.cos(theta)), azimuth + np.pi))
    return np.array(lights), np.array(views)


SIGMA_S = (1e-4, 0.005, 0.03, 0.15, 1.5, 10.0)


@pytest.mark.parametrize("sigma_s", SIGMA_S)
@pytest.mark.parametrize("near", [False, True])
def test_torrance_sparrow(sigma_s: float, near: bool) -> None:
    pairs = near_the_peak(sigma_s) if near else hard_directions()
    check_value("torrance_sparrow", torrance_sparrow, [1.7, 1 / sigma_s], *pairs)
    check_jacobian("torrance_sparrow", torrance_sparrow, [1.7, 1 / sigma_s], *pairs)


@pytest.mark.parametrize("ks", [(0.2, 0.7, 1.9), (0.0, 0.0, 0.0)])
def test_one_amplitude_a_channel(ks: tuple[float, ...]) -> None:
    name = "torrance_sparrow(coloured)"
    check_value(name, torrance_sparrow, [*ks, 5.0], *every(3))
    check_jacobian(name, torrance_sparrow, [*ks, 5.0], *every(3))


def test_far_tail_times_a_large_factor() -> None:
    # D = 1e-315 has 31 bits in float64, but G / (4 cos cos) = 2e14 makes it a BRDF of 1e-301
    light = np.tile(direction(1e-8, 0.3), (5, 1))
    view = np.array([direction(1e-8, 0.3 + np.pi - turn) for turn in 1e-7 * np.arange(1, 6)])
    for exponent in (705, 715, 725):
        for one in range(5):
            theta_h = np.arctan2(0.5e-7 * (one + 1), 1e-8)
            values = [1.0, float(np.sqrt(exponent) / theta_h)]
            pair = light[one : one + 1], view[one : one + 1]
            check_value("torrance_sparrow", torrance_sparrow, values, *pair)
            check_jacobian("torrance_sparrow", torrance_sparrow, values, *pair)


@pytest.mark.parametrize(("sigma_s", "largest"), [(0.3, 5e-7), (0.03, 5e-5), (0.005, 5e-5)])
def test_cost_of_float32(sigma_s: float, largest: float) -> None:
    # Rounding to 24 bits turns the half vector by up to 5e-8: relative to theta_h that is what the
    # exponent, up to 700 here, loses twice. Inputs explain 0.5 of the eps; below 1 they are not
    # told from the terms.
    pairs = near_the_peak(sigma_s)
    cost = float32_cost("torrance_sparrow", torrance_sparrow, [0.8, 1 / sigma_s], *pairs)
    assert cost.median < 5e-7
    assert cost.largest < largest
    assert cost.largest_eps <= 1.0
