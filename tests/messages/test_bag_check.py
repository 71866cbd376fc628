"""``check`` tells each thing that is wrong with a bag, and nothing of one that is right."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.messages.bag_samples import Told, arm_state, frame, rig_messages, write
from tests.sample_messages import START_NS
from tvbrdf_messages.bag import BagReader, CheckReport, check_bag

SECOND_NS = 10**9


def kinds(report: CheckReport) -> list[str]:
    return [problem.kind for problem in report.problems]


def states(*numbers: int) -> list[Told]:
    return [arm_state(n, START_NS + k * 20_000_000) for k, n in enumerate(numbers)]


@pytest.mark.parametrize("options", [{}, {"split_s": 1.0}])
def test_a_good_bag(tmp_path: Path, options: dict[str, float]) -> None:
    told = rig_messages(3)
    report = check_bag(write(tmp_path / "bag", told, **options))
    assert report.ok
    assert report.problems == []
    assert report.messages >= len(told)


def test_gaps_repeats_and_order(tmp_path: Path) -> None:
    report = check_bag(write(tmp_path / "a.mcap", states(0, 1, 4, 5, 5, 8, 7)))
    assert kinds(report) == ["gap", "again", "order"]
    gap, again, order = (problem.text for problem in report.problems)
    assert "/arm/state of arm (one): 3 messages missing: sequence numbers 2 to 3, 6" in gap
    assert "1 messages are there twice" in again
    assert "1 messages came after later ones" in order


def test_another_life_of_a_publisher_is_no_gap(tmp_path: Path) -> None:
    told = [*states(5, 6, 7), *(arm_state(n, START_NS + SECOND_NS + n, "two") for n in range(3))]
    assert check_bag(write(tmp_path / "a.mcap", told)).ok


def test_a_clock_that_goes_back(tmp_path: Path) -> None:
    told = [arm_state(k, START_NS + s * SECOND_NS) for k, s in enumerate((0, 5, 3, 4))]
    report = check_bag(write(tmp_path / "a.mcap", told))
    assert kinds(report) == ["clock"]
    assert "log time goes back by 2.000000 s" in report.problems[0].text


@pytest.mark.parametrize("jump_s", [-3600, -2, 2, 3600])
def test_a_clock_that_jumps_against_the_device(tmp_path: Path, jump_s: int) -> None:
    """The run's clock steps between two states; the arm's own clock does not."""
    told = states(*range(10))
    for k in range(5, 10):
        at, envelope = told[k]
        sent = envelope.header
        sent = sent._replace(stamp_ns=sent.stamp_ns + jump_s * SECOND_NS)
        told[k] = Told(at + jump_s * SECOND_NS, envelope._replace(header=sent))
    report = check_bag(write(tmp_path / "a.mcap", told))
    assert kinds(report) == (["clock", "clock"] if jump_s < 0 else ["clock"])
    way = f"on by {jump_s}.020 s" if jump_s > 0 else f"back by {-jump_s - 0.02:.6f} s"
    text = f"the run's clock goes {way} and the device's own goes on by 0.020 s"
    assert any(text in problem.text for problem in report.problems)


def test_a_pause_is_no_jump(tmp_path: Path) -> None:
    told = [arm_state(k, START_NS + k * 3600 * SECOND_NS) for k in range(3)]
    assert check_bag(write(tmp_path / "a.mcap", told)).ok


def test_no_calibration(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", states(0), attachments={"scene/calibration.yaml": b""})
    report = check_bag(path)
    assert kinds(report) == ["calibration"]
    assert str(path) in report.problems[0].text
    assert check_bag(
        write(tmp_path / "b.mcap", states(0), attachments={"calibration.yaml": b"x"})
    ).ok


def test_every_damaged_chunk_is_told(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [frame(k, START_NS + k * SECOND_NS) for k in range(5)])
    with BagReader(path) as reader:
        spots = [c.chunk_start_offset + c.chunk_length - 5 for c in reader.files[0].chunks]
    data = bytearray(path.read_bytes())
    for spot in (spots[1], spots[3]):
        data[spot] ^= 1
    path.write_bytes(data)
    report = check_bag(path)
    assert kinds(report).count("damaged") == 3  # two chunks, and the data as a whole
    assert "count" in kinds(report)
    assert report.messages == 3
    plain = report.plain()
    assert plain["ok"] is False
    assert plain["problems"][0] == {"kind": "damaged", "text": report.problems[0].text}
