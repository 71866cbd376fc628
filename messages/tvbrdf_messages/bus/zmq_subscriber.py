"""The receiving half of a ZeroMQ port: a DEALER for each publisher, and a SUB for clocks."""

from __future__ import annotations

import struct
from typing import Any

import msgpack
import zmq

from ..codec import decode_all, size_bytes
from ..envelope import Envelope
from ..errors import MessageError
from ..run_directory import Graph
from ..topics import LATEST, LOSSLESS, find_topic
from .port import PortEvent
from .zmq_publisher import (
    CREDIT,
    DONTWAIT,
    HELLO,
    MESSAGE_OVERHEAD_BYTES,
    REFUSED,
    WELCOME,
    Ready,
    readable,
)

DEFAULT_CREDIT_BYTES = 64 << 20
RECONNECT_MS = 5
BATCH_BYTES = 2 << 20
"""Handed out at once from one publisher: large images that are held together cost page faults."""
_MORE, _CONNECTED = int(zmq.RCVMORE), int(zmq.EVENT_CONNECTED)
_MONITOR_EVENT = struct.Struct("=Hi")


class _Link:
    """The connection to one publisher."""

    def __init__(
        self, publisher: str, topics: list[str], socket: zmq.Socket[bytes], credit_bytes: int
    ) -> None:
        self.publisher, self.topics, self.socket = publisher, topics, socket
        self.monitor = socket.get_monitor_socket(zmq.EVENT_CONNECTED | zmq.EVENT_DISCONNECTED)
        self.incarnation = ""
        self.expected: dict[tuple[str, str, str], int] = {}
        """Next sequence number by topic, publisher and its life: a player forwards others'."""
        self.credit_bytes = credit_bytes
        self.taken = [0, 0]  # bytes handed out since credit was last given: lossless, command
        self.handled = [0, 0]

    def note_size(self, size: int, lossless: bool) -> None:
        self.taken[0 if lossless else 1] += size

    def give_credit(self) -> None:
        """Give back the credit of what was handled, in few messages."""
        lossless, command = self.handled
        if lossless + command > min(self.credit_bytes // 16, 1 << 20):
            self.socket.send_multipart([CREDIT, msgpack.packb(self.handled)], DONTWAIT)
            self.handled = [0, 0]


class ZmqSubscriber:
    """Receives one participant's messages and counts what is missing."""

    def __init__(
        self,
        graph: Graph,
        name: str,
        incarnation: str,
        context: zmq.Context[zmq.Socket[bytes]],
        credit_bytes: int = DEFAULT_CREDIT_BYTES,
    ) -> None:
        self._name, self._incarnation = name, incarnation
        self._credit_bytes = credit_bytes
        self.events: list[PortEvent] = []
        self.received, self.received_bytes = 0, 0
        self.gaps, self.repeats, self.refused = 0, 0, 0
        self._early: list[Envelope] = []
        self._turn = 0
        self.links: list[_Link] = []
        by_publisher: dict[str, list[str]] = {}
        latest: list[tuple[str, str]] = []
        for topic in graph.find(name).takes:
            for publisher in graph.publishers(topic):
                if publisher == name:
                    continue
                if find_topic(topic).quality == LATEST:
                    latest.append((publisher, topic))
                else:
                    by_publisher.setdefault(publisher, []).append(topic)
        for publisher, topics in sorted(by_publisher.items()):
            socket = context.socket(zmq.DEALER)
            socket.linger = 0
            socket.rcvhwm = 0
            socket.sndhwm = 0
            socket.reconnect_ivl = RECONNECT_MS
            link = _Link(publisher, topics, socket, credit_bytes)
            socket.connect(graph.endpoint(publisher, "lossless"))
            self.links.append(link)
        self.latest: zmq.Socket[bytes] | None = None
        if latest:
            self.latest = context.socket(zmq.SUB)
            self.latest.linger = 0
            self.latest.reconnect_ivl = RECONNECT_MS
            for publisher, topic in latest:
                self.latest.connect(graph.endpoint(publisher, "latest"))
                self.latest.subscribe(topic)

    def sockets(self) -> list[zmq.Socket[bytes]]:
        """Return what to poll for reading."""
        found = [s for link in self.links for s in (link.socket, link.monitor)]
        return [*found, self.latest] if self.latest is not None else found

    def service(self, ready: Ready = None) -> None:
        """Register where a connection was made; notice where one was lost."""
        for link in self.links:
            while (ready is None or link.monitor in ready) and readable(link.monitor):
                # pyzmq's parser of these 2 + 4 bytes loads asyncio and ssl, 20 ms in every node
                event, _ = _MONITOR_EVENT.unpack(link.monitor.recv_multipart(DONTWAIT)[0])
                if event == _CONNECTED:
                    self._say_hello(link)
                elif link.incarnation:
                    self.events.append(PortEvent("lost", link.publisher, link.incarnation))
            if not link.incarnation and readable(link.socket):
                self._receive_one(link, self._early)  # the welcome comes before all else

    def _say_hello(self, link: _Link) -> None:
        link.taken, link.handled = [0, 0], [0, 0]
        hello = {
            "reader": self._name,
            "incarnation": self._incarnation,
            "topics": link.topics,
            "credit_bytes": self._credit_bytes,
        }
        link.socket.send_multipart([HELLO, msgpack.packb(hello)], DONTWAIT)

    def receive(self, limit: int, ready: Ready = None) -> list[Envelope]:
        """Return up to about ``limit`` messages; those of the call before count as handled."""
        found, self._early = self._early, []
        # from another publisher on each time: where all have much to say, none is left behind
        self._turn = (self._turn + 1) % max(len(self.links), 1)
        for link in (*self.links[self._turn :], *self.links[: self._turn]):
            link.handled[0] += link.taken[0]
            link.handled[1] += link.taken[1]
            link.taken = [0, 0]
            if ready is None or link.socket in ready:
                while (
                    len(found) < limit and sum(link.taken) < BATCH_BYTES and readable(link.socket)
                ):
                    self._receive_one(link, found)
            link.give_credit()
        latest = self.latest
        if latest is not None and (ready is None or latest in ready):
            # beyond the limit: behind a long queue the clock would stand still
            limit += len(found)
            while len(found) < limit and readable(latest):
                self._decode(_receive_parts(latest), found)
        return found

    def _receive_one(self, link: _Link, found: list[Envelope]) -> None:
        parts = _receive_parts(link.socket)
        if parts[0][:1] == b"!":
            self._take_control(link, parts)
            return
        size = size_bytes(parts) + MESSAGE_OVERHEAD_BYTES
        count = len(found)
        self._decode(parts, found)
        if len(found) == count:
            link.note_size(size, lossless=True)
            return
        # those that travelled together share one topic frame, but each has paid for it
        size += (MESSAGE_OVERHEAD_BYTES + len(parts[0])) * (len(found) - count - 1)
        link.note_size(size, find_topic(found[-1].topic).quality == LOSSLESS)
        self.received += len(found) - count
        self.received_bytes += size
        for envelope in found[count:]:
            self._count_gap(link, envelope)

    def _decode(self, parts: list[Any], found: list[Envelope]) -> None:
        try:
            found.extend(decode_all(parts))
        except MessageError as error:
            self.refused += 1
            self.events.append(PortEvent("refused", "unknown", text=f"{error!s:.200}"))

    def _count_gap(self, link: _Link, envelope: Envelope) -> None:
        header = envelope.header
        key = (envelope.topic, header.publisher, header.incarnation)
        sequence, expected = header.sequence, link.expected.get(key)
        if expected is not None and sequence != expected:
            if sequence < expected:
                self.repeats += 1
                return
            self.gaps += sequence - expected
        link.expected[key] = sequence + 1

    def _take_control(self, link: _Link, parts: list[Any]) -> None:
        if parts[0] == WELCOME and len(parts) == 2:
            welcome = msgpack.unpackb(getattr(parts[1], "buffer", parts[1]))
            link.incarnation = str(welcome["incarnation"])
            link.expected = {}
            self.events.append(PortEvent("found", link.publisher, link.incarnation))
        elif parts[0] == REFUSED:
            reason = msgpack.unpackb(getattr(parts[1], "buffer", parts[1]))["reason"]
            self.events.append(PortEvent("refused", link.publisher, text=str(reason)))

    def registered(self) -> bool:
        """Return whether every publisher has welcomed this reader."""
        return all(link.incarnation for link in self.links)

    def close(self) -> None:
        """Close all sockets; closing twice does nothing."""
        links, self.links = self.links, []
        for link in links:
            link.socket.disable_monitor()
            link.monitor.close(linger=0)
            link.socket.close()
        if self.latest is not None:
            self.latest.close()


def _receive_parts(socket: zmq.Socket[bytes]) -> list[Any]:
    """Return one multipart message; array frames are not copied."""
    parts: list[Any] = [socket.recv(DONTWAIT)]
    if not socket.getsockopt(_MORE):
        return parts
    parts.append(socket.recv(DONTWAIT))
    if socket.getsockopt(_MORE):
        parts += socket.recv_multipart(DONTWAIT, copy=False)
    return parts
