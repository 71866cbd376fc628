"""What is owed for what was played: when a replay may end."""

from __future__ import annotations

from typing import Any

import pytest

from tvbrdf_messages.envelope import Envelope, Header
from tvbrdf_messages.messages import Mark, ScanCommand, ScanMissing, Stored, SweepResult
from tvbrdf_messages.schema import Message
from tvbrdf_nodes.player.ledger import Ledger

CAMERAS = ("camera_1", "camera_2")


def sent(message: Message, sequence: int = 0) -> Envelope:
    return Envelope("/any", Header("x", "y", "h", "b", sequence, 0), message)


def prepare(sweep: int, attempt: int = 1, sweeps: int = 2) -> Envelope:
    return sent(
        ScanCommand(
            command_id=1,
            incarnation="x",
            not_after_ns=0,
            action="prepare",
            scan=3,
            sweep=sweep,
            attempt=attempt,
            exposures_ms=(1.0,) * sweeps,
        )
    )


def result(source: str, sweep: int, state: str = "done", attempt: int = 1) -> SweepResult:
    return SweepResult(
        source=source, command_id=1, action="sweep", state=state, scan=3, sweep=sweep,
        attempt=attempt,
    )  # fmt: skip


def stored(what: str, number: int = 3, refused: str = "") -> Stored:
    return Stored(sample="x", scan=number, what=what, refused=refused)


@pytest.fixture
def ledger() -> Ledger:
    return Ledger(CAMERAS, "arm")


def play_sweep(ledger: Ledger, sweep: int, **more: Any) -> None:
    ledger.played(prepare(sweep, **more))
    for source in (*CAMERAS, "arm"):
        ledger.played(sent(result(source, sweep, **more)))


def test_a_sweep_is_owed_once_it_is_whole_in_any_order(ledger: Ledger) -> None:
    for source in ("arm", "camera_2", "camera_1"):
        assert ledger.open() == ()
        ledger.played(sent(result(source, 0)))
    ledger.played(prepare(0))
    assert ledger.open() == ("sweep 1 of scan 3",)


def test_a_scan_is_owed_when_its_last_sweep_is_good(ledger: Ledger) -> None:
    play_sweep(ledger, 0)
    play_sweep(ledger, 1)
    ledger.heard(result("hdr_merger", 0))
    assert ledger.open() == ("sweep 2 of scan 3",)
    ledger.heard(result("hdr_merger", 1))
    assert ledger.open() == ("parameters of scan 3", "radiance of scan 3")
    ledger.heard(stored("radiance"))
    ledger.heard(stored("parameters"))
    assert (ledger.open(), ledger.stored, ledger.refused) == ((), {3}, [])


def test_a_broken_sweep_owes_nothing_and_its_retake_does(ledger: Ledger) -> None:
    play_sweep(ledger, 0)
    ledger.heard(result("hdr_merger", 0))
    play_sweep(ledger, 1)
    ledger.heard(result("hdr_merger", 1, "broken"))
    assert ledger.open() == ()
    play_sweep(ledger, 1, attempt=2)
    ledger.heard(result("hdr_merger", 1, attempt=2))
    assert len(ledger.open()) == 2


def test_the_database_may_answer_before_the_merger_does(ledger: Ledger) -> None:
    """They are different processes: nothing orders what they say."""
    ledger.played(prepare(0, sweeps=1))
    for source in (*CAMERAS, "arm"):
        ledger.played(sent(result(source, 0)))
    ledger.heard(stored("radiance"))
    ledger.heard(stored("parameters"))
    assert ledger.open() == ("sweep 1 of scan 3",)
    ledger.heard(result("hdr_merger", 0))
    assert ledger.open() == ()


def test_missing_scans_and_marks_are_owed_too(ledger: Ledger) -> None:
    missing = ScanMissing(sample="x", scan=4, scan_time_s=0.0, reason="dark")
    ledger.played(sent(missing))
    ledger.played(sent(Mark(text="now"), sequence=9))
    assert ledger.open() == ("mark 9", "missing scan 4")
    ledger.heard(stored("missing", 4))
    ledger.heard(stored("mark", 9, refused="no such sample"))
    assert ledger.open() == ()
    assert ledger.refused == ["mark 9: no such sample"]


def test_a_seek_clears_what_the_merger_forgets(ledger: Ledger) -> None:
    play_sweep(ledger, 0)
    ledger.played(sent(result("arm", 1)))
    ledger.jumped()
    assert ledger.open() == ()
    ledger.played(prepare(1))
    for camera in CAMERAS:
        ledger.played(sent(result(camera, 1)))
    assert ledger.open() == ()  # the arm's end was before the jump
