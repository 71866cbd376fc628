"""Watching topics from outside, and asking a node things."""

from __future__ import annotations

import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
import zmq

from tvbrdf_messages.bus import ZmqPort
from tvbrdf_messages.bus.watcher import ServiceClient, Watcher
from tvbrdf_messages.errors import BusError
from tvbrdf_messages.messages import Mark, ScanStatus
from tvbrdf_messages.run_directory import Graph, Participant

LIMIT_S = 10.0


@pytest.fixture
def graph() -> Iterator[Graph]:
    folder = Path(tempfile.mkdtemp(prefix="tv-"))  # sockets need a short path
    yield Graph(
        directory=str(folder),
        utc_ns=0,
        monotonic_ns=0,
        simulated=False,
        participants=(
            Participant(name="one", gives=("/operator/mark", "/scan/status"), node="n:N"),
            Participant(name="two", gives=("/operator/mark",), node="n:N"),
            Participant(name="sequencer", node="n:N"),
        ),
    )
    shutil.rmtree(folder)


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield context
    context.destroy(linger=0)


def mark(port: ZmqPort, text: str) -> None:
    port.publish("/operator/mark", Mark(text=text), stamp_ns=1)


def status() -> ScanStatus:
    return ScanStatus(
        state="s", sample="", scan=1, scans=1, sweep=1, sweeps=1, fraction=0.0, remaining_s=0.0
    )


def subscribed(port: ZmqPort, topic: str, watcher: Watcher) -> None:
    """Wait until the publisher has seen a watcher of the topic."""
    deadline = time.monotonic() + LIMIT_S
    while topic not in port.publisher._watched:
        assert time.monotonic() < deadline
        # a watcher subscribes anew when it is next used
        assert watcher.receive(0) is None
        port.publisher.watch.poll(10)
        port.service()


def test_all_publishers_of_a_topic_are_watched(
    graph: Graph, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    with Watcher(graph, ["/operator/mark"]) as watcher:  # before they are there
        assert not watcher.wait_connected(0.01)
        ports = [ZmqPort(graph, name, context) for name in ("one", "two")]
        assert watcher.wait_connected(LIMIT_S)
        for port in ports:
            subscribed(port, "/operator/mark", watcher)
        for port in ports:
            mark(port, f"from {port.name}")
        ports[0].publish("/scan/status", status(), stamp_ns=1)
        found = {}
        for _ in range(2):
            arrival = watcher.receive(LIMIT_S)
            assert arrival is not None
            message = arrival.envelope.message
            assert isinstance(message, Mark)
            found[arrival.envelope.header.publisher] = message.text
            assert 50 < arrival.size_bytes < 300
            assert arrival.monotonic_ns <= time.monotonic_ns()
        assert found == {"one": "from one", "two": "from two"}
        assert watcher.receive(0.05) is None, "another topic of the same publisher is not watched"
        for port in ports:
            port.close()


def test_a_restarted_publisher_is_watched_again(graph: Graph) -> None:
    with Watcher(graph, ["/operator/mark"]) as watcher:
        for text in ("first", "second"):
            with zmq.Context() as context:  # its end is the process's: the socket is gone
                port = ZmqPort(graph, "one", context)
                subscribed(port, "/operator/mark", watcher)
                mark(port, text)
                arrival = watcher.receive(LIMIT_S)
                assert arrival is not None
                assert arrival.envelope.message == Mark(text=text)
                port.close()


def test_what_is_latched_comes_at_once(
    graph: Graph, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    port = ZmqPort(graph, "one", context)
    port.publish("/scan/status", status(), stamp_ns=7)
    with Watcher(graph, ["/scan/status"]) as watcher:
        assert port.publisher.watch.poll(int(1000 * LIMIT_S))
        port.service()
        envelopes = watcher.until(time.monotonic() + LIMIT_S)
        assert next(envelopes).header.stamp_ns == 7
    port.close()


def test_strange_bytes_are_counted_and_skipped(
    graph: Graph, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    liar = context.socket(zmq.XPUB)
    liar.bind(graph.endpoint("one", "latest"))
    with Watcher(graph, ["/operator/mark"]) as watcher:
        assert liar.poll(int(1000 * LIMIT_S))
        liar.recv()
        for parts in ([b"/operator/mark"], [b"/operator/mark", b"\xc1"], [b"/operator/markx", b""]):
            liar.send_multipart(parts)
        liar.send_multipart([b"/operator/mark", msgpack.packb([[], [], []])])
        port = ZmqPort(graph, "two", context)
        subscribed(port, "/operator/mark", watcher)
        mark(port, "good")
        arrival = watcher.receive(LIMIT_S)
        assert arrival is not None
        assert arrival.envelope.message == Mark(text="good")
        assert watcher.refused <= 4
        port.close()
    liar.close()


def test_a_topic_that_nobody_gives_is_an_error(graph: Graph) -> None:
    with pytest.raises(BusError, match="nobody gives /arm/state in this run"):
        Watcher(graph, ["/arm/state"])


class Service:
    """Answers requests in a thread as the shell does, one list of answers a request."""

    def __init__(self, graph: Graph, answers: list[list[bytes]]) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self.context.socket(zmq.ROUTER)
        self.socket.bind(graph.endpoint("sequencer", "service"))
        self.asked: list[dict[str, object]] = []
        self.answers = answers
        self.thread = threading.Thread(target=self.serve)
        self.thread.start()

    def serve(self) -> None:
        for answers in self.answers:
            assert self.socket.poll(int(1000 * LIMIT_S))
            identity, body = self.socket.recv_multipart()
            raw = msgpack.unpackb(body)
            self.asked.append(raw)
            for answer in answers:
                self.socket.send_multipart([identity, answer])
            good = {"request_id": raw["request_id"], "ok": True, "text": "t", "data": {"a": 1}}
            self.socket.send_multipart([identity, msgpack.packb(good)])

    def close(self) -> None:
        self.thread.join()
        self.socket.close(linger=0)
        self.context.term()


def test_answers_of_others_and_strange_bytes_are_skipped(graph: Graph) -> None:
    other = {"request_id": "x", "ok": False, "text": "for somebody else", "data": {}}
    strange = [b"", b"\xc1", msgpack.packb(3), msgpack.packb({"ok": True}), msgpack.packb(other)]
    service = Service(graph, [[], strange])
    with ServiceClient(graph) as client:
        for verb in ("home", "jog"):
            reply = client.ask(verb, {"angle_deg": 1.5}, LIMIT_S)
            assert (reply.ok, reply.text, reply.data) == (True, "t", {"a": 1})
    assert [raw["verb"] for raw in service.asked] == ["home", "jog"]
    assert [raw["arguments"] for raw in service.asked] == [{"angle_deg": 1.5}] * 2
    service.close()


def test_no_answer_and_nobody_to_ask(graph: Graph, context: zmq.Context[zmq.Socket[bytes]]) -> None:
    with pytest.raises(BusError, match="sequencer takes no requests"):
        ServiceClient(graph)
    with pytest.raises(BusError, match="no node 'nobody'"):
        ServiceClient(graph, "nobody")
    deaf = context.socket(zmq.ROUTER)
    deaf.bind(graph.endpoint("sequencer", "service"))
    with (
        ServiceClient(graph) as client,
        pytest.raises(BusError, match=r"has not answered 'stop' within 0\.05 s"),
    ):
        client.ask("stop", {}, 0.05)
    deaf.close()
