"""Samples under the simulated rig: analytic materials, and measured reflectance from files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tvbrdf_fitting.geometry import CAMERA_ANGLES_DEG, light_direction, view_direction
from tvbrdf_fitting.models import get_model
from tvbrdf_fitting.published import (
    CameraScan,
    read_scan_file,
    scan_file_name,
    write_calibration,
    write_scan_file,
)
from tvbrdf_nodes.world.sample import (
    AnalyticSample,
    AngleTable,
    MeasuredSample,
    Sample,
    SampleError,
    make_sample,
    piecewise_cubic,
)
from tvbrdf_nodes.world.scene import available, load_scene

ANGLES_DEG = np.random.default_rng(3).uniform(-94.0, 94.0, 4000)
SHARP = {
    "kd_b": 0.1,
    "kd_g": 0.2,
    "kd_r": 0.5,
    "sigma_d": 0.4,
    "ks": 0.7,
    "inverse_sigma_s": 33.0,
}


def constant(model: str = "ON+TS", **parameters: float) -> Sample:
    spec = {"kind": "constant", "model": model, "parameters": parameters or SHARP}
    return make_sample(spec)


def expected(camera: int, angle_deg: np.ndarray, parameters: dict[str, float]) -> np.ndarray:
    """π·BRDF·cosθi straight from the model."""
    model = get_model("ON+TS")
    light = light_direction(angle_deg)
    view = np.broadcast_to(view_direction(CAMERA_ANGLES_DEG[camera - 1]), light.shape)
    brdf = model.evaluate(light, view, model.from_mapping(parameters))
    return np.pi * brdf * np.maximum(light[:, 2:], 0.0)


# -- analytic


@pytest.mark.parametrize("camera", [1, 2, 3, 4])
def test_radiance_is_pi_brdf_cosine_also_from_the_table(camera: int) -> None:
    """The table is good to 1e-6: of each value, or of 1e-3 of the largest (below the noise)."""
    sample = constant()
    truth = expected(camera, ANGLES_DEG, SHARP)
    exact = sample.radiance(camera, ANGLES_DEG, 5.0, 1)
    assert np.allclose(exact, truth, rtol=1e-13, atol=0)
    from_table = sample.radiance(camera, ANGLES_DEG, 5.0, 1)
    assert not np.array_equal(from_table, exact)
    scale = np.maximum(truth, 1e-3 * truth.max(axis=0))
    assert (np.abs(from_table - truth) / scale).max() < 1e-6


def test_nothing_is_seen_of_light_below_the_horizon() -> None:
    sample = constant()
    for _ in range(2):
        below = sample.radiance(2, np.linspace(-94.0, -78.01, 50), 0.0, 1)
        assert (below == 0).all()
        assert (sample.radiance(2, np.array([-77.9]), 0.0, 1) > 0).all()


def test_table_is_exact_where_no_cubic_does() -> None:
    """A function with steps, within a cell and between cells, and outside of the table."""

    def steps(angle_deg: np.ndarray) -> np.ndarray:
        found = np.stack([np.floor(angle_deg * 3.0)] * 3, axis=1)
        return np.asarray(found + np.sin(np.deg2rad(angle_deg))[:, None])

    table = AngleTable(steps)
    assert 0.5 < table.good.mean() < 1.0
    asked = np.concatenate([ANGLES_DEG, [-120.0, 99.0, 171.0]])
    near_a_step = np.abs(asked * 3.0 - np.round(asked * 3.0)) < 0.3
    assert np.allclose(table(asked)[near_a_step], steps(asked)[near_a_step], rtol=1e-6, atol=1e-9)


def test_time_changes_what_is_seen_also_after_a_table_was_made() -> None:
    sample = make_sample(load_scene("drying_paint", "ideal", 1).sample)
    for time_s in (0.0, 60.0, 0.0, 600.0):
        for _ in range(3):
            seen = sample.radiance(1, ANGLES_DEG, time_s, 1)
        truth = sample.truth(time_s)
        assert truth is not None
        values = dict(zip(truth[1], truth[2], strict=True))
        assert np.allclose(seen, expected(1, ANGLES_DEG, values), rtol=1e-6, atol=1e-9)


def test_few_angles_are_evaluated_exactly() -> None:
    """A sample that moves on with every frame never pays for a table."""
    sample = constant()
    assert isinstance(sample, AnalyticSample)
    for k in range(200):
        sample.radiance(1, np.array([1.0 * k - 90.0]), 0.1 * k, 1)
    assert not sample._tables


def test_directional_radiance_is_reciprocal_up_to_the_cosine() -> None:
    sample = constant()
    light, view = light_direction(np.array([20.0, 50.0])), light_direction(np.array([-30.0, 10.0]))
    there = sample.directional_radiance(light, view, 0.0)
    back = sample.directional_radiance(view, light, 0.0)
    assert there is not None
    assert back is not None
    assert np.allclose(there / light[:, 2:], back / view[:, 2:], rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("drying_paint", "oren_nayar+torrance_sparrow"),
        ("wet_cloth", "oren_nayar+torrance_sparrow"),
        ("settling_dust", "dust+oren_nayar+torrance_sparrow"),
    ],
)
def test_shipped_samples_are_plausible(name: str, model: str) -> None:
    """Their truth has the model's parameters; no more light comes back than falls in."""
    sample = make_sample(load_scene(name, "ideal", 1).sample)
    assert name in available("samples")
    angles = np.arange(-90.0, 90.5, 0.5)
    for time_s in (0.0, 60.0, 300.0, 1800.0):
        truth = sample.truth(time_s)
        assert truth is not None
        assert truth[0] == model
        assert truth[1] == get_model(model).parameter_names
        assert np.isfinite(truth[2]).all()
        diffuse = sample.radiance(4, angles, time_s, 1)
        assert diffuse.min() >= 0.0
        assert diffuse.max() < 1.0
        # at the top camera's highlight too, 4 ms must not saturate: 1 / 0.6 of white
        assert sample.radiance(1, angles, time_s, 1).max() < 1.6


def test_shipped_samples_change_as_they_should() -> None:
    def value(sample: Sample, name: str, time_s: float) -> float:
        truth = sample.truth(time_s)
        assert truth is not None
        return truth[2][truth[1].index(name)]

    paint, cloth, dust = (
        make_sample(load_scene(name, "ideal", 1).sample)
        for name in ("drying_paint", "wet_cloth", "settling_dust")
    )
    hour = 3600.0
    assert value(paint, "ks", 0.0) == pytest.approx(0.9)
    assert value(paint, "ks", hour) == pytest.approx(0.25, rel=1e-5)
    assert value(paint, "inverse_sigma_s", 0.0) == pytest.approx(12.0)
    assert value(paint, "inverse_sigma_s", hour) == pytest.approx(5.0, rel=1e-5)
    assert value(cloth, "kd_r", hour) > 1.8 * value(cloth, "kd_r", 0.0)
    assert value(cloth, "ks", hour) < 1e-6
    assert value(dust, "tau", 0.0) == 0.0
    assert value(dust, "ks", 600.0) < 0.02 * value(dust, "ks", 0.0)


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        ({}, "'kind' is missing"),
        ({"kind": "slime"}, "slime"),
        ({"kind": "drying_paint"}, "missing"),
        ({"kind": "constant", "model": "ON+TS", "parameters": {"kd_b": 1.0}}, "kd_g"),
        ({"kind": "measured"}, "needs one key, path"),
        ({"kind": "measured", "path": "x", "scan": 2}, "needs one key, path"),
    ],
)
def test_specifications_that_are_wrong(spec: dict[str, Any], text: str) -> None:
    with pytest.raises(SampleError, match=text):
        make_sample(spec)


# -- measured


Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Write scans of all cameras: a smooth function of the angle, times a scan's factor."""

    def smooth(angle_deg: np.ndarray) -> np.ndarray:
        return np.asarray(light_direction(angle_deg)[:, 2:] * np.array([0.3, 0.5, 0.8]))

    def do(factors: tuple[float, ...] = (1.0,), gap: bool = True) -> Path:
        folder = tmp_path / "sample01"
        (folder / "tvBrdf-data").mkdir(parents=True)
        for number, factor in enumerate(factors, start=1):
            for camera, camera_angle in enumerate(CAMERA_ANGLES_DEG, start=1):
                angle = np.arange(-77.5, 90.01, 0.5)
                if gap and camera == 1:
                    angle = angle[np.abs(angle) > 1.6]
                view = np.round(view_direction(camera_angle), 6)
                scan = CameraScan((4.0,), light_direction(angle), view, factor * smooth(angle))
                path = folder / "tvBrdf-data" / scan_file_name(number, camera)
                write_scan_file(path, scan)
        return folder

    return do


def test_measured_values_are_met_and_joined_smoothly(write: Write) -> None:
    """At the positions to the file's 6 decimals, between them too, as the function is smooth."""
    sample = make_sample({"kind": "measured", "path": str(write())})
    angle = np.arange(-77.5, 90.0, 0.1)
    truth = light_direction(angle)[:, 2:] * np.array([0.3, 0.5, 0.8])
    for camera in (2, 3, 4):
        assert np.abs(sample.radiance(camera, angle, 0.0, 1) - truth).max() < 3e-6


def test_gap_is_crossed_on_a_straight_line(write: Write) -> None:
    sample = make_sample({"kind": "measured", "path": str(write())})
    edges = sample.radiance(1, np.array([-2.0, 2.0]), 0.0, 1)
    inside = sample.radiance(1, np.array([-1.0, 0.0, 1.5]), 0.0, 1)
    share = np.array([[0.25], [0.5], [0.875]])
    # light directions are on file to 6 decimals: 6e-5 degrees
    assert np.allclose(inside, edges[0] + share * (edges[1] - edges[0]), atol=2e-6)


def test_radiance_ends_at_the_horizon(write: Write) -> None:
    sample = make_sample({"kind": "measured", "path": str(write())})
    angle = np.array([-95.0, -78.0, 102.0, 120.0])
    assert (sample.radiance(3, angle, 0.0, 1) == 0).all()
    assert (sample.radiance(3, np.array([-77.9]), 0.0, 1) > 0).all()


def test_scans_of_a_run_follow_the_scans_on_file(write: Write) -> None:
    sample = make_sample({"kind": "measured", "path": str(write((1.0, 0.5, 0.25)))})
    angle = np.array([30.0])
    first = sample.radiance(2, angle, 0.0, 1)
    for scan, factor in ((1, 1.0), (2, 0.5), (3, 0.25), (4, 0.25), (99, 0.25), (0, 1.0), (2, 0.5)):
        assert np.allclose(sample.radiance(2, angle, 0.0, scan), factor * first, rtol=1e-5)
    assert sample.truth(0.0) is None
    assert sample.directional_radiance(np.zeros((1, 3)), np.zeros((1, 3)), 0.0) is None


def test_calibration_beside_the_data_divides(write: Write) -> None:
    folder = write()
    angle = np.array([10.0])
    plain = MeasuredSample(folder).radiance(4, angle, 0.0, 1)
    constants = np.ones((4, 3))
    constants[3] = [2.0, 4.0, 8.0]
    write_calibration(folder / "tvBrdf-calibration.txt", constants)
    assert np.allclose(MeasuredSample(folder).radiance(4, angle, 0.0, 1), plain / constants[3])


def test_missing_and_broken_files_are_named(write: Write, tmp_path: Path) -> None:
    with pytest.raises(SampleError, match=r"nowhere.*tvBrdf-data"):
        MeasuredSample(tmp_path / "nowhere")
    folder = write()
    path = folder / "tvBrdf-data" / scan_file_name(1, 2)
    path.write_text("Exposure 4.000000\nF 1 2\n")
    with pytest.raises(SampleError, match=r"scan01_brdf_camera2.*:2: has 2 numbers"):
        MeasuredSample(folder).radiance(2, np.array([0.0]), 0.0, 1)
    path.unlink()
    with pytest.raises(SampleError, match="scan01_brdf_camera2"):
        MeasuredSample(folder).radiance(2, np.array([0.0]), 0.0, 1)


def test_piecewise_cubic_needs_two_positions() -> None:
    with pytest.raises(ValueError, match="two or more"):
        piecewise_cubic(np.array([1.0]), np.ones((1, 3)))
    with pytest.raises(ValueError, match="an angle of its own"):
        piecewise_cubic(np.array([1.0, 1.0]), np.ones((2, 3)))


def test_real_materials_are_shown_as_measured(shared_data: Path) -> None:
    """All published positions of a real material come back, to the file's 6 decimals."""
    folder = shared_data / "rgl_on_rig" / "satin_rosaline"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    from tvbrdf_fitting.geometry import light_world_angle_deg

    sample = MeasuredSample(folder)
    for camera in (1, 2, 3, 4):
        scan = read_scan_file(folder / "tvBrdf-data" / scan_file_name(1, camera))
        angle = light_world_angle_deg(scan.light_direction)
        assert np.allclose(sample.radiance(camera, angle, 0.0, 1), scan.radiance, atol=1e-12)
        # between the positions it stays near its neighbours: no ringing above 5 % of the peak
        between = sample.radiance(camera, (angle[1:] + angle[:-1]) / 2, 0.0, 1)
        low = np.minimum(scan.radiance[1:], scan.radiance[:-1])
        high = np.maximum(scan.radiance[1:], scan.radiance[:-1])
        slack = 0.05 * scan.radiance.max()
        assert (between > low - slack).all()
        assert (between < high + slack).all()


def test_real_series_changes_with_the_scan(shared_data: Path) -> None:
    folder = shared_data / "staf_cast_iron"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    sample = MeasuredSample(folder)
    angle = np.arange(-70.0, 80.0, 5.0)
    first, last = (sample.radiance(1, angle, 0.0, scan) for scan in (1, 28))
    assert np.abs(first - last).max() > 0.01
    assert np.array_equal(last, sample.radiance(1, angle, 0.0, 40))
