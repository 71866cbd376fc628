"""Grid of light positions: counts, exactness, gaps, clipped light, variances, lobe error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.paths import CALIBRATION_FILE
from tvbrdf_fitting.geometry import light_direction
from tvbrdf_fitting.measurement.calibration import Calibration, load_calibration
from tvbrdf_fitting.measurement.light_grid import (
    Interpolated,
    Stencils,
    grid_angles_deg,
    merge_on_grid,
    visible_positions,
)
from tvbrdf_fitting.measurement.scan_merge import ScanObservations

FloatArray = NDArray[np.float64]


def interpolate(
    angle_deg: FloatArray, value: FloatArray, variance: FloatArray, grid_deg: FloatArray
) -> Interpolated:
    """Bring one curve to grid positions."""
    return Stencils(angle_deg, grid_deg).apply(value, variance)


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return load_calibration(CALIBRATION_FILE)


def test_counts_of_positions(calibration: Calibration) -> None:
    grid = grid_angles_deg()
    assert (grid[0], grid[-1], grid.size) == (-90.0, 90.0, 361)
    seen = [int(visible_positions(calibration, camera).sum()) for camera in calibration.cameras]
    assert seen == [329, 336, 336, 336]
    hidden = visible_positions(calibration, calibration.camera(2))
    hidden &= ~visible_positions(calibration, calibration.camera(1))
    assert grid[hidden].tolist() == [-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5]


@given(
    coefficients=st.tuples(*[st.floats(-1.0, 1.0)] * 4),
    phase=st.floats(0.0, 0.49),
    jitter=st.floats(0.0, 0.24),
    seed=st.integers(0, 2**32),
)
@settings(max_examples=60, deadline=None)
def test_cubics_are_reproduced_exactly_from_irregular_samples(
    coefficients: tuple[float, float, float, float], phase: float, jitter: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    x = np.arange(-90.0, 90.0, 0.5) + phase
    x += 0.5 * jitter * random.uniform(-1.0, 1.0, x.size)
    random.shuffle(x)
    curve = np.polynomial.Polynomial(coefficients)
    grid = grid_angles_deg()
    found = interpolate(x, curve(x / 90.0), np.full(x.size, 4.0), grid)
    assert np.array_equal(found.bracketed, (grid >= x.min()) & (grid <= x.max()))
    # the weights are of order 1 and differences of angles lose 9 bits
    np.testing.assert_allclose(
        found.value[found.bracketed], curve(grid[found.bracketed] / 90.0), rtol=0, atol=1e-11
    )
    # beyond the ends a straight line: off by at most f'' d (d + h) / 2
    beyond = found.extrapolated
    assert np.allclose(found.value[beyond], curve(grid[beyond] / 90.0), atol=8.0 / 90.0**2)


def test_samples_on_the_grid_are_kept_bit_for_bit() -> None:
    random = np.random.default_rng(0)
    grid = grid_angles_deg()
    value, variance = random.normal(size=361), random.uniform(1.0, 2.0, 361)
    found = interpolate(grid, value, variance, grid)
    assert np.array_equal(found.value, value)
    assert np.array_equal(found.variance, variance)


def test_stated_variance_is_that_of_the_weighted_samples() -> None:
    """Half-way between samples (-1, 9, 9, -1)/16: variance 0.64 of a sample's."""
    x = np.arange(-90.0, 90.5, 0.5) + 0.25
    found = interpolate(x, np.ones(x.size), np.full(x.size, 3.0), grid_angles_deg()[5:-5])
    np.testing.assert_allclose(found.variance, 3.0 * 164.0 / 256.0, rtol=1e-9)


def test_nothing_is_interpolated_over_a_gap() -> None:
    x = np.concatenate([np.arange(-10.0, -0.9, 0.5), np.arange(1.0, 10.1, 0.5)])
    grid = np.arange(-12.0, 12.01, 0.25)
    curve = np.polynomial.Polynomial((1.0, 0.5, 0.2, -0.1))
    found = interpolate(x, curve(x), np.ones(x.size), grid)
    inside = (np.abs(grid) >= 1.0) & (np.abs(grid) <= 10.0)
    assert np.array_equal(found.bracketed, inside)
    # one-sided cubics beside the gap are exact as well
    np.testing.assert_allclose(found.value[inside], curve(grid[inside]), rtol=0, atol=1e-10)
    # half a degree beyond an end at most, and only there
    beyond = ((np.abs(grid) < 1.0) & (np.abs(grid) >= 0.5)) | (
        (np.abs(grid) > 10.0) & (np.abs(grid) <= 10.5)
    )
    assert np.array_equal(found.extrapolated, beyond)
    assert np.array_equal(np.isfinite(found.value), inside | beyond)


@pytest.mark.parametrize(("gap", "crossed"), [(0.75, True), (0.76, False)])
def test_gaps_of_one_and_a_half_steps_are_crossed(gap: float, crossed: bool) -> None:
    x = np.concatenate([np.arange(0.0, 5.0, 0.5), 4.5 + gap + np.arange(0.0, 5.0, 0.5)])
    found = interpolate(x, x, np.ones(x.size), np.array([4.6]))
    assert bool(found.bracketed[0]) is crossed


def test_short_stretches_take_a_straight_line() -> None:
    x = np.array([0.0, 0.5, 1.0, 5.0, 5.5, 9.0])
    found = interpolate(x, x**2, np.ones(6), np.array([0.25, 0.75, 5.25, 9.0, 7.0]))
    np.testing.assert_allclose(found.value[:3], [0.125, 0.625, 27.625])
    assert np.isnan(found.value[3:]).all()


def test_an_arm_that_stands_nearly_still_does_not_spoil_its_neighbourhood() -> None:
    random = np.random.default_rng(1)
    x = np.concatenate([np.arange(-10.0, 0.0, 0.5), np.linspace(0.0, 0.01, 40)])
    found = interpolate(
        x, 1.0 + 0.01 * random.standard_normal(x.size), np.full(x.size, 1e-4), np.array([-0.2])
    )
    # without averaging the crowd first the deviation would be above 1
    assert found.variance[0] <= 1.2e-4
    assert abs(found.value[0] - 1.0) < 4.4 * np.sqrt(found.variance[0])


@given(count=st.integers(0, 1))
@settings(deadline=None)
def test_too_few_samples_give_nothing(count: int) -> None:
    found = interpolate(np.zeros(count), np.ones(count), np.ones(count), grid_angles_deg())
    assert not found.bracketed.any()
    assert not found.extrapolated.any()
    assert np.isnan(found.value).all()


def test_error_at_a_sharp_lobe_is_as_stated() -> None:
    """Lobe of sigma_s = 0.03 as seen by the top camera: theta_h = (w - 24) / 2."""
    grid = grid_angles_deg()

    def lobe(angle_deg: FloatArray) -> FloatArray:
        return np.asarray(np.exp(-((np.deg2rad(angle_deg - 24.0) / 2.0 / 0.03) ** 2)))

    worst = 0.0
    for phase in np.linspace(0.0, 0.5, 21):
        x = np.arange(-90.0, 90.0, 0.5) + phase
        found = interpolate(x, lobe(x), np.ones(x.size), grid)
        inner = found.bracketed
        worst = max(worst, float(np.max(np.abs(found.value - lobe(grid))[inner])))
    assert 1.0e-4 < worst < 1.3e-4


def scan_of(
    calibration: Calibration,
    phases: tuple[float, ...],
    random: np.random.Generator,
    noise: tuple[float, ...],
) -> tuple[ScanObservations, FloatArray]:
    """Observations of a smooth curve, one sweep a phase, hidden and low positions left out."""
    camera, sweep, angle, std = [], [], [], []
    for calibrated in calibration.cameras:
        for number, phase in enumerate(phases):
            x = np.arange(-90.0, 90.0, 0.5) + phase
            x = x[light_direction(x, calibration.tilt_deg)[:, 2] >= 1e-3]
            for low, high in calibrated.hidden_light_intervals_deg:
                x = x[(x < low) | (x > high)]
            camera.append(np.full(x.size, calibrated.camera))
            sweep.append(np.full(x.size, number + 1))
            angle.append(x)
            std.append(np.full(x.size, noise[number]))
    w, sigma = np.concatenate(angle), np.concatenate(std)
    value = truth(w, np.concatenate(camera))
    radiance = value + sigma[:, None] * random.standard_normal(value.shape)
    rows = w.size
    sweeps = len(phases)
    views = calibration.view_directions[np.concatenate(camera) - 1]
    scan = ScanObservations(
        camera=np.concatenate(camera),
        sweep=np.concatenate(sweep),
        exposure_ms=np.ones(rows),
        stamp_ns=np.arange(rows, dtype=np.int64),
        light_angle_deg=w,
        swept_deg=np.zeros(rows),
        light_direction=light_direction(w, calibration.tilt_deg),
        view_direction=views,
        radiance=radiance,
        variance=np.broadcast_to(sigma[:, None] ** 2, value.shape).copy(),
        valid=np.ones(value.shape, dtype=np.bool_),
        sweep_number=np.arange(1, sweeps + 1),
        sweep_exposure_ms=np.ones(sweeps),
        sweep_direction=np.ones(sweeps, dtype=np.int64),
        sweep_lamp_factor=np.ones((sweeps, 4, 3)),
        sweep_lamp_factor_std=np.zeros((sweeps, 4, 3)),
        sweep_light_offset_std_deg=np.zeros(sweeps),
        sweep_camera_offset_std_deg=np.zeros((sweeps, 4)),
        gain_relative_std=np.zeros((4, 3)),
        dropped={},
    )
    return scan, value


def truth(angle_deg: FloatArray, camera: NDArray[np.int64]) -> FloatArray:
    cosine = np.cos(np.deg2rad(angle_deg - 12.0))
    return np.asarray(cosine[:, None] * np.array([0.2, 0.3, 0.4]) * (camera[:, None] + 1.0) / 5.0)


@pytest.mark.parametrize("phases", [(0.1, 0.2, 0.3), (0.49, 0.49, 0.49), (0.0, 0.0, 0.0)])
def test_every_visible_position_is_filled_whatever_the_phase(
    calibration: Calibration, phases: tuple[float, ...]
) -> None:
    scan, _ = scan_of(calibration, phases, np.random.default_rng(0), (0.0, 0.0, 0.0))
    scan = replace(scan, variance=np.ones_like(scan.variance))
    grid = merge_on_grid(scan, calibration)
    assert grid.valid.sum(axis=1).tolist() == [[329] * 3, [336] * 3, [336] * 3, [336] * 3]
    assert np.array_equal(np.isfinite(grid.variance), grid.valid)
    for index in range(4):
        expected = truth(grid.light_angle_deg, np.full(361, index + 1))
        # a cosine is no cubic; and straight lines beside the gap are off by f'' h**2 at most
        error = np.abs(grid.radiance[index] - expected)[grid.valid[index]]
        assert error.max() < 0.4 * np.deg2rad(0.5) ** 2


def test_sweeps_are_weighted_by_their_variance(calibration: Calibration) -> None:
    """Positions four apart share no sample: their errors are independent, chi square applies."""
    scan, _ = scan_of(calibration, (0.05, 0.2, 0.4), np.random.default_rng(5), (3e-3, 1e-3, 5e-4))
    grid = merge_on_grid(scan, calibration)
    normalised = []
    for index in range(4):
        expected = truth(grid.light_angle_deg, np.full(361, index + 1))
        z = (grid.radiance[index] - expected) / np.sqrt(grid.variance[index])
        normalised.append(z[::4][grid.valid[index, ::4]])
    z = np.concatenate(normalised)
    assert z.size > 900
    # two-sided 1e-5 of a sum of squares of independent normal numbers
    assert abs(np.mean(z**2) - 1.0) < 4.4 * np.sqrt(2.0 / z.size)
    # the best sweep alone, at this phase, has 0.7 of its samples' variance
    assert np.nanmedian(grid.variance) < 0.75 * 5e-4**2


def test_clipped_light_is_left_out_and_not_guessed_at(calibration: Calibration) -> None:
    scan, _ = scan_of(calibration, (0.1, 0.3), np.random.default_rng(0), (1e-6, 1e-6))
    clipped = np.abs(scan.light_angle_deg - 24.0) < 5.0
    spoiled = scan.radiance.copy()
    spoiled[clipped, 1] = 1e9
    valid = scan.valid.copy()
    valid[clipped & (scan.sweep == 2), 1] = False
    one_left = replace(
        scan,
        radiance=np.where((scan.sweep == 2)[:, None], spoiled, scan.radiance),
        valid=valid,
    )
    grid = merge_on_grid(one_left, calibration)
    assert np.nanmax(grid.radiance) < 1.0
    assert grid.valid[1].sum(axis=0).tolist() == [336, 336, 336]

    valid[clipped, 1] = False
    none_left = replace(scan, radiance=spoiled, valid=valid)
    grid = merge_on_grid(none_left, calibration)
    assert np.nanmax(grid.radiance) < 1.0
    missing = ~grid.valid[1, :, 1] & grid.valid[1, :, 0]
    angles = grid.light_angle_deg[missing]
    # nothing beyond the last unclipped sample: no extrapolation into the lobe
    assert angles.min() <= 19.5
    assert angles.max() >= 28.5


def test_order_of_rows_does_not_matter(calibration: Calibration) -> None:
    scan, _ = scan_of(calibration, (0.1, 0.3), np.random.default_rng(0), (1e-3, 1e-3))
    order = np.random.default_rng(1).permutation(scan.camera.size)
    rows = {
        name: getattr(scan, name)[order]
        for name in (
            "camera",
            "sweep",
            "exposure_ms",
            "stamp_ns",
            "light_angle_deg",
            "swept_deg",
            "light_direction",
            "view_direction",
            "radiance",
            "variance",
            "valid",
        )
    }
    expected, found = (
        merge_on_grid(scan, calibration),
        merge_on_grid(replace(scan, **rows), calibration),
    )
    assert np.array_equal(expected.radiance, found.radiance, equal_nan=True)
    assert np.array_equal(expected.variance, found.variance, equal_nan=True)
