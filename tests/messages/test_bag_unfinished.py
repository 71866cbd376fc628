"""What a killed process leaves of a new bag is removed by the next; what is in use never is."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.messages.bag_samples import plain, read, rig_messages, write
from tests.paths import ROOT
from tvbrdf_messages.bag import filter_bag, merge_bags, recover
from tvbrdf_messages.bag.unfinished import Unfinished, remove_unfinished

WRITES = """
import sys
from pathlib import Path
from tvbrdf_messages.bag import About, BagReader
from tvbrdf_messages.bag.output import NewBag

with BagReader(sys.argv[1]) as bag, NewBag(Path(sys.argv[2]), About(), {}) as new:
    for message in bag.messages(raw=True):
        new.add(message)
    new.writer.flush()
    print("written", flush=True)
    sys.stdin.read()
"""


@contextmanager
def half_written(bag: Path, out: Path) -> Iterator[Path]:
    """Give the folder in which another process makes a bag; in the end that process is killed."""
    command = [sys.executable, "-c", WRITES, str(bag), str(out)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, cwd=ROOT) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"written\n"
        (folder,) = out.parent.glob(f".{out.name}.*")
        yield folder
        process.kill()
        assert process.wait() == -signal.SIGKILL


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write(tmp_path / "bag.mcap", rig_messages(2))


@pytest.mark.parametrize("name", ["new.mcap", "new"])
def test_the_next_one_removes_it_and_says_so(tmp_path: Path, bag: Path, name: str) -> None:
    out = tmp_path / name
    with half_written(bag, out) as folder:
        assert remove_unfinished(out) == ()  # somebody is at work there
    assert any(folder.iterdir())
    report = recover(bag, out)
    assert report.removed == (folder,)
    assert report.plain()["removed"] == [str(folder)]
    assert sorted(tmp_path.iterdir()) == sorted([bag, out])
    assert plain(read(out)) == plain(read(bag))


def test_it_stays_while_its_maker_is_at_work(tmp_path: Path, bag: Path) -> None:
    out = tmp_path / "new.mcap"
    with half_written(bag, out) as folder:
        assert filter_bag(bag, out, topics=["/arm/state"]).removed == ()
        assert any(folder.iterdir())
        out.unlink()
    report = merge_bags([bag], out)
    assert report.removed == (folder,)
    assert report.plain()["removed"] == [str(folder)]
    assert not folder.exists()


def test_only_what_is_of_the_same_output_is_removed(tmp_path: Path, bag: Path) -> None:
    out = tmp_path / "new.mcap"
    others = [
        tmp_path / name
        for name in (".new.mcap.tvbrdf-12345678x", ".new.mcap.old", ".other.mcap.tvbrdf-12345678",
                     ".newxmcap.tvbrdf-12345678", "new.mcap.tvbrdf-12345678")
    ]  # fmt: skip
    left = tmp_path / ".new.mcap.tvbrdf-12345678"
    for folder in (*others, left):
        folder.mkdir()
        (folder / "file").write_text("of somebody")
    empty = tmp_path / ".new.mcap.tvbrdf-abcdefgh"  # of one that is about to lock it
    empty.mkdir()
    link = tmp_path / ".new.mcap.tvbrdf-87654321"
    link.symlink_to(others[0])
    assert recover(bag, out).removed == (left,)
    assert sorted(tmp_path.iterdir()) == sorted([bag, out, *others, empty, link])
    assert all((folder / "file").exists() for folder in others)


def test_two_may_make_the_same_output(tmp_path: Path) -> None:
    """Neither takes the other's place away; who is last finds that it exists by now."""
    out = tmp_path / "out"
    with Unfinished(out) as one:
        one.path.mkdir()
        with Unfinished(out) as other:
            assert other.removed == ()
            assert other.folder != one.folder
            other.path.mkdir()
        assert one.path.is_dir()
    assert list(tmp_path.iterdir()) == []
