"""From frames to observations and grid: a synthetic rig with known truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.paths import CALIBRATION_FILE
from tvbrdf_fitting.geometry import light_world_angle_deg
from tvbrdf_fitting.measurement.calibration import Calibration, CameraCalibration, load_calibration
from tvbrdf_fitting.measurement.clock_model import fit_clock, frame_stamps
from tvbrdf_fitting.measurement.frame_reduction import FrameReducer
from tvbrdf_fitting.measurement.light_grid import merge_on_grid
from tvbrdf_fitting.measurement.light_path import LightPath
from tvbrdf_fitting.measurement.scan_merge import ScanObservations, assemble_scan
from tvbrdf_fitting.measurement.sweep_merge import (
    FrameRecord,
    SweepObservations,
    sweep_observations,
)
from tvbrdf_fitting.published import read_scan_file, scan_file_name

CALIBRATION = load_calibration(CALIBRATION_FILE)
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

UTC_NS = 1_800_000_000_123_456_789
SPEED_DEG_S = 15.0
RAMP_S = 0.3
SWEEP_S = 190.0 / SPEED_DEG_S + RAMP_S
EXPOSURES_MS = (0.2, 4.0, 32.0)
ARM_DELAY_NS = 1_500_000
REGION = 32


def sample_radiance(angle_deg: FloatArray, camera: int) -> FloatArray:
    """Diffuse reflection and, for the top camera mostly, a lobe; (n, 3)."""
    cosine = np.cos(np.deg2rad(angle_deg - 12.0))
    half = np.deg2rad(angle_deg - 24.0) / 2.0
    lobe = 1.6 / camera**2 * np.exp(-((half / 0.1) ** 2))
    return np.asarray(cosine[:, None] * np.array([0.1, 0.3, 0.6]) + lobe[:, None])


def arm_angle(time_s: FloatArray, direction: int) -> FloatArray:
    t = np.clip(time_s, 0.0, SWEEP_S)
    up, down = np.minimum(t, RAMP_S), np.maximum(t - (SWEEP_S - RAMP_S), 0.0)
    acceleration = SPEED_DEG_S / RAMP_S
    angle = -95.0 + acceleration * (up**2 - down**2) / 2 + SPEED_DEG_S * (t - up)
    return np.asarray(direction * angle)


@dataclass(frozen=True)
class Rig:
    """Synthetic frames with everything the merge has to undo."""

    calibration: Calibration
    random: np.random.Generator
    lamp: tuple[float, ...] = (1.0, 1.012, 0.991)
    gains: FloatArray | None = None
    jitter_ns: float = 5e5
    sample: Callable[[FloatArray, int], FloatArray] = sample_radiance

    def frame(
        self, camera: CameraCalibration, exposure_ms: float, sample: FloatArray, ref: FloatArray
    ) -> NDArray[np.uint16]:
        """One frame of the given radiances (3,), with the camera's noise, in codes."""
        scale = exposure_ms / np.array(camera.radiance_per_dn_per_ms)
        signal = np.empty((REGION, REGION, 3), dtype=np.float32)
        signal[: REGION * 7 // 8] = sample * scale
        signal[REGION * 7 // 8 :] = ref * scale
        variance = signal / camera.gain_e_per_dn
        variance += (camera.read_noise_e / camera.gain_e_per_dn) ** 2
        pixel = self.random.standard_normal(signal.shape, dtype=np.float32)
        signal += np.sqrt(variance) * pixel
        codes = np.clip(np.rint(signal + camera.black_level_dn), 0, 4095)
        return np.asarray(codes, dtype=np.uint16)

    def jitter(self, count: int) -> IntArray:
        return np.rint(self.random.exponential(self.jitter_ns, count)).astype(np.int64)

    def sweep(self, number: int, exposure_ms: float, direction: int) -> SweepObservations:
        start = UTC_NS + number * 20_000_000_000
        report = start + np.arange(-5, 660, dtype=np.int64) * 20_000_000
        ticks = (report - UTC_NS) - np.rint((report - UTC_NS) * 4e-5).astype(np.int64)
        received = report + ARM_DELAY_NS + self.jitter(report.size)
        arm_clock = fit_clock(ticks, received - ARM_DELAY_NS)
        path = LightPath.from_reports(
            arm_clock.to_run_ns(ticks), arm_angle((report - start) / 1e9, direction)
        )
        frames: list[FrameRecord] = []
        dark: list[FrameRecord] = []
        stamp_std = {}
        for camera in self.calibration.cameras:
            taken, std = self.camera_frames(camera, number, exposure_ms, direction, start)
            frames.extend(taken)
            stamp_std[camera.camera] = std
            reducer = FrameReducer(camera)
            nothing = np.zeros(3)
            dark.extend(
                FrameRecord(
                    camera=camera.camera,
                    sweep=number,
                    exposure_ms=exposure_ms,
                    stamp_ns=start - i,
                    statistics=reducer.reduce(self.frame(camera, exposure_ms, nothing, nothing)),
                    lamp_on=False,
                )
                for i in range(8)
            )
        self.random.shuffle(frames)
        return sweep_observations(
            frames,
            dark,
            path,
            self.calibration,
            camera_stamp_std_ns=stamp_std,
            arm_stamp_std_ns=float(np.median(arm_clock.std_ns(ticks))),
        )

    def camera_frames(
        self,
        camera: CameraCalibration,
        number: int,
        exposure_ms: float,
        direction: int,
        start: int,
    ) -> tuple[list[FrameRecord], float]:
        phase = round(self.random.uniform(0.0, 3.3e7))
        middle = start + phase + np.arange(385, dtype=np.int64) * 33_333_333
        half, drift = round(exposure_ms * 5e5), -3e-5 * camera.camera
        device = middle - UTC_NS - np.rint((middle - UTC_NS) * drift).astype(np.int64) + 42
        delay = round(camera.frame_delay_ms * 1e6)
        stamps = frame_stamps(
            device + half, middle + half + delay + self.jitter(385), exposure_ms, camera
        )
        angle = arm_angle((middle - start) / 1e9, direction)
        cosine = np.maximum(np.cos(np.deg2rad(angle - 12.0)), 0.0)
        sample = np.maximum(self.sample(angle, camera.camera), 0.0)
        for low, high in camera.hidden_light_intervals_deg:
            sample[(angle >= low) & (angle <= high)] = 0.5
        reference = cosine[:, None] * np.array(self.calibration.reference_albedo)
        gain = 1.0 if self.gains is None else self.gains[camera.camera - 1]
        flicker = 1.0 + camera.relative_noise_std * self.random.standard_normal(385)
        flicker *= self.lamp[number - 1]
        reducer = FrameReducer(camera)
        frames = [
            FrameRecord(
                camera=camera.camera,
                sweep=number,
                exposure_ms=exposure_ms,
                stamp_ns=int(stamps.stamp_ns[i]),
                statistics=reducer.reduce(
                    self.frame(
                        camera,
                        exposure_ms,
                        sample[i] * flicker[i] * gain,
                        reference[i] * flicker[i] * gain,
                    )
                ),
            )
            for i in range(385)
        ]
        return frames, float(np.median(stamps.clock.std_ns(device)))

    def scan(self) -> list[SweepObservations]:
        return [
            self.sweep(number, exposure, 1 if number % 2 else -1)
            for number, exposure in enumerate(EXPOSURES_MS, start=1)
        ]


@pytest.fixture(scope="module")
def sweeps() -> list[SweepObservations]:
    random = np.random.default_rng(20240611)
    gains = 1.0 + 0.005 * random.standard_normal((4, 3))
    return Rig(CALIBRATION, random, gains=gains).scan()


@pytest.fixture(scope="module")
def scan(sweeps: list[SweepObservations]) -> ScanObservations:
    return assemble_scan(sweeps, CALIBRATION)


def errors(scan: ScanObservations) -> FloatArray:
    """Measured less true radiance, (n, 3)."""
    true = np.empty_like(scan.radiance)
    for camera in (1, 2, 3, 4):
        rows = scan.camera == camera
        true[rows] = sample_radiance(scan.light_angle_deg[rows], camera)
    return scan.radiance - true


def test_observations_agree_with_truth_within_their_deviation(scan: ScanObservations) -> None:
    """Flicker is common to a frame's channels, so each channel is looked at by itself."""
    error = errors(scan)
    lamp_std = scan.sweep_lamp_factor_std[scan.sweep - 1, scan.camera - 1]
    shared = (lamp_std * scan.radiance) ** 2
    for sweep in scan.sweep_number:
        for channel in range(3):
            used = scan.valid[:, channel] & (scan.sweep == sweep)
            variance = (scan.variance + shared)[used, channel]
            count = np.count_nonzero(used)
            assert count > 150
            chi_square = np.mean(error[used, channel] ** 2 / variance)
            # 4.4 deviations (1e-5, two-sided) of independent errors, and as many of the lamp
            # factors', which all frames of a camera share (4 in a sweep)
            share = np.mean(shared[used, channel] / variance)
            allowed = np.sqrt(2.0 / count) + share * np.sqrt(2.0 / 4.0)
            assert abs(chi_square - 1.0) < 4.4 * allowed
            assert share < 0.15


def test_grid_agrees_with_truth_within_its_deviation(scan: ScanObservations) -> None:
    """Positions four apart share no sample of the middle sweep, which weighs most."""
    grid = merge_on_grid(scan, CALIBRATION)
    assert grid.valid.any(axis=2).sum(axis=1).tolist() == [329, 336, 336, 336]
    total, count, worst = 0.0, 0, 0.0
    for index in range(4):
        true = sample_radiance(grid.light_angle_deg, index + 1)
        valid = grid.valid[index, :, 1]
        error = (grid.radiance[index] - true)[:, 1][valid]
        worst = max(worst, float(np.max(np.abs(error))))
        z = (error / np.sqrt(grid.variance[index, valid, 1]))[::4]
        total, count = total + float(np.sum(z**2)), count + z.size
    assert count > 300
    # and some per cent from the lamp factors, which are shared errors, not in this variance
    assert abs(total / count - 1.0) < 4.4 * np.sqrt(2.0 / count) + 0.05
    # largest value 1.8: five deviations of 1e-3 at most, 0.5 %
    assert worst < 5.0 * 1.2e-3 * 1.8


@pytest.mark.parametrize(
    "material", ["paper_white", "satin_rosaline", "vch_golden_yellow", "cc_ibiza_sunset"]
)
def test_measured_materials_come_back_from_the_grid(shared_data: Path, material: str) -> None:
    """Real reflectance put under the synthetic rig: within 1 % of the largest value everywhere."""
    folder = shared_data / "rgl_on_rig" / material / "tvBrdf-data"
    curves = {camera: read_scan_file(folder / scan_file_name(1, camera)) for camera in (1, 2, 3, 4)}
    lights = {n: light_world_angle_deg(curve.light_direction) for n, curve in curves.items()}

    def sample(angle_deg: FloatArray, camera: int) -> FloatArray:
        columns = curves[camera].radiance.T
        return np.stack([np.interp(angle_deg, lights[camera], c) for c in columns], axis=1)

    rig = Rig(CALIBRATION, np.random.default_rng(77), sample=sample)
    grid = merge_on_grid(assemble_scan(rig.scan(), CALIBRATION), CALIBRATION)
    largest = max(float(curve.radiance.max()) for curve in curves.values())
    for index, camera in enumerate(curves):
        place = np.rint((lights[camera] + 90.0) * 2.0).astype(int)
        assert grid.valid[index, place].all()
        error = np.abs(grid.radiance[index, place] - curves[camera].radiance)
        assert error.max() < 0.01 * largest


def test_lamp_and_gain_are_found_from_the_reference(sweeps: list[SweepObservations]) -> None:
    random = np.random.default_rng(20240611)
    gains = 1.0 + 0.005 * random.standard_normal((4, 3))
    for sweep, lamp in zip(sweeps, (1.0, 1.012, 0.991), strict=True):
        assert sweep.lamp_measured.all()
        z = (sweep.lamp_factor / (lamp * gains) - 1.0) / sweep.lamp_factor_std
        assert np.max(np.abs(z)) < 4.4
        # 0.2 ms: dark level to 0.06 dn (8 frames of 128 pixels) under a mean of 80 dn, 8e-4;
        # 4 ms: flicker and shot noise of 1.7e-3 in 300 frames, 1e-4; 32 ms: 20 grazing frames
        limits = {0.2: 1e-3, 4.0: 2e-4, 32.0: 4e-4}
        assert np.max(sweep.lamp_factor_std) < limits[sweep.exposure_ms]


def test_without_a_reference_the_constants_uncertainty_stands() -> None:
    cameras = tuple(replace(camera, reference_patch=None) for camera in CALIBRATION.cameras)
    calibration = replace(CALIBRATION, cameras=cameras)
    rig = Rig(calibration, np.random.default_rng(1), lamp=(1.0, 1.0, 1.0))
    scan = assemble_scan([rig.sweep(2, 4.0, 1)], calibration)
    assert np.all(scan.sweep_lamp_factor == 1.0)
    assert np.all(scan.gain_relative_std == 0.005)
    used = scan.valid[:, 0]
    chi_square = np.mean((errors(scan) ** 2 / scan.variance)[used, 0])
    assert abs(chi_square - 1.0) < 4.4 * np.sqrt(2.0 / np.count_nonzero(used))


def test_with_a_reference_its_own_uncertainty_is_left(
    sweeps: list[SweepObservations], scan: ScanObservations
) -> None:
    # the mean of the lamp factors is at most as uncertain as the best of them
    assert np.all(scan.gain_relative_std > 0.0)
    assert np.all(scan.gain_relative_std <= scan.sweep_lamp_factor_std.min(axis=0))
    certified = assemble_scan(sweeps, replace(CALIBRATION, reference_relative_std=0.003))
    np.testing.assert_allclose(certified.gain_relative_std, 0.003, rtol=0.01)


def test_rows_are_where_and_when_they_say(scan: ScanObservations) -> None:
    order = np.lexsort((scan.stamp_ns, scan.sweep, scan.camera))
    assert np.array_equal(order, np.arange(scan.camera.size))
    assert np.all(np.abs(scan.light_angle_deg) <= 90.0)
    assert np.all(scan.light_direction[:, 2] >= 1e-3)
    top = scan.camera == 1
    clear = np.abs(scan.light_angle_deg[top]) - scan.swept_deg[top] / 2
    assert clear.min() > 1.75
    cruising = np.abs(scan.light_angle_deg) < 85.0
    np.testing.assert_allclose(
        scan.swept_deg[cruising], 0.015 * scan.exposure_ms[cruising], rtol=0.01
    )
    assert np.array_equal(scan.view_direction, CALIBRATION.view_directions[scan.camera - 1])
    assert scan.sweep_direction.tolist() == [1, -1, 1]
    assert scan.sweep_exposure_ms.tolist() == list(EXPOSURES_MS)
    assert set(scan.dropped) == {"below_horizon", "hidden", "out_of_range"}


def test_light_offset_deviations_come_from_the_clocks(scan: ScanObservations) -> None:
    # clock models are good to some microseconds: 1e-6 s * 15 deg/s
    for std in (scan.sweep_light_offset_std_deg, scan.sweep_camera_offset_std_deg):
        assert np.all((std > 1e-6) & (std < 5e-4))
    combined = scan.light_angle_std_deg
    assert list(combined) == [1, 2, 3]
    own = np.sqrt(np.mean(scan.sweep_camera_offset_std_deg[2] ** 2))
    assert combined[3] == pytest.approx(np.hypot(scan.sweep_light_offset_std_deg[2], own))


def test_nothing_depends_on_arrival_order(
    sweeps: list[SweepObservations], scan: ScanObservations
) -> None:
    again = assemble_scan(reversed(sweeps), CALIBRATION)
    for field in fields(ScanObservations):
        if field.name != "dropped":
            assert np.array_equal(getattr(again, field.name), getattr(scan, field.name))
    assert again.dropped == scan.dropped


def test_rows_as_the_fit_takes_them(scan: ScanObservations) -> None:
    observations = scan.observations()
    assert len(observations) == scan.camera.size
    assert np.array_equal(observations.usable, scan.valid)
    assert observations.time_s.min() == 0.0
    # three sweeps, 20 s apart
    assert 40.0 < observations.time_s.max() < 60.0
    shifted = scan.observations(int(scan.stamp_ns.min()) - 5_000_000_000)
    np.testing.assert_allclose(shifted.time_s, observations.time_s + 5.0, atol=1e-9)


def test_a_sweep_without_its_own_lamp_factor_takes_the_others(
    sweeps: list[SweepObservations],
) -> None:
    blind = replace(
        sweeps[2],
        radiance=sweeps[2].radiance * 1.005,
        lamp_factor=np.ones((4, 3)),
        lamp_factor_std=np.zeros((4, 3)),
        lamp_measured=np.zeros((4, 3), dtype=np.bool_),
    )
    found = assemble_scan([sweeps[0], sweeps[1], blind], CALIBRATION)
    first, second, borrowed = found.sweep_lamp_factor
    assert np.all((borrowed > np.minimum(first, second)) & (borrowed < np.maximum(first, second)))
    # it may be as far off as the others are apart
    assert np.all(found.sweep_lamp_factor_std[2] >= 0.5 * np.abs(first - second))
    rows, column = found.sweep == 3, found.camera[found.sweep == 3] - 1
    np.testing.assert_allclose(
        found.radiance[rows] * borrowed[column],
        blind.radiance[np.lexsort((blind.stamp_ns, blind.camera))],
        rtol=1e-12,
    )
    untouched = assemble_scan(sweeps, CALIBRATION)
    others = found.sweep != 3
    assert np.array_equal(found.radiance[others], untouched.radiance[untouched.sweep != 3])


def test_sweeps_that_are_no_scan_are_refused(sweeps: list[SweepObservations]) -> None:
    with pytest.raises(ValueError, match=r"sweeps \[1, 1\]"):
        assemble_scan([sweeps[0], sweeps[0]], CALIBRATION)
    with pytest.raises(ValueError, match=r"sweeps \[\]"):
        assemble_scan([], CALIBRATION)
