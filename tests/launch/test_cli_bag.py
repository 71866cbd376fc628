"""``tvbrdf bag``: every verb, as text and as JSON; errors in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.messages.bag_samples import arm_state, plain, read, rig_messages, write
from tests.sample_messages import START_NS
from tvbrdf_launch.cli import main

SECOND_NS = 10**9


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write(tmp_path / "a.mcap", rig_messages(4))


class Shell:
    """Runs verbs in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def good(self, *words: object, status: int = 0) -> str:
        assert main(["bag", *map(str, words)]) == status
        out, err = self._capsys.readouterr()
        assert err == ""
        return out

    def parsed(self, *words: object, status: int = 0) -> Any:
        return json.loads(self.good(*words, "--json", status=status))

    def bad(self, *words: object) -> str:
        assert main(["bag", *map(str, words)]) == 1
        out, err = self._capsys.readouterr()
        assert out == ""
        assert len(err.splitlines()) == 1
        assert err.startswith("tvbrdf: error: ")
        return err


@pytest.fixture
def shell(capsys: pytest.CaptureFixture[str]) -> Shell:
    return Shell(capsys)


def test_info(bag: Path, shell: Shell) -> None:
    text = shell.good("info", bag)
    for line in (
        f"Bag:         {bag}",
        "Duration:    3.980 s",
        f"Messages:    {len(rig_messages(4))}",
        "Run:         run-1",
        "  calibration/rig.yaml (480 B)",
    ):
        assert line in text.splitlines()
    rows = {row.split()[0]: row.split()[1:] for row in text.split("Topics:\n")[1].splitlines()}
    assert rows["topic"] == ["type", "messages", "rate", "size", "lost", "publishers"]
    assert rows["/arm/state"][:4] == ["ArmState", "200", "50.00", "Hz"]
    assert rows["/diagnostics"][-2:] == ["arm,", "fitter"]
    assert "Gaps" not in text
    found = shell.parsed("info", bag)
    assert found["messages"] == len(rig_messages(4))
    assert found["duration_s"] == pytest.approx(3.98, abs=0.001)
    assert found["about"]["run"] == "run-1"
    assert found == shell.parsed("info", bag, "--recount")


def test_info_tells_gaps_and_files(tmp_path: Path, shell: Shell) -> None:
    numbers = [n for n in range(100) if n % 7 and n not in {50, 51}]
    told = [arm_state(n, START_NS + n * SECOND_NS // 10) for n in numbers]
    bag = write(tmp_path / "bag", told, split_s=4.0, attachments={})
    text = shell.good("info", bag)
    assert "Attachments: none" in text
    assert "  bag_2.mcap: 1.800 s, " in text
    assert "Gaps:\n  /arm/state of arm (one): 7\n" in text
    assert "  /arm/state of arm (one): 49 to 51\n" in text
    assert text.endswith("  and 4 more (all with --json)\n")
    (stream,) = shell.parsed("info", bag)["streams"]
    assert [49, 51] in stream["gaps"]


def test_info_tells_jumps_of_clocks(tmp_path: Path, shell: Shell) -> None:
    """By log time alone this one looks like a pause of an hour."""
    told = [arm_state(k, START_NS + k * 20_000_000) for k in range(20)]
    told[10:] = [each._replace(log_time_ns=each.log_time_ns + 3600 * 10**9) for each in told[10:]]
    bag = write(tmp_path / "a.mcap", told)
    text = shell.good("info", bag)
    assert "Jumps of clocks:\n  /arm/state, 3600.200 s after the start: log time leaps" in text
    (jump,) = shell.parsed("info", bag)["clock_jumps"]
    assert jump["log_time_ns"] == told[10].log_time_ns
    assert "Jumps" not in shell.good("info", write(tmp_path / "b.mcap", told[:10]))


def test_info_of_an_empty_recording(tmp_path: Path, shell: Shell) -> None:
    text = shell.good("info", write(tmp_path / "a.mcap", [], attachments={}))
    assert "Topics: none" in text
    assert "Duration" not in text


def test_filter(bag: Path, tmp_path: Path, shell: Shell) -> None:
    out = tmp_path / "out.mcap"
    text = shell.good(
        "filter", bag, "-o", out, "--topics", "/arm/state", "--regex", "frame", "-x", "camera_2",
        "--start", 1, "--end", 2.5,
    )  # fmt: skip
    assert text.splitlines()[0] == f"{out}: 90 messages"
    assert "  /arm/state: 75" in text
    first_ns = rig_messages(4)[0].log_time_ns
    expected = [
        t
        for t in rig_messages(4)
        if t.envelope.topic in {"/arm/state", "/camera_1/frame"}
        and first_ns + SECOND_NS <= t.log_time_ns < first_ns + 2.5 * SECOND_NS
    ]
    assert plain(read(out)) == plain(expected)


def test_merge(bag: Path, tmp_path: Path, shell: Shell) -> None:
    half = tmp_path / "half.mcap"
    shell.good("filter", bag, "-o", half, "--topics", "/arm/state")
    out = tmp_path / "out.mcap"
    found = shell.parsed("merge", bag, half, "-o", out)
    assert (found["messages"], found["left_out"]) == (len(rig_messages(4)), 200)
    assert plain(read(out)) == plain(rig_messages(4))
    text = shell.good("merge", half, bag, "-o", tmp_path / "two.mcap")
    assert "left out: 200 messages that had come already" in text


def test_recover(bag: Path, shell: Shell) -> None:
    data = bag.read_bytes()
    bag.write_bytes(data[: len(data) * 2 // 3])
    assert f"has no end: its recorder was killed or it was cut; run 'tvbrdf bag recover {bag}'" in (
        shell.bad("info", bag)
    )
    out = bag.with_name("a_recovered.mcap")
    text = shell.good("recover", bag)
    assert text.startswith(f"{out}: {len(read(out))} messages saved and read back\n  from 2027-")
    assert "the file had no end: what its recorder had not yet written" in text
    assert "the file ends within a chunk" in text
    assert "and the end" in text
    assert len(read(out)) > len(rig_messages(4)) // 2
    assert "exists already" in shell.bad("recover", bag)
    found = shell.parsed("recover", bag, "-o", bag.with_name("b.mcap"))
    assert found["messages"] == len(read(out))
    assert found["complete"] is False
    assert found["lost_bytes"] == sum(lost["bytes"] for lost in found["lost"]) > 0


def test_recover_after_one_that_was_killed(bag: Path, shell: Shell) -> None:
    out = bag.with_name("saved.mcap")
    left = out.with_name(".saved.mcap.tvbrdf-12345678")
    left.mkdir()
    (left / "saved.mcap").write_bytes(bag.read_bytes()[:1000])
    text = shell.good("recover", bag, "-o", out)
    assert f"removed {left}: what a run that was killed had left" in text.splitlines()[0]
    assert not left.exists()


def test_recover_of_a_whole_bag(bag: Path, shell: Shell) -> None:
    assert shell.good("recover", bag).endswith("nothing of the file was lost\n")


def test_check(bag: Path, tmp_path: Path, shell: Shell) -> None:
    assert shell.good("check", bag) == f"{bag}: {len(rig_messages(4))} messages, nothing wrong\n"
    data = bytearray(bag.read_bytes())
    data[len(data) // 2] ^= 1
    bag.write_bytes(data)
    text = shell.good("check", bag, status=1)
    assert f"damaged: {bag}: the checksum of its data is wrong" in text
    assert text.splitlines()[-1].endswith(" problems")
    found = shell.parsed("check", bag, status=1)
    assert found["ok"] is False
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    assert "unreadable: " in shell.good("check", empty, status=1)


@pytest.mark.parametrize("verb", ["info", "check", "recover"])
def test_no_such_bag(tmp_path: Path, shell: Shell, verb: str) -> None:
    assert f"{tmp_path}/none.mcap: there is no such bag" in shell.bad(verb, tmp_path / "none.mcap")


def test_errors_are_one_line(bag: Path, tmp_path: Path, shell: Shell) -> None:
    assert "is no bag and no other MCAP file" in shell.bad("info", __file__)
    assert "has no topic '/x'; there are: /arm/state, " in shell.bad(
        "filter", bag, "-o", tmp_path / "x.mcap", "--topics", "/x"
    )
    assert "no regular expression" in shell.bad("filter", bag, "-o", tmp_path / "x", "-e", "(")
    assert "exists already" in shell.bad("merge", bag, "-o", bag)
