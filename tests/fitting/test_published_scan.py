"""Scan files: exact inverses, the real files byte for byte, every fault named with its line."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tvbrdf_fitting.published import (
    CameraScan,
    PublishedFormatError,
    format_scan_file,
    list_scans,
    parse_scan_file_name,
    read_scan,
    read_scan_file,
    scan_file,
    scan_file_name,
    write_scan_file,
)

HALF_MICRO = 0.5e-6 * (1 + 1e-9)
"""Rounding to 6 decimals."""


def camera_scan(light_count: int = 5, seed: int = 1) -> CameraScan:
    random = np.random.default_rng(seed)
    angle = np.linspace(-1.5, 1.3, light_count)
    light = np.stack([np.sin(angle), np.zeros(light_count), np.cos(angle)], axis=1)
    return CameraScan(
        exposures_ms=(0.2, 4.0, 32.0),
        light_direction=light,
        view_direction=np.array([-np.sin(0.2), 0.0, np.cos(0.2)]),
        radiance=random.normal(1.0, 2.0, (light_count, 3)),
    )


def real_scan_files(shared_data: Path) -> list[Path]:
    files = sorted(shared_data.glob("**/tvBrdf-data/*.txt"))
    assert len(files) >= 16
    return files


def test_real_files_are_reproduced_byte_for_byte(shared_data: Path, tmp_path: Path) -> None:
    for path in real_scan_files(shared_data):
        copy = tmp_path / path.name
        write_scan_file(copy, read_scan_file(path))
        assert copy.read_bytes() == path.read_bytes(), path


def test_real_files_have_the_rigs_geometry(shared_data: Path) -> None:
    path = shared_data / "rgl_on_rig" / "paper_white" / "tvBrdf-data" / scan_file_name(1, 1)
    scan = read_scan_file(path)
    tilt = np.deg2rad(12)
    assert scan.exposures_ms == (0.2, 4.0, 32.0)
    assert scan.radiance.shape == (329, 3)
    expected = [-np.sin(tilt), 0, np.cos(tilt)]
    np.testing.assert_allclose(scan.view_direction, expected, rtol=0, atol=HALF_MICRO)


def test_fast_and_line_by_line_parsers_agree_exactly(shared_data: Path) -> None:
    for path in real_scan_files(shared_data)[::10]:
        body = path.read_bytes().split(b"\n", 1)[1]
        fast = scan_file._parse_canonical(body)
        assert fast is not None
        slow = scan_file._parse_lines(body, path)
        np.testing.assert_array_equal(fast, slow)
        np.testing.assert_array_equal(np.signbit(fast), np.signbit(slow))


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(*[st.floats(-1e8, 1e8, allow_nan=False)] * 3),
        min_size=1,
        max_size=12,
    ),
    st.lists(st.floats(1e-3, 1e5), min_size=1, max_size=5),
)
def test_reading_inverts_writing(
    radiance: list[tuple[float, float, float]], exposures_ms: list[float]
) -> None:
    base = camera_scan(len(radiance))
    written = CameraScan(
        tuple(exposures_ms),
        base.light_direction,
        base.view_direction,
        np.array(radiance),
    )
    text = format_scan_file(written)
    body = text.split(b"\n", 1)[1]
    parsed = scan_file._parse_canonical(body)
    assert parsed is not None
    np.testing.assert_array_equal(parsed, scan_file._parse_lines(body, Path("x")))
    # 1e8 with 6 decimals has 15 digits: a double's own rounding adds its spacing there, 1.5e-8
    np.testing.assert_allclose(parsed[:, 0], written.radiance, rtol=0, atol=HALF_MICRO + 1.5e-8)
    np.testing.assert_allclose(parsed[:, 1], written.light_direction, rtol=0, atol=HALF_MICRO)


def test_what_is_read_is_written_the_same(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    write_scan_file(first, camera_scan(40))
    write_scan_file(second, read_scan_file(first))
    assert first.read_bytes() == second.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first", "second"]


def test_positions_with_an_invalid_channel_are_left_out(tmp_path: Path) -> None:
    scan = camera_scan(6)
    scan.radiance[1, 0] = np.nan
    scan.radiance[4, 2] = np.inf
    path = tmp_path / "scan"
    write_scan_file(path, scan)
    text = path.read_text()
    assert "nan" not in text
    assert "inf" not in text
    kept = [0, 2, 3, 5]
    back = read_scan_file(path)
    np.testing.assert_allclose(back.radiance, scan.radiance[kept], rtol=0, atol=HALF_MICRO)
    np.testing.assert_allclose(
        back.light_direction, scan.light_direction[kept], rtol=0, atol=HALF_MICRO
    )


def test_other_spellings_of_the_same_numbers_are_accepted(tmp_path: Path) -> None:
    path = tmp_path / "scan"
    path.write_text("Exposure 1\r\nF 1e-1 .5   3\r\nL 0 0 1.0\r\nV\t-0.6 0 0.8\r\n")
    scan = read_scan_file(path)
    np.testing.assert_array_equal(scan.radiance, [[0.1, 0.5, 3.0]])
    np.testing.assert_array_equal(scan.view_direction, [-0.6, 0, 0.8])


LINES = format_scan_file(camera_scan(3)).decode().splitlines()
FAULTS = {
    "no exposures": (1, "Exposure", "exposure times are missing"),
    "no exposure line": (1, None, "line 'Exposure a b c' is missing"),
    "bad exposure": (1, "Exposure 0.2 4,0 32", "'4,0' is not a number"),
    "exposure zero": (1, "Exposure 0.0 4.0 32.0", "exposure time 0 ms is not positive"),
    "line lost": (3, None, "starts with 'V' where a line 'L a b c' belongs"),
    "wrong key": (2, "G 1.000000 1.000000 1.000000", "starts with 'G'"),
    "blank line": (5, "", "starts with '' where a line 'F a b c' belongs"),
    "two numbers": (5, "F 1.000000 1.000000", "has 2 numbers after 'F' instead of 3"),
    "four numbers": (6, "L 0.000000 0.000000 1.000000 1.000000", "has 4 numbers"),
    "no number": (5, "F 1.000000 1.0000o0 1.000000", "'1.0000o0' is not a number"),
    "nan": (8, "F nan 1.000000 1.000000", "'nan' is not a finite number"),
    "infinite": (8, "F 1.000000 -inf 1.000000", "'-inf' is not a finite number"),
    "not a unit vector": (6, "L 0.000000 0.010000 1.010000", "light direction is no unit vector"),
    "light below horizon": (9, "L 0.600000 0.000000 -0.800000", "light direction is below"),
    "light on horizon": (9, "L 1.000000 0.000000 0.000000", "light direction is below"),
    "view not a unit vector": (10, "V 0.5 0.0 0.5", "view direction is no unit vector"),
    "view changes": (7, "V 0.600000 0.000000 0.800000", "view direction changes"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_with_its_line(fault: str, tmp_path: Path) -> None:
    line, text, problem = FAULTS[fault]
    lines = list(LINES)
    if text is None:
        del lines[line - 1]
    else:
        lines[line - 1] = text
    path = tmp_path / "scan01_brdf_camera1_allexposures.txt"
    path.write_text("".join(f"{entry}\n" for entry in lines))
    with pytest.raises(PublishedFormatError) as caught:
        read_scan_file(path)
    assert caught.value.line == line
    assert str(caught.value).startswith(f"{path}:{line}: ")
    assert problem in str(caught.value)


def test_truncation_anywhere_but_between_groups_is_found(tmp_path: Path) -> None:
    whole = format_scan_file(camera_scan(3))
    ends = [index + 1 for index, code in enumerate(whole) if code == ord("\n")]
    between_groups = set(ends[3::3])
    path = tmp_path / "scan"
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        if length in between_groups:
            assert len(read_scan_file(path).radiance) == ends[3::3].index(length) + 1
        else:
            with pytest.raises(PublishedFormatError, match=r"truncated|is empty"):
                read_scan_file(path)


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_damaged_bytes_never_give_anything_but_valid_data_or_an_error(data: st.DataObject) -> None:
    whole = bytearray(format_scan_file(camera_scan(3)))
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(40, len(whole) - 1))] = data.draw(st.integers(0, 255))
    body = bytes(whole).split(b"\n", 1)[1]
    fast = scan_file._parse_canonical(body)
    try:
        slow: NDArray[np.float64] | None = scan_file._parse_lines(body, Path("x"))
    except PublishedFormatError:
        slow = None
    if fast is not None:  # the fast parser accepts nothing that the strict one refuses
        assert slow is not None
        np.testing.assert_array_equal(fast, slow)


def test_unwritable_scans_are_refused(tmp_path: Path) -> None:
    good = camera_scan(3)
    below = np.array([[0.6, 0, -0.8]] * 3)
    cases = {
        "no unit vector": CameraScan((1.0,), good.light_direction * 1.1, *_rest(good)),
        "below the sample's horizon": CameraScan((1.0,), below, *_rest(good)),
        "exposure times are missing": CameraScan((), good.light_direction, *_rest(good)),
        "not positive": CameraScan((0.0,), good.light_direction, *_rest(good)),
        "are not both": CameraScan((1.0,), good.light_direction[:2], *_rest(good)),
        "nothing to write": CameraScan(
            (1.0,), good.light_direction, good.view_direction, np.full((3, 3), np.nan)
        ),
    }
    for problem, scan in cases.items():
        with pytest.raises(PublishedFormatError, match=problem):
            write_scan_file(tmp_path / "scan", scan)
    assert list(tmp_path.iterdir()) == []


def _rest(scan: CameraScan) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return scan.view_direction, scan.radiance


def test_a_failed_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "scan"
    write_scan_file(path, camera_scan(3))
    before = path.read_bytes()

    def full(descriptor: int, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OSError, match="No space"):
        write_scan_file(path, camera_scan(4))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_read_scan_joins_the_cameras_that_are_there(tmp_path: Path) -> None:
    data = tmp_path / "tvBrdf-data"
    data.mkdir()
    for camera in (1, 3):
        write_scan_file(data / scan_file_name(7, camera), camera_scan(camera + 2))
    (data / "notes.txt").write_text("not a scan file\n")
    assert list_scans(tmp_path) == (7,)
    scan = read_scan(tmp_path, 7)
    assert {camera: len(one.radiance) for camera, one in scan.cameras.items()} == {1: 3, 3: 5}
    with pytest.raises(PublishedFormatError, match="no file of scan 08"):
        read_scan(tmp_path, 8)


def test_read_scan_refuses_cameras_with_different_exposures(tmp_path: Path) -> None:
    data = tmp_path / "tvBrdf-data"
    data.mkdir()
    scan = camera_scan()
    write_scan_file(data / scan_file_name(1, 1), scan)
    other = CameraScan((1.0,), scan.light_direction, scan.view_direction, scan.radiance)
    write_scan_file(data / scan_file_name(1, 2), other)
    with pytest.raises(PublishedFormatError, match=r"camera2.*:1: exposures"):
        read_scan(tmp_path, 1)


def test_missing_files_and_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(PublishedFormatError, match="no such file"):
        read_scan_file(tmp_path / "scan01")
    with pytest.raises(PublishedFormatError, match="tvBrdf-data: is not a folder"):
        list_scans(tmp_path)
    with pytest.raises(PublishedFormatError, match="cannot be read"):
        read_scan_file(tmp_path)


def test_file_names() -> None:
    assert scan_file_name(1, 4) == "scan01_brdf_camera4_allexposures.txt"
    for scan in (1, 47, 123):
        assert parse_scan_file_name(scan_file_name(scan, 2)) == (scan, 2)
    for name in (
        "scan1_brdf_camera1_allexposures.txt",
        "scan00_brdf_camera1_allexposures.txt",
        "scan01_brdf_camera5_allexposures.txt",
        "scan001_brdf_camera1_allexposures.txt",
        "scan01_brdf_camera1_allexposures.txt.bak",
    ):
        assert parse_scan_file_name(name) is None
    with pytest.raises(ValueError, match="count from 1"):
        scan_file_name(0, 1)
