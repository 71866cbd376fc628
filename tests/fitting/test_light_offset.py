"""Time shift from sweeps in opposite directions: unbiased, with the deviation it states."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tvbrdf_fitting.measurement.light_offset import SweepCurve, light_offset_from_opposite_sweeps

FloatArray = NDArray[np.float64]
SPEED_DEG_S = 15.0


def truth(angle_deg: FloatArray, sigma_s: float) -> FloatArray:
    """A diffuse curve with a lobe at 24 degrees, three channels (n, 3)."""
    diffuse = np.cos(np.deg2rad(angle_deg - 12.0))[:, None] * np.array([0.2, 0.3, 0.4])
    half = np.deg2rad(angle_deg - 24.0) / 2.0
    return np.asarray(diffuse + 0.5 * np.exp(-((half / sigma_s) ** 2))[:, None])


def sweep(
    direction: int,
    late_ns: float,
    random: np.random.Generator,
    *,
    noise: float = 1e-3,
    lamp: float = 1.0,
    sigma_s: float = 0.1,
) -> SweepCurve:
    true_angle = np.arange(-77.0, 90.0, 0.5) + random.uniform(0.0, 0.5)
    value = lamp * truth(true_angle, sigma_s)
    std = noise * value
    valid = np.ones(value.shape, dtype=np.bool_)
    valid[np.abs(true_angle) < 2.0] = False
    return SweepCurve(
        light_angle_deg=true_angle + direction * SPEED_DEG_S * late_ns / 1e9,
        radiance=value + std * random.standard_normal(value.shape),
        variance=std**2,
        valid=valid,
    )


@pytest.mark.parametrize("late_ms", [-20.0, -1.0, 0.0, 3.0, 20.0])
@pytest.mark.parametrize("sigma_s", [0.05, 0.1])
def test_shift_is_exact_without_noise(late_ms: float, sigma_s: float) -> None:
    random = np.random.default_rng(1)
    found = light_offset_from_opposite_sweeps(
        sweep(1, late_ms * 1e6, random, noise=1e-9, sigma_s=sigma_s),
        sweep(-1, late_ms * 1e6, random, noise=1e-9, lamp=1.02, sigma_s=sigma_s),
        SPEED_DEG_S,
    )
    # interpolating the lobe is off by 2e-5 of its height where its slope is 1/7 a degree
    assert found.angle_shift_deg == pytest.approx(late_ms * 1e-3 * SPEED_DEG_S, abs=2e-4)
    assert found.time_shift_ns == pytest.approx(late_ms * 1e6, abs=2e-4 / SPEED_DEG_S * 1e9)


def test_stated_deviation_is_true() -> None:
    random = np.random.default_rng(11)
    trials = 150
    late_ns = 2e6
    errors = []
    for _ in range(trials):
        found = light_offset_from_opposite_sweeps(
            sweep(1, late_ns, random), sweep(-1, late_ns, random, lamp=0.995), SPEED_DEG_S
        )
        errors.append((found.time_shift_ns - late_ns) / found.time_shift_std_ns)
        assert 0.3 < found.reduced_chi_square < 1.3
    # 4.4 deviations of the mean and of the mean square of normal numbers; interpolated noise is
    # smoothed a little, so the stated deviation may be up to 10 % too large
    assert abs(np.mean(errors)) < 4.4 / np.sqrt(trials)
    assert abs(np.mean(np.square(errors)) - 0.9) < 4.4 * np.sqrt(2.0 / trials) + 0.1


def test_a_sample_that_changed_shows_in_chi_square() -> None:
    random = np.random.default_rng(3)
    found = light_offset_from_opposite_sweeps(
        sweep(1, 0.0, random, sigma_s=0.1), sweep(-1, 0.0, random, sigma_s=0.11), SPEED_DEG_S
    )
    assert found.reduced_chi_square > 10.0


def test_what_cannot_be_used_is_refused() -> None:
    random = np.random.default_rng(4)
    curve = sweep(1, 0.0, random)
    with pytest.raises(ValueError, match="give the light's speed"):
        light_offset_from_opposite_sweeps(curve, curve, 0.0)
    flat = SweepCurve(
        curve.light_angle_deg, np.zeros((334, 3)), np.ones((334, 3)), np.ones((334, 3), np.bool_)
    )
    with pytest.raises(ValueError, match="has no slope"):
        light_offset_from_opposite_sweeps(flat, flat, SPEED_DEG_S)
    short = SweepCurve(
        curve.light_angle_deg[:8], curve.radiance[:8], curve.variance[:8], curve.valid[:8]
    )
    with pytest.raises(ValueError, match="share only"):
        light_offset_from_opposite_sweeps(short, curve, SPEED_DEG_S)
