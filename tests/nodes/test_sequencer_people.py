"""What an operator asks of the sequencer, and a run that goes on with an earlier one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from tvbrdf_messages.messages import Mark, ScanCommand
from tvbrdf_nodes.core.node import Exit, Reply

if TYPE_CHECKING:
    from conftest import MakeRig, Rig

ONE_SCAN = ["lamp", "dark", "lamp", *3 * ["prepare", "sweep", "end_sweep"]]
MINUTE_NS = 60_000_000_000


def ask(rig: Rig, verb: str, **arguments: Any) -> Reply:
    """Ask, and return the one answer that comes at once."""
    (reply,) = rig.stage.ask("sequencer", verb, **arguments)
    assert reply.request_id == "person"
    return reply


def played(rig: Rig, verb: str, **arguments: Any) -> list[Reply]:
    """Ask, let the devices answer, and return all answers."""
    replies = rig.stage.ask("sequencer", verb, **arguments)
    rig.play()
    return replies + rig.stage.replies("sequencer")


# -- scans when the operator says so


def test_without_an_interval_each_scan_waits_for_the_operator(make_rig: MakeRig) -> None:
    rig = make_rig(interval_s=0.0)
    rig.ready()
    for scan in (1, 2):
        rig.play_until(lambda: rig.status.state == "waiting for the operator")
        rig.stage.advance(1000.0)
        rig.play()
        assert rig.status.remaining_s == -1.0
        reply = ask(rig, "scan")
        assert (reply.ok, reply.text) == (True, f"scan {scan} begins")
    assert rig.play_to_end() == Exit(0)
    assert rig.sweeps() == [(scan, sweep, 1) for scan in (1, 2) for sweep in range(3)]
    starts = [c.scan_start_ns for c in rig.commands if c.action == "dark"]
    assert starts[1] - starts[0] >= 1000_000_000_000  # when the operator asked, not earlier


def test_a_scan_on_request_moves_the_schedule(make_rig: MakeRig) -> None:
    rig = make_rig(scans=3)
    rig.ready()
    rig.play_until(lambda: rig.status.scan == 2 and rig.status.state == "interval")
    rig.stage.advance(10.0)
    asked_ns = rig.stage.now_ns
    assert ask(rig, "scan").ok
    rig.play_to_end()
    starts = {c.scan: c.scan_start_ns for c in rig.commands if c.action == "dark"}
    assert starts[2] == asked_ns
    assert starts[3] - starts[2] == MINUTE_NS


def test_stop_ends_the_scan_and_nothing_begins_before_the_operator_says_so(rig: Rig) -> None:
    stopped: list[Reply] = []

    def stop(command: ScanCommand) -> None:
        if command.action == "sweep" and not stopped:
            stopped.append(ask(rig, "stop"))

    rig.on_command = stop
    rig.ready()
    rig.play_until(lambda: rig.status.state == "waiting for the operator")
    assert stopped[0].ok
    assert rig.actions()[-1] == "stop"
    assert [(m.scan, m.reason) for m in rig.missing] == [(1, "stopped by the operator")]
    count = len(rig.commands)
    rig.stage.advance(600.0)
    rig.play()
    assert len(rig.commands) == count
    assert ask(rig, "scan").text == "scan 2 begins"
    assert rig.play_to_end() == Exit(0)
    # stop had switched the lamp off
    assert rig.actions()[count:] == [*ONE_SCAN, "lamp"]


def test_after_a_stop_a_scan_without_dark_frames_has_light(make_rig: MakeRig) -> None:
    rig = make_rig(dark_frames=0)
    rig.ready()
    rig.play_until(lambda: rig.status.scan == 2 and rig.status.state == "interval")
    played(rig, "stop")
    ask(rig, "scan")
    rig.play_to_end()
    lit = [c.lamp for c in rig.commands if c.action in ("lamp", "stop")]
    assert lit == [True, False, True, False]
    after_stop = rig.actions()[rig.actions().index("stop") + 1 :]
    assert after_stop[:2] == ["lamp", "prepare"]


@pytest.mark.parametrize("state", ["waiting for nodes", "homing", "warming up"])
def test_stop_before_the_first_scan(rig: Rig, state: str) -> None:
    rig.faults["arm", "home", 0, 0, 0] = "silent" if state == "homing" else ""
    if state != "waiting for nodes":
        rig.ready()
    assert rig.status.state.startswith(state[:7])
    assert played(rig, "stop")[0].ok
    count = len(rig.commands)
    if state == "waiting for nodes":
        rig.ready()
    rig.stage.advance(100.0)
    rig.play()
    assert rig.status.state == "waiting for the operator"
    assert rig.actions()[count:] == []  # it homes only when it is told to go on
    del rig.faults["arm", "home", 0, 0, 0]
    assert ask(rig, "scan").ok
    assert rig.play_to_end() == Exit(0)
    assert rig.missing == []


def test_an_arm_that_is_restarted_after_a_stop_does_not_move(rig: Rig) -> None:
    rig.ready()
    rig.play_until(lambda: rig.status.scan == 2 and rig.status.state == "interval")
    played(rig, "stop")
    count = len(rig.commands)
    rig["arm"].die()
    rig["arm"].return_()
    rig["arm"].state()
    rig.stage.advance(300.0)
    rig.play()
    assert rig.actions()[count:] == []
    assert ask(rig, "scan").ok
    rig.play()
    assert rig.actions()[count] == "home"


# -- what is passed on to devices


@pytest.mark.parametrize(
    ("verb", "arguments", "target", "fields"),
    [
        ("home", {}, "arm", {}),
        ("jog", {"angle_deg": 12.5}, "arm", {"to_deg": 12.5}),
        ("lamp", {"on": True}, "arm", {"lamp": True}),
        ("still", {}, "cameras", {"exposures_ms": (0.2, 4.0, 32.0)}),
    ],
)
def test_requests_are_passed_on_and_answered_when_they_are_done(
    rig: Rig, verb: str, arguments: dict[str, Any], target: str, fields: dict[str, Any]
) -> None:
    rig.ready()
    rig.play_until(lambda: rig.status.scan == 2 and rig.status.state == "interval")
    (reply,) = played(rig, verb, **arguments)
    assert (reply.ok, reply.text) == (True, f"{verb}: done")
    command = rig.commands[-1]
    assert (command.action, command.target) == (verb, target)
    assert {name: getattr(command, name) for name in fields} == fields
    assert rig.play_to_end() == Exit(0)
    assert rig.missing == []


def test_a_device_that_can_not_do_it_says_so(rig: Rig) -> None:
    rig.ready()
    rig.play_until(lambda: rig.status.scan == 2 and rig.status.state == "interval")
    rig.faults["arm", "jog", 0, 0, 0] = "130° is outside the arm's limits"
    (reply,) = played(rig, "jog", angle_deg=130.0)
    assert (reply.ok, reply.text) == (False, "arm: 130° is outside the arm's limits")
    # the measurement goes on
    assert rig.play_to_end() == Exit(0)
    assert rig.missing == []


def test_a_device_that_dies_over_a_request_is_told(rig: Rig) -> None:
    rig.ready()
    rig.play_until(lambda: rig.status.scan == 2 and rig.status.state == "interval")
    rig.faults["camera_2", "still", 0, 0, 0] = "silent"
    assert played(rig, "still") == []
    rig["camera_2"].die()
    assert rig.stage.replies("sequencer") == [Reply("person", False, "camera_2 was lost")]


@pytest.mark.parametrize("verb", ["home", "jog", "lamp", "still", "scan"])
def test_a_busy_rig_refuses(rig: Rig, verb: str) -> None:
    found: list[Reply] = []

    def interfere(command: ScanCommand) -> None:
        if command.action == "sweep":
            found.append(ask(rig, verb, angle_deg=0.0, on=False))

    rig.on_command = interfere
    rig.ready()
    rig.play_until(lambda: rig.status.scan == 2)
    assert found
    assert not any(reply.ok for reply in found)
    assert "the rig is busy (sweeping)" in found[0].text
    assert rig.sweeps() == [(1, sweep, 1) for sweep in range(3)]


@pytest.mark.parametrize(
    ("verb", "arguments", "text"),
    [
        ("jog", {}, "jog: argument missing or wrong: 'angle_deg'"),
        ("jog", {"angle_deg": "far"}, "jog: argument missing or wrong"),
        ("lamp", {}, "lamp: argument missing or wrong: 'on'"),
        ("mark", {}, "a mark needs a text"),
        ("mark", {"text": "  "}, "a mark needs a text"),
        ("mark", {"text": ["no"]}, "a mark needs a text"),
        ("mark", {"text": "x" * 10_001}, "at most 10000 characters, this one 10001"),
        ("dance", {}, "unknown request 'dance'; known: home, jog"),
    ],
)
def test_wrong_requests_are_refused(
    rig: Rig, verb: str, arguments: dict[str, Any], text: str
) -> None:
    rig.ready()
    rig.play_until(lambda: rig.status.scan == 2 and rig.status.state == "interval")
    count = len(rig.commands)
    reply = ask(rig, verb, **arguments)
    assert not reply.ok
    assert text in reply.text
    rig.play()
    assert len(rig.commands) == count
    assert rig.marks == []


# -- notes


def test_a_mark_may_set_the_time_to_zero_before_the_first_scan(rig: Rig) -> None:
    rig.ready()
    marked_ns = rig.stage.now_ns
    reply = ask(rig, "mark", text="painted", zero=True)
    assert (reply.ok, reply.data) == (True, {"stamp_ns": marked_ns, "zero": True})
    rig.play_to_end()
    assert rig.marks == [Mark(text="painted", zero=True)]
    times = {c.scan: c.scan_time_s for c in rig.commands if c.action == "sweep"}
    assert times == {1: 10.0, 2: 70.0}  # the lamp had warmed up for ten seconds
    starts = {c.scan: c.scan_start_ns for c in rig.commands if c.action == "sweep"}
    assert starts[1] - marked_ns == 10_000_000_000


def test_later_the_time_of_zero_stays(rig: Rig) -> None:
    found: list[Reply] = []

    def mark(command: ScanCommand) -> None:
        if command.action == "sweep" and not found:
            found.append(ask(rig, "mark", text="a draught", zero=True))

    rig.on_command = mark
    rig.ready()
    rig.play_to_end()
    assert found[0].ok
    assert found[0].data["zero"] is False
    assert rig.marks == [Mark(text="a draught", zero=False)]
    assert "t = 0 can't move" in rig.stage.log("warning")[0]
    assert {c.scan_time_s for c in rig.commands if c.action == "sweep"} == {0.0, 60.0}


def test_marks_are_noted_at_any_time_with_their_moment(rig: Rig) -> None:
    rig.ready()
    rig.play_until(lambda: rig.status.scan == 2 and rig.status.state == "interval")
    rig.stage.advance(3.0)
    at_ns = rig.stage.now_ns
    ask(rig, "mark", text="window opened")
    (envelope,) = rig.stage.said("/operator/mark")
    assert envelope.header.stamp_ns == at_ns
    assert rig.play_to_end() == Exit(0)


# -- going on with an earlier run


def test_it_goes_on_after_the_last_scan_that_the_database_has(make_rig: MakeRig) -> None:
    rig = make_rig(scans=5)
    zero_ns = rig.stage.now_ns - 10 * MINUTE_NS
    rig.ready(
        scans=(1, 3), fitted=(1, 3), missing=(2,), zero_ns=zero_ns, last_ns=zero_ns + 2 * MINUTE_NS
    )
    assert rig.play_to_end() == Exit(0)
    assert rig.sweeps() == [(scan, sweep, 1) for scan in (4, 5) for sweep in range(3)]
    times = {c.scan: c.scan_time_s for c in rig.commands if c.action == "sweep"}
    assert times == {4: 610.0, 5: 670.0}  # ten minutes ago was t = 0


def test_the_interval_holds_between_the_runs_too(make_rig: MakeRig) -> None:
    """Also in simulation, where the earlier run's clock may have run ahead of this one's."""
    rig = make_rig(scans=3)
    zero_ns = rig.stage.now_ns - MINUTE_NS
    last_ns = zero_ns + 5 * MINUTE_NS
    rig.ready(scans=(1,), fitted=(1,), zero_ns=zero_ns, last_ns=last_ns)
    assert rig.play_to_end() == Exit(0)
    starts = {c.scan: c.scan_start_ns for c in rig.commands if c.action == "sweep"}
    assert starts == {2: last_ns + MINUTE_NS, 3: last_ns + 2 * MINUTE_NS}


def test_a_run_with_nothing_left_to_do_moves_nothing(rig: Rig) -> None:
    rig.ready(scans=(1, 2), fitted=(1, 2), zero_ns=rig.stage.now_ns - MINUTE_NS)
    assert rig.exit == Exit(0)
    assert [(c.action, c.lamp) for c in rig.commands] == [("lamp", False)]


@pytest.mark.parametrize("scans", [2, 3])
def test_scans_that_were_not_fitted_are_waited_for(make_rig: MakeRig, scans: int) -> None:
    """Whether or not there is something left to measure."""
    rig = make_rig(scans=scans)
    rig.ready(scans=(1, 2), fitted=(), zero_ns=rig.stage.now_ns - MINUTE_NS)
    rig.play_until(lambda: rig.status.state == "finishing")
    for scan in (1, 2):
        assert rig.exit is None
        rig.stored(scan, "parameters")
    assert rig.exit == Exit(0)
    assert {scan for scan, _, _ in rig.sweeps()} == set(range(3, scans + 1))
    assert "scans [1, 2] are stored, not fitted; they are fitted now" in rig.stage.log("info")


def test_scans_may_be_fitted_before_the_sequencer_begins(rig: Rig) -> None:
    rig.database(scans=(1, 2), fitted=(1,), zero_ns=rig.stage.now_ns - MINUTE_NS)
    rig.stored(2, "parameters")
    rig.database(scans=(1, 2), fitted=(1, 2), zero_ns=rig.stage.now_ns - MINUTE_NS)
    assert rig.exit is None
    rig.all_running()
    rig.play()
    assert rig.exit == Exit(0)


def test_an_earlier_scan_that_can_not_be_fitted_makes_the_run_fail_at_its_end(rig: Rig) -> None:
    rig.ready(scans=(1,), fitted=(), zero_ns=rig.stage.now_ns - MINUTE_NS)
    rig.stored(1, "parameters", refused="scan01.npz is no zip file")
    end = rig.play_to_end()
    text = "parameters of scan 1 can't be stored: scan01.npz is no zip file"
    assert end == Exit(1, text)
    assert {scan for scan, _, _ in rig.sweeps()} == {2}


def test_a_restarted_writer_tells_its_state_again_without_harm(rig: Rig) -> None:
    def again(command: ScanCommand) -> None:
        if command.action == "sweep":
            rig.database(scans=(1,), fitted=(), zero_ns=5)

    rig.on_command = again
    rig.ready()
    assert rig.play_to_end() == Exit(0)
    assert rig.sweeps() == [(scan, sweep, 1) for scan in (1, 2) for sweep in range(3)]
