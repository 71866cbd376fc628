"""Clock models from one-sided delays: accuracy, stated deviation, robustness, steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.paths import CALIBRATION_FILE
from tvbrdf_fitting.measurement.calibration import HardwareStampEvent, load_calibration
from tvbrdf_fitting.measurement.clock_model import (
    ClockError,
    ClockStepError,
    fit_clock,
    frame_stamps,
    one_way_delay_ns,
)

UTC_NS = 1_800_000_000_123_456_789
JITTER_NS = 5e5
SWEEP_NS = 12_000_000_000

IntArray = NDArray[np.int64]


def stamps(count: int, drift: float, offset_ns: int = 987_654_321) -> tuple[IntArray, IntArray]:
    """True times on the run's clock over one sweep, and the device's stamps of them."""
    elapsed = np.arange(count, dtype=np.int64) * (SWEEP_NS // count)
    device = elapsed - np.rint(elapsed * (drift / (1.0 + drift))).astype(np.int64)
    return UTC_NS + elapsed, device + offset_ns


@given(
    count=st.integers(8, 200),
    drift=st.floats(-9e-4, 9e-4),
    offset_ns=st.integers(-(2**61), 2**61),
    latency_ns=st.integers(0, 10**9),
)
@settings(deadline=None)
def test_without_jitter_every_stamp_is_exact(
    count: int, drift: float, offset_ns: int, latency_ns: int
) -> None:
    true, hardware = stamps(count, drift, offset_ns)
    clock = fit_clock(hardware, true + latency_ns)
    # stamps are rounded to 1 ns when made, at the line's two ends, and when converted
    assert np.max(np.abs(clock.to_run_ns(hardware) - true - latency_ns)) <= 4
    assert clock.drift == pytest.approx(drift, abs=4.0 / SWEEP_NS * 2)


def test_accuracy_and_stated_deviation_with_exponential_jitter() -> None:
    """600 stamps in 12 s, mean jitter 0.5 ms, 50 ppm: 400 sweeps, looked at all along the sweep."""
    random = np.random.default_rng(2024)
    true, hardware = stamps(600, 5e-5)
    at = np.linspace(0, 599, 9).astype(int)
    errors, stated = [], []
    for _ in range(400):
        jitter = np.rint(random.exponential(JITTER_NS, 600)).astype(np.int64)
        clock = fit_clock(hardware, true + jitter)
        errors.append((clock.to_run_ns(hardware) - true)[at])
        stated.append(clock.std_ns(hardware[at]))
    error, std = np.array(errors, dtype=np.float64), np.array(stated)
    assert np.all(3.0 * std < 20e3)
    # the error has exponential tails (kurtosis about 6): the mean of 400 squares has a relative
    # deviation of sqrt(5 / 400) = 0.11; 4.4 of them
    assert np.all(np.abs(np.mean((error / std) ** 2, axis=0) - 1.0) < 0.5)
    assert np.all(np.abs(np.mean(error, axis=0)) < 4.4 * np.std(error, axis=0) / np.sqrt(400))
    # exponential tails: exp(-3) to exp(-3 sqrt 2) lie outside of 3 deviations, not 0.3 %
    assert np.mean(np.abs(error) > 3.0 * std) < 0.05


@given(drift=st.floats(-5e-4, 5e-4), seed=st.integers(0, 2**32), share=st.floats(0.0, 0.3))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_late_outliers_do_not_move_the_line(drift: float, seed: int, share: float) -> None:
    random = np.random.default_rng(seed)
    true, hardware = stamps(600, drift)
    jitter = random.exponential(JITTER_NS, 600)
    late = random.random(600) < share
    jitter[late] += random.uniform(1e7, 3e9, np.count_nonzero(late))
    clock = fit_clock(hardware, true + np.rint(jitter).astype(np.int64))
    error = clock.to_run_ns(hardware) - true
    # 420 prompt stamps are left at least: scale 0.5 ms / 420; 15 of the stated deviations
    assert np.all(np.abs(error) < 15.0 * np.sqrt(2.0 + 4.6 * 3.0) * JITTER_NS / 420)


@pytest.mark.parametrize("first", [100, 300, 480])
def test_a_burst_of_late_stamps_is_no_step(first: int) -> None:
    """A tenth of the sweep in which the computer was busy and everything came 20 ms late."""
    random = np.random.default_rng(first)
    true, hardware = stamps(600, 5e-5)
    jitter = random.exponential(JITTER_NS, 600)
    jitter[first : first + 60] += 2e7
    clock = fit_clock(hardware, true + np.rint(jitter).astype(np.int64))
    assert np.max(np.abs(clock.to_run_ns(hardware) - true)) < 20e3


def test_order_and_repeated_stamps_do_not_matter() -> None:
    random = np.random.default_rng(7)
    true, hardware = stamps(300, -2e-5)
    received = true + np.rint(random.exponential(JITTER_NS, 300)).astype(np.int64)
    expected = fit_clock(hardware, received)
    order = random.permutation(np.concatenate([np.arange(300), np.arange(50)]))
    again = np.concatenate([received, received[:50] + 10**7])
    assert fit_clock(np.concatenate([hardware, hardware[:50]])[order], again[order]) == expected


@pytest.mark.parametrize("step_ms", [1.0, -1.0, 5.0, -5.0, 400.0, -400.0])
@pytest.mark.parametrize("at", [30, 150, 300, 450, 570])
def test_steps_of_twice_the_jitter_are_detected(step_ms: float, at: int) -> None:
    for seed in range(5):
        random = np.random.default_rng(seed)
        true, hardware = stamps(600, 5e-5)
        hardware[at:] += round(step_ms * 1e6)
        received = true + np.rint(random.exponential(JITTER_NS, 600)).astype(np.int64)
        with pytest.raises(ClockStepError, match="clock stepped by"):
            fit_clock(hardware, received)


@pytest.mark.parametrize("kind", ["exponential", "uniform", "gamma", "lognormal", "usb_frames"])
def test_no_step_is_seen_where_there_is_none(kind: str) -> None:
    """500 sweeps each; a false alarm in 1e9 is what the threshold allows."""
    random = np.random.default_rng(99)
    draw: Callable[[], NDArray[np.float64]] = {
        "exponential": lambda: random.exponential(JITTER_NS, 600),
        "uniform": lambda: random.uniform(0.0, 1e6, 600),
        "gamma": lambda: random.gamma(2.0, 2.5e5, 600),
        "lognormal": lambda: 1e5 * random.lognormal(1.0, 1.0, 600),
        "usb_frames": lambda: random.exponential(2e4, 600) + 1e6 * random.integers(0, 2, 600),
    }[kind]
    true, hardware = stamps(600, -3e-5)
    for _ in range(500):
        fit_clock(hardware, true + np.rint(draw()).astype(np.int64))


def test_a_coarse_tick_is_no_step() -> None:
    """A controller that counts milliseconds, 0.05 ms of jitter, reports every 20 ms."""
    random = np.random.default_rng(3)
    true, hardware = stamps(600, 4e-5, 987_200_000)
    ticks = hardware // 1_000_000 * 1_000_000
    received = true + np.rint(random.exponential(5e4, 600)).astype(np.int64)
    with pytest.raises(ClockStepError):
        fit_clock(ticks, received)
    clock = fit_clock(ticks, received, resolution_ns=1e6)
    assert np.max(np.abs(clock.to_run_ns(ticks) - true)) < 2e6


def test_wrong_stamps_are_refused() -> None:
    true, hardware = stamps(100, 0.0)
    with pytest.raises(ClockError, match=r"7 different stamps are too few .* needs 8"):
        fit_clock(hardware[:7], true[:7])
    with pytest.raises(ClockError, match="100 hardware stamps for 99"):
        fit_clock(hardware, true[:99])
    with pytest.raises(ClockError, match="float64 cannot hold UTC"):
        fit_clock(hardware.astype(np.float64), true)
    with pytest.raises(ClockError, match="check the unit of its stamps"):
        fit_clock(hardware // 1000, true)


@pytest.mark.parametrize(
    ("event", "share"), [("exposure_start", -0.5), ("exposure_middle", 0.0), ("exposure_end", 0.5)]
)
def test_frame_stamps_are_the_middle_of_the_exposure(
    event: HardwareStampEvent, share: float
) -> None:
    camera = replace(
        load_calibration(CALIBRATION_FILE).camera(2), hardware_stamp_event=event, frame_delay_ms=3.0
    )
    random = np.random.default_rng(1)
    exposure_ms = 32.0
    middle, device_middle = stamps(360, 5e-5)
    hardware = device_middle + round(share * exposure_ms * 1e6)
    received = middle + round((exposure_ms / 2 + 3.0) * 1e6)
    received = received + np.rint(random.exponential(JITTER_NS, 360)).astype(np.int64)
    found = frame_stamps(hardware, received, exposure_ms, camera)
    assert np.max(np.abs(found.stamp_ns - middle)) < 20e3
    # the deviation has the frame delay's, 0.02 ms, besides the clock model's
    assert np.all(found.std_ns >= 20e3)
    assert np.all(found.std_ns < 25e3)
    with pytest.raises(ClockError, match="camera 2: 3 different stamps"):
        frame_stamps(hardware[:3], received[:3], exposure_ms, camera)


def test_latency_from_round_trips() -> None:
    random = np.random.default_rng(5)
    sent = UTC_NS + np.arange(400, dtype=np.int64) * 10_000_000
    forth = 80_000 + np.rint(random.exponential(2e5, 400)).astype(np.int64)
    back = 100_000 + np.rint(random.exponential(2e5, 400)).astype(np.int64)
    device_offset = 5_000_000_000
    found = one_way_delay_ns(sent, sent + forth - device_offset, sent + forth + back)
    assert found.round_trip_ns == np.min(forth + back)
    # whatever the shares of the fastest round trip: at most half of it off
    assert abs(found.delay_ns - 100_000) <= found.round_trip_ns / 2
    assert abs(found.offset_ns - device_offset) <= found.round_trip_ns / 2 + 1
    assert found.std_ns == pytest.approx(found.round_trip_ns / np.sqrt(12.0))
    with pytest.raises(ClockError, match="0 sent, 0 stamped, 0 received"):
        one_way_delay_ns([], [], [])
    with pytest.raises(ClockError, match="round trip 0: answered 5 ns before"):
        one_way_delay_ns([10], [3], [5])
