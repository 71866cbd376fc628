"""Jumps of clocks are told from pauses: when a bag is checked, and by what its recorder noticed."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pytest

from tests.messages.bag_samples import Told, arm_state, diagnostics, rig_messages, write
from tests.paths import ROOT
from tests.sample_messages import START_NS
from tvbrdf_messages.bag import BagReader, ClockJump, check_bag, recover
from tvbrdf_messages.envelope import in_epoch

SECOND_NS = 10**9
STEP_NS = 20_000_000


def told_jumps(path: Path) -> list[ClockJump]:
    """Return what the recorder noticed; the check finds the same."""
    with BagReader(path) as reader:
        noticed = reader.summary().clock_jumps
        assert reader.summary().plain()["clock_jumps"] == [jump._asdict() for jump in noticed]
    found = [p.text for p in check_bag(path).problems if p.kind == "clock"]
    expected = [f"{jump.topic} at {jump.log_time_ns}: {jump.text}" for jump in noticed]
    assert [text.partition(": ")[2] for text in found] == expected
    return list(noticed)


def moved(
    told: Iterable[Told], after_ns: int, by_s: float, *, log: bool, stamp: bool
) -> list[Told]:
    """Let clocks jump at a moment; a device's own never does."""
    found = []
    by_ns = round(by_s * SECOND_NS)
    for at_ns, envelope in told:
        after = at_ns >= after_ns
        stamp_ns = envelope.header.stamp_ns + by_ns * (after and stamp)
        header = envelope.header._replace(stamp_ns=stamp_ns)
        found.append(Told(at_ns + by_ns * (after and log), envelope._replace(header=header)))
    return found


@pytest.mark.parametrize("by_s", [2.0, 3600.0])
@pytest.mark.parametrize("options", [{}, {"split_s": 1.0}])
def test_log_time_that_leaps_alone(tmp_path: Path, by_s: float, options: dict[str, float]) -> None:
    at_ns = START_NS + 2 * SECOND_NS
    told = moved(rig_messages(4), at_ns, by_s, log=True, stamp=False)
    (jump,) = told_jumps(write(tmp_path / "bag", told, **options))
    assert jump.log_time_ns == next(log_ns for log_ns, _ in told if log_ns >= at_ns + by_s * 1e9)
    # the rig's messages take 0 to 3 ms each, so that it is known to that
    assert f"from here on is {by_s:.3f} s later than before against all stamps" in jump.text


def test_a_leap_of_log_time_behind_a_message_that_came_again(tmp_path: Path) -> None:
    told = [arm_state(k, START_NS + k * STEP_NS) for k in range(50)]
    late_ns = START_NS + 60 * SECOND_NS
    later = [Told(late_ns + at_ns - START_NS, e) for at_ns, e in told[25:]]
    again = Told(late_ns, told[3].envelope)
    (jump,) = told_jumps(write(tmp_path / "a.mcap", [*told[:25], again, *later]))
    assert "from here on is 60.000 s later" in jump.text


def test_every_leap_is_told(tmp_path: Path) -> None:
    told = moved(rig_messages(6), START_NS + 2 * SECOND_NS, 5.0, log=True, stamp=False)
    told = moved(told, START_NS + 9 * SECOND_NS, 7.0, log=True, stamp=False)
    jumps = told_jumps(write(tmp_path / "bag", told))
    assert ["is 5.000 s later" in jumps[0].text, "is 7.000 s later" in jumps[1].text] == [True] * 2


def test_a_pause_is_no_jump(tmp_path: Path) -> None:
    told = rig_messages(2)
    for hour in (1, 2, 3):
        later = rig_messages(2, START_NS + hour * 3600 * SECOND_NS)
        told += [
            Told(at, e._replace(header=e.header._replace(incarnation=f"life {hour}")))
            for at, e in later
        ]
    assert told_jumps(write(tmp_path / "bag", told)) == []


def test_a_recorder_that_stood_still_is_no_jump(tmp_path: Path) -> None:
    """What it takes when it goes on is old, until it has caught up."""
    stood = (START_NS + 2 * SECOND_NS, START_NS + 6 * SECOND_NS)
    told = [Told(stood[1] if stood[0] <= at < stood[1] else at, e) for at, e in rig_messages(8)]
    assert told_jumps(write(tmp_path / "bag", told)) == []


def test_old_messages_at_the_beginning_are_no_jump(tmp_path: Path) -> None:
    """Who joins late is told what is latched, and what was kept for it."""
    old = [diagnostics("arm", k, START_NS) for k in range(10)]
    first_ns = START_NS + 100 * SECOND_NS
    told = [*(Told(first_ns, e) for _, e in old), *rig_messages(2, first_ns)]
    assert told_jumps(write(tmp_path / "bag", told)) == []


def test_a_message_sent_again_is_no_jump(tmp_path: Path) -> None:
    told = [arm_state(k, START_NS + k * STEP_NS) for k in range(200)]
    again = [Told(START_NS + 5 * SECOND_NS + k, told[k].envelope) for k in range(10)]
    assert told_jumps(write(tmp_path / "bag", [*told, *again])) == []


def test_a_node_that_was_not_told_the_time_yet_is_no_jump(tmp_path: Path) -> None:
    """In a replay of an old bag nodes have the time of the launch until the player tells it."""
    told = rig_messages(3)
    first = {e.header.publisher: id(e) for _, e in reversed(told)}
    untold = [
        Told(at, e._replace(header=e.header._replace(stamp_ns=START_NS + 10**17)))
        if id(e) in first.values()
        else Told(at, e)
        for at, e in told
    ]
    assert untold != told
    jumps = told_jumps(write(tmp_path / "bag", untold))
    assert [jump.topic for jump in jumps] == ["/arm/state"]  # by its own clock, which knew


@pytest.mark.parametrize(
    ("by_s", "text"),
    [
        (30.0, "the stamps of fitter get ahead of log time, by 30.000 s"),
        (-30.0, "the stamps of fitter go back by 29.000 s, log time goes on by 1.000 s"),
    ],
)
def test_stamps_of_one_publisher_that_jump(tmp_path: Path, by_s: float, text: str) -> None:
    """Of a publisher without a device, whose clock is that of another host."""
    told = rig_messages(5)
    mine = [each for each in told if each.envelope.header.publisher == "fitter"]
    shifted = moved(mine, START_NS + 2 * SECOND_NS, by_s, log=True, stamp=True)
    changed = {id(old.envelope): new.envelope for old, new in zip(mine, shifted, strict=True)}
    told = [Told(at, changed.get(id(e), e)) for at, e in told]
    (jump,) = told_jumps(write(tmp_path / "bag", told))
    assert (jump.topic, jump.text) == ("/diagnostics", text)


def test_a_jump_of_the_runs_clock_behind_a_gap(tmp_path: Path) -> None:
    """Messages are missing there; the device's own clock tells it all the same."""
    told = [arm_state(k, START_NS + k * STEP_NS) for k in (*range(10), *range(60, 70))]
    assert told_jumps(write(tmp_path / "a.mcap", told)) == []
    told = moved(told, START_NS + SECOND_NS, 600.0, log=True, stamp=True)
    (jump,) = told_jumps(write(tmp_path / "b.mcap", told))
    assert jump.text.endswith("clock goes on by 601.020 s and the device's own goes on by 1.020 s")


def test_a_devices_clock_may_drift(tmp_path: Path) -> None:
    """By 100 ppm, and by the hour between two scans."""
    told = []
    for k, (at_ns, envelope) in enumerate(arm_state(k, START_NS) for k in range(24)):
        run_ns = k * 3600 * SECOND_NS
        header = envelope.header._replace(
            stamp_ns=START_NS + run_ns, hardware_ns=1 + round(run_ns * (1 + 1e-4))
        )
        told.append(Told(at_ns + run_ns + 1, envelope._replace(header=header)))
    assert told_jumps(write(tmp_path / "a.mcap", told)) == []


def test_a_seek_of_a_replay_that_was_recorded(tmp_path: Path) -> None:
    told = [arm_state(k, START_NS + k * STEP_NS) for k in range(10)]
    for k in range(500, 510):
        at_ns, envelope = arm_state(k, START_NS + k * STEP_NS)
        header = envelope.header._replace(incarnation=in_epoch("one", 2))
        told.append(Told(at_ns, envelope._replace(header=header)))
    (jump,) = told_jumps(write(tmp_path / "a.mcap", told))
    assert jump.text == "the replay that was recorded jumped (epoch 2), log time goes on by 9.820 s"


def test_jumps_survive_a_recovery(tmp_path: Path) -> None:
    told = moved(rig_messages(4), START_NS + SECOND_NS, 60.0, log=True, stamp=False)
    path = write(tmp_path / "a.mcap", told)
    path.write_bytes(path.read_bytes()[:-100])
    recover(path, tmp_path / "saved.mcap")
    assert len(told_jumps(tmp_path / "saved.mcap")) == 1


def test_a_bag_of_before_has_none_noticed() -> None:
    """It was recorded by a version that did not look for them."""
    assert told_jumps(ROOT / "tests" / "replay" / "rig.mcap") == []
