"""Every fault of controller and line gives its documented error; what can be mended is mended."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tvbrdf_nodes.arm.simulated_faults import KINDS, FaultError, parse_faults
from tvbrdf_nodes.core.device import DeviceError

Make = Callable[..., Any]
SWEEP = {"from_deg": -90.0, "to_deg": 90.0, "duration_s": 12.0}
QUICK = {"answer_timeout_s": 0.1, "attempts": 2}
ENDS_SOON = {"stop_limit_s": 0.1}


def sweep_with(make_arm_rig: Make, *faults: dict[str, Any]) -> tuple[Any, int]:
    """Begin a sweep that the faults will meet; return the rig and the sweep's number."""
    rig = make_arm_rig(faults=faults, arm=QUICK, node=ENDS_SOON).start_all().homed()
    assert rig.do("lamp", lamp=True).state == "done"
    assert rig.do("prepare", **SWEEP).state == "done"
    return rig, rig.send("sweep", **SWEEP)


def fails_with(rig: Any, number: int, text: str) -> None:
    """The node ends with an error that names the port, and tells first that the sweep is broken."""
    with pytest.raises(DeviceError, match=text) as caught:
        rig.run(lambda: False)
    assert str(caught.value).startswith(str(rig.directory / "arm_controller.tty"))
    (result,) = rig.results(number)
    assert (result.state, result.reason) == ("broken", str(caught.value))


def arm_is_safe(rig: Any) -> bool:
    state = rig.kept_state()
    return not state["moving"] and not state["lamp"]


def test_silent_controller(make_arm_rig: Make) -> None:
    rig, number = sweep_with(make_arm_rig, {"kind": "silent", "at_sweep": 1})
    rig.pace_s = 0.005  # else the sweep's time is up, on the run's clock, before 0.2 s of real time
    fails_with(rig, number, r"stopped answering \(ALIVE, for 0\.2 s\); check its power")
    rig.kill("arm")
    rig.run(lambda: arm_is_safe(rig), "the controller's own watchdog")
    assert rig.kept_state()["stopped_by_watchdog"]


def test_unplugged(make_arm_rig: Make) -> None:
    rig, number = sweep_with(make_arm_rig, {"kind": "unplug", "at_sweep": 1})
    fails_with(rig, number, r"port is gone \(unplugged\?\)")
    rig.hold_time = True
    rig.kill("arm")
    rig.run(lambda: rig.kept_state()["stopped_by_watchdog"], "the controller's own watchdog")
    rig.hold_time = False
    rig.run(lambda: arm_is_safe(rig))


def test_plugged_in_again(make_arm_rig: Make) -> None:
    rig, number = sweep_with(make_arm_rig, {"kind": "unplug", "at_sweep": 1, "for_s": 0.1})
    fails_with(rig, number, "port is gone")
    rig.pace_s = 0.005  # else the command is too late, on the run's clock, when the port is back
    rig.kill("arm")
    rig.start("arm")  # waits for the port
    result = rig.do("jog", to_deg=1.0)
    assert result.state == "done", result.reason


def test_garbage(make_arm_rig: Make) -> None:
    garbage = {"kind": "garbage", "at_sweep": 1, "count": 60, "bytes": 40}
    rig, number = sweep_with(make_arm_rig, garbage)
    fails_with(rig, number, r"of the last 50 lines were unreadable .*check baud_rate")


def test_single_bad_lines_are_passed_over(make_arm_rig: Make) -> None:
    faults = [
        {"kind": "garbage", "at_sweep": 1, "fraction": 0.3, "bytes": 2000},
        {"kind": "wrong_checksum", "at_sweep": 1, "fraction": 0.4, "count": 2},
        {"kind": "lost_bytes", "at_sweep": 1, "fraction": 0.6, "count": 3, "bytes": 2},
    ]
    rig, number = sweep_with(make_arm_rig, *faults)
    rig.run(lambda: rig.results(number), "the sweep's end")
    result = rig.results(number)[0]
    assert (result.state, result.reason) == ("done", "")
    counters = rig.runners["arm"].node.diagnostics()
    assert counters["too_long_lines"] == 1
    assert counters["wrong_checksums"] >= 2
    unreadable = counters["wrong_checksums"] + counters["malformed_lines"]
    assert unreadable == 5
    inside = [s for _, s in rig.states() if s.speed_deg_s == 15.0 and abs(s.angle_deg) <= 90]
    assert len(inside) in (600 - 6, 601 - 6)  # exactly those are missing
    slope = [(s.angle_deg, e.header.hardware_ns) for e, s in rig.states() if s in inside]
    for angle, tick_ns in slope:  # and none of the others is wrong
        since_s = (tick_ns - slope[0][1]) * 1e-9
        assert angle - slope[0][0] == pytest.approx(15.0 * since_s, abs=2e-6)


def test_wrong_checksums(make_arm_rig: Make) -> None:
    rig, number = sweep_with(make_arm_rig, {"kind": "wrong_checksum", "at_sweep": 1, "count": 60})
    fails_with(rig, number, r"[0-9]+ wrong checksums")


def test_late_answers_are_waited_for_and_nothing_is_done_twice(make_arm_rig: Make) -> None:
    # ten times the patience, and many attempts: a busy machine may stand still for a while
    late = {"kind": "late_answers", "at_report": 3, "count": 1, "delay_s": 1.0}
    rig = make_arm_rig(faults=[late], arm={**QUICK, "attempts": 50}).start_all().homed()
    rig.run(lambda: len(rig.states()) > 4)
    for angle in (10.0, 20.0, 30.0):
        result = rig.do("jog", to_deg=angle)
        assert (result.state, result.reason) == ("done", "")
    rig.run(lambda: rig.runners["arm"].node.diagnostics()["answers_unasked"] >= 1, "a late answer")
    rig.run(lambda: rig.states()[-1][1].angle_deg == 30.0)


def test_a_machine_that_stood_still_is_nobodys_fault(make_arm_rig: Make) -> None:
    # nobody runs in that time: the node sends no keepalive, and its controller no answer
    rig = make_arm_rig().start_all()
    rig.run(lambda: rig.runners["arm_controller"].node.diagnostics()["requests"], "a request")
    time.sleep(1.2)
    rig.homed()
    jog = rig.send("jog", to_deg=30.0)
    rig.run(lambda: rig.states()[-1][1].moving, "the beginning")
    time.sleep(1.2)
    rig.run(lambda: rig.results(jog), "the end")
    assert (rig.results(jog)[0].state, rig.results(jog)[0].reason) == ("done", "")
    assert not rig.kept_state()["stopped_by_watchdog"]


@pytest.mark.parametrize("repeated", [True, False])
def test_lost_answer_to_a_motion(make_arm_rig: Make, repeated: bool) -> None:
    # many attempts: on a busy machine a few time-outs may pass while nobody is at fault
    rig = make_arm_rig(arm={**QUICK, "attempts": 50}).start_all().homed()
    twin, arm = rig.runners["arm_controller"].node, rig.runners["arm"]
    rig.hold_time = True
    before = twin.diagnostics()["requests"]
    number = rig.send("jog", to_deg=10.0)
    arm.take_messages()
    twin._wire._silent = True  # the request arrives, its answer does not
    rig.run(lambda: twin.diagnostics()["requests"] > before)
    twin._wire._silent = False
    if repeated:
        rig.run(lambda: arm.node.diagnostics()["requests_repeated"] > 0, "asking again")
    rig.hold_time = False  # if it was not asked again, the motion's end tells that it was accepted
    rig.run(lambda: rig.results(number))
    result = rig.results(number)[0]
    assert (result.state, result.reason) == ("done", "")


@pytest.mark.parametrize("fraction", [0.1, 0.9])
def test_lost_end_of_a_motion_is_asked_for(make_arm_rig: Make, fraction: float) -> None:
    rig = make_arm_rig(faults=[]).start_all().homed()
    jog = rig.send("jog", to_deg=60.0 * fraction)
    wire = rig.runners["arm_controller"].node._wire
    rig.run(lambda: rig.states()[-1][1].moving, "the beginning")
    report = wire.report

    def without_events(message: Any, *rest: Any) -> None:
        if type(message).__name__ != "Event":
            report(message, *rest)

    wire.report = without_events
    rig.run(lambda: rig.results(jog), "the end")
    assert rig.results(jog)[0].state == "done"
    stop = rig.do("stop")
    assert stop.state == "done"


def test_stall(make_arm_rig: Make) -> None:
    rig, number = sweep_with(make_arm_rig, {"kind": "stall", "at_sweep": 1, "fraction": 0.25})
    rig.run(lambda: rig.results(number))
    result = rig.results(number)[0]
    assert (result.state, "stalled" in result.reason) == ("broken", True)
    rig.run(lambda: rig.states()[-1][1].fault == "stall")
    state = rig.states()[-1][1]
    # a quarter of the way from -90° to 90°, at which it stood still within a microsecond
    assert state.angle_deg == pytest.approx(-45.0, abs=2e-5)
    refused = rig.do("jog", to_deg=0.0)
    assert (refused.state, "fault (stall)" in refused.reason) == ("refused", True)
    assert "stalled" in rig.log()
    rig.homed()
    assert rig.do("jog", to_deg=1.0).state == "done"


def test_emergency_stop(make_arm_rig: Make) -> None:
    fault = {"kind": "emergency_stop", "at_sweep": 1, "for_s": 5.0}
    rig, number = sweep_with(make_arm_rig, fault)
    rig.run(lambda: rig.results(number))
    assert "emergency stop" in rig.results(number)[0].reason
    rig.run(lambda: rig.states()[-1][1].emergency_stop)
    state = rig.states()[-1][1]
    assert (state.lamp, state.moving) == (False, False)
    for action, fields in (("home", {}), ("jog", {"to_deg": 0.0}), ("lamp", {"lamp": True})):
        refused = rig.do(action, **fields)
        assert (refused.state, "emergency stop" in refused.reason) == ("refused", True)
    assert rig.do("lamp", lamp=False).state == "done"
    rig.run(lambda: not rig.states()[-1][1].emergency_stop, "its release")
    assert rig.do("home").state == "done"


# -- what a scene may ask for


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ({"kind": "melt", "at_report": 1}, "unknown arm fault 'melt'; there are: garbage, "),
        ({"at_report": 1}, "'kind' is missing"),
        ({"kind": "stall"}, "one of at_report and at_sweep"),
        ({"kind": "stall", "at_report": 1, "at_sweep": 1}, "one of at_report and at_sweep"),
        ({"kind": "stall", "at_report": 1, "delay_s": 1.0}, "stall has no 'delay_s'"),
        ({"kind": "silent", "at_report": 1, "colour": 2}, "unknown parameter 'colour'"),
        ({"kind": "garbage", "at_report": "soon"}, "expected int"),
        ({"kind": "garbage", "at_sweep": 1, "fraction": 2.0}, "fraction is 0 to 1"),
        ({"kind": "late_answers", "at_sweep": 1, "delay_s": -1.0}, "0 or more"),
    ],
)
def test_faults_that_do_not_exist(fault: dict[str, Any], text: str) -> None:
    with pytest.raises(FaultError, match="number 2") as caught:
        parse_faults([{"kind": "stall", "at_report": 1}, fault])
    assert text in str(caught.value)


def test_every_kind_of_fault_is_known() -> None:
    faults = parse_faults({"kind": kind, "at_report": 5} for kind in KINDS)
    assert [fault.kind for fault in faults] == list(KINDS)


def test_the_readme_lists_every_kind_of_fault() -> None:
    path = Path(__file__).parents[3] / "nodes" / "tvbrdf_nodes" / "arm" / "README.md"
    text = path.read_text(encoding="utf-8")
    for kind, details in KINDS.items():
        (row,) = [line for line in text.splitlines() if line.startswith(f"| `{kind}` |")]
        for detail in details:
            assert f"`{detail}`" in row


def test_twin_refuses_a_scene_with_unknown_faults(make_arm_rig: Make) -> None:
    rig = make_arm_rig(faults=[{"kind": "melt", "at_report": 1}])
    rig.world.publish("/sim/scene", rig.scene, stamp_ns=0)
    rig.start("arm_controller")
    rig._grant()
    with pytest.raises(DeviceError, match=r"arm_controller: arm\.faults, number 1: unknown arm"):
        rig.step()
