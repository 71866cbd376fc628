"""What the arm's node does with commands: it carries them out, or refuses them with a reason."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from tvbrdf_messages.messages import Diagnostics

Make = Callable[..., Any]
SWEEP = {"from_deg": -90.0, "to_deg": 90.0, "duration_s": 12.0, "scan": 2, "sweep": 1}


def begin_sweep(rig: Any, **fields: Any) -> int:
    """Home, light the lamp and begin a sweep; return its command's number."""
    rig.homed()
    assert rig.do("lamp", lamp=True).state == "done"
    number: int = rig.send("sweep", **{**SWEEP, **fields})
    rig.run(lambda: rig.states()[-1][1].speed_deg_s == 15.0, "a sweep's constant speed")
    return number


def still_and_dark(rig: Any) -> bool:
    state = rig.states()[-1][1]
    return not state.moving and not state.lamp


# -- safety rules


def test_late_command_is_refused(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all().homed()
    result = rig.do("jog", to_deg=10.0, not_after_ns=rig.clock.now_ns() - 250_000_000)
    assert result.state == "refused"
    assert "ms late" in result.reason
    assert rig.states()[-1][1].angle_deg == 0.0


def test_repeated_command_is_refused(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all().homed()
    number = rig.send("jog", to_deg=10.0)
    rig.run(lambda: rig.results(number))
    rig.send("jog", to_deg=-10.0, command_id=number)
    rig.run(lambda: len(rig.results(number)) == 2)
    assert [r.state for r in rig.results(number)] == ["done", "refused"]
    assert "came again" in rig.results(number)[1].reason


def test_foreign_and_earlier_sequencers_are_refused(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all().homed()
    earlier = rig.sequencer
    result = rig.do("jog", to_deg=10.0, incarnation="somebody")
    assert (result.state, "somebody" in result.reason) == ("refused", True)
    rig.sequencer = rig.bus.port("sequencer")  # it was restarted
    assert rig.do("jog", to_deg=10.0).state == "done"
    rig.sequencer, newer = earlier, rig.sequencer
    rig.bus.ports["sequencer"] = newer
    result = rig.do("jog", to_deg=20.0)
    assert result.state == "refused"
    assert "earlier sequencer" in result.reason


def test_stop_is_obeyed_however_late(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    number = begin_sweep(rig)
    result = rig.do("stop", not_after_ns=1, incarnation="somebody")
    assert result.state == "done"
    (broken,) = rig.results(number)
    assert (broken.state, broken.action, broken.scan, broken.sweep) == ("broken", "sweep", 2, 1)
    assert broken.reason == f"stopped by command {result.command_id}"
    assert 0 <= broken.first_sequence <= broken.last_sequence
    rig.run(lambda: still_and_dark(rig))


def test_stop_may_leave_the_lamp_on(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    begin_sweep(rig)
    assert rig.do("stop", lamp=True).state == "done"
    rig.run(lambda: not rig.states()[-1][1].moving)
    assert rig.states()[-1][1].lamp


def test_commands_wait_for_a_stop_to_end(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    begin_sweep(rig)
    stop = rig.send("stop")
    lamp = rig.send("lamp", lamp=True)
    jog = rig.send("jog", to_deg=0.0)
    rig.run(lambda: rig.results(jog), "the jog")
    states = [rig.results(n)[0].state for n in (stop, lamp, jog)]
    assert states == ["done", "done", "done"]
    rig.run(lambda: rig.states()[-1][1].lamp)


def test_second_stop_answers_both_and_drops_what_waits(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    begin_sweep(rig)
    numbers = [rig.send("stop"), rig.send("jog", to_deg=0.0), rig.send("stop")]
    rig.run(lambda: all(rig.results(n) for n in numbers))
    assert [rig.results(n)[0].state for n in numbers] == ["done", "refused", "done"]


@pytest.mark.parametrize(
    ("action", "fields", "reason"),
    [
        ("jog", {"to_deg": 111.0}, "outside the arm's limits of -110° to 110°"),
        ("jog", {"to_deg": float("nan")}, "angle is nan"),
        ("sweep", {**SWEEP, "duration_s": 2.0}, "speed 90°/s is above the arm's limit of 60°/s"),
        ("sweep", {**SWEEP, "duration_s": 0.0}, "is none"),
        ("sweep", {**SWEEP, "duration_s": float("inf")}, "is none"),
        ("prepare", {**SWEEP, "to_deg": -90.0}, "is none"),
        # at 50°/s the run-up is 50²/2·60 + 0.5 = 21.3°
        ("prepare", {**SWEEP, "duration_s": 3.6}, "21.3° to accelerate"),
        ("sweep", {**SWEEP, "from_deg": -150.0}, "start -150° is outside"),
        ("dance", {}, "unknown action 'dance'"),
    ],
)
def test_limits(make_arm_rig: Make, action: str, fields: dict[str, Any], reason: str) -> None:
    rig = make_arm_rig().start_all().homed()
    result = rig.do(action, **fields)
    assert result.state == "refused"
    assert reason in result.reason
    rig.run_for(0.5)
    assert rig.states()[-1][1].angle_deg == 0.0


def test_nothing_moves_before_homing(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    rig.run(rig.states)
    for action in ("jog", "prepare", "sweep"):
        result = rig.do(action, **SWEEP)
        assert result.state == "refused"
        assert "home" in result.reason
    assert rig.states()[-1][1].angle_deg == -20.0


def test_busy(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    number = begin_sweep(rig)
    result = rig.do("jog", to_deg=0.0)
    assert (result.state, result.reason) == ("refused", f"busy with sweep (command {number})")
    rig.run(lambda: rig.results(number), "the sweep's end")
    assert rig.results(number)[0].state == "done"


def test_commands_before_the_controller_is_ready_wait(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    home, late = rig.send("home"), rig.send("jog", to_deg=3.0, not_after_ns=rig.clock.now_ns())
    arm = rig.runners["arm"]
    arm.take_messages()
    assert not rig.results(home)
    rig.run(lambda: rig.results(home) and rig.results(late))
    assert rig.results(home)[0].state == "done"
    assert rig.results(late)[0].state == "refused"


def test_stop_before_the_controller_is_ready(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    numbers = [rig.send("home"), rig.send("stop")]
    rig.runners["arm"].take_messages()
    rig.run(lambda: all(rig.results(n) for n in numbers))
    assert [rig.results(n)[0].state for n in numbers] == ["refused", "done"]


# -- losing things


def test_restarted_arm_stops_darkens_and_waits_for_a_new_command(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    rig.homed()
    rig.do("lamp", lamp=True)
    rig.send("sweep", **SWEEP)
    rig.run(lambda: rig.states()[-1][1].speed_deg_s == 15.0)
    rig.kill("arm")
    before = len(rig.states())
    rig.start("arm")
    rig.run(lambda: len(rig.states()) > before and still_and_dark(rig), "still and dark")
    state = rig.states()[-1][1]
    assert state.homed  # the controller kept its position
    assert -90 < state.angle_deg < 90
    rig.run_for(3.0)
    assert rig.states()[-1][1].angle_deg == state.angle_deg
    assert not rig.kept_state()["stopped_by_watchdog"]  # it was told
    assert rig.do("jog", to_deg=5.0).state == "done"


@pytest.mark.parametrize("hung", [True, False], ids=["hung", "killed"])
def test_controller_stops_by_itself_without_keepalives(make_arm_rig: Make, hung: bool) -> None:
    rig = make_arm_rig().start_all()
    begin_sweep(rig)
    rig.hold_time = True
    arm = rig.runners.pop("arm")
    if not hung:
        arm.node._driver.close()
    began_s = time.monotonic()
    rig.run(lambda: rig.kept_state()["stopped_by_watchdog"], "the watchdog")
    # the last keepalive may have been sent 0.1 s ago, and is looked at every 0.05 s
    assert time.monotonic() - began_s > 0.5 - 0.1 - 0.05
    assert not rig.kept_state()["lamp"]
    rig.hold_time = False
    rig.run(lambda: not rig.kept_state()["moving"], "standing still")
    motion = rig.motions()[-1]
    assert (motion.speed_deg_s[-1], motion.lamp[-1]) == (0.0, False)
    if hung:
        arm.node._driver.close()
    arm.port.close()


def test_keepalives_cease_while_the_main_loop_hangs(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all().homed()
    node = rig.runners["arm"].node
    sent = node.diagnostics()["keepalives"]
    arm = rig.runners.pop("arm")
    deadline = time.monotonic() + 0.35
    rig.run(lambda: time.monotonic() > deadline)
    assert node.diagnostics()["keepalives"] == sent
    rig.runners["arm"] = arm
    rig.run(lambda: node.diagnostics()["keepalives"] >= sent + 3, "keepalives")


def test_sequencer_gone_for_long(make_arm_rig: Make) -> None:
    rig = make_arm_rig(node={"commander_lost_s": 0.05}).start_all()
    number = begin_sweep(rig)
    rig.hold_time = True
    rig.sequencer.close()
    rig.run(lambda: rig.results(number), "the sweep's end")
    assert "its sequencer has been gone for 0.05 s" in rig.results(number)[0].reason
    rig.hold_time = False
    rig.run(lambda: still_and_dark(rig))


def test_sequencer_that_comes_back_in_time(make_arm_rig: Make) -> None:
    rig = make_arm_rig(node={"commander_lost_s": 0.05}).start_all()
    number = begin_sweep(rig)
    rig.sequencer.close()
    rig.step()
    rig.sequencer = rig.bus.port("sequencer")
    rig.step()
    rig.run(lambda: rig.results(number), "the sweep's end")
    assert rig.results(number)[0].state == "done"


def test_signal_stops_without_the_bus(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    number = begin_sweep(rig)
    arm = rig.runners["arm"]
    arm.put(arm.node.on_signal())
    (result,) = rig.results(number)
    assert (result.state, result.reason) == ("broken", "stopped by a signal")
    rig.run(lambda: still_and_dark(rig))


def test_end_of_the_node_waits_for_the_controller(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    number = begin_sweep(rig)
    with rig.twin_running():
        arm = rig.runners.pop("arm")
        arm.put(arm.node.stop())
    assert rig.results(number)[0].state == "broken"
    assert "did not confirm" not in rig.log()
    rig.run(lambda: not rig.kept_state()["moving"] and not rig.kept_state()["lamp"])
    assert not rig.kept_state()["stopped_by_watchdog"]


def test_end_of_the_node_does_not_wait_for_ever(make_arm_rig: Make) -> None:
    rig = make_arm_rig(node={"stop_limit_s": 0.1}).start_all().homed()
    arm = rig.runners.pop("arm")
    began_s = time.monotonic()
    arm.put(arm.node.stop())  # nobody answers: the twin does not run
    assert 0.1 <= time.monotonic() - began_s < 1.0
    assert "did not confirm stop and lamp off" in rig.log()


def test_end_of_the_twin_leaves_the_arm_still_and_dark(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    begin_sweep(rig)
    twin = rig.runners.pop("arm_controller")
    twin.put(twin.node.stop())
    state = rig.kept_state()
    assert (state["moving"], state["lamp"]) == (False, False)
    assert -90 < state["angle_deg"] < 90
    assert state["requests"] > 0
    assert not (rig.directory / "arm_controller.tty").is_symlink()


def test_lost_states_break_a_sweep(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    number = begin_sweep(rig)
    rig.bus.ports.pop("reader")  # what is sent to it is not delivered
    rig.run(lambda: rig.results(number))
    assert "a reader of /arm/state is too slow" in rig.results(number)[0].reason


def test_motion_that_does_not_end_is_given_up(make_arm_rig: Make) -> None:
    rig = make_arm_rig(node={"home_limit_s": 0.2}).start_all()
    result = rig.do("home")
    assert (result.state, result.reason) == ("broken", "home did not end in time")
    rig.run(lambda: still_and_dark(rig))


def test_diagnostics(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all().homed()
    rig.do("dance")
    rig.runners["arm"].tell_diagnostics()
    found = [e.message for e in rig.published("/diagnostics") if e.header.publisher == "arm"]
    assert isinstance(found[-1], Diagnostics)
    counters = found[-1].counters
    assert counters["commands_refused"] == 1
    assert counters["lines"] > 10
    assert counters["wrong_checksums"] == 0
    assert counters["requests_repeated"] == 0
