"""Motion blur: the second derivative, and radiances as they are in the middle of an exposure."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tvbrdf_fitting.measurement.motion_blur import second_derivative, without_motion_blur
from tvbrdf_fitting.measurement.sweep_merge import SweepObservations

STEP_DEG = 0.5
ARC_DEG = 0.48
"""32 ms at 15 degrees a second."""


def sweep(
    angle_deg: np.ndarray, radiance: np.ndarray, *, arc_deg: float = ARC_DEG, camera: int = 1
) -> SweepObservations:
    n = angle_deg.size
    return SweepObservations(
        sweep=0,
        exposure_ms=32.0,
        direction=1,
        camera=np.full(n, camera, dtype=np.int64),
        stamp_ns=np.arange(n, dtype=np.int64) * 33_000_000,
        light_angle_deg=angle_deg,
        swept_deg=np.full(n, arc_deg),
        frame_exposure_ms=np.full(n, 32.0),
        radiance=radiance,
        variance=np.full((n, 3), 1e-6),
        valid=np.ones((n, 3), dtype=np.bool_),
        lamp_factor=np.ones((1, 3)),
        lamp_factor_std=np.zeros((1, 3)),
        lamp_measured=np.ones((1, 3), dtype=np.bool_),
        light_offset_std_deg=0.0,
        camera_offset_std_deg=np.zeros(1),
        dropped={},
    )


def lobe(angle_deg: np.ndarray, sigma_s: float) -> np.ndarray:
    """Of the half angle, which turns half as fast as the light; three channels of two heights."""
    height = np.exp(-((np.deg2rad(angle_deg) / (2.0 * sigma_s)) ** 2))
    return np.stack([height, 0.5 * height, height], axis=1)


def blurred_lobe(angle_deg: np.ndarray, sigma_s: float, arc_deg: float) -> np.ndarray:
    """Return the lobe's mean over each exposure, by Gauss's rule (exact to 1e-15 here)."""
    nodes, weights = np.polynomial.legendre.leggauss(9)
    moved = angle_deg[:, None] + 0.5 * arc_deg * nodes
    values = lobe(moved.ravel(), sigma_s).reshape(*moved.shape, 3)
    return np.asarray(np.einsum("nkc,k->nc", values, weights) / 2.0)


def angles(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    steps = STEP_DEG * (1.0 + 0.02 * rng.standard_normal(241))
    return np.asarray(-60.0 + np.cumsum(steps))


def test_second_derivative_is_exact_for_cubics_wherever_the_samples_lie() -> None:
    x = np.sort(np.random.default_rng(1).uniform(-10.0, 10.0, 60))
    x = x[np.concatenate([[True], np.diff(x) > 0.05])]
    value = np.stack([x**3, 2.0 * x**2 + x], axis=1)
    expected = np.stack([6.0 * x, np.full_like(x, 4.0)], axis=1)
    gaps = np.diff(x) > 1.5 * np.median(np.diff(x))
    sizes = np.diff(np.concatenate([[0], np.flatnonzero(gaps) + 1, [x.size]]))
    long_enough = np.repeat(sizes >= 4, sizes)
    assert 0 < np.count_nonzero(long_enough) < x.size  # both cases are there
    found = second_derivative(x, value)
    np.testing.assert_allclose(found[long_enough], expected[long_enough], rtol=0, atol=2e-6)
    assert not found[~long_enough].any()


@pytest.mark.parametrize(("sigma_s", "left"), [(0.03, 0.06), (0.05, 0.02), (0.2, 2e-3)])
def test_most_of_the_blur_goes(sigma_s: float, left: float) -> None:
    # left: 0.37 h^2 r''''/r'' at the lobe's top is 6 * 0.37 h^2 / (2 sigma_s)^2 = 4.7 % at 0.03
    at = angles()
    sharp, blurred = lobe(at, sigma_s), blurred_lobe(at, sigma_s, ARC_DEG)
    found = without_motion_blur(sweep(at, blurred)).radiance
    before, after = np.abs(blurred - sharp).max(), np.abs(found - sharp).max()
    assert before > 1e-6
    assert after < left * before


def test_nothing_is_taken_across_the_gap_that_the_arm_leaves() -> None:
    at = angles()
    at = at[np.abs(at) > 1.75]
    sharp, blurred = lobe(at, 0.05), blurred_lobe(at, 0.05, ARC_DEG)
    found = without_motion_blur(sweep(at, blurred)).radiance
    # at a stretch's end the cubic looks to one side: off by 11/12 h^2 r'''' at most
    assert np.abs(found - sharp).max() < 0.1 * np.abs(blurred - sharp).max()


def test_clipped_values_neither_change_nor_take_part() -> None:
    at = angles()
    sharp, blurred = lobe(at, 0.05), blurred_lobe(at, 0.05, ARC_DEG)
    clipped = sweep(at, blurred)
    valid = clipped.valid.copy()
    valid[sharp[:, 0] > 0.6, 0] = False  # of blue only
    wrong = np.where(valid, blurred, 7.0)
    found = without_motion_blur(replace(clipped, radiance=wrong, valid=valid))
    assert np.array_equal(found.radiance[~valid], wrong[~valid])
    error = np.abs(found.radiance - sharp)[valid]
    assert error.max() < 0.1 * np.abs(blurred - sharp).max()
    whole = without_motion_blur(clipped).radiance
    assert np.array_equal(found.radiance[:, 1:], whole[:, 1:])


def test_cameras_are_apart_and_rows_keep_their_order() -> None:
    at = angles()
    one, two = blurred_lobe(at, 0.05, ARC_DEG), 0.3 * blurred_lobe(at, 0.2, ARC_DEG)
    first, second = sweep(at, one), sweep(at[::-1], two[::-1], camera=2)
    rows = np.random.default_rng(2).permutation(2 * at.size)
    names = ("camera", "light_angle_deg", "swept_deg", "radiance", "variance", "valid")
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(first, name), getattr(second, name)])[rows] for name in names
    }
    joined = replace(first, **columns)
    expected = np.concatenate(
        [without_motion_blur(first).radiance, without_motion_blur(second).radiance]
    )[rows]
    np.testing.assert_allclose(without_motion_blur(joined).radiance, expected, rtol=0, atol=1e-12)


def test_short_exposures_and_few_frames_are_left_alone() -> None:
    at = angles()
    radiance = lobe(at, 0.05)
    assert np.array_equal(without_motion_blur(sweep(at, radiance, arc_deg=3e-3)).radiance, radiance)
    few = sweep(at[:3], radiance[:3])
    assert np.array_equal(without_motion_blur(few).radiance, few.radiance)


def test_the_noise_it_adds_is_small() -> None:
    at = -60.0 + STEP_DEG * np.arange(241)
    noise = np.random.default_rng(3).standard_normal((at.size, 3))
    found = without_motion_blur(sweep(at, noise)).radiance
    # inside, the correction is 0.0384 h^2 r'': weights (2, -1, -2, -1, 2) / 7 of five neighbours
    added = (found - noise)[2:-2]
    expected = ARC_DEG**2 / 24.0 / STEP_DEG**2 * np.sqrt(14.0) / 7.0
    # 711 values, correlated over five: the deviation is known to 6 %, so 4 deviations are 24 %
    assert added.std() == pytest.approx(expected, rel=0.24)
    assert added.std() < 0.03
