"""The store when it is killed, or the disk is full, at any step: nothing lost, nothing half.

Run as a script, this file is the process that is killed.
"""

from __future__ import annotations

import errno
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tvbrdf_fitting.published import CameraScan, list_scans, read_sample
from tvbrdf_fitting.published.sample import SURFACE_PARAMETERS
from tvbrdf_nodes.database_writer.store import (
    DatabaseError,
    DatabaseStore,
    DiskFullError,
    FitRecord,
    Outcome,
    ScanRecord,
    read_database,
)

SAMPLE = "blue_paint"
WATCHED = ("write", "fsync", "replace", "unlink", "mkdir")
"""Calls to the operating system by which Python code changes the disk."""


def scan_record(scan: int, observation_count: int = 100) -> ScanRecord:
    random = np.random.default_rng(scan)
    angle = np.deg2rad(np.arange(-80.0, 78.0, 8.0))
    light = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    view = np.array([0.0, 0.6, 0.8])
    return ScanRecord(
        sample=SAMPLE,
        scan=scan,
        start_stamp_ns=scan * 60_000_000_000,
        time_s=60.0 * scan,
        exposures_ms=(1.0,),
        grid={
            camera: CameraScan((1.0,), light, view, random.normal(size=light.shape))
            for camera in (1, 2)
        },
        observations={"radiance": random.normal(size=(observation_count, 3))},
    )


def fit_record(scan: int) -> FitRecord:
    values = np.random.default_rng(scan).uniform(0.1, 0.9, 6)
    return FitRecord(
        sample=SAMPLE,
        scan=scan,
        model="oren_nayar+torrance_sparrow",
        parameter_names=SURFACE_PARAMETERS,
        values=values,
        standard_deviations=values / 100,
        covariance=np.diag(values),
        errors={"rms_percent": 1.0, "count": 7},
        solver="lm",
        reason="converged",
    )


STEPS: dict[str, Callable[[DatabaseStore], Outcome]] = {
    "scan 1": lambda store: store.store_scan(scan_record(1)),
    "missing 2": lambda store: store.store_missing(2, "no light"),
    "fit 1": lambda store: store.store_parameters(fit_record(1)),
    "note": lambda store: store.store_note(7, "painted", zero=True),
    "late scan 2": lambda store: store.store_scan(scan_record(2)),
    "fit 2": lambda store: store.store_parameters(fit_record(2)),
}


def has(path: Path) -> set[str]:
    """What a database holds, of STEPS, by reading it."""
    (sample,) = read_database(path).samples or (None,)
    if sample is None:
        return set()
    late = {"late scan 2", "missing 2"}
    found = set()
    for scan in sample.scans:
        scan.radiance()
        scan.observations()
        found |= late if scan.scan == 2 else {f"scan {scan.scan}"}
        found |= {f"fit {scan.scan}"} if scan.fit is not None else set()
    found |= {"missing 2"} if [scan.scan for scan in sample.missing] == [2] else set()
    found |= {"note"} if any(note.zero for note in sample.notes) else set()
    return found


def catalogued_scans(path: Path) -> tuple[int, ...]:
    return tuple(scan.scan for scan in read_database(path).samples[0].scans)


def files(path: Path) -> dict[str, bytes]:
    """All files but those of the catalogue itself, which differ in order and stamps."""
    found = sorted(file for file in path.rglob("*") if file.is_file())
    return {
        str(file.relative_to(path)): file.read_bytes()
        for file in found
        if not file.name.startswith("catalogue")
    }


def complete(path: Path) -> dict[str, bytes]:
    """Open it for resuming, go through all steps, and return what is on disk then."""
    with DatabaseStore(path, SAMPLE, resume=True) as store:
        for step in STEPS.values():
            step(store)
    assert has(path) == set(STEPS)
    sample = read_sample(path / "sample01")
    assert [scan.scan for scan in sample.scans] == [1, 2]
    assert sample.parameter_scans == (1, 2)
    return files(path)


@contextmanager
def watching(at_call: Callable[[], None]) -> Iterator[None]:
    """Call ``at_call`` before each call that changes the disk, and around each commit."""
    from sqlalchemy import event
    from sqlalchemy.engine import Engine

    originals = {name: getattr(os, name) for name in WATCHED}

    def wrapped(original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            at_call()
            return original(*arguments, **options)

        return call

    def at_commit(_connection: Any) -> None:
        at_call()

    for name, original in originals.items():
        setattr(os, name, wrapped(original))
    event.listen(Engine, "commit", at_commit)
    try:
        yield
    finally:
        event.remove(Engine, "commit", at_commit)
        for name, original in originals.items():
            setattr(os, name, original)


def run_until_killed(path: Path, fatal_call: int, acknowledged: int) -> None:
    """Go through all steps in this process; SIGKILL at one call. Never returns."""
    calls = 0
    plain_write = os.write

    def at_call() -> None:
        nonlocal calls
        calls += 1
        if calls == fatal_call:
            os.kill(os.getpid(), signal.SIGKILL)

    with watching(at_call), DatabaseStore(path, SAMPLE, resume=True) as store:
        for name, step in STEPS.items():
            step(store)
            plain_write(acknowledged, f"{name}\n".encode())
    os._exit(0)


def kill_at_every_call(folder: Path) -> int:
    """Main program of the killed process: one fork for each call, and what it left is checked."""
    import sqlalchemy.orm  # noqa: F401  (once, not in each fork)

    reference = complete(folder / "reference")
    fatal_call = 0
    while True:
        fatal_call += 1
        path = folder / f"killed{fatal_call:03d}"
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                run_until_killed(path, fatal_call, writer)
            finally:
                os._exit(1)
        os.close(writer)
        with os.fdopen(reader, "r") as pipe:
            acknowledged = set(pipe.read().splitlines())
        _, status = os.waitpid(child, 0)
        if os.WIFEXITED(status):
            assert os.WEXITSTATUS(status) == 0
            return fatal_call - 1
        assert os.WTERMSIG(status) == signal.SIGKILL
        DatabaseStore(path, SAMPLE, resume=True).close()
        assert acknowledged <= has(path), fatal_call
        assert not list(path.rglob(".writing-*")), fatal_call
        assert list_scans(path / "sample01") == catalogued_scans(path), fatal_call
        assert complete(path) == reference, fatal_call


@pytest.mark.slow
def test_killed_at_any_step_nothing_acknowledged_is_lost(tmp_path: Path) -> None:
    command = [sys.executable, __file__, "kill_at_every_call", str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=170, check=False)
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) > 60  # the steps that were killed: files, folders, commits, renames


@pytest.mark.slow
def test_disk_full_at_any_step_nothing_is_lost(tmp_path: Path) -> None:
    reference = complete(tmp_path / "reference")
    full_call = 0
    while True:
        full_call += 1
        path = tmp_path / f"full{full_call:03d}"
        faults, done = _steps_with_one_fault(path, full_call)
        if faults == 0:
            break
        assert done == set(STEPS)
        assert complete(path) == reference, full_call
    assert full_call > 60


def _steps_with_one_fault(path: Path, full_call: int) -> tuple[int, set[str]]:
    """Each step until it succeeds, as a sender does, with one failing call."""
    calls = faults = 0

    def at_call() -> None:
        nonlocal calls
        calls += 1
        if calls == full_call:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def until_it_works(action: Callable[[], Any]) -> Any:
        nonlocal faults
        try:
            return action()
        except DiskFullError as error:
            message = str(error)
        faults += 1
        assert "the disk is full" in message
        assert "MB free" in message
        return action()

    done = set()
    with watching(at_call):
        store = until_it_works(lambda: DatabaseStore(path, SAMPLE, resume=True))
        with store:
            for name, step in STEPS.items():
                before = has(path)
                until_it_works(partial(step, store))
                assert before <= has(path)
                done.add(name)
    assert faults <= 1
    return min(calls // full_call, 1), done


def test_full_catalogue_is_told_and_overcome(tmp_path: Path) -> None:
    from sqlalchemy import event

    with DatabaseStore(tmp_path, SAMPLE) as store:
        store.store_scan(scan_record(1))

        def limit(pages: int) -> Callable[[Any], None]:
            return lambda connection: connection.exec_driver_sql(f"PRAGMA max_page_count={pages}")

        def store_notes() -> None:  # one or two fit into the page that is there
            for part in range(100):
                store.store_note(part, "x" * 500)

        small, large = limit(1), limit(1_000_000)
        event.listen(store._engine, "begin", small)
        with pytest.raises(DiskFullError, match="storing a note failed: the disk is full"):
            store_notes()
        with pytest.raises(DiskFullError, match="storing scan 2 failed: the disk is full"):
            store.store_scan(replace(scan_record(2), quality={"gaps": "x" * 5000}))
        event.remove(store._engine, "begin", small)
        event.listen(store._engine, "begin", large)
        assert store.contents().scans == (1,)
        assert store.store_scan(scan_record(2)) == "stored"
        event.remove(store._engine, "begin", large)
    assert has(tmp_path) >= {"scan 1", "late scan 2"}


def in_a_small_disk(function: str, options: str) -> subprocess.CompletedProcess[str]:
    """Run a function of this file on a disk of its own, which vanishes with the process."""
    script = f'mount -t tmpfs -o {options} none /mnt && exec "$0" "$1" {function} /mnt'
    command = ["unshare", "--mount", "sh", "-c", script, sys.executable, __file__]
    result = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    if "Operation not permitted" in result.stderr or "permission denied" in result.stderr:
        pytest.skip(f"may not mount a small disk here: {result.stderr.strip()}")
    return result


def fill_the_disk(folder: Path) -> int:
    """Store scans until the disk is full, make space, go on."""
    filler = folder / "filler"
    filler.write_bytes(bytes(1_000_000))
    path = folder / "database"
    with DatabaseStore(path, SAMPLE) as store:

        def store_scans() -> None:
            for scan in count(1):
                store.store_scan(scan_record(scan, observation_count=4000))

        with pytest.raises(DiskFullError, match=r"storing scan \d+ failed: the disk is full"):
            store_scans()
        stored = len(store.contents().scans)
        assert store.contents().scans == tuple(range(1, stored + 1))
        with suppress(DiskFullError):  # this little may still find a place
            store.store_parameters(fit_record(1))
        filler.unlink()
        for number in range(1, stored + 4):
            outcome = store.store_scan(scan_record(number, observation_count=4000))
            assert outcome == ("already_stored" if number <= stored else "stored")
        store.store_parameters(fit_record(1))
    database = read_database(path)
    assert [scan.scan for scan in database.samples[0].scans] == list(range(1, stored + 4))
    for scan in database.samples[0].scans:
        expected = scan_record(scan.scan, observation_count=4000).observations["radiance"]
        assert np.array_equal(scan.observations()["radiance"], expected)
    read_sample(path / "sample01")
    return stored


def test_a_disk_that_is_really_full(tmp_path: Path) -> None:
    result = in_a_small_disk("fill_the_disk", "size=2m")
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) >= 3


def open_where_nothing_can_be_written(folder: Path) -> int:
    problem = "is not writable .* give a folder that you may write to"
    with pytest.raises(DatabaseError, match=problem):
        DatabaseStore(folder / "database", SAMPLE)
    return 0


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    result = in_a_small_disk("open_where_nothing_can_be_written", "size=1m,ro")
    assert result.returncode == 0, result.stderr


def test_a_catalogue_locked_by_a_stranger_is_told(tmp_path: Path) -> None:
    with DatabaseStore(tmp_path, SAMPLE) as store:
        stranger = sqlite3.connect(tmp_path / "catalogue.sqlite", isolation_level=None)
        try:
            stranger.execute("PRAGMA busy_timeout=0")
            stranger.execute("BEGIN IMMEDIATE")
            with store._engine.connect() as connection:
                connection.exec_driver_sql("PRAGMA busy_timeout=10")
            with pytest.raises(DatabaseError, match=r"storing scan 1 failed: .*locked"):
                store.store_scan(scan_record(1))
            stranger.execute("ROLLBACK")
        finally:
            stranger.close()
        assert store.store_scan(scan_record(1)) == "stored"


if __name__ == "__main__":
    print(globals()[sys.argv[1]](Path(sys.argv[2])))  # noqa: T201
