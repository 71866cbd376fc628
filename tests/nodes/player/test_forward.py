"""Recorded messages on the bus: they keep their headers, and numbers of several leave no gap."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator

import pytest
import zmq

from tests.nodes.player.test_player_node import START_NS, info, state
from tvbrdf_messages.bus import InProcessBus, Port, ZmqPort
from tvbrdf_messages.codec import encode
from tvbrdf_messages.envelope import Envelope, epoch_of, in_epoch
from tvbrdf_messages.errors import BusError, MessageError
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_messages.topics import find_topic

TOPICS = ("/arm/state", "/camera_1/info")


def parts(envelope: Envelope) -> list[bytes]:
    return encode(find_topic(envelope.topic), envelope.header, envelope.message)


@pytest.fixture(params=["zmq", "inprocess"])
def ports(request: pytest.FixtureRequest) -> Iterator[tuple[Port, Port]]:
    """A player's port and its reader's."""
    with tempfile.TemporaryDirectory(prefix="tv") as folder:
        graph = Graph(
            directory=folder,
            utc_ns=0,
            monotonic_ns=0,
            simulated=True,
            participants=(
                Participant(name="player", gives=TOPICS),
                Participant(name="reader", takes=TOPICS),
            ),
        )
        if request.param == "inprocess":
            bus = InProcessBus(graph)
            yield bus.port("player"), bus.port("reader")
            return
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        both = tuple(ZmqPort(graph, name, context) for name in ("player", "reader"))
        player, reader = both
        deadline = time.monotonic() + 10
        while not all(port.ready() for port in both):
            assert time.monotonic() < deadline, "the ports do not find each other"
            for port in both:
                port.service()
        yield player, reader
        for port in both:
            port.close()
        context.term()


def receive(player: Port, reader: Port, count: int) -> list[Envelope]:
    found: list[Envelope] = []
    deadline = time.monotonic() + 10
    while len(found) < count:
        assert time.monotonic() < deadline, f"{len(found)} of {count} messages arrived"
        for port in (player, reader):
            if isinstance(port, ZmqPort):
                port.service()
        found += reader.receive()
    return found


def test_headers_stay_and_several_lives_leave_no_gap(ports: tuple[Port, Port]) -> None:
    player, reader = ports
    told = [
        state(7, START_NS),
        info(3, START_NS),
        state(8, START_NS),
        state(0, START_NS, "two"),
        state(1, START_NS, "two"),
        state(7, START_NS, in_epoch("one", 2)),
    ]
    for envelope in told:
        assert player.forward(parts(envelope))
    assert receive(player, reader, len(told)) == told
    assert (reader.counters()["gaps"], reader.counters()["repeats"]) == (0, 0)
    player.forward(parts(state(5, START_NS, "two")))  # 2, 3 and 4 were never recorded
    receive(player, reader, 1)
    assert reader.counters()["gaps"] == 3
    # its own numbers are not those of what it forwards
    assert player.next_sequence("/arm/state") == 0


def test_a_topic_that_it_does_not_give_is_refused(ports: tuple[Port, Port]) -> None:
    player, reader = ports
    with pytest.raises(MessageError, match="reader does not give /arm/state"):
        reader.forward(parts(state(0, START_NS)))
    with pytest.raises((MessageError, BusError)):
        player.forward([b"/nothing", *parts(state(0, START_NS))[1:]])


def test_an_incarnation_tells_its_epoch() -> None:
    assert epoch_of("3f2a") == 0
    assert epoch_of(in_epoch("3f2a", 12)) == 12
    assert epoch_of("a~b") == 0


def test_a_player_may_tell_what_a_simulation_said_and_reads_nothing_of_it() -> None:
    def graph(node: str) -> Graph:
        one = Participant(name="player", gives=("/sim/scene",), node=node)
        return Graph(directory="", utc_ns=0, monotonic_ns=0, simulated=True, participants=(one,))

    graph("tvbrdf_nodes.player.node:PlayerNode").check()
    with pytest.raises(BusError, match="may not touch /sim/scene"):
        graph("my_lab.player:Player").check()
