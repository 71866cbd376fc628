"""For tools: watching topics of a run without being part of its graph, and asking it things."""

from __future__ import annotations

import time
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import zmq
from zmq.utils.monitor import parse_monitor_message

from ..codec import decode, size_bytes
from ..envelope import Envelope
from ..errors import BusError, MessageError
from ..messages import OperatorReply
from ..run_directory import Graph

RECONNECT_MS = 50
QUEUE_MESSAGES, QUEUE_FRAMES = 1000, 16
"""For each publisher; what a slow tool has not read by then is skipped."""
MAX_REPLY_BYTES = 4 << 20


class Arrival(NamedTuple):
    """A message with its size on the wire and when it came (monotonic time)."""

    envelope: Envelope
    size_bytes: int
    monotonic_ns: int


class Watcher:
    """Watches topics as if they were ``latest``: it may miss messages, and slows nobody.

    Parameters
    ----------
    graph
        The run's graph.
    topics
        Full names. Every publisher that the graph names for one is watched, also before it starts
        and after a restart.

    Raises
    ------
    BusError
        If nobody in the graph gives a topic.
    """

    def __init__(self, graph: Graph, topics: Iterable[str]) -> None:
        self.topics = frozenset(topics)
        self.refused = 0
        """Messages that were not what their topic declares."""
        publishers: set[str] = set()
        for topic in sorted(self.topics):
            found = graph.publishers(topic)
            if not found:
                raise BusError(f"nobody gives {topic} in this run")
            publishers.update(found)
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self._context.socket(zmq.SUB)
        self.socket.linger = 0
        big = any(topic.endswith("/frame") for topic in self.topics)
        self.socket.rcvhwm = QUEUE_FRAMES if big else QUEUE_MESSAGES
        self.socket.reconnect_ivl = RECONNECT_MS
        self._unconnected = {graph.endpoint(name, "latest") for name in publishers}
        self._monitor = self.socket.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED)
        for topic in self.topics:
            self.socket.subscribe(topic)
        for endpoint in sorted(self._unconnected):
            self.socket.connect(endpoint)

    def __enter__(self) -> Watcher:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def wait_connected(self, timeout_s: float) -> bool:
        """Wait until every publisher has been reached; False if some were not."""
        deadline = time.monotonic() + timeout_s
        while self._unconnected:
            if not self._monitor.poll(_left_ms(deadline)):
                return False
            event = parse_monitor_message(self._monitor.recv_multipart())
            self._unconnected.discard(event["endpoint"].decode())
        return True

    def receive(self, timeout_s: float) -> Arrival | None:
        """Return the next message, or None after ``timeout_s`` without one."""
        deadline = time.monotonic() + timeout_s
        while True:
            if not self.socket.poll(_left_ms(deadline)):
                return None
            frames = self.socket.recv_multipart(copy=False)
            now_ns = time.monotonic_ns()
            try:
                envelope = decode(frames)
            except MessageError:
                self.refused += 1
                continue
            if envelope.topic in self.topics:  # a subscription is a prefix
                return Arrival(envelope, size_bytes(frames), now_ns)

    def until(self, deadline_s: float) -> Iterator[Envelope]:
        """Yield messages as they come until ``time.monotonic()`` has reached ``deadline_s``."""
        while (arrival := self.receive(deadline_s - time.monotonic())) is not None:
            yield arrival.envelope

    def close(self) -> None:
        """Close everything."""
        self.socket.disable_monitor()
        self._monitor.close(linger=0)
        self.socket.close()
        self._context.term()


class ServiceClient:
    """Asks a node that answers people (the sequencer); one request at a time.

    Raises
    ------
    BusError
        If the node is not in the graph, or its socket is not there.
    """

    def __init__(self, graph: Graph, name: str = "sequencer") -> None:
        graph.find(name)
        endpoint = graph.endpoint(name, "service")
        if not Path(endpoint.removeprefix("ipc://")).exists():
            raise BusError(f"{name} takes no requests: it has not started yet, or is gone")
        self._name = name
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.linger = 0
        self._socket.connect(endpoint)

    def __enter__(self) -> ServiceClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def ask(self, verb: str, arguments: dict[str, Any], timeout_s: float) -> OperatorReply:
        """Send a request and return its answer.

        Raises
        ------
        BusError
            If no answer comes in time.
        """
        request_id = uuid.uuid4().hex
        body = {"request_id": request_id, "verb": verb, "arguments": arguments}
        self._socket.send(msgpack.packb(body))
        deadline = time.monotonic() + timeout_s
        while self._socket.poll(_left_ms(deadline)):
            reply = _reply(self._socket.recv_multipart())
            if reply is not None and reply.request_id == request_id:
                return reply
        raise BusError(f"{self._name} has not answered {verb!r} within {timeout_s:g} s")

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()
        self._context.term()


def _reply(parts: list[bytes]) -> OperatorReply | None:
    """Return the answer in a message's last part; None if it holds none."""
    if not parts or len(parts[-1]) > MAX_REPLY_BYTES:
        return None
    try:
        raw = msgpack.unpackb(parts[-1], strict_map_key=True)
        return OperatorReply(
            request_id=str(raw["request_id"]),
            ok=raw["ok"] is True,
            text=str(raw["text"]),
            data=dict(raw["data"]),
        )
    except (ValueError, KeyError, TypeError, AttributeError, msgpack.UnpackException):
        return None


def _left_ms(deadline: float) -> int:
    """Return the milliseconds to a moment of monotonic time, rounded up, at least 0."""
    return max(0, int(1000 * (deadline - time.monotonic()) + 0.999))
