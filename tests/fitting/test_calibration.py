"""Calibration: the shipped file, its meaning, and what the reader refuses."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.paths import CALIBRATION_FILE
from tvbrdf_fitting.geometry import view_direction
from tvbrdf_fitting.measurement.calibration import (
    Calibration,
    CalibrationError,
    Rectangle,
    calibration_from_dict,
    load_calibration,
    parse_calibration,
)


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return load_calibration(CALIBRATION_FILE)


@pytest.fixture
def data() -> dict[str, Any]:
    loaded = yaml.safe_load(CALIBRATION_FILE.read_text())
    assert isinstance(loaded, dict)
    return loaded


def test_shipped_file_is_the_rig(calibration: Calibration) -> None:
    assert [camera.camera_angle_deg for camera in calibration.cameras] == [0.0, 25.0, 50.0, 75.0]
    np.testing.assert_allclose(
        calibration.view_directions[0], [-0.207912, 0.0, 0.978148], atol=5e-7
    )
    for index, camera in enumerate(calibration.cameras):
        expected = view_direction(camera.camera_angle_deg, calibration.tilt_deg)
        assert np.array_equal(calibration.view_directions[index], expected)
    assert calibration.camera(1).hidden_light_intervals_deg == ((-1.75, 1.75),)
    assert all(calibration.camera(n).hidden_light_intervals_deg == () for n in (2, 3, 4))


def test_white_diffuser_gives_60_percent_of_full_scale_at_4_ms(calibration: Calibration) -> None:
    camera = calibration.camera(2)
    signal_dn = 1.0 * 4.0 / np.array(camera.radiance_per_dn_per_ms)
    full_scale = camera.saturation_dn - camera.black_level_dn
    np.testing.assert_allclose(signal_dn / full_scale, 0.6, rtol=1e-6)
    assert full_scale * camera.gain_e_per_dn == pytest.approx(10000.0, rel=1e-6)


def test_pixel_noise_is_photon_transfer(calibration: Calibration) -> None:
    camera = calibration.camera(1)
    signal_e = np.array([0.0, 100.0, 6000.0])
    expected_e2 = signal_e + 5.0**2 + camera.gain_e_per_dn**2 / 12.0
    variance = camera.pixel_variance_dn2(signal_e / camera.gain_e_per_dn)
    np.testing.assert_allclose(variance * camera.gain_e_per_dn**2, expected_e2, rtol=1e-12)
    # below the black level there is read noise only
    assert camera.pixel_variance_dn2(-10.0) == camera.pixel_variance_dn2(0.0)


@pytest.mark.parametrize("bit_depth", [8, 10, 12, 16])
def test_other_bit_depths_measure_the_same_radiance(
    calibration: Calibration, bit_depth: int
) -> None:
    camera = calibration.camera(1)
    other = camera.with_bit_depth(bit_depth)
    share = 0.4
    signals = [
        (share * c.response.linear_table(c.bit_depth)[-1] - c.black_level_dn)
        * c.radiance_per_dn_per_ms[0]
        for c in (camera, other)
    ]
    assert signals[1] == pytest.approx(signals[0], rel=1e-12)
    assert other.saturation_dn == 2**bit_depth - 1
    assert other.gain_e_per_dn * other.black_level_dn == pytest.approx(
        camera.gain_e_per_dn * camera.black_level_dn
    )


@given(width=st.integers(64, 700), height=st.integers(64, 700), split=st.floats(0.1, 0.9))
@settings(deadline=None)
def test_rectangles_sharing_an_edge_never_overlap(width: int, height: int, split: float) -> None:
    upper = Rectangle(0.0, 0.0, 1.0, split).pixels(width, height)
    lower = Rectangle(0.0, split, 1.0, 1.0 - split).pixels(width, height)
    assert upper[0].stop == lower[0].start
    assert (upper[0].start, lower[0].stop) == (0, height)
    assert (upper[1].start, upper[1].stop) == (0, width)


def test_rectangle_in_pixels(calibration: Calibration) -> None:
    camera = calibration.camera(1)
    assert camera.patch.pixels(128, 128) == (slice(0, 112), slice(0, 128))
    assert camera.patch.pixels(640, 480) == (slice(0, 420), slice(0, 640))
    assert camera.reference_patch is not None
    assert camera.reference_patch.pixels(128, 128) == (slice(112, 128), slice(0, 128))
    with pytest.raises(ValueError, match="holds no pixel of a 10x10 region"):
        Rectangle(0.0, 0.0, 0.01, 1.0).pixels(10, 10)


def test_a_camera_overrides_what_holds_for_every_camera(data: dict[str, Any]) -> None:
    data["cameras"][3]["read_noise_e"] = 7.5
    data["cameras"][3]["reference_patch"] = None
    data["cameras"][3]["response"] = {"kind": "gamma", "exponent": 0.5}
    calibration = calibration_from_dict(data)
    assert [camera.read_noise_e for camera in calibration.cameras] == [5.0, 5.0, 7.5, 5.0]
    assert calibration.camera(3).reference_patch is None
    assert calibration.camera(3).response.exponent == 0.5
    assert calibration.camera(2).response.is_linear


def test_numbers_that_yaml_reads_as_text_are_understood() -> None:
    text = CALIBRATION_FILE.read_text().replace(
        "relative_noise_std: 0.001", "relative_noise_std: 1e-3"
    )
    assert parse_calibration(text).camera(1).relative_noise_std == 1e-3


def set_at(data: Any, path: str, value: object) -> None:
    *parents, key = path.split(".")
    for parent in parents:
        data = data[int(parent) if parent.isdigit() else parent]
    if value is None:
        del data[key]
    else:
        data[int(key) if key.isdigit() else key] = value


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("tilt_deg", None, "rig.yaml: tilt_deg is missing; add it"),
        ("tilt_deg", "steep", "rig.yaml: tilt_deg: 'steep' will not do; give a number in"),
        ("tilt_deg", 120, "give a number in .-45, 45."),
        ("tilt", 12.0, "rig.yaml: unknown key 'tilt'; did you mean tilt_deg"),
        ("every_camera.gain", 2.0, "cameras: 1: unknown key 'gain'"),
        ("every_camera.bit_depth", 12.5, "give a whole number"),
        ("every_camera.bit_depth", 24, "bit_depth: 24 will not do; give a number in .8, 16."),
        ("every_camera.saturation_dn", 5000, "saturation_dn: 5000 will not do"),
        ("every_camera.gain_e_per_dn", 0.0, "gain_e_per_dn: 0.0 will not do"),
        ("every_camera.read_noise_e", True, "read_noise_e: True will not do"),
        ("every_camera.read_noise_e", float("nan"), "read_noise_e: nan will not do"),
        ("every_camera.radiance_per_dn_per_ms", [1.0, 2.0], "three numbers above 0"),
        ("every_camera.radiance_per_dn_per_ms", [1.0, 0.0, 2.0], "three numbers above 0"),
        ("every_camera.hardware_stamp_event", "begin", "use one of exposure_start"),
        ("every_camera.response.kind", "cubic", "response: kind: 'cubic' will not do"),
        ("every_camera.response", {"kind": "gamma"}, "response: exponent is missing"),
        ("every_camera.response.exponent", 2.0, "response: unknown key 'exponent'"),
        ("every_camera.patch.height", 112, "patch: height: 112 will not do"),
        ("every_camera.patch.y", 0.5, "patch: reaches to 1 x 1.375"),
        ("every_camera.black_level_dn", 4095, "give one below saturation"),
        ("cameras.1.hidden_light_intervals_deg", [[2, -2]], "list of .from, to. in degrees"),
        ("cameras.1.hidden_light_intervals_deg", [1, 2], "list of .from, to. in degrees"),
        ("cameras.1.camera_angle_deg", None, "cameras: 1: camera_angle_deg is missing"),
        ("cameras", {1: {}}, "cameras: has 1; give each of 1, 2, 3, 4"),
        ("cameras", [1, 2], "cameras: .1, 2. will not do; give keys with values"),
        ("reference_albedo", "grey", "reference_albedo: 'grey' will not do"),
    ],
)
def test_wrong_files_are_refused_naming_file_key_and_remedy(
    data: dict[str, Any], path: str, value: object, message: str
) -> None:
    changed = copy.deepcopy(data)
    set_at(changed, path, value)
    with pytest.raises(CalibrationError, match=message) as caught:
        calibration_from_dict(changed, "rig.yaml")
    assert str(caught.value).startswith("rig.yaml: ")


def test_response_tables_are_checked_where_they_stand(data: dict[str, Any]) -> None:
    data["cameras"][2]["response"] = {"kind": "table", "linear": [0, 2, 1], "code": [0, 0.5, 1]}
    with pytest.raises(CalibrationError, match="cameras: 2: response: response table"):
        calibration_from_dict(data)


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"missing\.yaml: cannot be read"):
        load_calibration(tmp_path / "missing.yaml")
    broken = tmp_path / "broken.yaml"
    broken.write_text("tilt_deg: [1,")
    with pytest.raises(CalibrationError, match=r"broken\.yaml: is not valid YAML"):
        load_calibration(broken)
    broken.write_text("")
    with pytest.raises(CalibrationError, match="has nothing where keys with values are needed"):
        load_calibration(broken)
    broken.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CalibrationError, match="cannot be read"):
        load_calibration(broken)
