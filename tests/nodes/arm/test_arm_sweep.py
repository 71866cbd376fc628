"""A sweep through the whole chain: node, pyserial, pseudo-terminal, twin."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from tvbrdf_messages.clock import SystemClock
from tvbrdf_messages.messages import SimHorizon
from tvbrdf_nodes.arm.simulated_parameters import TickClock

Make = Callable[..., Any]
SWEEP = {"from_deg": -90.0, "to_deg": 90.0, "duration_s": 12.0, "sample": "paint", "scan": 3}
BACK = {"from_deg": 90.0, "to_deg": -90.0, "duration_s": 12.0, "sample": "paint", "scan": 3}
DECIMALS_DEG = 5e-7 + 2e-8
"""Angles travel with six decimals; moments are rounded to 1 ns, at 15°/s."""


def swept(rig: Any, way: dict[str, Any]) -> list[Any]:
    """Sweep; return the reports that the result names."""
    assert rig.do("prepare", **way).state == "done"
    result = rig.do("sweep", **way)
    assert (result.state, result.reason) == ("done", "")
    found = [
        (envelope, state)
        for envelope, state in rig.states()
        if result.first_sequence <= envelope.header.sequence <= result.last_sequence
    ]
    assert len(found) == result.frames > 600
    return found


def test_speed_is_constant_between_the_ends(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all().homed()
    reports = swept(rig, SWEEP)
    inside = [(e, s) for e, s in reports if s.moving and abs(s.angle_deg) <= 90.0]
    assert len(inside) in (600, 601)  # 12 s at 50 Hz
    for _, state in inside:
        assert state.speed_deg_s == pytest.approx(15.0, abs=1e-6)
    for (first, a), (second, b) in pairwise(inside):
        step_s = (second.header.hardware_ns - first.header.hardware_ns) * 1e-9
        assert step_s == pytest.approx(0.02, abs=1e-12)
        assert b.angle_deg - a.angle_deg == pytest.approx(15.0 * step_s, abs=2 * DECIMALS_DEG)
    # run-up and run-down lie outside: v²/2a = 1.875° at 60°/s², and 0.5° to settle
    at_rest = [s.angle_deg for _, s in reports if not s.moving]
    assert at_rest[0] == pytest.approx(-92.375, abs=1e-6)
    assert reports[-1][1].angle_deg == pytest.approx(92.375, abs=0.01)


def test_the_ends_are_passed_in_the_time_that_was_asked_for(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all().homed()
    swept(rig, SWEEP)
    cruises = {
        (start, angle)
        for motion in rig.motions()
        for start, angle, speed, acceleration in zip(
            motion.start_ns,
            motion.angle_deg,
            motion.speed_deg_s,
            motion.acceleration_deg_s2,
            strict=True,
        )
        if speed == 15.0 and acceleration == 0.0
    }
    for start_ns, angle in cruises:  # all tell the same line: it passes -90° at one moment
        first_ns, _ = min(cruises)
        passes_s = (start_ns - first_ns) * 1e-9 - (angle + 90.0) / 15.0
        assert passes_s == pytest.approx(0.5 / 15.0, abs=2e-9)
    end_ns = max(m.until_ns for m in rig.motions() if 15.0 in m.speed_deg_s)
    assert (end_ns - min(cruises)[0]) * 1e-9 >= 12.0 + 1.0 / 15.0


def test_ticks_follow_the_controllers_own_clock(make_arm_rig: Make, true_angle: Any) -> None:
    effects = {
        "clock_offset_s": 3.2,
        "clock_drift_ppm": 40.0,
        "latency_ms": 1.2,
        "jitter_ms": 0.4,
        "angle_offset_deg": 0.25,
    }
    rig = make_arm_rig(**effects).start_all().homed()
    reports = [(e, s) for e, s in swept(rig, BACK) if s.moving and abs(s.angle_deg) <= 90.0]
    motions = rig.motions()
    excess_ms = []
    for envelope, state in reports:
        header = envelope.header
        # hardware = (run - zero + offset) (1 + drift), told in whole microseconds
        happened_ns = round(header.hardware_ns / (1 + 40e-6) - 3.2e9) + rig.scene.zero_ns
        true_deg = true_angle(motions, happened_ns)
        # 2e-8: the division above is off by a nanosecond or so, at 15°/s
        assert true_deg - state.angle_deg == pytest.approx(0.25, abs=DECIMALS_DEG + 2e-8)
        excess_ms.append((header.received_ns - happened_ns) / 1e6 - 1.2)
        assert header.stamp_ns == header.received_ns - state.one_way_delay_ns
    assert min(excess_ms) > -1e-5
    # exponential delays: the mean of n is off by mean/sqrt(n), here at most by 5 of those
    mean = sum(excess_ms) / len(excess_ms)
    assert mean == pytest.approx(0.4, abs=5 * 0.4 / math.sqrt(len(excess_ms)))
    # half of the fastest of n round trips: latency, and half of the smallest sum of two delays;
    # that it exceeds x (in units of their mean) has probability exp(-n x²/2), 1e-8 at n = 100
    trips = rig.runners["arm"].node.diagnostics()["round_trips"]
    assert trips > 100
    delay_ms = reports[-1][1].one_way_delay_ns / 1e6
    assert 1.2 <= delay_ms < 1.2 + 0.4 * 0.5 * math.sqrt(2 * math.log(1e8) / 100)


def test_a_32_bit_count_is_unwrapped(make_arm_rig: Make) -> None:
    # 24 bits wrap around every 16.8 s, so a homing and a sweep see it
    rig = make_arm_rig(controller={"tick_bits": 24}, clock_offset_s=10.0).start_all().homed()
    swept(rig, SWEEP)
    stamps = [envelope.header.hardware_ns for envelope, _ in rig.states()]
    assert stamps[-1] > 2**24 * 1000
    assert all(0 < b - a <= 200_000_000 for a, b in pairwise(stamps))
    assert stamps[-1] - stamps[0] == pytest.approx(
        rig.states()[-1][0].header.received_ns - rig.states()[0][0].header.received_ns, abs=2000
    )


@pytest.mark.parametrize("drift_ppm", [-100.0, 0.0, 37.123])
@pytest.mark.parametrize("offset_s", [-2.5, 0.0, 1e6])
def test_tick_clock_is_exact(drift_ppm: float, offset_s: float) -> None:
    clock = TickClock(1_700_000_000_000_000_001, offset_s, drift_ppm)
    for count in (0, 1, 17, 20_000, 12_345_678_901, -5):
        moment = clock.when(count)
        assert clock.count(moment) == count
        assert clock.count(moment - 1) == count - 1


def test_true_motion_is_gapless_and_within_limits(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all().homed()
    rig.do("lamp", lamp=True)
    swept(rig, SWEEP)
    number = rig.send("sweep", **BACK)
    rig.run_for(9.0)
    rig.do("stop")
    rig.run_for(1.0)
    assert rig.results(number)[0].state == "broken"
    motions = rig.motions()
    end_ns, angle, speed, lamps = motions[0].start_ns[0], motions[0].angle_deg[0], 0.0, []
    for motion in motions:
        assert motion.start_ns[0] == end_ns
        edges = [*motion.start_ns, motion.until_ns]
        for k, (begin, end) in enumerate(pairwise(edges)):
            assert begin < end
            # angles and moments are rounded to double precision and 1 ns; 60°/s at most
            assert motion.angle_deg[k] == pytest.approx(angle, abs=1e-7)
            assert motion.speed_deg_s[k] == pytest.approx(speed, abs=1e-7)
            t, rate = (end - begin) * 1e-9, motion.acceleration_deg_s2[k]
            assert abs(rate) <= 60.0
            angle = motion.angle_deg[k] + (motion.speed_deg_s[k] + 0.5 * rate * t) * t
            speed = motion.speed_deg_s[k] + rate * t
            assert abs(speed) <= 60.0 + 1e-7
        end_ns = motion.until_ns
        lamps.extend(motion.lamp)
    assert [on for on, _ in _runs(lamps)] == [False, True, False]
    assert speed == 0.0


def _runs(values: list[bool]) -> list[tuple[bool, int]]:
    found: list[tuple[bool, int]] = []
    for value in values:
        if not found or found[-1][0] != value:
            found.append((value, 1))
    return found


def test_horizon_tells_whether_the_arm_moves(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all()
    rig.run_for(0.5)
    rig.homed()
    rig.run_for(0.5)
    horizons = [e.message for e in rig.published("/sim/horizon")]
    idle = [h.idle for h in horizons if isinstance(h, SimHorizon)]
    assert idle[0]
    assert idle[-1]
    assert not all(idle)
    assert all(h.device == "arm_controller" for h in horizons)


def test_simulated_time_waits_for_a_reader_that_does_not_read(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all().homed()
    assert rig.do("prepare", **SWEEP).state == "done"
    number = rig.send("sweep", **SWEEP)
    moving = len(rig.states()) + 20
    rig.run(lambda: len(rig.states()) > moving, "the sweep's beginning")
    arm = rig.runners.pop("arm")
    granted, stuck = rig.granted_ns, 0
    while stuck < 200:  # nothing is read: its pseudo-terminal fills up, then time stands still
        rig.step()
        stuck = stuck + 1 if rig.granted_ns == granted else 0
        granted = rig.granted_ns
        assert granted < rig.scene.zero_ns + 600 * 10**9
    waiting = rig.runners["arm_controller"].node.diagnostics()["waiting_bytes"]
    assert 0 < waiting < 8192 + 4096
    rig.runners["arm"] = arm
    rig.run(lambda: rig.results(number), "the sweep's end")
    assert rig.granted_ns > granted


def test_on_the_computers_clock_without_a_line_monitor(make_arm_rig: Make) -> None:
    clock = SystemClock()
    rig = make_arm_rig(arm={"arrival_stamps": "host"}, clock=clock)
    before_ns = clock.now_ns()
    rig.start_all()
    forever = clock.now_ns() + 3600 * 10**9
    rig.do("home", not_after_ns=forever)
    after_ns = clock.now_ns()
    for envelope, state in rig.states():
        assert before_ns < envelope.header.received_ns < after_ns
        assert state.one_way_delay_ns < after_ns - before_ns
    assert rig.runners["arm"].node.diagnostics()["one_way_delay_us"] > 0


def test_commands_for_others_are_left_alone(make_arm_rig: Make) -> None:
    rig = make_arm_rig().start_all().homed()
    numbers = [
        rig.send("still", target="cameras"),
        rig.send("prepare", target="camera_1"),
        rig.send("end_sweep", target="all"),
        rig.send("dark", target="all"),
    ]
    assert rig.do("lamp", lamp=True).state == "done"
    assert not any(rig.results(number) for number in numbers)
