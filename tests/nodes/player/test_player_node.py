"""The player on a stage: what it publishes, how people direct it, what it refuses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import playback
from tests.nodes.stage import MakeStage, Stage
from tests.replay_bags import write_bag
from tests.sample_messages import camera_info
from tvbrdf_messages.bag import BagWriter
from tvbrdf_messages.envelope import Envelope, Header, in_epoch
from tvbrdf_messages.messages import ArmState, Clock, Diagnostics, Mark, ScanCommand
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_nodes.core.device import DeviceError
from tvbrdf_nodes.core.parameters import ParameterError, build
from tvbrdf_nodes.player.node import PlayerNode
from tvbrdf_nodes.player.parameters import PlayerParameters

START_NS = 1_700_000_000_000_000_000
STEP_NS = 20_000_000
COUNT = 50
"""States of the arm: one second of them, from before the stage's time."""


def header(publisher: str, sequence: int, stamp_ns: int, incarnation: str = "one") -> Header:
    return Header(publisher, incarnation, "elsewhere", "boot", sequence, stamp_ns, stamp_ns + 5, 77)


def state(sequence: int, log_ns: int, incarnation: str = "one") -> Envelope:
    message = ArmState(angle_deg=sequence / 3, speed_deg_s=1.0, lamp=True, moving=True, homed=True)
    return Envelope("/arm/state", header("arm", sequence, log_ns - 1000, incarnation), message)


def info(sequence: int, log_ns: int) -> Envelope:
    message = camera_info(serial=str(sequence))
    return Envelope("/camera_1/info", header("camera_1", sequence, log_ns), message)


def command(log_ns: int) -> Envelope:
    message = ScanCommand(command_id=1, incarnation="x", not_after_ns=0, action="home")
    return Envelope("/scan/command", header("sequencer", 0, log_ns), message)


def diagnostics(log_ns: int) -> Envelope:
    message = Diagnostics(node="arm", state="running")
    return Envelope("/diagnostics", header("arm", 0, log_ns), message)


def write(path: Path, told: list[tuple[int, Envelope]]) -> Path:
    with BagWriter(path, floor_free_bytes=0) as bag:
        for log_ns, envelope in told:
            bag.write_envelope(envelope, log_ns)
    return path


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A second of the arm's states, with infos before the first and before the 31st."""
    told = [(START_NS, info(0, START_NS)), (START_NS, command(START_NS))]
    told.append((START_NS, diagnostics(START_NS)))
    for k in range(COUNT):
        at = START_NS + k * STEP_NS
        if k == 30:
            told.append((at, info(1, at)))
        told.append((at, state(k, at)))
    return write(tmp_path / "run.mcap", told)


class Played:
    """A player on a stage with one reader, whom the test plays."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.runner = stage.graph.runners["player"]
        stage.begin()

    def on(self, topic: str) -> list[Any]:
        return [envelope.message for envelope in self.stage.said(topic)]

    def angles(self) -> list[int]:
        """Numbers of the states that were played."""
        return [envelope.header.sequence for envelope in self.stage.said("/arm/state")]

    def ended(self) -> bool:
        return self.runner.exit is not None

    def wait(self, done: Callable[[], bool]) -> None:
        self.stage.wait(done)

    def ask(self, verb: str, **arguments: Any) -> Any:
        (reply,) = self.stage.ask("player", verb, **arguments)
        return reply


@pytest.fixture
def play(make_stage: MakeStage, bag: Path) -> Callable[..., Played]:
    def make(**parameters: Any) -> Played:
        return Played(make_stage(("player", "player", {"bag": str(bag), **parameters}, True)))

    return make


def test_messages_are_what_they_were_header_and_all(play: Callable[..., Played], bag: Path) -> None:
    played = play(rate=0.0)
    played.wait(played.ended)
    assert played.runner.exit is not None
    assert played.runner.exit.code == 0
    said = played.stage.said("/arm/state")
    assert said == [state(k, START_NS + k * STEP_NS) for k in range(COUNT)]
    assert played.on("/scan/command") == []
    assert [m.action for m in played.on("/replay/command")] == ["home"]
    # what nodes said of themselves is not played: these are the player's
    assert {m.node for m in played.on("/diagnostics")} == {"player"}
    told = played.on("/clock")
    assert {clock.epoch for clock in told} == {1}
    times = [clock.now_ns for clock in told]
    assert times == sorted(times)
    assert (times[0], times[-1]) == (START_NS, START_NS + (COUNT - 1) * STEP_NS)
    assert max(np.diff(times)) <= 100_000_000 + STEP_NS
    assert played.stage.now_ns == times[-1]  # long before the launch


def test_the_clock_is_never_behind_what_was_played(play: Callable[..., Played]) -> None:
    """By a tenth of a second at most; and never before it."""
    played = play(rate=5.0)
    played.wait(played.ended)
    now = 0
    for envelope in played.stage.graph.bus.taps:
        if isinstance(envelope.message, Clock):
            now = envelope.message.now_ns
        elif envelope.topic == "/arm/state":
            assert 0 <= envelope.header.stamp_ns + 1000 - now <= 5 * 100_000_000


def test_rate_offset_and_end(play: Callable[..., Played]) -> None:
    import time

    began = time.monotonic()
    played = play(rate=2.0, start_offset_s=0.5, until_s=0.7)
    played.wait(played.ended)
    assert time.monotonic() - began >= 0.1
    assert played.angles() == list(range(25, 36))
    # what was told before the offset comes first
    assert [i.serial for i in played.on("/camera_1/info")] == ["0", "1"]
    assert played.stage.said("/camera_1/info")[0].header.sequence == 0


def test_a_loop_is_a_new_epoch_in_clock_and_headers(play: Callable[..., Played]) -> None:
    played = play(rate=0.0, loop=True, until_s=0.1)
    played.wait(lambda: len(played.angles()) >= 18)
    said = played.stage.said("/arm/state")[:18]
    assert [e.header.sequence for e in said] == list(range(6)) * 3
    lives = [e.header.incarnation for e in said]
    assert lives == ["one"] * 6 + [in_epoch("one", 2)] * 6 + [in_epoch("one", 3)] * 6
    assert said[6].message == said[0].message
    assert said[6].header._replace(incarnation="one") == said[0].header
    starts = [c for c in played.on("/clock") if c.now_ns == START_NS][:3]
    assert [c.epoch for c in starts] == [1, 2, 3]


def test_pause_step_seek_and_go_on(play: Callable[..., Played]) -> None:
    played = play(paused=True)
    assert played.angles() == []
    assert played.ask("status").data["paused"]
    for k in range(4):  # command and info come first, at the same moment
        assert played.ask("step").ok
        count = k + 1
        played.wait(
            lambda count=count: played.ask("status").data["played"] == count  # type: ignore[misc]
        )
    before = len(played.angles())
    assert before in (1, 2)
    reply = played.ask("seek", seconds=0.7)
    assert reply.ok
    assert reply.data["epoch"] == 2
    # latched state first, then what follows: the 31st info was at 0.6 s
    seen = played.stage.graph.bus.taps
    jump = max(k for k, e in enumerate(seen) if isinstance(e.message, Clock))
    assert [e.message.serial for e in seen[jump:] if e.topic == "/camera_1/info"] == ["1"]  # type: ignore[attr-defined]
    assert played.ask("step").ok
    played.wait(lambda: len(played.angles()) == before + 1)
    assert played.angles()[-1] == 35
    assert played.ask("rate", rate=50).ok
    assert played.ask("resume").ok
    played.wait(played.ended)
    assert played.angles()[before:] == list(range(35, COUNT))


def test_a_request_that_makes_no_sense_is_refused(play: Callable[..., Played]) -> None:
    played = play(rate=0.001)
    for verb, arguments, text in (
        ("step", {}, "pause it first"),
        ("seek", {"seconds": 5}, "give 0 to 0.980"),
        ("seek", {}, "seconds is None, expected a number"),
        ("rate", {"rate": -1}, "rate -1"),
        ("fly", {}, "no request 'fly'; there are pause"),
    ):
        reply = played.ask(verb, **arguments)
        assert not reply.ok
        assert text in reply.text
    assert played.ask("toggle").data["paused"]
    assert not played.ask("toggle").data["paused"]


def test_a_remapped_topic(play: Callable[..., Played]) -> None:
    played = play(rate=0.0, topics=["/camera_1/info"], remap={"/camera_1/info": "/top/info"})
    played.wait(played.ended)
    assert [i.serial for i in played.on("/top/info")] == ["0", "1"]
    assert played.on("/camera_1/info") == []


# -- what is refused


def refused(**parameters: Any) -> str:
    with pytest.raises((ParameterError, DeviceError, ValueError)) as caught:
        build(PlayerParameters, parameters)
    return str(caught.value)


def test_bags_that_can_not_be_played_are_named(tmp_path: Path, bag: Path) -> None:
    assert refused(bag=str(tmp_path / "none.mcap")) == f"{tmp_path}/none.mcap: there is no such bag"
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(bag.read_bytes()[:-100])
    text = refused(bag=str(cut))
    assert str(cut) in text
    assert "tvbrdf bag recover" in text
    empty = tmp_path / "empty.mcap"
    with BagWriter(empty, floor_free_bytes=0):
        pass
    assert f"{empty}: holds none of" in refused(bag=str(empty))
    text = refused(bag=str(bag), what="frames")
    assert f"{bag}: can't be replayed from frames: it has no /scan/sweep_result, /CAMERA/f" in text
    assert "no /scan/radiance" in refused(bag=str(bag), what="radiance")


def test_parameters_that_contradict_each_other(bag: Path) -> None:
    given = {"bag": str(bag)}
    assert "frames or radiance" in refused(**given, what="all")
    assert "not with topics" in refused(**given, what="frames", topics=["/arm/state"])
    assert "until_stored" in refused(**given, loop=True, until_stored=True)
    assert "never played" in refused(**given, topics=["/scan/command"])
    assert "the bag lasts 0.980 s" in refused(**given, start_offset_s=2.0)


def test_a_bag_recorded_from_a_loop_is_refused(tmp_path: Path) -> None:
    told = [(START_NS + k, state(k, START_NS, life)) for k, life in enumerate(("one", "one~2"))]
    path = write(tmp_path / "loop.mcap", told)
    assert f"{path}: was recorded from a replay that looped or was moved" in refused(bag=str(path))


def test_a_clock_that_went_back_while_it_recorded_ends_the_play(
    make_stage: MakeStage, tmp_path: Path
) -> None:
    """Log times 0 to 9, then 5 to 14: the second half lies over the first."""
    at = [START_NS + k * STEP_NS for k in (*range(10), *range(5, 15))]
    told = [(time_ns, state(k, time_ns)) for k, time_ns in enumerate(at)]
    path = write(tmp_path / "jump.mcap", told)
    stage = make_stage(("player", "player", {"bag": str(path), "rate": 0.0}, True))
    with pytest.raises(DeviceError, match=r"jump\.mcap: its clock jumps at \d+ ns: /arm/state"):
        Played(stage).wait(lambda: False)


def test_no_bag_is_played_beside_a_real_device_or_a_second_clock(bag: Path) -> None:
    given = build(PlayerParameters, {"bag": str(bag)})

    def notices(other: Participant) -> None:
        me = Participant(name="player", gives=("/clock",), node="tvbrdf_nodes.player.node:X")
        graph = Graph(
            directory="", utc_ns=0, monotonic_ns=0, simulated=True, participants=(me, other)
        )
        tuple(PlayerNode.notices("player", given, graph))

    with pytest.raises(ValueError, match="arm is a real device"):
        notices(Participant(name="arm", live=True))
    with pytest.raises(ValueError, match="world tells the time already"):
        notices(Participant(name="world", gives=("/clock",)))
    notices(Participant(name="fitter"))


def test_the_helper_writes_what_is_recorded(tmp_path: Path) -> None:
    """Marks carry their own numbers; the order of a bag is the order in which it was told."""
    marks = [
        Envelope("/operator/mark", header("sequencer", k, START_NS), Mark(text=str(k)))
        for k in range(3)
    ]
    path = write_bag(tmp_path / "marks.mcap", marks, calibration=False)
    source = build(PlayerParameters, {"bag": str(path)}).open()
    assert source.topics == {"/operator/mark": "/operator/mark"}
    assert source.last_ns - source.first_ns == 2_000_000


def test_the_benchmark_measures_every_message() -> None:
    """Figures depend on the machine; that they are of all messages, and in order, does not."""
    figures = playback.main(0.5, small=True)
    assert figures["messages"] == figures["received"] == len(playback.moments(0.5))
    assert 0 < figures["late_p50_ms"] <= figures["late_p99_ms"] <= figures["late_max_ms"]
