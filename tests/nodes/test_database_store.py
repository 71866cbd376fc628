"""The database store: exactly once, exact, refuses what it must, in plain words."""

from __future__ import annotations

import io
import logging
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tvbrdf_fitting.models import DUST, SURFACE, get_model
from tvbrdf_fitting.published import CameraScan, read_parameters, read_sample
from tvbrdf_fitting.published.database import MissingScan
from tvbrdf_nodes.database_writer.store import (
    DatabaseError,
    DatabaseStore,
    FitRecord,
    ScanRecord,
    read_database,
)

EXPOSURES_MS = (0.2, 4.0, 32.0)
START_NS = 1_769_851_800_000_000_007


def scan_record(scan: int, seed: int = 0, sample: str = "blue_paint") -> ScanRecord:
    random = np.random.default_rng([scan, seed])
    angle = np.deg2rad(np.arange(-80.0, 78.0, 4.0))
    light = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    grid = {}
    for camera in (1, 2, 3, 4):
        radiance = random.normal(0.5, 0.1, light.shape)
        radiance[camera, 1] = np.nan  # an invalid channel
        view = np.array([0.0, np.sin(camera / 4), np.cos(camera / 4)])
        grid[camera] = CameraScan(EXPOSURES_MS, light, view, radiance)
    return ScanRecord(
        sample=sample,
        scan=scan,
        start_stamp_ns=START_NS + scan * 60_000_000_000,
        time_s=60.0 * scan,
        exposures_ms=EXPOSURES_MS,
        grid=grid,
        observations={
            "radiance": random.normal(size=(50, 3)),
            "valid": random.random((50, 3)) > 0.1,
            "camera": random.integers(1, 5, 50),
        },
        quality={"gaps": [], "lamp_drift": 0.002, "dark": {"camera_1": np.float64(1.5)}},
    )


def fit_record(scan: int, model: str = SURFACE, seed: int = 0) -> FitRecord:
    names = get_model(model).parameter_names
    random = np.random.default_rng([scan, seed, 1])
    return FitRecord(
        sample="blue_paint",
        scan=scan,
        model=model,
        parameter_names=names,
        values=random.uniform(0.1, 0.9, len(names)),
        standard_deviations=random.uniform(1e-4, 1e-3, len(names)),
        covariance=random.normal(size=(len(names), len(names))),
        errors={"rms_percent": 1.25, "rms_log": None, "count": 1234, "rms_b": 0.5},
        solver="lm",
        reason="the step is small",
        evaluations=17,
        solve_time_ms=12.5,
        at_bound=("sigma_d",),
        undetermined=(),
        details={"metric": "log", "choice": {"reason": "simplest", "rungs": [{"model": model}]}},
    )


def test_everything_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "new" / "database"
    records = {scan: scan_record(scan) for scan in (1, 3)}
    with DatabaseStore(path, "blue_paint", process="drying paint", run_id="r1") as store:
        for record in records.values():
            assert store.store_scan(record) == "stored"
        assert store.store_missing(2, "the arm did\nnot answer", time_s=120.0) == "stored"
        assert store.store_parameters(fit_record(3)) == "stored"
        assert store.store_note(START_NS, "painted", zero=True) == "stored"
        assert store.contents().scans == (1, 3)
        assert store.contents().fitted == (3,)
        assert store.contents().missing == {2: "the arm did not answer"}
        assert store.contents().zero_ns == START_NS

    (sample,) = read_database(path).samples
    assert (sample.name, sample.process, sample.run_id) == ("blue_paint", "drying paint", "r1")
    assert [scan.scan for scan in sample.scans] == [1, 3]
    assert sample.missing == (MissingScan(2, "the arm did not answer", 120.0),)
    assert [(n.stamp_ns, n.text, n.zero) for n in sample.notes] == [(START_NS, "painted", True)]
    for scan in sample.scans:
        record = records[scan.scan]
        assert scan.start_stamp_ns == record.start_stamp_ns
        assert scan.time_s == record.time_s
        assert scan.exposures_ms == EXPOSURES_MS
        assert scan.quality == {"gaps": [], "lamp_drift": 0.002, "dark": {"camera_1": 1.5}}
        observations = scan.observations()
        assert observations.keys() == record.observations.keys()
        for name, array in record.observations.items():
            assert observations[name].dtype == array.dtype
            np.testing.assert_array_equal(observations[name], array)
        for camera, camera_scan in scan.radiance().cameras.items():
            kept = ~np.isnan(record.grid[camera].radiance).any(axis=1)
            assert np.count_nonzero(~kept) == 1
            np.testing.assert_allclose(
                camera_scan.radiance, record.grid[camera].radiance[kept], rtol=0, atol=5.1e-7
            )
    assert sample.scans[0].fit is None
    fit, sent = sample.scans[1].fit, fit_record(3)
    assert fit is not None
    assert (fit.model, fit.parameter_names) == (sent.model, sent.parameter_names)
    np.testing.assert_array_equal(fit.values, sent.values)
    np.testing.assert_array_equal(fit.standard_deviations, sent.standard_deviations)
    np.testing.assert_array_equal(fit.covariance, sent.covariance)
    assert fit.errors == sent.errors
    assert isinstance(fit.errors["count"], int)
    assert (fit.solver, fit.reason) == ("lm", "the step is small")
    assert (fit.evaluations, fit.solve_time_ms) == (17, 12.5)
    assert (fit.at_bound, fit.undetermined) == (("sigma_d",), ())


def test_published_files_are_the_published_layout(tmp_path: Path) -> None:
    with DatabaseStore(tmp_path, "blue_paint", process="drying paint") as store:
        for scan in (2, 1):  # the text is in the scans' order, whatever came first
            store.store_scan(scan_record(scan))
            store.store_parameters(fit_record(scan))
        store.store_scan(scan_record(4))
        store.store_missing(3, "no light")
    sample = read_sample(tmp_path / "sample01")
    assert sample.info is not None
    assert (sample.info.sample_name, sample.info.process) == ("blue_paint", "drying paint")
    assert sample.info.exposures_ms == EXPOSURES_MS
    assert [(s.scan, s.time_s, s.fitted) for s in sample.info.scans] == [
        (1, 60.0, True),
        (2, 120.0, True),
        (4, 240.0, False),
    ]
    assert sample.info.missing == ((3, "no light"),)
    assert sample.parameter_scans == (1, 2)
    expected = np.array([fit_record(1).values, fit_record(2).values])
    assert sample.parameters is not None
    np.testing.assert_allclose(sample.parameters, expected, rtol=0, atol=5.1e-7)


def test_dust_parameters_have_eleven_columns(tmp_path: Path) -> None:
    with DatabaseStore(tmp_path, "blue_paint") as store:
        store.store_scan(scan_record(1))
        store.store_parameters(fit_record(1, DUST))
    parameters = read_parameters(tmp_path / "sample01" / "tvBrdf-fits" / "brdf-params.txt")
    expected = np.asarray(fit_record(1, DUST).values)[None]
    np.testing.assert_allclose(parameters, expected, rtol=0, atol=5.1e-7)


def test_fits_without_a_place_in_the_layout_are_in_the_catalogue_only(tmp_path: Path) -> None:
    unknown = np.array([0.1, 0.2, 0.3, np.nan, 0.5, 30.0])
    with DatabaseStore(tmp_path, "blue_paint") as store:
        for scan in (1, 2):
            store.store_scan(scan_record(scan))
        store.store_parameters(replace(fit_record(1), values=unknown))
        store.store_parameters(fit_record(2))
        assert store.contents().fitted == (1, 2)
    sample = read_sample(tmp_path / "sample01")
    assert sample.parameter_scans == (2,)
    fit = read_database(tmp_path).samples[0].scans[0].fit
    assert fit is not None
    np.testing.assert_array_equal(fit.values, unknown)


def contents(path: Path) -> dict[str, bytes]:
    files = (file for file in sorted(path.rglob("*")) if file.is_file())
    return {
        str(file.relative_to(path)): file.read_bytes()
        for file in files
        if not file.name.startswith("catalogue")
    }


def test_repetitions_change_nothing(tmp_path: Path) -> None:
    with DatabaseStore(tmp_path, "blue_paint") as store:
        first = [
            store.store_scan(scan_record(1)),
            store.store_parameters(fit_record(1)),
            store.store_missing(2, "no light"),
            store.store_note(5, "painted"),
        ]
        before, catalogue = contents(tmp_path), read_database(tmp_path)
        again = [
            store.store_scan(scan_record(1)),
            store.store_parameters(replace(fit_record(1), solve_time_ms=99.0)),
            store.store_missing(2, "no light"),
            store.store_note(5, "painted"),
            store.store_missing(1, "no light"),  # it was measured after all
        ]
        assert (first, again) == (["stored"] * 4, ["already_stored"] * 5)
        assert contents(tmp_path) == before
        after = read_database(tmp_path)
    assert len(after.samples[0].scans) == len(catalogue.samples[0].scans) == 1
    assert after.samples[0].missing == (MissingScan(2, "no light", None),)
    assert len(after.samples[0].notes) == 1


def test_the_first_of_two_contradicting_contents_is_kept(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with DatabaseStore(tmp_path, "blue_paint") as store:
        store.store_scan(scan_record(1))
        store.store_parameters(fit_record(1))
        before = contents(tmp_path)
        with caplog.at_level(logging.WARNING):
            for _ in range(2):
                assert store.store_scan(scan_record(1, seed=9)) == "already_stored"
                assert store.store_parameters(fit_record(1, seed=9)) == "already_stored"
    assert contents(tmp_path) == before
    notes = [note.text for note in read_database(tmp_path).samples[0].notes]
    assert len(notes) == len(caplog.messages) == 2  # once each, however often it comes
    assert notes[0].startswith("scan 1 came again with another content")
    assert notes[1].startswith("parameters of scan 1 came again with another content")


def test_a_scan_that_was_missing_may_come_late(tmp_path: Path) -> None:
    with DatabaseStore(tmp_path, "blue_paint") as store:
        store.store_missing(1, "merger was killed")
        assert store.store_scan(scan_record(1)) == "stored"
        assert store.contents().missing == {}
        assert store.contents().scans == (1,)
    (note,) = read_database(tmp_path).samples[0].notes
    assert note.text == "scan 1 came after it was recorded as missing: merger was killed"


def test_time_zero_comes_from_a_mark_or_from_the_first_scan(tmp_path: Path) -> None:
    with DatabaseStore(tmp_path, "blue_paint") as store:
        assert store.contents().zero_ns == 0
        store.store_scan(scan_record(2))
        assert store.contents().zero_ns == START_NS
        store.store_note(START_NS - 5, "painted", zero=True)
        store.store_note(START_NS + 7, "a fly sat down")
        assert store.contents().zero_ns == START_NS - 5


def test_a_database_that_is_not_empty_is_refused_unless_resumed(tmp_path: Path) -> None:
    with DatabaseStore(tmp_path, "blue_paint", run_id="r1") as store:
        store.store_scan(scan_record(1))
    with pytest.raises(DatabaseError, match=r"holds 1 scans of sample 'blue_paint'.*resume:=true"):
        DatabaseStore(tmp_path, "blue_paint")
    with pytest.raises(DatabaseError, match=r"holds 1 scans"):
        DatabaseStore(tmp_path, "blue_paint", run_id="r2")
    with pytest.raises(DatabaseError, match=r"is the database of sample 'blue_paint', not of 'wet"):
        DatabaseStore(tmp_path, "wet_cloth", resume=True)
    for own in ({"resume": True}, {"run_id": "r1"}):  # a restarted writer finds its own
        options: dict[str, Any] = dict(own)
        with DatabaseStore(tmp_path, "blue_paint", **options) as store:
            assert store.contents().scans == (1,)
            assert store.store_scan(scan_record(1)) == "already_stored"


def test_a_database_with_nothing_in_it_is_empty(tmp_path: Path) -> None:
    (tmp_path / "truth.json").write_text("{}")
    DatabaseStore(tmp_path, "wet_cloth").close()
    with DatabaseStore(tmp_path, "blue_paint") as store:
        store.store_scan(scan_record(1))
    assert read_database(tmp_path).samples[0].name == "blue_paint"


def test_other_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(DatabaseError, match=r"holds 'thesis.tex'.*empty or a new folder"):
        DatabaseStore(tmp_path, "blue_paint", resume=True)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(DatabaseError, match="is a file; give a folder"):
        DatabaseStore(tmp_path / "thesis.tex", "blue_paint")
    with pytest.raises(DatabaseError, match=r"thesis.tex/database.*opening it failed"):
        DatabaseStore(tmp_path / "thesis.tex" / "database", "blue_paint")


def test_a_second_writer_is_refused(tmp_path: Path) -> None:
    with (
        DatabaseStore(tmp_path, "blue_paint"),
        pytest.raises(DatabaseError, match=r"process \d+ is writing to it"),
    ):
        DatabaseStore(tmp_path, "blue_paint", resume=True)
    DatabaseStore(tmp_path, "blue_paint", resume=True).close()


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"sample": "wet_cloth"}, "is of 'wet_cloth'"),
        ({"scan": 0}, "scans count from 1"),
        ({"time_s": float("nan")}, "times are finite"),
        ({"exposures_ms": (1.0,)}, "are not the scan's"),
        ({"grid": {}}, "store it as missing"),
        ({"grid": {5: scan_record(1).grid[1]}}, "camera 5"),
        ({"observations": {"file": np.ones(1)}}, "observations 'file'"),
        ({"observations": {"a": np.array([None])}}, "observations 'a' .object. cannot"),
        ({"quality": {"a": object()}}, "cannot be stored as JSON"),
    ],
)
def test_records_that_cannot_be_stored_are_refused(
    change: dict[str, Any], problem: str, tmp_path: Path
) -> None:
    with DatabaseStore(tmp_path, "blue_paint") as store:
        before = contents(tmp_path)
        with pytest.raises(DatabaseError, match=problem):
            store.store_scan(replace(scan_record(1), **change))
        assert store.contents().scans == ()
        assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"sample": "wet_cloth"}, "is of 'wet_cloth'"),
        ({"scan": 2}, "parameters of scan 2 came before the scan"),
        ({"values": np.ones(5)}, r"values have shape \(5,\), not \(6,\)"),
        ({"covariance": np.ones(6)}, r"covariance have shape"),
        ({"parameter_names": ("kd_b",) * 6}, "are not unique"),
        ({"errors": {"rms": [1.0]}}, "error measure 'rms'"),
        ({"model": "cook_torrance", "details": {}}, "fit all with one model"),
    ],
)
def test_fits_that_cannot_be_stored_are_refused(
    change: dict[str, Any], problem: str, tmp_path: Path
) -> None:
    with DatabaseStore(tmp_path, "blue_paint") as store:
        for scan in (1, 3):
            store.store_scan(scan_record(scan))
        store.store_parameters(fit_record(3))
        with pytest.raises(DatabaseError, match=problem):
            store.store_parameters(replace(fit_record(1), **change))
        assert store.contents().fitted == (3,)


def test_damage_is_named(tmp_path: Path) -> None:
    with DatabaseStore(tmp_path, "blue_paint") as store:
        store.store_scan(scan_record(1))
    text = tmp_path / "sample01" / "tvBrdf-data" / "scan01_brdf_camera2_allexposures.txt"
    whole = text.read_bytes()
    text.write_bytes(whole[:-1])
    with pytest.raises(DatabaseError, match=r"camera2.*bytes instead of .* restore it from a copy"):
        DatabaseStore(tmp_path, "blue_paint", resume=True)
    text.unlink()
    with pytest.raises(DatabaseError, match=r"camera2.*is missing, but scan 1 was stored with it"):
        DatabaseStore(tmp_path, "blue_paint", resume=True)
    text.write_bytes(whole)
    (tmp_path / "sample01" / "tvBrdf-info.txt").unlink()  # derived: simply written again
    DatabaseStore(tmp_path, "blue_paint", resume=True).close()
    read_sample(tmp_path / "sample01")

    observations = tmp_path / "sample01" / "observations" / "scan01.npz"
    observations.write_bytes(observations.read_bytes()[:100])
    with pytest.raises(DatabaseError, match="observations of scan 1 cannot be read"):
        read_database(tmp_path).samples[0].scans[0].observations()
    (tmp_path / "catalogue.sqlite").write_bytes(b"no database" * 1000)
    with pytest.raises(DatabaseError, match="cannot be read"):
        read_database(tmp_path)
    with pytest.raises(DatabaseError, match="is damaged"):
        DatabaseStore(tmp_path, "blue_paint", resume=True)


def test_other_versions_are_refused(tmp_path: Path) -> None:
    DatabaseStore(tmp_path, "blue_paint").close()
    connection = sqlite3.connect(tmp_path / "catalogue.sqlite")
    with connection:
        connection.execute("UPDATE schema_version SET version = 99")
    connection.close()
    with pytest.raises(DatabaseError, match="version 99"):
        DatabaseStore(tmp_path, "blue_paint", resume=True)
    with pytest.raises(DatabaseError, match="version 99"):
        read_database(tmp_path)
    with pytest.raises(DatabaseError, match="no database of this project"):
        read_database(tmp_path / "elsewhere")


def test_it_can_be_read_while_it_is_written(tmp_path: Path) -> None:
    with DatabaseStore(tmp_path, "blue_paint") as store:
        for scan in (1, 2):
            store.store_scan(scan_record(scan))
            assert len(read_database(tmp_path).samples[0].scans) == scan


def test_a_closed_database_is_one_plain_catalogue_file(tmp_path: Path) -> None:
    store = DatabaseStore(tmp_path, "blue_paint")
    store.store_scan(scan_record(1))
    store.close()
    store.close()
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"catalogue.sqlite", "catalogue.lock", "sample01"}
    with pytest.raises(DatabaseError, match="is closed"):
        store.store_scan(scan_record(2))


def test_names_that_the_info_file_cannot_hold_are_refused(tmp_path: Path) -> None:
    for name, process in (("", ""), ("two\nlines", ""), ("paint", "a (b)")):
        with pytest.raises(DatabaseError, match="sample cannot be stored"):
            DatabaseStore(tmp_path / "database", name, process=process)
    assert not (tmp_path / "database").exists()


def test_importing_the_store_does_not_load_sqlalchemy() -> None:
    code = "import sys, tvbrdf_nodes.database_writer.store; print('sqlalchemy' in sys.modules)"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert result.stdout == "False\n"


def test_observations_hold_no_pickle(tmp_path: Path) -> None:
    with DatabaseStore(tmp_path, "blue_paint") as store:
        store.store_scan(scan_record(1))
    data = (tmp_path / "sample01" / "observations" / "scan01.npz").read_bytes()
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        assert set(arrays.files) == {"radiance", "valid", "camera"}


def test_what_the_published_file_has_no_room_for_is_said_beside_it(tmp_path: Path) -> None:
    with DatabaseStore(tmp_path, "blue_paint", process="drying", run_id="r1") as store:
        for scan, model in ((1, "oren_nayar+torrance_sparrow(coloured)"), (2, SURFACE)):
            store.store_scan(scan_record(scan))
            store.store_parameters(fit_record(scan, model))
    (lost,) = tmp_path.rglob("brdf-params-lost.txt")
    (line,) = lost.read_text().splitlines()
    assert line.startswith("scan 1: Ks of the channels, ")
    rows = [row.split() for row in (lost.parent / "brdf-params.txt").read_text().splitlines()]
    assert [len(row) for row in rows] == [6, 6]
    (sample,) = read_database(tmp_path).samples
    assert [len(scan.fit.values) for scan in sample.scans if scan.fit] == [8, 6]
