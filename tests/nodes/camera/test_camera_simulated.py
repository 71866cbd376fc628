"""The simulated camera on simulated time: when frames come, faults, the driver interface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.nodes.camera.simulated_frames import TAG, MakeBench, middle_ns
from tvbrdf_messages.messages import SimGrant
from tvbrdf_nodes.camera.conformance import check_camera_driver
from tvbrdf_nodes.camera.driver import CameraSettings, RawFrame
from tvbrdf_nodes.camera.simulated_bench import (
    STEP_NS,
    ZERO_NS,
    SimulatedBench,
    sweeping_light,
)
from tvbrdf_nodes.camera.simulated_image import SimulatedCameraParameters
from tvbrdf_nodes.core.device import DeviceError
from tvbrdf_nodes.world.sample import make_sample
from tvbrdf_nodes.world.scene import CameraEffects, Scene

REALISTIC = CameraEffects(
    shot_noise=True,
    read_noise=True,
    quantisation=True,
    motion_blur=True,
    clock_offset_s=5.0,
    clock_drift_ppm=30.0,
    jitter_ms=0.5,
    relative_noise_std=0.001,
    gain_error_std=0.002,
)


def test_frames_run_on_the_cameras_own_clock(make_bench: MakeBench) -> None:
    """Drift and offset are those drawn; frames are a period of that clock apart, to rounding."""
    effects = CameraEffects(clock_offset_s=5.0, clock_drift_ppm=200.0)
    drifts, phases = [], []
    for camera in (1, 2, 3, 4):
        frames = make_bench(effects, camera=camera).frames(300, TAG)
        hardware = np.array([frame.hardware_ns for frame in frames])
        middle = np.array([middle_ns(frame) for frame in frames])
        assert np.abs(np.diff(hardware) - 1e9 / 30.0).max() <= 2.0
        drifts.append(float(np.polyfit(middle - ZERO_NS, hardware - hardware[0], 1)[0]) - 1.0)
        phases.append(((middle[0] - ZERO_NS) * 30e-9) % 1.0)
    assert len({round(1e9 * drift) for drift in drifts}) == 4
    assert max(abs(drift) for drift in drifts) < 5 * 200e-6
    assert len({round(1e3 * phase) for phase in phases}) == 4


def test_frames_arrive_after_exposure_delay_and_jitter(make_bench: MakeBench) -> None:
    """Delay 5 ms after the end of exposure, plus an exponential delay with the mean told."""
    bench = make_bench(CameraEffects(jitter_ms=0.8), sensor={"frame_rate_hz": 25.0})
    frames = bench.frames(400, TAG)
    clean = make_bench(sensor={"frame_rate_hz": 25.0}).frames(400, TAG)
    late_ms = np.array(
        [(a.received_ns - b.received_ns) * 1e-6 for a, b in zip(frames, clean, strict=True)]
    )
    assert late_ms.min() >= 0.0
    assert abs(late_ms.mean() / 0.8 - 1.0) < 3.89 / np.sqrt(400)
    assert abs(late_ms.std() / 0.8 - 1.0) < 3.89 * np.sqrt(2.0 / 400)  # kurtosis of 9
    period_ns = np.diff([frame.received_ns for frame in clean])
    assert np.abs(period_ns - 40_000_000).max() <= 1


def test_long_exposures_slow_the_camera_down(make_bench: MakeBench) -> None:
    bench = make_bench(exposure_ms=100.0)
    frames = bench.frames(5, TAG)
    assert np.diff([f.received_ns for f in frames]) == pytest.approx(1e8, abs=1)


def test_no_frame_of_before_start_and_none_beyond_the_grant(make_bench: MakeBench) -> None:
    bench = make_bench()
    for _ in range(5):
        bench.advance()
        bench.read()
    bench.driver.start(TAG)
    for _ in range(8):
        began_ns = bench.granted_ns
        bench.advance()
        frames = bench.read()
        assert frames
        assert all(middle_ns(f) - 2_000_000 >= ZERO_NS + 5 * STEP_NS for f in frames)
        assert all(began_ns < f.received_ns <= bench.granted_ns for f in frames)


def test_horizon_follows_the_grant_and_comes_after_the_frames(make_bench: MakeBench) -> None:
    bench = make_bench()
    bench.advance()
    assert bench.read() == []
    assert [(h.until_ns, h.idle) for h in bench.horizons] == [(ZERO_NS + STEP_NS, True)]
    bench.driver.start(TAG)
    bench.advance(1_000_000_000)
    first = bench.driver.read()
    assert 0 < len(first) <= 4
    assert bench.driver.pending()
    rest = bench.read()
    assert len(first) + len(rest) >= 29
    # told only when the last frames had been handed over
    assert [h.until_ns for h in bench.horizons] == [ZERO_NS + STEP_NS, bench.granted_ns]
    assert not bench.horizons[-1].idle


def test_waits_for_the_lights_motion(make_bench: MakeBench) -> None:
    bench = make_bench()
    bench.driver.start(TAG)
    bench._world.publish("/sim/grant", SimGrant(until_ns=ZERO_NS + STEP_NS), stamp_ns=ZERO_NS)
    assert bench.driver.read() == []
    assert not bench.driver.pending()
    assert bench.read() == []
    assert bench.horizons == []
    bench.advance()
    assert len(bench.read()) >= 2
    assert bench.horizons[-1].until_ns == bench.granted_ns


def test_trigger_takes_one_frame_each(make_bench: MakeBench) -> None:
    bench = make_bench()
    settings = CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0, mode="trigger")
    bench.driver.configure(settings)
    bench.driver.start(TAG)
    bench.advance()
    assert bench.read() == []
    bench.driver.trigger()
    bench.driver.trigger()
    bench.advance()
    frames = bench.read()
    assert [frame.frame_id for frame in frames] == [0, 1]
    assert frames[1].received_ns - frames[0].received_ns >= 4_000_000
    bench.advance()
    assert bench.read() == []


def test_sample_changes_during_a_scan_only_when_told(folder: Path) -> None:
    """Frames show the sample at the scan's time, or at their own."""
    spec = {"kind": "measured", "path": str(folder)}
    asked: list[float] = []

    class Watched:
        """The real sample, with a note of the times that it is asked for."""

        def __init__(self) -> None:
            self._sample = make_sample(spec)

        def radiance(self, camera: int, angle: Any, time_s: float, scan: int) -> Any:
            asked.append(time_s)
            return self._sample.radiance(camera, angle, time_s, scan)

    tag = replace(TAG, scan_time_s=100.0, scan_start_ns=ZERO_NS)
    for evolves in (False, True):
        asked.clear()
        scene = Scene(sample=spec, evolves_during_scan=evolves)
        bench = SimulatedBench(scene, SimulatedCameraParameters(camera=2, width=8, height=8))
        bench.open()
        bench.driver._world.view._sample = Watched()  # type: ignore[union-attr]
        frames = bench.frames(30, tag)
        if evolves:
            times = [100.0 + (middle_ns(frame) - ZERO_NS) * 1e-9 for frame in frames]
            assert asked[:30] == pytest.approx(times, abs=1e-6)
        else:
            assert set(asked) == {100.0}


# -- determinism


def test_same_keys_give_the_same_frames(make_bench: MakeBench) -> None:
    first = make_bench(REALISTIC).frames(40, TAG)
    again = make_bench(REALISTIC).frames(40, TAG)
    for one, other in zip(first, again, strict=True):
        assert np.array_equal(one.image, other.image)
        assert one[1:] == other[1:]


def test_frames_do_not_depend_on_how_time_is_granted(make_bench: MakeBench) -> None:
    motion = sweeping_light(-40.0, 15.0)
    first = make_bench(REALISTIC, motion).frames(40, TAG)
    bench = make_bench(REALISTIC, motion)
    bench.driver.start(TAG)
    second: list[RawFrame] = []
    for step_ns in (7_000_000, 333_000_000, 1_000_000_000, 1_000_000):
        bench.advance(step_ns)
        second += bench.read()
    for one, other in zip(first, second, strict=False):
        assert np.array_equal(one.image, other.image)
        assert one[1:] == other[1:]
    assert len(second) > 30


@pytest.mark.parametrize(
    "change",
    [{"scan": 2}, {"sweep": 3}, {"attempt": 2}, {"lamp": False}],
)
def test_other_keys_give_other_noise(make_bench: MakeBench, change: dict[str, Any]) -> None:
    one = make_bench(REALISTIC).frames(1, TAG)[0].image
    other = make_bench(REALISTIC).frames(1, replace(TAG, **change))[0].image
    assert not np.array_equal(one, other)


# -- faults


def ids(frames: list[RawFrame]) -> list[int]:
    return [frame.frame_id for frame in frames]


def faulty(make_bench: MakeBench, *faults: dict[str, Any], **more: Any) -> SimulatedBench:
    return make_bench(CameraEffects(faults=faults), **more)


def test_dropped_frame(make_bench: MakeBench) -> None:
    bench = faulty(make_bench, {"kind": "drop", "frame": 3, "count": 2})
    assert ids(bench.frames(5, TAG)) == [0, 1, 2, 5, 6]


def test_repeated_frame(make_bench: MakeBench) -> None:
    bench = faulty(make_bench, {"kind": "repeat", "frame": 2})
    assert ids(bench.frames(5, TAG)) == [0, 1, 2, 2, 3]


def test_reordered_frames(make_bench: MakeBench) -> None:
    bench = faulty(make_bench, {"kind": "reorder", "frame": 1})
    assert ids(bench.frames(5, TAG)) == [0, 2, 1, 3, 4]


def test_camera_that_falls_silent_still_tells_its_horizon(make_bench: MakeBench) -> None:
    bench = faulty(make_bench, {"kind": "stop", "frame": 4, "attempt": 1})
    bench.driver.start(TAG)
    bench.advance(1_000_000_000)
    assert ids(bench.read()) == [0, 1, 2, 3]
    assert bench.horizons[-1].until_ns == bench.granted_ns
    bench.driver.stop()
    assert len(bench.frames(10, replace(TAG, attempt=2))) == 10


def test_wrong_exposure_is_read_back(make_bench: MakeBench) -> None:
    bench = faulty(make_bench, {"kind": "wrong_exposure", "exposure_ms": 2.0, "factor": 1.5})
    read_back = [
        bench.driver.configure(CameraSettings(exposure_ms=ms, frame_rate_hz=30.0)).exposure_ms
        for ms in (1.0, 2.0, 2.0)
    ]
    assert read_back == [1.0, 3.0, 2.0]


def test_stale_frames_have_the_earlier_exposure(make_bench: MakeBench) -> None:
    bench = faulty(make_bench, {"kind": "stale", "count": 2})
    before = bench.frames(1, TAG)[0]
    bench.driver.configure(CameraSettings(exposure_ms=1.0, frame_rate_hz=30.0))
    frames = bench.frames(4, TAG)
    assert [frame.exposure_ms for frame in frames] == [4.0, 4.0, 1.0, 1.0]
    assert np.array_equal(frames[0].image, before.image)
    assert frames[2].image.max() < before.image.max()


def test_faults_of_other_cameras_and_scans_do_not_strike(make_bench: MakeBench) -> None:
    faults = ({"kind": "drop", "camera": 3}, {"kind": "drop", "scan": 7})
    assert ids(faulty(make_bench, *faults).frames(3, TAG)) == [0, 1, 2]


@pytest.mark.parametrize(
    ("fault", "text"),
    [({"kind": "explode"}, "expected one of drop"), ({"kind": "drop", "frames": 2}, "frame'")],
)
def test_unknown_faults_are_refused(
    make_bench: MakeBench, fault: dict[str, Any], text: str
) -> None:
    with pytest.raises(DeviceError, match=f"camera fault 1: .*{text}"):
        faulty(make_bench, fault)


# -- the driver interface


@pytest.mark.parametrize("effects", [CameraEffects(), REALISTIC])
def test_conforms(make_bench: MakeBench, effects: CameraEffects) -> None:
    bench = make_bench(effects)
    assert check_camera_driver(bench.driver, wait=bench.wait) == []


def test_conformance_finds_a_camera_that_drops_and_lies(make_bench: MakeBench) -> None:
    faults = ({"kind": "drop", "frame": 1}, {"kind": "wrong_exposure", "factor": 2.0, "count": 99})
    bench = faulty(make_bench, *faults)
    findings = check_camera_driver(bench.driver, wait=bench.wait, timeout_s=0.5)
    found = {finding.check for finding in findings}
    assert {"exposure_read_back", "free_run"} <= found


def test_settings_do_not_change_during_a_capture(make_bench: MakeBench) -> None:
    bench = make_bench()
    bench.driver.start(TAG)
    with pytest.raises(DeviceError, match="during a capture"):
        bench.driver.configure(CameraSettings(exposure_ms=1.0, frame_rate_hz=30.0))


def test_scene_whose_sample_is_missing_is_an_error(tmp_path: Path) -> None:
    scene = Scene(sample={"kind": "measured", "path": str(tmp_path)})
    bench = SimulatedBench(scene, SimulatedCameraParameters(camera=1))
    with pytest.raises(DeviceError, match="tvBrdf-data"):
        bench.open()


def test_measured_sample_has_no_near_field(make_bench: MakeBench) -> None:
    with pytest.raises(DeviceError, match="near_field needs an analytic sample"):
        make_bench(CameraEffects(near_field=True))


@pytest.mark.parametrize(
    "wrong",
    [
        {"camera": 5},
        {"bit_depth": 7},
        {"frame_rate_hz": 0.0},
        {"dn_per_radiance_ms": (1.0, 2.0)},
        {"response": "log"},
        {"full_well_e": 0.0},
        {"black_level_dn": 5000.0},
    ],
)
def test_impossible_cameras_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        SimulatedCameraParameters(**{"camera": 1, **wrong})
