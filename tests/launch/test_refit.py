"""Refits: the same as live, whatever the order, the number of processes, or what came between."""

from __future__ import annotations

import errno
import hashlib
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.launch.published_samples import write_sample
from tests.launch.refit_inputs import copy_bag, found_values, inside, results, shuffled
from tests.replay.process_replay import BAG
from tests.replay.recorded_rig import read_all, record_rig, write_bag
from tvbrdf_fitting import fit_scan
from tvbrdf_fitting.published import read_parameters, read_scan
from tvbrdf_fitting.published.database import read_database
from tvbrdf_fitting.published.text import write_all, write_beside
from tvbrdf_launch.errors import RunError
from tvbrdf_launch.refit import Refit, Report, Settings, find_sources, pool
from tvbrdf_launch.refit.events import Progress
from tvbrdf_launch.refit.settings import Plan
from tvbrdf_launch.refit.sources import Unit
from tvbrdf_launch.refit.stored_sources import PublishedSource
from tvbrdf_launch.refit.writer import PART_FILE
from tvbrdf_messages.messages import Frame, Mark, Parameters, Radiance, ScanMissing

SEEDS = 3


def refit(*paths: Path, out: Path, jobs: int = 1, again: bool = False, **options: Any) -> Report:
    settings = Settings(**options)
    return Refit(find_sources([*paths]), out, settings, jobs=jobs, again=again).run()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scans of the simulated rig, with what the live nodes found."""
    return record_rig(
        tmp_path_factory.mktemp("rig"),
        scans=2,
        pixels=8,
        sweep_s=4.0,
        frame_rate_hz=15.0,
        dark_frames=3,
        exposures_ms=[0.2, 4.0],
    )


@pytest.fixture(scope="module")
def live(recorded: Path) -> dict[int, Parameters]:
    messages = (envelope.message for envelope in read_all(recorded))
    return {m.scan: m for m in messages if isinstance(m, Parameters)}


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample(tmp_path_factory.mktemp("published") / "sample07", scans=5)


def check_live(folder: Path, live: dict[int, Parameters]) -> None:
    records = results(folder)
    assert [record["scan"] for record in records] == sorted(live)
    for record in records:
        expected = live[record["scan"]]
        assert tuple(record["values"]) == expected.values
        assert tuple(record["standard_deviations"]) == expected.standard_deviations
        assert record["covariance"] == expected.covariance.tolist()
        assert record["errors"] == expected.errors


# -- the same as live


def test_a_refit_from_frames_equals_the_live_run_bit_for_bit(
    recorded: Path, live: dict[int, Parameters], tmp_path: Path
) -> None:
    report = refit(recorded, out=tmp_path)
    assert report.problems == []
    assert report.refitted == 2
    check_live(tmp_path / "rig", live)
    (stored,) = read_database(tmp_path / "rig" / "database").samples
    assert stored.name == "drying_paint"
    for scan in stored.scans:
        assert scan.fit is not None
        assert tuple(scan.fit.values) == live[scan.scan].values
    (note,) = stored.notes
    assert "from frames of rig.mcap (SHA-256 " in note.text


def test_a_refit_from_radiances_and_from_its_own_database_gives_the_same(
    recorded: Path, live: dict[int, Parameters], tmp_path: Path
) -> None:
    refit(recorded, out=tmp_path / "a", start="radiance")
    check_live(tmp_path / "a" / "rig", live)
    refit(tmp_path / "a" / "rig" / "database", out=tmp_path / "b")
    check_live(tmp_path / "b" / "database", live)


@pytest.mark.parametrize("seed", range(SEEDS))
def test_the_order_in_which_publishers_messages_came_does_not_matter(
    recorded: Path, live: dict[int, Parameters], tmp_path: Path, seed: int
) -> None:
    messages = list(read_all(recorded))
    other = list(shuffled(messages, seed))
    assert [e.order() for e in other] != [e.order() for e in messages]
    bag = write_bag(tmp_path / "rig.mcap", other, inside(recorded))
    refit(bag, out=tmp_path / "out", jobs=1 + seed % 2)
    check_live(tmp_path / "out" / "rig", live)


# -- jobs, repetition, kills


def files_below(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_results_do_not_depend_on_jobs_nor_on_being_repeated(
    recorded: Path, sample: Path, tmp_path: Path
) -> None:
    for name, jobs in (("a", 1), ("b", 2), ("c", 3)):
        report = refit(recorded, sample, out=tmp_path / name, jobs=jobs)
        assert report.problems == []
    for other in ("b", "c"):
        for name in ("rig", "sample07"):
            for file in ("results.jsonl", "refit.json"):
                one, another = (tmp_path / o / name / file for o in ("a", other))
                assert one.read_bytes() == another.read_bytes()
        first, second = (files_below(tmp_path / o / "sample07") for o in ("a", other))
        assert first == second
    texts = "rig/database/sample01"
    assert files_below(tmp_path / "a" / texts) == files_below(tmp_path / "b" / texts)


def test_what_is_done_already_is_kept_and_what_was_cut_is_done_again(
    sample: Path, tmp_path: Path
) -> None:
    refit(sample, out=tmp_path / "whole")
    whole = tmp_path / "whole" / "sample07"
    lines = (whole / "results.jsonl").read_bytes().splitlines(keepends=True)
    refit(sample, out=tmp_path / "cut")
    folder = tmp_path / "cut" / "sample07"
    header = (folder / "refit.json").read_text()
    (folder / "refit.json").write_text(header.replace('"complete": true', '"complete": false'))
    (folder / "results.jsonl").unlink()
    (folder / PART_FILE).write_bytes(b"".join([lines[3], lines[1], lines[0][:-40]]))
    report = refit(sample, out=tmp_path / "cut")
    assert report.refitted == 3
    assert report.targets[0].scans == 5
    assert files_below(folder) == files_below(whole)
    assert refit(sample, out=tmp_path / "cut").refitted == 0
    assert files_below(folder) == files_below(whole)


def test_a_refit_that_was_killed_goes_on_where_it_was(sample: Path, tmp_path: Path) -> None:
    big = tmp_path / "sample01"
    (big / "tvBrdf-data").mkdir(parents=True)
    for scan in range(1, 121):
        for camera in range(1, 5):
            name = f"scan{{:02d}}_brdf_camera{camera}_allexposures.txt"
            source = sample / "tvBrdf-data" / name.format(1 + scan % 5)
            (big / "tvBrdf-data" / name.format(scan)).hardlink_to(source)
    out = tmp_path / "out"
    words = ["refit", str(big), "--out", str(out), "--jobs", "2"]
    command = [sys.executable, "-m", "tvbrdf_launch", *words]
    process = subprocess.Popen(command, start_new_session=True)
    part = out / "sample01" / PART_FILE
    deadline = time.monotonic() + 60.0
    while not (part.exists() and part.stat().st_size > 20_000):
        assert time.monotonic() < deadline
        assert process.poll() is None
        os.sched_yield()
    process.kill()
    assert process.wait() == -signal.SIGKILL
    while alive_in_session(process.pid):  # its own processes end with it
        assert time.monotonic() < deadline
    done = part.read_bytes().count(b"\n")
    assert 0 < done < 120
    report = refit(big, out=out)
    assert report.refitted == 120 - done
    refit(big, out=tmp_path / "once", jobs=1)
    assert files_below(out) == files_below(tmp_path / "once")


def alive_in_session(session: int) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[3]) == session and fields[0] != "Z":
                found.append(int(entry.name))
    return found


def test_a_scan_that_was_stored_just_before_a_kill_is_not_stored_twice(
    recorded: Path, live: dict[int, Parameters], tmp_path: Path
) -> None:
    refit(recorded, out=tmp_path)
    folder = tmp_path / "rig"
    whole = (folder / "results.jsonl").read_bytes()
    header = (folder / "refit.json").read_text()
    (folder / "refit.json").write_text(header.replace('"complete": true', '"complete": false'))
    (folder / "results.jsonl").unlink()
    (folder / PART_FILE).write_bytes(whole.splitlines(keepends=True)[0])
    assert refit(recorded, out=tmp_path).refitted == 1
    assert (folder / "results.jsonl").read_bytes() == whole
    (stored,) = read_database(folder / "database").samples
    assert [scan.scan for scan in stored.scans] == [1, 2]
    assert len(stored.notes) == 1  # a contradiction would be noted


# -- what it was made from


def test_each_result_says_what_it_was_made_from_and_with(recorded: Path, tmp_path: Path) -> None:
    refit(recorded, out=tmp_path, metric="relative")
    digest = hashlib.sha256(recorded.read_bytes()).hexdigest()
    size = recorded.stat().st_size
    for record in results(tmp_path / "rig"):
        made = record["made_from"]
        assert made["files"] == [{"name": "rig.mcap", "size": size, "sha256": digest}]
        assert record["version"]
        assert record["settings"]["fitter"]["metric"] == "relative"
        assert record["settings"]["calibration"]["name"] == "calibration.yaml"
        ranges = {one["topic"]: one for one in made["messages"]}
        frames = [
            e.header.sequence
            for e in read_all(recorded)
            if e.topic == "/camera_2/frame" and getattr(e.message, "scan", 0) == record["scan"]
        ]
        told = ranges["/camera_2/frame"]
        assert (told["first_sequence"], told["last_sequence"]) == (frames[0], frames[-1])
        assert told["messages"] == len(frames)
        assert ranges["/arm/state"]["publisher"] == "arm"


def test_another_calibration_moves_the_radiance(
    recorded: Path, live: dict[int, Parameters], tmp_path: Path
) -> None:
    """Albedos of the reference doubled: everything is twice as bright, so are Kd and Ks."""
    from tvbrdf_launch.refit.settings import CalibrationFile

    text = inside(recorded)["calibration/calibration.yaml"].decode()
    old = "reference_albedo: [0.7410, 0.7438, 0.752]"
    assert old in text
    new = text.replace(old, "reference_albedo: [0.3705, 0.3719, 0.376]")
    refit(recorded, out=tmp_path, calibration=CalibrationFile("half.yaml", new.encode()))
    for record in results(tmp_path / "rig"):
        values = dict(zip(record["parameter_names"], record["values"], strict=True))
        before = live[record["scan"]]
        then = dict(zip(before.parameter_names, before.values, strict=True))
        for name in ("kd_b", "kd_g", "kd_r", "ks"):
            assert values[name] == pytest.approx(0.5 * then[name], rel=0.02), name


def test_published_samples_are_fitted_as_tvbrdf_fit_does(sample: Path, tmp_path: Path) -> None:
    refit(sample, out=tmp_path)
    folder = tmp_path / "sample07"
    for record in results(folder):
        expected = fit_scan(read_scan(sample, record["scan"]).observations())
        np.testing.assert_allclose(record["values"], expected.values, rtol=1e-12)
        files = record["made_from"]["files"]
        assert len(files) == 4
        for one in files:
            data = (sample / "tvBrdf-data" / one["name"]).read_bytes()
            assert f"scan{record['scan']:02d}_" in one["name"]
            assert (one["size"], one["sha256"]) == (len(data), hashlib.sha256(data).hexdigest())
    table = read_parameters(folder / "tvBrdf-fits" / "brdf-params.txt")
    np.testing.assert_allclose(table, [r["values"] for r in results(folder)], atol=0.5000001e-6)


def test_notes_and_missing_scans_go_along(recorded: Path, tmp_path: Path) -> None:
    messages = list(read_all(recorded))
    header = messages[0].header
    lost = ScanMissing(sample="drying_paint", scan=3, scan_time_s=120.0, reason="the lamp was off")
    messages += [
        messages[0]._replace(
            topic="/operator/mark",
            header=header._replace(publisher="operator"),
            message=Mark(text="paint applied", zero=True),
        ),
        messages[0]._replace(
            topic="/scan/missing", header=header._replace(publisher="sequencer"), message=lost
        ),
    ]
    bag = write_bag(tmp_path / "rig.mcap", messages, inside(recorded))
    for start in ("frames", "radiance"):
        report = refit(bag, out=tmp_path / start, start=start)
        assert report.targets[0].unfinished == {3: "the lamp was off"}
        (stored,) = read_database(tmp_path / start / "rig" / "database").samples
        assert [(m.scan, m.reason) for m in stored.missing] == [(3, "the lamp was off")]
        assert ("paint applied", True) in [(n.text, n.zero) for n in stored.notes]


def test_a_scan_of_which_frames_are_missing_is_told_and_the_others_are_fitted(
    recorded: Path, live: dict[int, Parameters], tmp_path: Path
) -> None:
    light = [
        (e.message.attempt, e.header.sequence)
        for e in read_all(recorded)
        if isinstance(e.message, Frame)
        and (e.message.camera, e.message.kind) == ("camera_3", "light")
        and (e.message.scan, e.message.sweep) == (2, 0)
    ]
    # of the last attempt: on a busy machine the simulated serial line may have broken another
    _, gone = max(light)
    bag = copy_bag(
        tmp_path / "rig.mcap",
        lambda e: not (e.topic == "/camera_3/frame" and e.header.sequence == gone),
        bag=recorded,
    )
    report = refit(bag, out=tmp_path / "out")
    assert report.problems == []
    assert [*report.targets[0].unfinished] == [2]
    assert "camera_3 sent" in report.targets[0].unfinished[2]
    check_live(tmp_path / "out" / "rig", {1: live[1]})


# -- what fails while it works


def test_a_scan_that_cannot_be_fitted_is_told(recorded: Path, tmp_path: Path) -> None:
    def spoiled() -> Iterator[Any]:
        for envelope in read_all(recorded):
            message = envelope.message
            if isinstance(message, Radiance) and message.scan == 2:
                message = replace(message, valid=np.zeros_like(message.valid))
            yield envelope._replace(message=message)

    bag = write_bag(tmp_path / "rig.mcap", spoiled(), inside(recorded))
    report = refit(bag, out=tmp_path / "out", start="radiance")
    (text,) = report.problems
    assert text.startswith(f"{bag}: scan 2 can't be fitted: 0 usable values")
    one, two = results(tmp_path / "out" / "rig")
    assert all(value is None for value in two["values"])
    assert all(value is not None for value in one["values"])


def test_a_full_disk_ends_it_and_what_is_finished_is_kept(
    sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tvbrdf_launch.refit import writer

    written: list[bytes] = []

    def full(descriptor: int, data: bytes) -> None:
        if len(written) == 2:
            os.write(descriptor, data[:100])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written.append(data)
        write_all(descriptor, data)

    with monkeypatch.context() as patch:
        patch.setattr(writer, "_write", full)
        with pytest.raises(RunError, match=r"sample07: .*No space left.*kept: free some space"):
            refit(sample, out=tmp_path / "out")
    report = refit(sample, out=tmp_path / "out")
    assert report.refitted == 3
    refit(sample, out=tmp_path / "whole")
    assert files_below(tmp_path / "out") == files_below(tmp_path / "whole")


def test_a_full_disk_under_the_database_ends_it_too(
    recorded: Path, live: dict[int, Parameters], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tvbrdf_nodes.database_writer import store

    calls: list[Path] = []

    def full(path: Path, data: bytes) -> Path:
        if path.name.startswith("scan02"):
            calls.append(path)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return write_beside(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(store, "write_beside", full)
        with pytest.raises(RunError, match=r"the disk is full.*run the same command again"):
            refit(recorded, out=tmp_path)
    assert calls
    report = refit(recorded, out=tmp_path)
    assert report.refitted == 1
    check_live(tmp_path / "rig", live)


def test_a_process_that_dies_is_told(
    sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers are forked or spawned; a spawned one finds the same bad file and dies of it."""
    monkeypatch.setattr(pool, "_serve", _killed)
    copied = write_sample(tmp_path / "sample09", scans=1)
    with pytest.raises(RunError, match=r"ended by signal 9: out of memory\? give fewer --jobs"):
        refit(sample, copied, out=tmp_path / "out", jobs=2)


def _killed(end: Any, parent: int, tasks: Any) -> None:
    end.recv()
    os.kill(os.getpid(), signal.SIGKILL)


def test_what_was_found_before_an_error_is_handed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(task: Any) -> Iterator[Any]:
        yield Progress(0.25)
        yield Progress(0.5)
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(pool, "_events", broken)
    task = pool.Task(0, 0, PublishedSource(Path("sample01")), Unit(), Plan("radiance", {}))
    mine, theirs = multiprocessing.Pipe()
    with mine, theirs:
        pool._tell(theirs, task)
        *events, error = mine.recv()
    assert events == [Progress(0.25), Progress(0.5)]
    assert isinstance(error, ZeroDivisionError)
    assert error.__notes__ == ["while refitting sample01"]


def test_models_that_are_kept_from_scan_to_scan_are_chosen_in_order(
    sample: Path, tmp_path: Path
) -> None:
    for name, jobs in (("a", 1), ("b", 2)):
        refit(sample, out=tmp_path / name, jobs=jobs, model="auto")
    first, second = (files_below(tmp_path / name) for name in ("a", "b"))
    assert first == second
    assert all("choice" in record["details"] for record in results(tmp_path / "a" / "sample07"))


def test_the_bag_in_the_repository_is_refitted(tmp_path: Path) -> None:
    refit(BAG, out=tmp_path)
    assert found_values(tmp_path / "rig")
