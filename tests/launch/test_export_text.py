"""The published text layout of a bag is what a live run's database writer has on disk."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.launch.export_inputs import results, the_radiance, whole_bag
from tests.replay.recorded_rig import write_bag
from tvbrdf_fitting.published import read_parameters, read_sample
from tvbrdf_launch.errors import RunError
from tvbrdf_launch.export import export_bag
from tvbrdf_messages.bag.errors import BagError
from tvbrdf_messages.messages import Mark, Parameters, ScanMissing
from tvbrdf_nodes.database_writer.conversion import fit_record, scan_record
from tvbrdf_nodes.database_writer.store import DatabaseStore, read_database


def files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_files_are_those_of_the_store(tmp_path: Path) -> None:
    report = export_bag(whole_bag(tmp_path / "a.mcap"), tmp_path / "out", ["text"])
    (written,) = report.written
    assert written.counts == {"scans": 1, "parameters": 1, "missing": 1}
    assert written.remarks == []
    with DatabaseStore(tmp_path / "db", "drying_paint") as store:
        for envelope in results():
            message = envelope.message
            if isinstance(message, Parameters):
                store.store_parameters(fit_record(message))
            else:
                store.store_scan(scan_record(the_radiance()))
        mark = Mark(text="painted", zero=True)
        store.store_note(1_800_000_005_000_000_000, mark.text, zero=mark.zero)
        store.store_missing(2, "lamp failed", time_s=60.0)
    assert files(tmp_path / "out" / "text" / "sample01") == files(tmp_path / "db" / "sample01")


def test_it_reads_as_a_published_sample_with_the_values_of_the_messages(tmp_path: Path) -> None:
    export_bag(whole_bag(tmp_path / "a.mcap"), tmp_path / "out", ["text"])
    folder = tmp_path / "out" / "text" / "sample01"
    (scan,) = read_sample(folder).scans
    radiance = the_radiance()
    for number, camera in scan.cameras.items():
        valid = radiance.grid_valid[number - 1].all(axis=1)
        # half of the layout's last decimal
        np.testing.assert_allclose(
            camera.radiance, radiance.grid_radiance[number - 1][valid], atol=0.5001e-6
        )
    (fit,) = [e.message for e in results() if isinstance(e.message, Parameters)]
    (row,) = read_parameters(folder / "tvBrdf-fits" / "brdf-params.txt")
    np.testing.assert_allclose(row, fit.values, atol=0.5001e-6)
    (sample,) = read_database(tmp_path / "out" / "text").samples
    (stored,) = sample.scans
    assert stored.quality["lamp_factor"] == radiance.quality["lamp_factor"]


def test_what_comes_twice_or_has_no_scan_is_told(tmp_path: Path) -> None:
    radiance, parameters = results()
    stray = parameters._replace(message=replace(_as(parameters, Parameters), scan=7))
    path = write_bag(tmp_path / "a.mcap", [radiance, radiance, parameters, stray], {})
    (written,) = export_bag(path, tmp_path / "out", ["text"]).written
    assert written.counts == {"scans": 1, "parameters": 1}
    assert written.remarks == ["parameters of 1 scans: their radiance is not in the bag"]


def test_a_foreign_missing_scan_is_left_out_and_told(tmp_path: Path) -> None:
    radiance, _ = results()
    other = ScanMissing(sample="dust", scan=2, scan_time_s=60.0, reason="late")
    path = write_bag(
        tmp_path / "a.mcap", [radiance, radiance._replace(topic="/scan/missing", message=other)], {}
    )
    (written,) = export_bag(path, tmp_path / "out", ["text"]).written
    (remark,) = written.remarks
    assert remark.startswith("scan 2, missing: ")
    assert "dust" in remark


def test_two_samples_are_refused(tmp_path: Path) -> None:
    radiance, _ = results()
    other = radiance._replace(message=replace(the_radiance(), sample="dust", scan=2))
    path = write_bag(tmp_path / "a.mcap", [radiance, other], {})
    with pytest.raises(BagError, match=r"2 samples \(drying_paint, dust\).*bag filter"):
        export_bag(path, tmp_path / "out", ["text"])
    assert not (tmp_path / "out").exists()


def test_a_full_disk_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bag(tmp_path / "a.mcap", results(), {})

    def full(*_: Any) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(os, "write", full)
        with pytest.raises(RunError, match=rf"{tmp_path}/out/text.*the disk is full"):
            export_bag(path, tmp_path / "out", ["text"])
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.mcap"]


def _as(envelope: Any, kind: type) -> Any:
    assert isinstance(envelope.message, kind)
    return envelope.message
