"""The merge's rules one by one, on records made by hand: dropping, clipping, variances, lamp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.paths import CALIBRATION_FILE
from tvbrdf_fitting.measurement.calibration import load_calibration
from tvbrdf_fitting.measurement.frame_reduction import PatchStatistics, RegionStatistics
from tvbrdf_fitting.measurement.light_path import LightPath
from tvbrdf_fitting.measurement.radiometry import (
    RegionRadiance,
    dark_level,
    lamp_factor,
    region_radiance,
)
from tvbrdf_fitting.measurement.sweep_merge import (
    FrameRecord,
    SweepObservations,
    sweep_observations,
)

CALIBRATION = load_calibration(CALIBRATION_FILE)


def region(mean_dn: float, *, pixels: int = 10_000, saturated: int = 0) -> RegionStatistics:
    return RegionStatistics(
        pixel_count=pixels,
        saturated_count=np.full(3, saturated, dtype=np.int64),
        mean_dn=np.full(3, mean_dn),
        variance_dn2=np.full(3, 100.0),
    )


def record(
    stamp_ns: int,
    mean_dn: float = 1064.0,
    *,
    camera: int = 1,
    exposure_ms: float = 4.0,
    saturated: int = 0,
    sweep: int = 1,
    lamp_on: bool = True,
) -> FrameRecord:
    return FrameRecord(
        camera=camera,
        sweep=sweep,
        exposure_ms=exposure_ms,
        stamp_ns=stamp_ns,
        statistics=PatchStatistics(region(mean_dn, saturated=saturated), None),
        lamp_on=lamp_on,
    )


# one degree a second from -100 degrees at stamp 0: the stamp in seconds less 100 is the angle
PATH = LightPath.from_reports(
    np.array([0, 200_000_000_000]), np.array([-100.0, 100.0]), max_gap_ms=1e9
)


def at_angle(angle_deg: float) -> int:
    return round((angle_deg + 100.0) * 1e9)


def merged(frames: list[FrameRecord], dark: list[FrameRecord] | None = None) -> SweepObservations:
    return sweep_observations(
        frames, dark or [], PATH, CALIBRATION, camera_stamp_std_ns={1: 3e5}, arm_stamp_std_ns=4e5
    )


def test_frames_are_dropped_for_stated_reasons() -> None:
    horizon = -78.0 + np.rad2deg(1e-3)
    # 4 ms at 1 degree a second: 0.004 degrees, half of them on each side
    rising = [-95.0, -90.0, horizon - 1e-3, horizon + 1.9e-3, horizon + 2.1e-3]
    angles = [*rising, -1.753, -1.751, 0.0, 1.753, 90.0, 90.1]
    frames = [record(at_angle(angle)) for angle in angles]
    frames.append(record(at_angle(150.0)))
    frames.append(record(at_angle(50.0)))
    frames.append(record(at_angle(50.0), 1065.0))
    frames.append(record(at_angle(60.0), exposure_ms=32.0))
    result = merged(frames)
    np.testing.assert_allclose(
        result.light_angle_deg, [horizon + 2.1e-3, -1.753, 1.753, 50.0, 90.0], atol=1e-8
    )
    assert result.dropped == {
        "below_horizon": 3,
        "hidden": 2,
        "light_unknown": 1,
        "other_exposure": 1,
        "out_of_range": 2,
        "repeated": 1,
    }
    # hidden is camera 1's own
    others = merged([replace(frame, camera=2) for frame in frames])
    assert "hidden" not in others.dropped
    # of repeated frames the same one is kept however they come
    assert np.array_equal(merged(frames[::-1]).radiance, result.radiance)


def test_clipped_channels_stay_as_rows_that_are_not_valid() -> None:
    frames = [
        record(at_angle(20.0), 2000.0),
        record(at_angle(21.0), 2000.0, saturated=1),
        record(at_angle(22.0), 4000.0),
    ]
    result = merged(frames)
    assert result.valid.tolist() == [[True] * 3, [False] * 3, [False] * 3]
    assert np.all(np.isfinite(result.radiance))
    assert np.all(result.variance > 0.0)


def test_offset_deviations_are_speed_times_time() -> None:
    result = merged([record(at_angle(20.0))])
    assert result.light_offset_std_deg == pytest.approx(4e-4)
    assert result.camera_offset_std_deg.tolist() == pytest.approx([3e-4, 0.0, 0.0, 0.0])
    assert result.direction == 1


def test_radiance_and_its_variance_by_hand() -> None:
    camera = CALIBRATION.camera(1)
    dark = [record(i, 70.0 + d, lamp_on=False) for i, d in enumerate((-0.01, 0.0, 0.01))]
    # of another exposure, and of another camera: neither may be used
    dark.append(record(9, 90.0, lamp_on=False, exposure_ms=32.0))
    dark.append(record(9, 95.0, lamp_on=False, camera=2))
    result = merged([record(at_angle(20.0), 1070.0)], dark)
    constant = camera.radiance_per_dn_per_ms[0]
    np.testing.assert_allclose(result.radiance, 1000.0 / 4.0 * constant, rtol=1e-12)
    read_dn2 = (5.0 / camera.gain_e_per_dn) ** 2 + 1.0 / 12.0
    expected = (1000.0 / camera.gain_e_per_dn + read_dn2) / 1e4 + (1e-3 * 1000.0) ** 2
    expected += max(read_dn2 / 1e4, 1e-4) / 3.0
    np.testing.assert_allclose(result.variance, expected * (constant / 4.0) ** 2, rtol=1e-9)
    # without dark frames the nominal level holds, with its own deviation
    nominal = merged([record(at_angle(20.0), 1064.0)])
    np.testing.assert_allclose(nominal.radiance, result.radiance, rtol=1e-12)
    assert np.all(nominal.variance > result.variance)


def test_dark_frames_that_are_not_dark_are_refused() -> None:
    with pytest.raises(ValueError, match=r"camera 1: dark frames .* check that the lamp was off"):
        dark_level([region(800.0)], CALIBRATION.camera(1))


def test_variance_does_not_follow_a_frames_own_noise() -> None:
    """Weights taken from the noisy signal itself would pull a weighted mean down."""
    camera = replace(CALIBRATION.camera(1), relative_noise_std=0.0, read_noise_e=0.0)
    random = np.random.default_rng(8)
    # 20 electrons in the whole patch: relative noise 22 %
    electrons = random.poisson(20.0, 5000)
    means = camera.black_level_dn + electrons / camera.gain_e_per_dn
    regions = [region(float(mean), pixels=1) for mean in means]
    found = region_radiance(regions, 4.0, dark_level([], camera), camera)
    weights = 1.0 / found.variance[:, 0]
    value = found.radiance[:, 0] / camera.radiance_per_dn_per_ms[0] * 4.0 * camera.gain_e_per_dn
    own = 1.0 / np.maximum(electrons, 1)
    # own weights: low by one electron (5 %); over five frames a fifth of that
    assert np.sum(own * electrons) / np.sum(own) < 20.0 - 0.8
    assert np.sum(weights * value) / np.sum(weights) > 20.0 - 0.35


def test_reference_under_grazing_light_allows_for_an_offset() -> None:
    """An offset of 0.05 degrees biases the lamp factor less than the deviation that is stated."""
    angle = np.concatenate([np.arange(-67.5, -62.0, 0.25), np.arange(86.0, 90.0, 0.25)])
    sample_angle = np.deg2rad(angle - 12.0)
    light = np.stack([np.sin(sample_angle), np.zeros(angle.size), np.cos(sample_angle)], axis=1)
    albedo = np.array(CALIBRATION.reference_albedo)
    shown = np.cos(sample_angle + np.deg2rad(0.05))[:, None] * albedo * 1.03
    usable = np.ones(shown.shape, dtype=np.bool_)
    reference = RegionRadiance(shown, (1e-3 * shown) ** 2, 0.0 * shown, usable)
    camera = CALIBRATION.camera(2)
    aware = lamp_factor(reference, light, 0.05, CALIBRATION, camera)
    unaware = lamp_factor(reference, light, 0.0, CALIBRATION, camera)
    assert np.all(np.abs(aware.factor - 1.03) < aware.std)
    assert np.all(np.abs(unaware.factor - 1.03) > 3.0 * unaware.std)
    dim = replace(reference, radiance=shown * 0.1)
    with pytest.raises(ValueError, match=r"camera 2: reference shows 0\.103"):
        lamp_factor(dim, light, 0.0, CALIBRATION, camera)


def test_frames_that_are_no_sweep_are_refused() -> None:
    with pytest.raises(ValueError, match=r"carry the sweep numbers \[\]"):
        merged([])
    with pytest.raises(ValueError, match=r"carry the sweep numbers \[1, 2\]"):
        merged([record(at_angle(1.0)), record(at_angle(2.0), sweep=2)])
    with pytest.raises(ValueError, match="camera 7 is not calibrated"):
        merged([record(at_angle(20.0), camera=7)])
