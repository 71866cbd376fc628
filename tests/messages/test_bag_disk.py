"""A disk that is full or refuses to write: what was recorded is kept, and the error says so."""

from __future__ import annotations

import dataclasses
import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.messages.bag_samples import Told, arm_state, frame, plain, read, rig_messages, write
from tests.paths import ROOT
from tests.sample_messages import START_NS
from tvbrdf_messages.bag import (
    BagError,
    BagFloorError,
    BagReader,
    BagWriteError,
    BagWriter,
    check_bag,
    filter_bag,
    recover,
)

LIMIT_BYTES = 300_000
RECORDER = """
import resource
import sys
from pathlib import Path
from tests.messages.bag_samples import rig_messages
from tvbrdf_messages.bag import BagError, BagWriter
resource.setrlimit(resource.RLIMIT_FSIZE, 2 * (int(sys.argv[2]),))
try:
    with BagWriter(Path(sys.argv[1]), compression="none") as writer:
        for log_time_ns, envelope in rig_messages(60):
            writer.write_envelope(envelope, log_time_ns)
except BagError as error:
    print(type(error).__name__, error)
"""


@pytest.mark.system
def test_a_file_that_may_not_grow(tmp_path: Path) -> None:
    """The system's own limit (RLIMIT_FSIZE): a whole bag remains, a second is lost."""
    path = tmp_path / "a.mcap"
    done = subprocess.run(
        [sys.executable, "-c", RECORDER, str(path), str(LIMIT_BYTES)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=True,
    )
    assert done.stdout.startswith(f"BagWriteError {path}: can't be written: File too large;")
    found = read(path)
    assert "what was recorded before is complete" in done.stdout
    assert len(found) > 200
    assert plain(found) == plain(rig_messages(60)[: len(found)])
    assert check_bag(path).problems[1:] == []  # of the first, "no calibration"
    assert path.stat().st_size <= LIMIT_BYTES


def write_all(writer: BagWriter, told: list[Told]) -> None:
    for log_time_ns, envelope in told:
        writer.write_envelope(envelope, log_time_ns)


def full_disk(monkeypatch: pytest.MonkeyPatch, room: int) -> None:
    """Let the system write so many bytes more, the last of them in part, then refuse."""
    left = [room]
    real = os.write

    def write_some(fd: int, data: bytes) -> int:
        if left[0] == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        count = real(fd, memoryview(data)[: left[0]])
        left[0] -= count
        return count

    monkeypatch.setattr(os, "write", write_some)


@pytest.mark.parametrize("room", [5_000, 20_000, 39_000, 60_000, 77_777])
def test_a_full_disk_keeps_whole_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    """No room even for the index: the file ends behind a whole chunk, and can be recovered."""
    told = rig_messages(10)
    path = tmp_path / "a.mcap"
    writer = BagWriter(path, chunk_s=0.1, compression="none")
    full_disk(monkeypatch, room)
    with pytest.raises(BagWriteError, match="No space left on device; recording has ended") as e:
        write_all(writer, told)
    monkeypatch.undo()
    assert f"run 'tvbrdf bag recover {path}'" in str(e.value)
    with pytest.raises(BagError, match="nothing more can be recorded: writing"):
        writer.write_envelope(arm_state(0, START_NS).envelope, START_NS)
    report = recover(path, tmp_path / "out.mcap")
    assert report.lost == []
    found = read(tmp_path / "out.mcap")
    assert plain(found) == plain(told[: len(found)])
    assert len(found) == sum(writer.counts().values())
    written = path.stat().st_size
    assert room - 10_000 < written <= room + 1000  # a chunk has 7 to 9 kB


def test_a_full_disk_between_two_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The next file can't be begun: the one before is whole."""
    told = rig_messages(3)
    writer = BagWriter(tmp_path / "bag", split_s=1.0)
    real = os.open

    def no_more(path: str, *rest: int) -> int:
        if str(path).endswith("_1.mcap"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(path, *rest)

    monkeypatch.setattr(os, "open", no_more)
    with pytest.raises(BagWriteError, match=r"what was recorded before is complete"):
        write_all(writer, told)
    monkeypatch.undo()
    found = read(tmp_path / "bag")
    assert plain(found) == plain([t for t in told if t.log_time_ns < START_NS + 10**9])
    assert [file.name for file in (tmp_path / "bag").iterdir()] == ["bag_0.mcap"]


def test_the_floor_ends_the_bag_with_everything_in_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk's free room shrinks while it records; the message that met the floor is in."""
    told = rig_messages(10)
    floor = 1_000_000
    free = [floor + 50_000]
    path = tmp_path / "a.mcap"

    class Disk:
        f_frsize = 1

        @property
        def f_bavail(self) -> int:
            return free[0] - (path.stat().st_size if path.exists() else 0)

    monkeypatch.setattr(os, "fstatvfs", lambda fd: Disk())
    writer = BagWriter(path, chunk_s=0.1, floor_free_bytes=floor)
    with pytest.raises(BagFloorError, match=r"less than the floor of 1 MB .* complete up to here"):
        write_all(writer, told)
    written = sum(writer.counts().values())
    assert 0 < written < len(told)
    assert plain(read(path)) == plain(told[:written])
    free[0] = floor - 1
    with pytest.raises(BagFloorError, match="nothing was recorded"):
        BagWriter(tmp_path / "b", floor_free_bytes=floor)
    assert [file.name for file in tmp_path.iterdir()] == ["a.mcap"]


def test_a_full_disk_while_a_bag_is_made_of_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a.mcap", [frame(k, START_NS + k, shape=(99, 99)) for k in range(50)])
    before = path.read_bytes()
    full_disk(monkeypatch, 1_000_000)
    with pytest.raises(BagWriteError, match="No space left on device"):
        filter_bag(path, tmp_path / "out.mcap")
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == before


def test_a_writer_that_was_abandoned_can_be_recovered(tmp_path: Path) -> None:
    told = rig_messages(3)
    writer = BagWriter(tmp_path / "a.mcap")
    write_all(writer, told)
    writer.abandon()
    recover(tmp_path / "a.mcap", tmp_path / "out.mcap")
    found = read(tmp_path / "out.mcap")
    assert plain(found) == plain([t for t in told if t.log_time_ns < START_NS + 2 * 10**9])
    with BagReader(tmp_path / "out.mcap") as reader:
        about = dataclasses.replace(writer.about, extra=reader.about.extra)
        assert reader.about == about


def test_an_interrupt_while_writing_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C in the middle of a chunk's bytes: the bag that is then closed has everything."""
    told = rig_messages(2)
    writer = BagWriter(tmp_path / "a.mcap", compression="none")
    real = os.write
    calls = []

    def interrupted(fd: int, data: bytes) -> int:
        calls.append(real(fd, memoryview(data)[:1000]))
        if len(calls) == 5:
            raise KeyboardInterrupt
        return calls[-1]

    first = [each for each in told if each.log_time_ns < START_NS + 10**9]
    write_all(writer, first)
    monkeypatch.setattr(os, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        writer.flush()
    monkeypatch.undo()
    write_all(writer, told[len(first) :])
    writer.close()
    assert plain(read(tmp_path / "a.mcap")) == plain(told)
    assert [p.kind for p in check_bag(tmp_path / "a.mcap").problems] == ["calibration"]
