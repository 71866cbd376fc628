"""The sequencer when things go wrong: retakes, missing scans, lost nodes, and what never ends."""

from __future__ import annotations

import random
from collections import Counter
from typing import TYPE_CHECKING

import pytest

from tvbrdf_messages.messages import ScanCommand, SweepResult

if TYPE_CHECKING:
    from conftest import MakeRig, Rig

SILENT = "silent"
DEVICES = ("arm", "camera_1", "camera_2", "hdr_merger")


def reasons(rig: Rig) -> list[tuple[int, str]]:
    return [(missing.scan, missing.reason) for missing in rig.missing]


# -- retakes


@pytest.mark.parametrize(
    ("device", "action"),
    [
        ("arm", "prepare"),
        ("camera_1", "prepare"),
        ("arm", "sweep"),
        ("camera_2", "sweep"),
        ("hdr_merger", "sweep"),
    ],
)
@pytest.mark.parametrize("sweep", [0, 1])
def test_a_broken_sweep_is_taken_again_in_the_same_way(
    rig: Rig, device: str, action: str, sweep: int
) -> None:
    rig.faults[device, action, 1, sweep, 1] = "it broke"
    rig.ready()
    end = rig.play_to_end()
    assert end.code == 0
    assert rig.missing == []
    keys = [(c.scan, c.sweep, c.attempt) for c in rig.commands if c.action == "prepare"]
    once = [(scan, s, 1) for scan in (1, 2) for s in range(3)]
    at = once.index((1, sweep, 1))
    assert keys == [
        *once[: at + 1],
        *[(1, s, 1 + (s == sweep)) for s in range(sweep, 3)],
        *once[3:],
    ]
    # the retake has the same way and exposure, and the arm was stopped before
    tries = [c for c in rig.commands if c.action == "prepare" and c.scan == 1 and c.sweep == sweep]
    same = ("from_deg", "to_deg", "exposure_ms", "scan_start_ns", "scan_time_s")
    assert [getattr(tries[0], n) for n in same] == [getattr(tries[1], n) for n in same]
    between = rig.actions()[rig.commands.index(tries[0]) : rig.commands.index(tries[1])]
    assert "stop" in between
    # stop switches the lamp off
    lamps = [c.lamp for c in rig.commands[: rig.commands.index(tries[1])] if c.action == "lamp"]
    assert lamps[-1] is True
    assert f"scan 1 sweep {sweep + 1}: {device}: it broke" in rig.stage.log("warning")


def test_broken_dark_frames_are_taken_again(rig: Rig) -> None:
    rig.faults["camera_1", "dark", 1, 0, 1] = "no frame"
    rig.ready()
    assert rig.play_to_end().code == 0
    dark = [(c.scan, c.attempt) for c in rig.commands if c.action == "dark"]
    assert dark == [(1, 1), (1, 2), (2, 1)]
    assert rig.missing == []


def test_a_sweep_is_taken_three_times_at_most(rig: Rig) -> None:
    for attempt in (1, 2, 3, 4):
        rig.faults["camera_1", "sweep", 1, 1, attempt] = "frames were lost"
    rig.ready()
    assert rig.play_to_end().code == 0
    assert reasons(rig) == [(1, "camera_1: frames were lost (3 attempts)")]
    assert rig.sweeps() == [
        (1, 0, 1),
        *[(1, 1, attempt) for attempt in (1, 2, 3)],
        *[(2, sweep, 1) for sweep in range(3)],
    ]
    starts = {c.scan: c.scan_start_ns for c in rig.commands if c.action == "sweep"}
    assert starts[2] - starts[1] == 60_000_000_000  # the next scan comes in its own slot


def test_each_sweep_has_its_own_tries(rig: Rig) -> None:
    for sweep in range(3):
        for attempt in (1, 2):
            rig.faults["arm", "sweep", 1, sweep, attempt] = "stalled"
    rig.ready()
    assert rig.play_to_end().code == 0
    assert rig.missing == []
    assert rig.sweeps()[:9] == [(1, sweep, a) for sweep in range(3) for a in (1, 2, 3)]


def test_the_number_of_tries_can_be_set(make_rig: MakeRig) -> None:
    rig = make_rig(attempts=1)
    rig.faults["arm", "sweep", 1, 0, 1] = "stalled"
    rig.ready()
    rig.play_to_end()
    assert reasons(rig) == [(1, "arm: stalled (1 attempts)")]


def test_after_its_time_slot_a_scan_is_missing(rig: Rig) -> None:
    """The sample moves on: a retake would be of another material."""
    rig.faults["camera_2", "sweep", 1, 1, 1] = "dropped frames"
    late = {(1, 1, 1)}

    def take_long(command: ScanCommand) -> None:
        if command.action == "sweep" and (command.scan, command.sweep, command.attempt) in late:
            rig.stage.advance(61.0)

    rig.on_command = take_long
    rig.ready()
    assert rig.play_to_end().code == 0
    assert reasons(rig) == [(1, "camera_2: dropped frames (its time slot had passed)")]
    assert rig.sweeps()[2:] == [(2, sweep, 1) for sweep in range(3)]


def test_scans_whose_time_has_passed_are_recorded_one_by_one(make_rig: MakeRig) -> None:
    rig = make_rig(scans=5)

    def take_long(command: ScanCommand) -> None:
        if command.action == "sweep" and (command.scan, command.sweep) == (1, 2):
            rig.stage.advance(155.0)

    rig.on_command = take_long
    rig.ready()
    assert rig.play_to_end().code == 0
    assert reasons(rig) == [(2, "its time slot had passed"), (3, "its time slot had passed")]
    assert [missing.scan_time_s for missing in rig.missing] == [60.0, 120.0]
    assert sorted({scan for scan, _, _ in rig.sweeps()}) == [1, 4, 5]


# -- answers that are late, foreign or missing


def test_answers_of_a_try_that_was_given_up_change_nothing(rig: Rig) -> None:
    rig.faults["arm", "sweep", 1, 0, 1] = "stalled"
    old: list[SweepResult] = []

    def repeat_old(command: ScanCommand) -> None:
        if command.action == "stop":
            old.extend(
                SweepResult(
                    source=device,
                    command_id=command.command_id - 1,
                    action="sweep",
                    state=state,
                    reason="late",
                    scan=1,
                    sweep=0,
                    attempt=1,
                )
                for device in DEVICES
                for state in ("done", "broken")
            )
        if command.attempt == 2 and command.sweep == 0:
            for result in old:
                rig[result.source].say("/scan/sweep_result", result)

    rig.on_command = repeat_old
    rig.ready()
    assert rig.play_to_end().code == 0
    assert old
    assert rig.sweeps()[:3] == [(1, 0, 1), (1, 0, 2), (1, 1, 1)]
    assert rig.missing == []


def test_answers_that_come_twice_or_were_never_asked_for_change_nothing(rig: Rig) -> None:
    def add_noise(command: ScanCommand) -> None:
        for action in ("home", "prepare", "lamp", "jog", "still"):
            for command_id in (command.command_id - 1, command.command_id + 1, 0):
                result = SweepResult(
                    source="camera_1", command_id=command_id, action=action, state="done"
                )
                rig["camera_1"].say("/scan/sweep_result", result)

    rig.on_command = add_noise
    rig.ready()
    assert rig.play_to_end().code == 0
    assert rig.sweeps() == [(scan, sweep, 1) for scan in (1, 2) for sweep in range(3)]


def test_a_device_that_does_not_answer_breaks_the_sweep(make_rig: MakeRig) -> None:
    rig = make_rig(answer_limit_s=0.01, sweep_s=0.04, scans=1)
    rig.faults["camera_2", "prepare", 1, 1, 1] = SILENT
    rig.ready()
    rig.play_until(lambda: rig.status.state == "preparing" and rig.status.sweep == 2)
    rig.stage.wait(lambda: rig.stage.log("warning") != [])
    assert rig.stage.log("warning") == ["scan 1 sweep 2: no answer from camera_2"]
    assert rig.play_to_end().code == 0
    assert rig.missing == []


# -- lost nodes


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("when", ["dark", "prepare", "sweep", "end_sweep"])
def test_a_lost_node_breaks_the_sweep_and_is_waited_for(rig: Rig, device: str, when: str) -> None:
    died: list[tuple[int, int, int]] = []
    target = (1, 0, 1) if when == "dark" else (1, 1, 1)

    def kill(command: ScanCommand) -> None:
        key = (command.scan, command.sweep, command.attempt)
        if command.action == when and key == target and not died:
            died.append(key)
            rig[device].die()

    rig.on_command = kill
    rig.ready()
    rig.play_until(lambda: rig.status.state == "waiting for a restart")
    assert died
    count = len(rig.commands)
    rig.stage.advance(5.0)
    rig.play()
    assert rig.actions()[count:] == []  # nobody moves meanwhile
    rig[device].return_()
    rig[device].state("ready")
    rig.play()
    assert rig.actions()[count:] == []
    rig[device].state("running")
    rig.play()
    again = rig.actions()[count:]
    assert again[0] == ("home" if device == "arm" else "lamp")
    assert rig.play_to_end().code == 0
    assert rig.missing == []
    # a merger takes the scan's earlier sweeps with it
    first = 0 if device == "hdr_merger" else target[1]
    prepared = [(c.scan, c.sweep, c.attempt) for c in rig.commands[count:] if c.action == "prepare"]
    assert prepared[0] == (1, first, 2)
    keys = rig.sweeps()
    assert len(keys) == len(set(keys))
    assert f"{device} is back" in rig.stage.log("info")


@pytest.mark.parametrize("node", ["fitter", "database_writer"])
def test_a_lost_fitter_or_writer_does_not_disturb_the_sweep(rig: Rig, node: str) -> None:
    def kill(command: ScanCommand) -> None:
        if command.action == "sweep" and (command.scan, command.sweep) == (1, 1):
            rig[node].die()

    rig.on_command = kill
    rig.ready()
    rig.play_until(lambda: rig.status.sweep == 3)
    assert "stop" not in rig.actions()
    rig[node].return_()
    rig[node].state()
    if node == "database_writer":
        rig.database()
    assert rig.play_to_end().code == 0
    assert rig.sweeps() == [(scan, sweep, 1) for scan in (1, 2) for sweep in range(3)]


def test_a_node_lost_between_scans_is_waited_for(rig: Rig) -> None:
    rig.ready()
    rig.play_until(lambda: rig.status.state == "interval" and rig.status.scan == 2)
    rig["arm"].die()
    assert rig.stage.graph.runners["sequencer"].next_timer_ns() is not None
    rig["arm"].return_()
    rig["arm"].state()
    rig.play()
    # its lamp is off and it has forgotten where it is
    assert rig.actions()[-2:] == ["home", "lamp"]
    assert rig.status.state == "warming up"
    assert rig.play_to_end().code == 0
    assert rig.missing == []


def test_a_node_lost_before_the_start_does_not_start_anything(rig: Rig) -> None:
    rig.all_running()
    rig["camera_1"].die()
    rig["camera_1"].return_()
    rig["camera_1"].state()
    rig.play()
    assert rig.commands == []
    rig.database(scans=(1,), fitted=(1,), zero_ns=rig.stage.now_ns - 10**10)
    assert rig.play_to_end().code == 0
    assert {scan for scan, _, _ in rig.sweeps()} == {2}


def test_a_node_that_comes_back_after_the_slot_finds_its_scan_missing(rig: Rig) -> None:

    def kill(command: ScanCommand) -> None:
        if command.action == "sweep" and (command.scan, command.sweep) == (1, 1):
            rig["camera_1"].die()

    rig.on_command = kill
    rig.ready()
    rig.play_until(lambda: rig.status.state == "waiting for a restart")
    rig.stage.advance(70.0)
    rig["camera_1"].return_()
    rig["camera_1"].state()
    assert rig.play_to_end().code == 0
    reason = "its time slot had passed while a node was restarted"
    assert reasons(rig) == [(1, reason)]


@pytest.mark.parametrize("node", ["arm", "camera_2", "hdr_merger", "fitter", "database_writer"])
def test_a_node_that_does_not_come_back_ends_the_run_safely(make_rig: MakeRig, node: str) -> None:
    rig = make_rig(restart_limit_s=0.05)

    killed = []

    def kill(command: ScanCommand) -> None:
        if command.action == "sweep" and (command.scan, command.sweep) == (1, 1):
            killed.append(node)
            rig[node].die()

    rig.on_command = kill
    rig.ready()
    rig.play_until(lambda: killed)
    rig.stage.wait(lambda: rig.exit is not None)
    assert rig.exit is not None
    assert (rig.exit.code, rig.exit.text) == (1, f"{node} did not come back")
    last = rig.stage.said("/scan/command")[-1].message
    assert isinstance(last, ScanCommand)
    assert (last.action, last.target) == ("stop", "all")
    assert rig.status.state == "failed"


def test_a_merger_that_dies_with_a_scan_that_is_not_on_disk(make_rig: MakeRig) -> None:
    """Else the run would wait for ever for a scan that nobody has any more."""
    rig = make_rig(restart_limit_s=0.2)
    rig.stores = False
    rig.ready()
    rig.play_until(lambda: rig.status.state == "interval" and rig.status.scan == 2)
    rig["hdr_merger"].die()
    rig["hdr_merger"].return_()
    rig["hdr_merger"].state()
    rig.stores = True
    rig.stage.wait(lambda: any("lost with" in text for text in rig.stage.log("warning")))
    assert rig.play_to_end().code == 0
    assert reasons(rig) == [(1, "it was lost with hdr_merger")]


def test_a_merger_that_dies_with_a_scan_on_its_way_to_the_disk(make_rig: MakeRig) -> None:
    rig = make_rig(restart_limit_s=0.2)
    rig.stores = False
    rig.ready()
    rig.play_until(lambda: rig.status.state == "interval" and rig.status.scan == 2)
    rig["hdr_merger"].die()
    rig["hdr_merger"].return_()
    rig["hdr_merger"].state()
    rig.stores = True
    rig.measured(1)
    assert rig.play_to_end().code == 0
    assert rig.missing == []


def test_a_scan_that_is_stored_though_its_merger_died_is_not_taken_again(rig: Rig) -> None:
    rig.faults["hdr_merger", "sweep", 1, 2, 1] = SILENT
    rig.ready()
    rig.play_until(lambda: rig.status.sweep == 3 and rig.actions()[-1] == "end_sweep", limit=40)
    rig["hdr_merger"].die()
    rig.measured(1)
    rig["hdr_merger"].return_()
    rig["hdr_merger"].state()
    assert rig.play_to_end().code == 0
    assert rig.missing == []
    assert rig.sweeps() == [(scan, sweep, 1) for scan in (1, 2) for sweep in range(3)]


# -- what can't go on


def test_an_arm_that_can_not_home_ends_the_run(rig: Rig) -> None:
    rig.faults["arm", "home", 0, 0, 0] = "the emergency stop is pressed"
    rig.ready()
    end = rig.play_to_end()
    assert (end.code, end.text) == (1, "arm: the emergency stop is pressed")
    assert rig.actions() == ["home", "stop"]


def test_a_run_that_measured_nothing_has_failed(rig: Rig) -> None:
    for scan in (1, 2):
        for attempt in (1, 2, 3):
            rig.faults["arm", "prepare", scan, 0, attempt] = "too fast for the limits"
    rig.ready()
    end = rig.play_to_end()
    assert end.code == 1
    assert "nothing was measured: scan 2 is missing: arm: too fast" in end.text
    assert [scan for scan, _ in reasons(rig)] == [1, 2]


def test_a_scan_that_the_database_refuses_is_missing(rig: Rig) -> None:
    rig.stores = False
    rig.ready()
    rig.play_until(lambda: rig.status.scan == 2)
    rig.stored(1, "radiance", refused="no camera has a single valid radiance")
    rig.stores = True
    assert rig.play_to_end().code == 0
    text = "radiance of scan 1 can't be stored: no camera has a single valid radiance"
    assert reasons(rig) == [(1, text)]


def test_parameters_that_the_database_refuses_make_the_run_fail_at_its_end(rig: Rig) -> None:
    rig.stores = False
    rig.ready()
    rig.play_until(lambda: rig.status.scan == 2)
    rig.stored(1, "radiance")
    rig.stored(1, "parameters", refused="of another model")
    rig.stores = True
    end = rig.play_to_end()
    assert (end.code, end.text) == (1, "parameters of scan 1 can't be stored: of another model")
    assert rig.missing == []
    assert {scan for scan, _, _ in rig.sweeps()} == {1, 2}


# -- all together


@pytest.mark.parametrize("seed", range(40))
def test_whatever_happens_each_scan_ends_once_and_the_run_ends(
    make_rig: MakeRig, seed: int
) -> None:
    """Random faults and deaths: every scan is stored or missing, no sweep is taken too often."""
    rng = random.Random(seed)
    rig = make_rig(scans=4, restart_limit_s=100.0)
    dead: list[str] = []

    def trouble(command: ScanCommand) -> None:
        if command.action not in ("dark", "prepare", "sweep", "end_sweep"):
            return
        if rng.random() < 0.1:
            # by then the arm has said that its sweep was good
            device = rng.choice(DEVICES[1:] if command.action == "end_sweep" else DEVICES)
            action = "sweep" if command.action == "end_sweep" else command.action
            key = (command.scan, command.sweep, command.attempt)
            rig.faults[device, action, *key] = "it broke"
        if rng.random() < 0.05:
            name = rng.choice((*DEVICES, "fitter", "database_writer"))
            if name not in dead:
                dead.append(name)
                rig[name].die()
        if rng.random() < 0.1:
            rig.stage.advance(rng.uniform(0.0, 50.0))

    rig.on_command = trouble
    rig.ready()
    for _ in range(400):
        timer_ns = rig.stage.graph.runners["sequencer"].next_timer_ns()
        if rig.exit is not None:
            break
        if dead and (timer_ns is None or rng.random() < 0.5):
            name = dead.pop()
            rig[name].return_()
            rig[name].state()
            if name == "database_writer":
                rig.database()
        elif timer_ns is not None:
            rig.stage.advance(max(0.0, (timer_ns - rig.stage.now_ns) / 1e9))
        rig.play()
    assert rig.exit is not None, (rig.status, dead)
    measured, missing = Counter(rig.measured_scans), Counter(m.scan for m in rig.missing)
    assert set(measured) | set(missing) == {1, 2, 3, 4}
    assert not set(measured) & set(missing)
    assert max((measured | missing).values()) == 1
    keys = rig.sweeps()
    assert len(keys) == len(set(keys))
    assert max(attempt for _, _, attempt in keys) <= 3
    assert rig.exit.code == (0 if measured else 1)
    lamp_and_arm = [c for c in rig.commands if c.action in ("stop", "lamp")]
    assert lamp_and_arm[-1].lamp is False
