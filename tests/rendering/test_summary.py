"""Tables of a database: every number from the fits, the truth beside, as text and as JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tvbrdf_fitting.published.database import DatabaseError, read_database
from tvbrdf_rendering.summary import (
    format_summary,
    pooled_errors,
    summary_as_json,
    summary_table,
    write_summary,
)
from tvbrdf_rendering.truth import read_truth

MakeDatabase = Callable[..., Path]
SD_LIMIT = 5.0
"""A normal error exceeds 5 standard deviations once in 1.7 million; seeds are fixed."""


@pytest.fixture(scope="module")
def path(make_database: MakeDatabase) -> Path:
    return make_database(scans=5, missing=(3,), unfitted=(4,))


def test_rows_hold_the_fits(path: Path) -> None:
    database = read_database(path)
    rows = summary_table(database)
    assert [(row.scan, row.state, row.time_s) for row in rows] == [
        (1, "fitted", 0.0),
        (2, "fitted", 120.0),
        (3, "missing", 240.0),
        (4, "unfitted", 360.0),
        (5, "fitted", 480.0),
    ]
    assert rows[2].reason == "the arm did not answer"
    scans = {scan.scan: scan for scan in database.samples[0].scans}
    for row in (rows[0], rows[1], rows[4]):
        fit = scans[row.scan].fit
        assert fit is not None
        assert tuple(row.parameters) == fit.parameter_names
        assert [entry.value for entry in row.parameters.values()] == fit.values.tolist()
        deviations = [entry.standard_deviation for entry in row.parameters.values()]
        assert deviations == fit.standard_deviations.tolist()
        assert row.errors == fit.errors


def test_fits_agree_with_the_truth_beside_them(path: Path) -> None:
    for row in summary_table(read_database(path)):
        for entry in row.parameters.values():
            assert entry.value is not None
            assert entry.standard_deviation
            assert entry.truth is not None
            assert abs(entry.value - entry.truth) < SD_LIMIT * entry.standard_deviation


def test_errors_are_pooled_over_values_of_all_scans(path: Path) -> None:
    rows = [row for row in summary_table(read_database(path)) if row.state == "fitted"]
    pooled = pooled_errors(rows)
    counts = np.array([row.errors["count"] for row in rows], dtype=float)
    rms = np.array([row.errors["rms_absolute"] for row in rows], dtype=float)
    assert pooled["count"] == counts.sum()
    assert pooled["rms_absolute"] == pytest.approx(
        float(np.sqrt((counts * rms**2).sum() / counts.sum())), rel=1e-12
    )
    assert pooled["scans"] == 3
    assert pooled_errors([]) == {}


def test_text_has_each_number_to_two_digits_of_its_deviation(path: Path) -> None:
    database = read_database(path)
    text = format_summary(database)
    lines = text.splitlines()
    assert lines[0] == "Sample blue_paint (drying paint): 4 scans measured, 3 fitted, 1 missing"
    assert "Scan 3 is missing: the arm did not answer" in lines
    assert "Note: paint applied" in lines
    cells = [line.split() for line in lines]
    (first,) = [row for row in cells if row[:2] == ["1", "0.00"]]
    entries = summary_table(database)[0].parameters.values()
    shown = re.findall(r"(\S+) ± (\S+)", " ".join(first))
    assert len(shown) == len(entries) == 6
    for (value, deviation), entry in zip(shown, entries, strict=True):
        assert entry.value is not None
        assert entry.standard_deviation is not None
        decimals = len(value.split(".")[1])
        assert decimals == len(deviation.split(".")[1])
        half_digit = 0.5 * 10.0**-decimals * (1 + 1e-9)
        assert abs(float(value) - entry.value) <= half_digit
        assert abs(float(deviation) - entry.standard_deviation) <= half_digit
        assert half_digit < 0.1 * entry.standard_deviation
    assert sum(row[:1] == ["truth"] for row in cells) == 3
    assert ["4", "6.00", "unfitted"] in cells
    headings = {"RMS/peak %", "RMS", "RMS/mean", "RMS b", "RMS g", "RMS r", "RMS log", "chi2/dof"}
    heading_line = next(line for line in lines if "RMS/peak %" in line)
    assert headings | {"-grazing", "-dark"} <= set(re.split(r"\s{2,}", heading_line))
    assert any(row[:1] == ["all"] for row in cells)


def test_columns_are_aligned(path: Path) -> None:
    lines = format_summary(read_database(path)).splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("scan  time/min"))
    ends = {line.rindex("±") for line in lines[start:] if "±" in line and "value" not in line}
    assert len(ends) == 1


def test_doubtful_parameters_are_marked(make_database: MakeDatabase) -> None:
    from tvbrdf_fitting.models import SURFACE
    from tvbrdf_fitting.time_varying import ConstantMaterial

    matt = {"kd_b": 0.5, "kd_g": 0.4, "kd_r": 0.3, "sigma_d": 0.0, "ks": 0.0}
    material = ConstantMaterial(SURFACE, matt | {"inverse_sigma_s": 10.0})
    database = read_database(make_database(material, scans=1, truth=False))
    (row,) = summary_table(database)
    assert row.parameters["inverse_sigma_s"].undetermined
    text = format_summary(database)
    assert "?" in next(line for line in text.splitlines() if line.startswith("   1"))
    assert "truth" not in [line.split()[0] for line in text.splitlines() if "±" in line]


def test_json_says_the_same(path: Path, tmp_path: Path) -> None:
    text_path = tmp_path / "summary.txt"
    json_path = write_summary(text_path, path)
    assert json_path == tmp_path / "summary.json"
    database = read_database(path)
    assert text_path.read_text() == format_summary(database)
    content = json.loads(json_path.read_text())
    assert content == json.loads(json.dumps(summary_as_json(database)))
    (sample,) = content["samples"]
    row = summary_table(database)[1]
    assert sample["scans"][1]["parameters"]["ks"] == vars(row.parameters["ks"])
    assert sample["notes"][0]["text"] == "paint applied"
    assert sample["pooled_errors"]["scans"] == 3
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["summary.json", "summary.txt"]


def test_a_database_without_fits_has_a_table(make_database: MakeDatabase) -> None:
    path = make_database(scans=1, unfitted=(1,), truth=False)
    text = format_summary(read_database(path))
    assert text.startswith("Sample blue_paint (drying paint): 1 scans measured, 0 fitted, 0 miss")


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"parameter_names": ["a"], "scans": {"1": {"values": [1.0]}}}',
        '{"parameter_names": ["a"], "scans": {"1": {"time_s": 0, "values": [1.0, 2.0]}}}',
        '{"parameter_names": ["a"], "scans": {"one": {"time_s": 0, "values": [1.0]}}}',
    ],
)
def test_a_damaged_truth_is_told(text: str, tmp_path: Path) -> None:
    (tmp_path / "truth.json").write_text(text)
    with pytest.raises(DatabaseError, match=r"truth.json: is not of the form"):
        read_truth(tmp_path)
