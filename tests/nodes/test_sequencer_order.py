"""The sequencer when all goes well: what it commands, in which order, and when."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest

from tvbrdf_messages.messages import ScanCommand, Stored
from tvbrdf_nodes.core.node import Exit
from tvbrdf_nodes.core.parameters import ParameterError, build
from tvbrdf_nodes.sequencer.plan import SequencerParameters

if TYPE_CHECKING:
    from conftest import MakeRig, Rig

ONE_SWEEP = ["prepare", "sweep", "end_sweep"]
ONE_SCAN = ["lamp", "dark", "lamp", *3 * ONE_SWEEP]


def test_one_scan_from_start_to_end(make_rig: MakeRig) -> None:
    rig = make_rig(scans=1)
    rig.ready()
    assert rig.play_to_end() == Exit(0)
    assert rig.actions() == ["home", "lamp", *ONE_SCAN, "lamp"]
    lamps = [command.lamp for command in rig.commands if command.action == "lamp"]
    assert lamps == [True, False, True, False]  # warm-up, dark frames, sweeps, end
    targets = {command.action: command.target for command in rig.commands}
    assert targets == {
        "home": "arm",
        "lamp": "arm",
        "dark": "cameras",
        "prepare": "all",
        "sweep": "all",
        "end_sweep": "all",
    }
    dark = next(command for command in rig.commands if command.action == "dark")
    assert (dark.frames, dark.exposures_ms) == (8, (0.2, 4.0, 32.0))
    # each step waits for the answers to the one before: nobody is told two things at once
    ids = [command.command_id for command in rig.commands]
    assert ids == sorted(set(ids))
    assert {c.incarnation for c in rig.commands} == {
        rig.stage.graph.bus.ports["sequencer"].incarnation
    }
    for command in rig.commands:
        assert command.not_after_ns > 0
        assert command.sample == "paint"


def test_sweeps_go_to_and_fro_and_through_the_exposures(rig: Rig) -> None:
    rig.ready()
    rig.play_to_end()
    sweeps = [command for command in rig.commands if command.action == "sweep"]
    assert [(c.scan, c.sweep, c.attempt) for c in sweeps] == [
        (scan, sweep, 1) for scan in (1, 2) for sweep in (0, 1, 2)
    ]
    assert [c.exposure_ms for c in sweeps] == [0.2, 4.0, 32.0] * 2
    # three sweeps a scan: the second scan begins where the first ended, so drying and angle part
    assert [(c.from_deg, c.to_deg) for c in sweeps] == [(-90.0, 90.0), (90.0, -90.0)] * 3
    for before, after in pairwise(rig.commands):
        if after.action in ("sweep", "end_sweep"):
            same = ("scan", "sweep", "attempt", "from_deg", "to_deg", "exposure_ms", "duration_s")
            assert [getattr(before, n) for n in same] == [getattr(after, n) for n in same]


def test_scans_are_an_interval_apart_and_count_their_time_from_the_first(make_rig: MakeRig) -> None:
    rig = make_rig(scans=4)
    rig.ready()
    rig.play_to_end()
    starts = {c.scan: (c.scan_start_ns, c.scan_time_s) for c in rig.commands if c.action == "sweep"}
    zero_ns = starts[1][0]
    assert {scan: (at - zero_ns, time_s) for scan, (at, time_s) in starts.items()} == {
        1: (0, 0.0),
        2: (60_000_000_000, 60.0),
        3: (120_000_000_000, 120.0),
        4: (180_000_000_000, 180.0),
    }


def test_the_lamp_warms_up_before_the_first_scan_and_settles_before_each(rig: Rig) -> None:
    moments: list[int] = []

    def note(command: ScanCommand) -> None:
        moments.append(rig.stage.now_ns)

    rig.on_command = note
    rig.ready()
    rig.play_to_end()
    actions = rig.actions()
    assert actions[:4] == ["home", "lamp", "lamp", "dark"]
    assert moments[2] - moments[1] == 10_000_000_000
    for index, action in enumerate(actions):
        if action == "dark":
            assert actions[index + 1 : index + 3] == ["lamp", "prepare"]
            assert moments[index + 2] - moments[index + 1] == 2_000_000_000


def test_nothing_moves_before_all_nodes_run_and_the_database_is_open(rig: Rig) -> None:
    rig.play()
    for name in ("arm", "camera_1", "camera_2", "hdr_merger", "fitter"):
        rig[name].state()
    rig.database()
    rig.play()
    assert rig.commands == []
    rig["database_writer"].state("ready")  # not yet running
    rig.play()
    assert rig.commands == []
    rig["database_writer"].state()
    rig.play()
    assert rig.actions()[0] == "home"


def test_it_begins_while_the_fitter_still_loads(rig: Rig) -> None:
    """What is sent to a fitter that has registered waits for it; one that has not loses it."""
    for name in ("arm", "camera_1", "camera_2", "hdr_merger", "database_writer"):
        rig[name].state()
    rig.database()
    rig["fitter"].state("waiting")
    rig.play()
    assert rig.commands == []
    rig["fitter"].state("ready")
    rig.play()
    assert rig.actions()[0] == "home"
    rig["fitter"].state()
    assert rig.play_to_end() == Exit(0)
    assert rig.sweeps() == [(scan, sweep, 1) for scan in (1, 2) for sweep in range(3)]


@pytest.mark.parametrize("name", ["arm", "camera_1", "hdr_merger", "database_writer"])
def test_it_begins_only_when_all_others_have_loaded(rig: Rig, name: str) -> None:
    rig.all_running()
    rig[name].state("ready")
    rig.database()
    rig.play()
    assert rig.commands == []


def test_a_node_that_stops_running_before_the_start_is_waited_for_again(rig: Rig) -> None:
    for name in ("arm", "camera_1", "camera_2", "hdr_merger", "fitter", "database_writer"):
        rig[name].state()
    rig["camera_2"].state("fault")
    rig.database()
    rig.play()
    assert rig.commands == []


def test_it_ends_only_when_everything_is_stored_and_fitted(make_rig: MakeRig) -> None:
    rig = make_rig(scans=1)
    rig.stores = False
    rig.ready()
    rig.play_until(lambda: rig.status.state == "finishing")
    rig.stored(1, "radiance")
    rig.play()
    assert rig.status.state == "finishing"
    rig.stored(1, "parameters")
    assert rig.exit == Exit(0)
    assert (rig.status.state, rig.status.fraction) == ("finished", 1.0)


def test_what_is_stored_may_be_forgotten(rig: Rig) -> None:
    """Kept messages go to a restarted database writer until it has confirmed them."""
    rig.stores = False
    rig.ready()
    rig.stage.ask("sequencer", "mark", text="paint is on", zero=True)
    rig.play()
    writer = rig["database_writer"]
    writer.die()
    writer.return_()
    rig.play()
    assert [mark.text for mark in rig.marks] == ["paint is on"] * 2
    rig["database_writer"].say("/scan/stored", Stored(sample="paint", scan=0, what="mark"))
    writer.die()
    writer.return_()
    rig.play()
    assert len(rig.marks) == 2


def test_without_dark_frames_the_lamp_stays_on(make_rig: MakeRig) -> None:
    rig = make_rig(dark_frames=0)
    rig.ready()
    rig.play_to_end()
    assert rig.actions() == ["home", "lamp", *2 * 3 * ONE_SWEEP, "lamp"]


def test_the_status_tells_how_far_it_is(rig: Rig) -> None:
    rig.ready()
    rig.play_to_end()
    statuses: list[Any] = [e.message for e in rig.stage.said("/scan/status")]
    fractions = [status.fraction for status in statuses]
    assert fractions[0] == 0.0
    assert fractions[-1] == 1.0
    assert fractions == sorted(fractions)
    left = [status.remaining_s for status in statuses]
    assert left == sorted(left, reverse=True)
    assert left[-1] == 0.0


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"scans": 0}, "scans is 0"),
        ({"exposures_ms": ()}, "exposures_ms"),
        ({"exposures_ms": (0.0, 1.0)}, "exposures_ms"),
        ({"cameras": ()}, "cameras is empty"),
        ({"sweep_s": 0.0}, "sweep_s must be above 0"),
        ({"end_angle_deg": 120.0}, "end_angle_deg"),
        ({"interval_s": -1.0}, "interval_s"),
        ({"attempts": 0}, "attempts"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(values: dict[str, object], text: str) -> None:
    with pytest.raises(ParameterError, match=text):
        build(SequencerParameters, {"sample": "paint"} | values)
