"""Fits, information and calibration files, and a sample as a whole."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tvbrdf_fitting.models import get_model
from tvbrdf_fitting.published import (
    DUST_PARAMETERS,
    SURFACE_PARAMETERS,
    CameraScan,
    PublishedFormatError,
    SampleInfo,
    ScanInfo,
    format_info,
    list_samples,
    parameters_row,
    read_calibration,
    read_info,
    read_parameters,
    read_sample,
    scan_file_name,
    write_calibration,
    write_info,
    write_parameters,
    write_scan_file,
)
from tvbrdf_fitting.published.sample import format_parameters

INFO = SampleInfo(
    sample_name="blue paint (glossy)",
    process="drying paint",
    exposures_ms=(0.2, 4.0, 32.0),
    scans=(
        ScanInfo(1, 1_769_851_800_000_000_007, 0.0, True),
        ScanInfo(3, 1_769_851_920_123_456_789, 120.123457, False),
    ),
    missing=((2, "the arm did not answer"),),
)


def make_sample(folder: Path, scans: tuple[int, ...]) -> None:
    (folder / "tvBrdf-data").mkdir(parents=True)
    (folder / "tvBrdf-fits").mkdir()
    angle = np.linspace(-1.4, 1.2, 7)
    light = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    for scan in scans:
        for camera in (1, 2, 3, 4):
            write_scan_file(
                folder / "tvBrdf-data" / scan_file_name(scan, camera),
                CameraScan((0.2, 4.0, 32.0), light, np.array([0.0, 0.6, 0.8]), light + camera),
            )


def test_info_text_is_the_documented_one() -> None:
    assert format_info(INFO).decode() == (
        "Sample blue paint (glossy) (drying paint)\n"
        "Exposure 0.200000 4.000000 32.000000\n"
        "Scans 2\n"
        "Scan 01 2026-01-31T09:30:00.000000007Z 0.000000 fitted\n"
        "Scan 03 2026-01-31T09:32:00.123456789Z 120.123457 unfitted\n"
        "Missing 02 the arm did not answer\n"
    )


@settings(max_examples=100, deadline=None)
@given(
    name=st.from_regex(r"[A-Za-zäß()_:/-][\w ()]{0,20}[\w()]", fullmatch=True),
    process=st.from_regex(r"[\w ,]{0,20}", fullmatch=True),
    scans=st.lists(
        st.tuples(
            st.integers(1, 2000), st.integers(0, 4 * 10**18), st.floats(-1e6, 1e6), st.booleans()
        ),
        max_size=6,
        unique_by=lambda scan: scan[0],
    ),
    reason=st.from_regex(r"\w[\w ,;:]{0,30}\w", fullmatch=True),
)
def test_info_reading_inverts_writing(
    name: str,
    process: str,
    scans: list[tuple[int, int, float, bool]],
    reason: str,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    info = SampleInfo(
        name,
        process,
        (0.2, 32.0),
        tuple(ScanInfo(n, stamp, round(t, 6), fitted) for n, stamp, t, fitted in sorted(scans)),
        ((3000, reason),),
    )
    path = tmp_path_factory.mktemp("info") / "tvBrdf-info.txt"
    write_info(path, info)
    assert read_info(path) == info


INFO_LINES = format_info(INFO).decode().splitlines()


@pytest.mark.parametrize(
    ("line", "text", "problem"),
    [
        (1, "Sample blue paint", "is not of the form 'Sample NAME"),
        (2, "Exposure", "exposure times are missing"),
        (3, "Scans two", "is not of the form 'Scans N'"),
        (3, "Scans 1", "is not of the form 'Missing"),
        (3, "Scans 3", "is not of the form 'Scan TT"),
        (4, "Scan 01 yesterday 0.0 fitted", "'yesterday' is not a UTC time stamp"),
        (4, "Scan 01 2026-13-31T09:30:00.000000007Z 0.0 fitted", "is not a UTC time stamp"),
        (4, "Scan 01 2026-01-31T09:30:00.000000007Z nan fitted", "'nan' is not a finite number"),
        (4, "Scan 01 2026-01-31T09:30:00.000000007Z 0.0 maybe", "is not of the form"),
    ],
)
def test_info_faults_are_named_with_their_line(
    line: int, text: str, problem: str, tmp_path: Path
) -> None:
    lines = list(INFO_LINES)
    lines[line - 1] = text
    path = tmp_path / "tvBrdf-info.txt"
    path.write_text("".join(f"{entry}\n" for entry in lines))
    with pytest.raises(PublishedFormatError, match=problem) as caught:
        read_info(path)
    assert str(caught.value).startswith(f"{path}:")


def test_truncated_info_is_found(tmp_path: Path) -> None:
    whole = format_info(INFO)
    path = tmp_path / "tvBrdf-info.txt"
    last_scan_ends = len(whole) - len("Missing 02 the arm did not answer\n")
    for length in range(last_scan_ends):
        path.write_bytes(whole[:length])
        with pytest.raises(PublishedFormatError, match=r"truncated|is empty"):
            read_info(path)


def test_info_that_could_not_be_read_back_is_not_written(tmp_path: Path) -> None:
    scan = INFO.scans[0]
    for bad in (
        replace(INFO, sample_name=""),
        replace(INFO, sample_name="two\nlines"),
        replace(INFO, process="a (b)"),
        replace(INFO, exposures_ms=()),
        replace(INFO, scans=(INFO.scans[1], INFO.scans[0])),
        replace(INFO, scans=(scan, scan)),
        replace(INFO, scans=(replace(scan, time_s=float("nan")),)),
        replace(INFO, missing=((2, "two\nlines"),)),
        replace(INFO, missing=((2, ""),)),
        replace(INFO, missing=((1, "there and missing"),)),
    ):
        with pytest.raises(PublishedFormatError):
            write_info(tmp_path / "tvBrdf-info.txt", bad)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("columns", [6, 11])
def test_parameters_reading_inverts_writing(columns: int, tmp_path: Path) -> None:
    rows = np.random.default_rng(3).uniform(-1, 40, (24, columns))
    path, again = tmp_path / "brdf-params.txt", tmp_path / "again"
    write_parameters(path, rows)
    back = read_parameters(path)
    np.testing.assert_allclose(back, rows, rtol=0, atol=0.5e-6 * (1 + 1e-9))
    write_parameters(again, back)
    assert again.read_bytes() == path.read_bytes()
    assert all(len(line.split()) == columns for line in path.read_text().splitlines())


def test_the_other_sign_of_g_is_read_on_request(tmp_path: Path) -> None:
    path = tmp_path / "brdf-params.txt"
    rows = np.arange(22.0).reshape(2, 11)
    write_parameters(path, rows)
    turned = read_parameters(path, g_positive_is_forward=False)
    rows[:, 9] *= -1
    np.testing.assert_array_equal(turned, rows)


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        ("1 2 3 4 5\n", 1, "has 5 numbers instead of 6 or 11"),
        ("1 2 3 4 5 6\n1 2 3 4 5 6 7 8 9 10 11\n", 2, "has 11 numbers instead of 6 as in line 1"),
        ("1 2 3 4 5 6\n\n", 2, "has 0 numbers"),
        ("1 2 3 4 5 6\n1 2 3 4 5 nan\n", 2, "'nan' is not a finite number"),
        ("1 2 3 4 5 6\n1 2 3 4 5 x\n", 2, "'x' is not a number"),
        ("1 2 3 4 5 6\n1 2 3 4 5 6", 2, "truncated"),
        ("", None, "is empty"),
    ],
)
def test_parameter_faults_are_named_with_their_line(
    text: str, line: int | None, problem: str, tmp_path: Path
) -> None:
    path = tmp_path / "brdf-params.txt"
    path.write_text(text)
    with pytest.raises(PublishedFormatError, match=problem) as caught:
        read_parameters(path)
    assert caught.value.line == line


def test_parameters_that_are_not_finite_are_not_written() -> None:
    rows = np.ones((2, 6))
    rows[1, 2] = np.nan
    with pytest.raises(PublishedFormatError, match=":2: a parameter is not finite"):
        format_parameters(rows)
    with pytest.raises(PublishedFormatError, match=r"\(k, 6 or 11\)"):
        format_parameters(np.ones((2, 7)))


def test_parameters_of_our_models_are_put_in_the_published_order() -> None:
    for model, columns in (("ON+TS", SURFACE_PARAMETERS), ("dust", DUST_PARAMETERS)):
        names = get_model(model).parameter_names
        assert set(names) == set(columns)
        values = {name: 1.0 + columns.index(name) for name in columns}
        shuffled = sorted(names)
        row = parameters_row(shuffled, [values[name] for name in shuffled])
        assert row is not None
        np.testing.assert_array_equal(row.values, np.arange(1.0, len(columns) + 1))
        assert row.lost == ""
    assert parameters_row(SURFACE_PARAMETERS, [1, 2, 3, 4, 5, np.inf]) is None
    assert parameters_row(("ks", "alpha", "eta"), [1, 2, 3]) is None
    two_lobes = get_model("oren_nayar+torrance_sparrow+torrance_sparrow").parameter_names
    assert parameters_row(two_lobes, np.ones(8)) is None


def test_simpler_and_coloured_models_have_a_row_that_says_what_is_lost() -> None:
    matte = parameters_row(get_model("lambert").parameter_names, [0.1, 0.2, 0.3])
    assert matte is not None
    np.testing.assert_allclose(matte.values, [0.1, 0.2, 0.3, 0.0, 0.0, 1 / 1.5])
    assert matte.lost == ""
    # what the row means is what was fitted
    light, view = np.array([[0.0, 0.6, 0.8]]), np.array([[0.6, 0.0, 0.8]])
    np.testing.assert_allclose(
        get_model("ON+TS").evaluate(light, view, matte.values),
        get_model("lambert").evaluate(light, view, [0.1, 0.2, 0.3]),
    )
    names = get_model("oren_nayar+torrance_sparrow(coloured)").parameter_names
    metal = parameters_row(names, [0.1, 0.2, 0.3, 0.4, 1.0, 2.0, 6.0, 8.0])
    assert metal is not None
    np.testing.assert_allclose(metal.values, [0.1, 0.2, 0.3, 0.4, 3.0, 8.0])
    assert "written as its mean 3" in metal.lost
    assert "1.000000 2.000000 6.000000" in metal.lost


def test_calibration(tmp_path: Path) -> None:
    path = tmp_path / "calibration.txt"
    constants = np.random.default_rng(5).uniform(0.5, 2, (4, 3))
    write_calibration(path, constants)
    np.testing.assert_allclose(read_calibration(path), constants, rtol=0, atol=0.5e-6)
    for text, problem in (
        ("1 1 1\n" * 3, "has 3 lines instead of 4"),
        ("1 1 1\n1 1\n1 1 1\n1 1 1\n", ":2: has 2 numbers"),
        ("1 1 1\n1 1 1\n1 1 1\n1 0 1\n", ":4: 0 is not positive"),
    ):
        path.write_text(text)
        with pytest.raises(PublishedFormatError, match=problem):
            read_calibration(path)
    for bad in (np.zeros((4, 3)), np.ones((3, 3)), np.full((4, 3), np.nan)):
        with pytest.raises(PublishedFormatError, match="calibration constants"):
            write_calibration(path, bad)


def test_sample_with_data_only(tmp_path: Path) -> None:
    make_sample(tmp_path / "sample01", (1, 2))
    sample = read_sample(tmp_path / "sample01")
    assert [scan.scan for scan in sample.scans] == [1, 2]
    assert sample.parameters is None
    assert sample.info is None
    np.testing.assert_array_equal(sample.calibration, np.ones((4, 3)))
    assert sorted(sample.scans[0].cameras) == [1, 2, 3, 4]
    assert list_samples(tmp_path) == (tmp_path / "sample01",)


def test_sample_with_everything(tmp_path: Path) -> None:
    make_sample(tmp_path, (1, 3))
    write_info(tmp_path / "tvBrdf-info.txt", INFO)
    write_parameters(tmp_path / "tvBrdf-fits" / "brdf-params.txt", np.ones((1, 6)))
    write_calibration(tmp_path / "tvBrdf-calibration.txt", np.full((4, 3), 2.0))
    sample = read_sample(tmp_path)
    assert sample.info == INFO
    assert sample.parameter_scans == (1,)
    assert sample.parameters is not None
    assert sample.parameters.shape == (1, 6)
    np.testing.assert_array_equal(sample.calibration, np.full((4, 3), 2.0))


def test_sample_whose_files_disagree_is_refused(tmp_path: Path) -> None:
    make_sample(tmp_path, (1, 2))
    fits = tmp_path / "tvBrdf-fits" / "brdf-params.txt"
    write_parameters(fits, np.ones((3, 6)))
    with pytest.raises(PublishedFormatError, match="has 3 lines for 2 fitted scans"):
        read_sample(tmp_path)
    write_parameters(fits, np.ones((2, 6)))
    assert read_sample(tmp_path).parameter_scans == (1, 2)
    write_info(tmp_path / "tvBrdf-info.txt", INFO)
    with pytest.raises(PublishedFormatError, match=r"lists scans \[1, 3\], but"):
        read_sample(tmp_path)
    (tmp_path / "empty" / "tvBrdf-data").mkdir(parents=True)
    with pytest.raises(PublishedFormatError, match="holds no scan file"):
        read_sample(tmp_path / "empty")


def test_real_samples_are_read(shared_data: Path) -> None:
    iron = read_sample(shared_data / "staf_cast_iron")
    assert [scan.scan for scan in iron.scans] == list(range(1, 29))
    for folder in sorted((shared_data / "rgl_on_rig").iterdir()):
        sample = read_sample(folder)
        assert len(sample.scans) == 1
        assert sorted(sample.scans[0].cameras) == [1, 2, 3, 4]
        for camera_scan in sample.scans[0].cameras.values():
            assert camera_scan.light_direction[:, 2].min() > 1e-3
