"""The shell that runs nodes inside one process: timers, order, restarts, ends."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.errors import BusError, MessageError
from tvbrdf_messages.messages import Clock, Mark, OperatorRequest
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_nodes.core.device import DeviceError
from tvbrdf_nodes.core.inprocess import InProcessGraph
from tvbrdf_nodes.core.node import Exit, Node, NodeContext, Outputs, Release, Reply, Send, TopicUse

START_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeParameters:
    """What a probe does: at which seconds it sends a mark, and after how many received it ends."""

    send_at_s: tuple[float, ...] = ()
    end_after: int = 0
    keep: bool = False


class Probe(Node[ProbeParameters]):
    """Sends marks by timer, and notes down everything that happens to it."""

    parameters_type = ProbeParameters
    has_service: ClassVar[bool] = True
    notes: ClassVar[list[tuple[str, str, int]]] = []
    """Of all probes: name, what happened, at which time since the start, in ns."""

    def __init__(self, context: NodeContext, parameters: ProbeParameters) -> None:
        super().__init__(context, parameters)
        self.received: list[Envelope] = []

    @classmethod
    def topics(cls, name: str, parameters: ProbeParameters) -> TopicUse:
        given = ("/operator/mark",) if parameters.send_at_s else ()
        taken = () if given else ("/operator/mark",)
        return TopicUse(takes=(*taken, "/clock"), gives=(*given, "/diagnostics", "/log"))

    def note(self, what: str) -> None:
        self.notes.append((self.context.name, what, self.context.clock.now_ns() - START_NS))

    def prepare(self) -> None:
        self.note("prepare")

    def start(self) -> Outputs:
        self.note("start")
        for index, seconds in enumerate(self.parameters.send_at_s):
            self.context.set_timer(f"send {index}", START_NS + round(seconds * SECOND_NS))
        return ()

    def handle(self, envelope: Envelope) -> Outputs:
        assert isinstance(envelope.message, Mark)
        self.received.append(envelope)
        self.note(f"got {envelope.message.text}")
        if len(self.received) == self.parameters.end_after:
            yield Exit(3, "enough")

    def on_timer(self, name: str) -> Outputs:
        self.note(name)
        if name.startswith("send"):
            text = name.split()[1]
            keep = text if self.parameters.keep else ""
            yield Send(topic="/operator/mark", message=Mark(text=text), keep=keep)

    def on_lost(self, publisher: str) -> Outputs:
        self.note(f"lost {publisher}")
        return ()

    def on_found(self, publisher: str) -> Outputs:
        self.note(f"found {publisher}")
        return ()

    def on_reader(self, reader: str) -> Outputs:
        self.note(f"reader {reader}")
        return ()

    def on_request(self, request: OperatorRequest) -> Outputs:
        yield Release("/operator/mark", request.verb)
        yield Reply(request.request_id, True, "forgotten")

    def stop(self) -> Outputs:
        self.note("stop")
        return ()


class Teller(Node[ProbeParameters]):
    """Owns the clock, and lets a second pass whenever it is asked to."""

    parameters_type = ProbeParameters

    @classmethod
    def topics(cls, name: str, parameters: ProbeParameters) -> TopicUse:
        return TopicUse(gives=("/clock", "/diagnostics"))

    def start(self) -> Outputs:
        self.context.set_watchdog("tick", 0.001)
        return ()

    def on_timer(self, name: str) -> Outputs:
        self.context.set_watchdog("tick", 0.001)
        yield Send(topic="/clock", message=Clock(now_ns=self.context.clock.now_ns() + SECOND_NS))


class Device(Probe):
    """Holds something open from its first moment to its stop."""

    all: ClassVar[list[Device]] = []

    def __init__(self, context: NodeContext, parameters: ProbeParameters) -> None:
        super().__init__(context, parameters)
        self.file = os.fdopen(os.open(os.devnull, os.O_RDONLY))
        self.all.append(self)

    def stop(self) -> Outputs:
        self.file.close()
        return ()


class Broken(Probe):
    """Fails in one moment of its life, which is its name."""

    def __init__(self, context: NodeContext, parameters: ProbeParameters) -> None:
        super().__init__(context, parameters)
        self.fail("made")

    def fail(self, moment: str) -> None:
        if self.context.name == moment:
            raise DeviceError(f"it can't be {moment}")

    def prepare(self) -> None:
        self.fail("prepared")

    def start(self) -> Outputs:
        self.fail("started")
        return ()

    def stop(self) -> Outputs:
        self.fail("stopped")
        return ()


@pytest.fixture(autouse=True)
def notes() -> list[tuple[str, str, int]]:
    Probe.notes.clear()
    Device.all.clear()
    return Probe.notes


KINDS: dict[str, type[Node[Any]]] = {
    "teller": Teller,
    **dict.fromkeys(("made", "prepared", "started", "stopped"), Broken),
    **dict.fromkeys(("device_1", "device_2", "device_3"), Device),
}


def graph(**nodes: dict[str, Any] | None) -> Graph:
    """Return a graph of probes with their parameters; ``None``: one that the test plays."""
    participants = []
    for name, given in nodes.items():
        cls = KINDS.get(name, Probe)
        use = cls.topics(name, ProbeParameters(**(given or {})))
        participants.append(
            Participant(
                name=name,
                takes=use.takes,
                gives=use.gives,
                node=f"{__name__}:{cls.__name__}",
                parameters=given or {},
            )
        )
    return Graph(
        directory="",
        utc_ns=START_NS,
        monotonic_ns=0,
        simulated=True,
        participants=tuple(participants),
    )


def received(run: InProcessGraph, name: str) -> list[str]:
    node: Any = run.runners[name].node
    return [envelope.message.text for envelope in node.received]


def test_all_are_prepared_before_any_starts_and_all_are_stopped(
    notes: list[tuple[str, str, int]],
) -> None:
    with InProcessGraph(graph(source={"send_at_s": (1.0,)}, one={}, two={})) as run:
        assert [(name, what) for name, what, _ in notes] == [
            *((name, "prepare") for name in ("source", "one", "two")),
            *((name, "start") for name in ("source", "one", "two")),
        ]
        run.run_until(lambda: bool(received(run, "two")))
    assert [name for name, what, _ in notes if what == "stop"] == ["source", "one", "two"]


def test_time_jumps_to_the_next_timer_when_all_are_idle(notes: list[tuple[str, str, int]]) -> None:
    with InProcessGraph(graph(source={"send_at_s": (7200.0, 1.5, 60.0)}, reader={})) as run:
        run.run_until(lambda: len(received(run, "reader")) == 3, 5.0)
        assert received(run, "reader") == ["1", "2", "0"]
        assert [at for name, what, at in notes if what.startswith("got")] == [
            round(seconds * SECOND_NS) for seconds in (1.5, 60.0, 7200.0)
        ]
        assert run.clock.now_ns() == START_NS + 7200 * SECOND_NS
        stamps = [e.header.stamp_ns - START_NS for e in run.published("/operator/mark")]
        assert stamps == [round(s * SECOND_NS) for s in (1.5, 60.0, 7200.0)]


def test_a_clocks_owner_moves_time_alone(notes: list[tuple[str, str, int]]) -> None:
    nodes = graph(teller={}, source={"send_at_s": (2.5, 3.5)}, reader={})
    with InProcessGraph(nodes) as run:
        run.run_until(lambda: len(received(run, "reader")) == 2, 5.0)
    # a timer fires at the first time told that has reached it
    at = [at // SECOND_NS for name, what, at in notes if what.startswith("got")]
    assert at == [3, 4]


def test_messages_keep_their_publishers_order_and_carry_who_sent_them() -> None:
    with InProcessGraph(graph(source={"send_at_s": (1.0, 1.0, 1.0)}, reader={})) as run:
        run.run_until(lambda: len(received(run, "reader")) == 3)
        node: Any = run.runners["reader"].node
        headers = [envelope.header for envelope in node.received]
    assert [header.sequence for header in headers] == [0, 1, 2]
    assert {header.publisher for header in headers} == {"source"}
    assert {header.incarnation for header in headers} == {run.runners["source"].incarnation}


def test_a_node_that_has_ended_does_nothing_more() -> None:
    nodes = graph(source={"send_at_s": (1.0, 2.0, 3.0)}, reader={"end_after": 2}, other={})
    with InProcessGraph(nodes) as run:
        run.run_until(lambda: len(received(run, "other")) == 3)
        assert run.runners["reader"].exit == Exit(3, "enough")
        assert received(run, "reader") == ["0", "1"]


def test_the_test_can_play_a_participant_and_let_it_die_and_return(
    notes: list[tuple[str, str, int]],
) -> None:
    nodes = graph(source={"send_at_s": (1.0, 2.0, 3.0), "keep": True}, reader=None)
    with InProcessGraph(nodes, run=["source"]) as run:
        first = run.bus.port("reader")
        run.run_until(lambda: len(run.published("/operator/mark")) == 1)
        assert [e.message for e in first.receive()] == [Mark(text="0")]
        first.close()
        run.run_until(lambda: len(run.published("/operator/mark")) == 2)
        assert run.runners["source"].port.counters()["undelivered"] == 1
        second = run.bus.port("reader")
        assert second.incarnation != first.incarnation
        # what is kept comes to the new life, what came before its death too
        assert [e.message for e in second.receive()] == [Mark(text="0"), Mark(text="1")]
        run.step()
        source = run.runners["source"]
        source.put(source.node.on_request(OperatorRequest(request_id="r", verb="0")))
        assert source.replies == [Reply("r", True, "forgotten")]
        second.close()
        third = run.bus.port("reader")
        assert [e.message for e in third.receive()] == [Mark(text="1")]
        run.step()
    assert [what for name, what, _ in notes if what.startswith("reader")] == ["reader reader"] * 3


def test_nodes_are_told_when_a_publisher_is_gone_and_back(
    notes: list[tuple[str, str, int]],
) -> None:
    with InProcessGraph(graph(source={"send_at_s": (1.0,)}, reader={}), run=["reader"]) as run:
        port = run.bus.port("source")
        run.step()
        port.close()
        run.step()
        run.bus.port("source")
        run.step()
    told = [what for _, what, _ in notes if "source" in what]
    assert told == ["found source", "lost source", "found source"]


def test_missing_readers_are_known_by_name() -> None:
    with InProcessGraph(graph(source={"send_at_s": (1.0,)}, reader={}), run=["source"]) as run:
        assert run.runners["source"].port.missing_readers() == ("reader:/operator/mark",)


def test_a_run_that_lasts_too_long_or_in_which_nothing_can_happen_is_told() -> None:
    with InProcessGraph(graph(teller={})) as run, pytest.raises(TimeoutError, match=r"after 0\.05"):
        run.run_until(lambda: False, 0.05)
    with (
        InProcessGraph(graph(source={"send_at_s": (1.0,)}, reader={})) as run,
        pytest.raises(RuntimeError, match="nothing is left that could happen"),
    ):
        run.run_until(lambda: False, 5.0)


def test_the_contract_of_the_bus_is_kept() -> None:
    with InProcessGraph(graph(source={"send_at_s": (1.0,)}, reader={})) as run:
        with pytest.raises(MessageError, match="reader does not give /operator/mark"):
            run.runners["reader"].port.publish("/operator/mark", Mark(text=""), stamp_ns=0)
        with pytest.raises(MessageError, match="/operator/mark carries Mark, not Clock"):
            run.runners["source"].port.publish("/operator/mark", Clock(now_ns=0), stamp_ns=0)


def test_wrong_parameters_name_their_node() -> None:
    with pytest.raises(BusError, match="node source: unknown parameter 'send_at'"):
        InProcessGraph(
            Graph(
                directory="",
                utc_ns=0,
                monotonic_ns=0,
                simulated=False,
                participants=(
                    Participant(
                        name="source", node=f"{__name__}:Probe", parameters={"send_at": (1.0,)}
                    ),
                ),
            )
        )


@pytest.mark.parametrize("moment", ["made", "prepared", "started"])
def test_when_one_node_cant_begin_the_devices_of_the_others_are_closed(moment: str) -> None:
    nodes = graph(device_1={}, device_2={}, **{moment: {}}, device_3={})
    with pytest.raises(DeviceError, match=f"it can't be {moment}"), InProcessGraph(nodes):
        pass
    expected = ["device_1", "device_2"] + ["device_3"] * (moment != "made")
    assert [device.context.name for device in Device.all] == expected
    assert all(device.file.closed for device in Device.all)


def test_when_one_node_cant_be_stopped_the_others_are() -> None:
    run = InProcessGraph(graph(device_1={}, stopped={}, device_2={})).__enter__()
    assert not any(device.file.closed for device in Device.all)
    with pytest.raises(DeviceError, match="it can't be stopped"):
        run.stop()
    assert all(device.file.closed for device in Device.all)
    assert run.bus.ports == {}
    run.stop()  # twice does no harm


def test_timers_and_watchdogs_can_be_moved_and_cancelled(
    notes: list[tuple[str, str, int]],
) -> None:
    with InProcessGraph(graph(source={"send_at_s": (50.0,)}, reader={})) as run:
        context = run.runners["source"]
        context.set_timer("moved", START_NS + SECOND_NS)
        context.set_timer("moved", START_NS + 2 * SECOND_NS)
        context.set_timer("cancelled", START_NS + SECOND_NS)
        context.cancel("cancelled")
        context.set_watchdog("dog", 0.01)
        context.set_watchdog("dead dog", 0.01)
        context.cancel("dead dog")
        run.run_until(lambda: any(what == "dog" for _, what, _ in notes), 5.0)
        run.run_until(lambda: bool(received(run, "reader")), 5.0)
    fired = [
        (what, at) for name, what, at in notes if what in ("moved", "dog", "cancelled", "dead dog")
    ]
    assert ("moved", 2 * SECOND_NS) in fired
    assert sorted(what for what, _ in fired) == ["dog", "moved"]
