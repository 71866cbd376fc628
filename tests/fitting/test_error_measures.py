"""Error measures against their definitions."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.fitting.scans import SATIN, Simulate
from tvbrdf_fitting.error_measures import ErrorMeasures, measure_errors, pool
from tvbrdf_fitting.geometry import HORIZON_COSINE
from tvbrdf_fitting.observations import Observations


def observations_of(
    radiance: np.ndarray, light_angle_deg: np.ndarray, valid: np.ndarray | None = None
) -> Observations:
    n = len(radiance)
    angle = np.deg2rad(light_angle_deg)
    return Observations(
        light_direction=np.stack([np.sin(angle), np.zeros(n), np.cos(angle)], axis=1),
        view_direction=np.tile([0.0, 0.6, 0.8], (n, 1)),
        radiance=radiance,
        variance=np.ones((n, 3)),
        valid=np.ones((n, 3), dtype=bool) if valid is None else valid,
        camera=np.ones(n, dtype=int),
        sweep=np.ones(n, dtype=int),
        exposure_ms=np.ones(n),
        time_s=np.zeros(n),
    )


def test_by_hand() -> None:
    measured = np.array([[1.0, 2.0, 4.0], [1.0, 2.0, 2.0]])
    predicted = measured + np.array([[0.1, 0.2, 0.2], [-0.1, 0.2, -0.4]])
    errors = measure_errors(observations_of(measured, np.zeros(2)), predicted)
    rms = math.sqrt((0.01 + 0.04 + 0.04 + 0.01 + 0.04 + 0.16) / 6)
    assert errors.rms_absolute == pytest.approx(rms, rel=1e-12)
    assert errors.rms_percent == pytest.approx(100 * rms / 4, rel=1e-12)
    assert errors.rms_over_mean == pytest.approx(rms / 2, rel=1e-12)
    assert errors.rms_b == pytest.approx(0.1, rel=1e-12)
    assert errors.rms_g == pytest.approx(0.2, rel=1e-12)
    assert errors.rms_r == pytest.approx(math.sqrt(0.1), rel=1e-12)
    ratios = np.log(predicted / measured)
    assert errors.rms_log == pytest.approx(math.sqrt((ratios**2).mean()), rel=1e-12)
    assert (errors.count, errors.count_b, errors.log_count, errors.log_dropped) == (6, 2, 6, 0)
    assert (errors.largest, errors.mean) == (4.0, 2.0)


def test_the_log_measure_says_what_it_left_out() -> None:
    measured = np.full((4, 3), 0.5)
    predicted = measured * 1.01
    measured[0, 0] = 1e-4  # not above the limit
    predicted[1, 1] = -0.2
    predicted[1, 2] = 9e-5
    valid = np.ones((4, 3), dtype=bool)
    valid[2, 0] = False
    angles = np.array([0.0, 30.0, 79.9, 80.1])
    errors = measure_errors(observations_of(measured, angles, valid), predicted)
    assert errors.count == 11
    assert errors.log_dropped_grazing == 3
    assert errors.log_dropped_measured == 1
    assert errors.log_dropped_predicted == 2
    assert errors.log_count == 11 - errors.log_dropped
    assert errors.rms_log == pytest.approx(math.log(1.01), rel=1e-12)


def test_values_that_are_masked_or_below_the_horizon_do_not_count() -> None:
    measured = np.full((3, 3), 0.5)
    valid = np.ones((3, 3), dtype=bool)
    valid[0] = False
    measured[0] = np.nan
    predicted = np.array([[9.0, 9.0, 9.0], [0.6, 0.6, 0.6], [7.0, 7.0, 7.0]])
    low = 90 - np.rad2deg(0.9 * HORIZON_COSINE)
    errors = measure_errors(observations_of(measured, np.array([0.0, 0.0, low]), valid), predicted)
    assert errors.count == 3
    assert errors.rms_absolute == pytest.approx(0.1, rel=1e-12)


def test_nothing_to_compare_gives_nan_and_valid_json() -> None:
    nothing = observations_of(np.ones((2, 3)), np.zeros(2), np.zeros((2, 3), dtype=bool))
    errors = measure_errors(nothing, np.ones((2, 3)))
    assert math.isnan(errors.rms_percent)
    assert errors.count == 0
    plain = json.loads(json.dumps(errors.as_dict(), allow_nan=False))
    assert plain["rms_log"] is None
    assert plain["count"] == 0


def test_black_has_no_relative_error() -> None:
    errors = measure_errors(observations_of(np.zeros((2, 3)), np.zeros(2)), np.zeros((2, 3)))
    assert errors.rms_absolute == 0.0
    assert math.isnan(errors.rms_percent)
    assert math.isnan(errors.rms_over_mean)


def test_pooling_is_the_rms_over_all_values(simulate: Simulate) -> None:
    rng = np.random.default_rng(3)
    scans = [simulate(SATIN, step=step) for step in (5, 9, 20)]
    predictions = [s.radiance + 0.01 * rng.normal(size=s.radiance.shape) for s in scans]
    each = [measure_errors(s, p) for s, p in zip(scans, predictions, strict=True)]
    together = measure_errors(Observations.concatenate(scans), np.concatenate(predictions))
    pooled = pool(each)
    assert pooled.scans == 3
    for name in ("rms_absolute", "rms_b", "rms_g", "rms_r", "rms_log", "mean", "largest"):
        assert getattr(pooled, name) == pytest.approx(getattr(together, name), rel=1e-12)
    for name in ("count", "count_r", "log_count", "log_dropped_grazing", "log_dropped_measured"):
        assert getattr(pooled, name) == getattr(together, name)


def test_pooling_keeps_each_scans_own_peak(simulate: Simulate) -> None:
    scan = simulate(SATIN, step=20)
    errors = measure_errors(scan, scan.radiance * 1.01)
    dull = replace(errors, rms_percent=3 * errors.rms_percent)
    expected = errors.rms_percent * math.sqrt((1 + 9) / 2)
    assert pool([errors, dull]).rms_percent == pytest.approx(expected, rel=1e-12)


def test_a_scan_without_a_measure_does_not_spoil_the_sample() -> None:
    black = measure_errors(observations_of(np.zeros((2, 3)), np.zeros(2)), np.full((2, 3), 0.1))
    white = measure_errors(observations_of(np.ones((2, 3)), np.zeros(2)), np.full((2, 3), 1.1))
    pooled = pool([black, white])
    assert pooled.rms_percent == pytest.approx(10.0, rel=1e-12)
    assert pooled.rms_absolute == pytest.approx(0.1, rel=1e-12)
    assert math.isnan(pool([black]).rms_log)


def test_bad_input() -> None:
    observations = observations_of(np.ones((2, 3)), np.zeros(2))
    with pytest.raises(ValueError, match=r"shape \(2, 2\), the observations \(2, 3\)"):
        measure_errors(observations, np.ones((2, 2)))
    with pytest.raises(ValueError, match=r"radiance\[1, 2\] is nan"):
        measure_errors(observations, np.array([[1, 1, 1], [1, 1, np.nan]]))
    with pytest.raises(ValueError, match="no error measures to pool"):
        pool([])


def test_one_scan_pools_to_itself(simulate: Simulate) -> None:
    scan = simulate(SATIN, step=20)
    errors = measure_errors(scan, scan.radiance + 0.01)
    pooled = pool([errors])
    for name, value in errors.as_dict().items():
        assert getattr(pooled, name) == pytest.approx(value, rel=1e-12)
    assert isinstance(pooled, ErrorMeasures)
