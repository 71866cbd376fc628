"""The sending half of a ZeroMQ port: ROUTER with credit for each reader, and XPUB for watchers."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Container
from typing import Any

import msgpack
import zmq

from ..codec import encode, size_bytes
from ..envelope import Header, boot_id, host_name, in_epoch
from ..errors import MessageError, QueueFullError
from ..run_directory import Graph
from ..schema import Message
from ..topics import LATEST, LOSSLESS, Topic, find_topic
from .port import PortEvent

ZERO_COPY_BYTES = 262144
"""Below this a copy is faster than sharing the buffer, which a thread must be told to free."""
TOGETHER_BYTES = 16384
"""Small lossless messages wait for each other up to this size, or until :meth:`flush`."""
COMMAND_CREDIT_BYTES = 8 << 20
MESSAGE_OVERHEAD_BYTES = 64
COUNTED_WAIT_S = 1.0
"""What a simulated source waits for a counted reader that has stopped reading; it costs the run no
time of its own. Nobody else waits for one at all."""
# plain integers: arithmetic with pyzmq's enumerations takes longer than sending does
DONTWAIT, SNDMORE, POLLIN = int(zmq.DONTWAIT), int(zmq.SNDMORE), int(zmq.POLLIN)
_BROKEN = (
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    OverflowError,
    RecursionError,
    msgpack.UnpackException,
)
"""What comes of reading bytes that no reader of ours has sent."""
MAX_WORD_BYTES = 1 << 20
"""Of what readers say: far more than a registration has."""
HELLO, CREDIT, WELCOME, REFUSED = b"!HELLO", b"!CREDIT", b"!WELCOME", b"!REFUSED"


Ready = Container[Any] | None
"""The sockets that a poll found readable; None: nobody polled, so each is asked."""


def readable(socket: zmq.Socket[bytes]) -> bool:
    """Return whether a message waits in the socket."""
    return bool(int(socket.getsockopt(zmq.EVENTS)) & POLLIN)


class _Reader:
    """What is known of one registered reader, and how much it may still be sent."""

    __slots__ = (
        "command",
        "identity",
        "incarnation",
        "lossless",
        "name",
        "stalled",
        "topics",
        "waiting",
        "waiting_bytes",
        "waiting_topic",
    )

    def __init__(
        self, name: str, identity: bytes, incarnation: str, topics: frozenset[str], credit: int
    ) -> None:
        self.name, self.identity, self.incarnation = name, identity, incarnation
        self.topics = topics
        self.stalled = False  # a counted reader that was waited for in vain
        self.lossless = credit
        self.command = COMMAND_CREDIT_BYTES
        self.waiting: list[bytes] = []  # small messages of one topic, to be sent together
        self.waiting_topic = b""
        self.waiting_bytes = 0


class ZmqPublisher:
    """Sends one participant's messages. ``wait_for_credit`` returns False to give up."""

    def __init__(
        self,
        graph: Graph,
        name: str,
        incarnation: str,
        context: zmq.Context[zmq.Socket[bytes]],
        wait_for_credit: Callable[[], bool],
    ) -> None:
        me = graph.find(name)
        self._name, self._incarnation = name, incarnation
        self._topics = {topic: find_topic(topic) for topic in me.gives}
        self._wanted = {
            topic: frozenset(graph.readers(name, topic))
            for topic, row in self._topics.items()
            if row.quality != LATEST
        }
        self._counted = frozenset(p.name for p in graph.participants if p.counted_bytes)
        self._live = me.live
        self._patient = graph.simulated and not me.live
        self._wait_for_credit = wait_for_credit
        self._sequence: defaultdict[str, int] = defaultdict(int)
        self._who = (name, incarnation, host_name(), boot_id())
        self._readers: dict[str, _Reader] = {}
        self._latched: dict[str, list[Any]] = {}
        self._kept: dict[str, dict[str, list[Any]]] = defaultdict(dict)
        self._watched: set[str] = set()
        self.events: list[PortEvent] = []
        self.sent, self.sent_bytes, self.undelivered, self.refused = 0, 0, 0, 0
        self.left_out = 0
        """Messages that a counted reader had no room for, or was not there for."""

        self.router = context.socket(zmq.ROUTER)
        self.router.linger = 1000
        self.router.sndhwm = 0  # credit bounds the queue, in bytes
        self.router.rcvhwm = 0
        self.router.maxmsgsize = MAX_WORD_BYTES  # of what comes in
        self.router.router_mandatory = True  # a reader that died is an error, not silence
        self.router.bind(graph.endpoint(name, "lossless"))
        self.watch = context.socket(zmq.XPUB)
        self.watch.linger = 0
        self.watch.xpub_verboser = True
        big = any(topic.endswith("/frame") for topic in self._topics)
        self.watch.sndhwm = 8 if big else 1000
        self.watch.bind(graph.endpoint(name, "latest"))

    # -- sending

    def publish(self, name: str, message: Message, stamps: tuple[int, int, int], keep: str) -> bool:
        """Send to all readers and watchers; False when a reader did not get it."""
        topic = self._topics.get(name)
        if topic is None:
            raise MessageError(f"{self._name} does not give {name}")
        sequence = self._sequence[name]
        header = Header(*self._who, sequence, *stamps)
        parts = encode(topic, header, message)
        self._sequence[name] = sequence + 1
        if keep:
            self._kept[name][keep] = parts
        return self._send_to_all(topic, parts)

    def forward(self, parts: list[Any]) -> bool:
        """Send a recorded message to all readers and watchers; False when a reader lacks it."""
        name = bytes(parts[0]).decode(errors="replace")
        topic = self._topics.get(name)
        if topic is None:
            raise MessageError(f"{self._name} does not give {name}")
        return self._send_to_all(topic, parts)

    def _send_to_all(self, topic: Topic, parts: list[Any]) -> bool:
        name = topic.name
        if topic.latched:
            self._latched[name] = parts
        size = size_bytes(parts) + MESSAGE_OVERHEAD_BYTES
        delivered = True
        for reader in self._wanted.get(name, ()):
            delivered &= self._deliver(reader, topic, parts, size)
        if name in self._watched:
            self._send(self.watch, None, parts)
        self.sent += 1
        self.sent_bytes += size
        return delivered

    def begin_epoch(self, epoch: int) -> None:
        """Let what is published from now on tell the epoch."""
        name, _, host, boot = self._who
        self._who = (name, in_epoch(self._incarnation, epoch), host, boot)

    def release(self, topic: str, key: str) -> None:
        """Forget a kept message."""
        self._kept[topic].pop(key, None)

    def next_sequence(self, topic: str) -> int:
        """Return the sequence number of the next message on a topic."""
        return self._sequence[topic]

    def missing_readers(self) -> tuple[str, ...]:
        """Return ``reader:topic`` for each reader that has not registered, but no counted ones."""
        return tuple(
            f"{reader}:{topic}"
            for topic, readers in sorted(self._wanted.items())
            for reader in sorted(readers - self._counted)
            if reader not in self._readers or topic not in self._readers[reader].topics
        )

    def lacks_counted(self) -> bool:
        """Return whether a counted reader has not registered."""
        wanted = frozenset().union(*self._wanted.values()) & self._counted
        return not wanted <= self._readers.keys()

    def _deliver(self, name: str, topic: Topic, parts: list[Any], size: int) -> bool:
        lossless = topic.quality == LOSSLESS
        if name in self._counted:
            self.left_out += not self._offer(name, topic, parts, size)
            return True
        while True:
            reader = self._readers.get(name)
            if reader is not None and topic.name in reader.topics:
                credit = reader.lossless if lossless else reader.command
                if credit > 0:  # one message may overdraw, or none larger than all could pass
                    together = lossless and len(parts) == 2
                    if not (self._join(reader, parts) if together else self._post(reader, parts)):
                        continue  # it died; wait for its successor
                    if lossless:
                        reader.lossless -= size
                    else:
                        reader.command -= size
                    return True
                if not lossless:
                    raise QueueFullError(
                        f"{name} has not read {topic.name} from {self._name} for too long: "
                        f"{COMMAND_CREDIT_BYTES} bytes are waiting"
                    )
            elif not lossless:
                self.undelivered += not topic.latched
                return False
            if self._live or not self._wait_for_credit():
                self.undelivered += 1
                return False

    def _offer(self, name: str, topic: Topic, parts: list[Any], size: int) -> bool:
        """Send to a counted reader if it is there and has room; say whether it was."""
        lossless = topic.quality == LOSSLESS
        if lossless and self._patient:
            self._wait_for_counted(name)
        reader = self._readers.get(name)
        if reader is None or (reader.lossless if lossless else reader.command) <= 0:
            return False
        together = lossless and len(parts) == 2
        if not (self._join(reader, parts) if together else self._post(reader, parts)):
            return False
        if lossless:
            reader.lossless -= size
        else:
            reader.command -= size
        return True

    def _wait_for_counted(self, name: str) -> None:
        """Wait a moment for room at a counted reader, once until it reads again."""
        deadline = 0.0
        while True:
            reader = self._readers.get(name)
            if reader is None or reader.stalled or reader.lossless > 0:
                return
            now = time.monotonic()
            deadline = deadline or now + COUNTED_WAIT_S
            if now >= deadline or not self._wait_for_credit():
                reader.stalled = True
                return

    def _join(self, reader: _Reader, parts: list[Any]) -> bool:
        """Put a small message beside those that wait, and send them when they are enough."""
        topic, body = parts
        if reader.waiting and reader.waiting_topic != topic and not self._flush(reader):
            return False
        reader.waiting.append(body)
        reader.waiting_topic = topic
        reader.waiting_bytes += len(body)
        return reader.waiting_bytes < TOGETHER_BYTES or self._flush(reader)

    def _post(self, reader: _Reader, parts: list[Any]) -> bool:
        """Send at once, after what waits; False if the reader is gone."""
        if reader.waiting and not self._flush(reader):
            return False
        try:
            self._send(self.router, reader.identity, parts)
        except zmq.ZMQError as error:
            if error.errno not in (zmq.EHOSTUNREACH, zmq.EAGAIN):
                raise
            self._readers.pop(reader.name, None)
            return False
        return True

    def _flush(self, reader: _Reader) -> bool:
        bodies, reader.waiting, reader.waiting_bytes = reader.waiting, [], 0
        return self._post(reader, [reader.waiting_topic, b"".join(bodies)])

    def flush(self) -> None:
        """Send the small messages that wait to be sent together."""
        for reader in list(self._readers.values()):
            if reader.waiting:
                self._flush(reader)

    @staticmethod
    def _send(socket: zmq.Socket[bytes], identity: bytes | None, parts: list[Any]) -> None:
        if identity is not None:
            socket.send(identity, DONTWAIT | SNDMORE)
        last = len(parts) - 1
        for index, part in enumerate(parts):
            flags = DONTWAIT | SNDMORE if index < last else DONTWAIT
            share = type(part) is not bytes and part.nbytes >= ZERO_COPY_BYTES
            socket.send(part, flags, copy=not share)

    # -- what readers and watchers say

    def service(self, ready: Ready = None) -> None:
        """Take registrations, credit and watchers' subscriptions that have arrived."""
        self.flush()
        if ready is None or self.watch in ready:
            while readable(self.watch):
                self._take_subscription(self.watch.recv(DONTWAIT))
        if ready is not None and self.router not in ready:
            return
        while readable(self.router):
            parts = self.router.recv_multipart(DONTWAIT)
            try:
                self._take(parts)
            except _BROKEN as bad:
                self.refused += 1
                self.events.append(PortEvent("refused", "unknown", text=f"{bad!s:.200}"))
            except zmq.ZMQError as error:
                if error.errno not in (zmq.EHOSTUNREACH, zmq.EAGAIN):
                    raise
                # it died between its registration and the answer; wait for its successor
                gone = [name for name, r in self._readers.items() if r.identity == parts[0]]
                for name in gone:
                    del self._readers[name]

    def _take_subscription(self, raw: bytes) -> None:
        if not raw or raw[0] not in (0, 1):
            return
        prefix = raw[1:].decode(errors="replace")
        names = {name for name in self._topics if name.startswith(prefix)}
        if raw[0]:
            self._watched |= names
            for name in names & self._latched.keys():
                self._send(self.watch, None, self._latched[name])
        # An end of watching is not acted on: another watcher may remain, and XPUB drops for none.

    def _take(self, parts: list[bytes]) -> None:
        identity, kind, body = parts
        if kind == CREDIT:
            lossless, command = msgpack.unpackb(body)
            for reader in self._readers.values():
                if reader.identity == identity:
                    reader.stalled = False
                    reader.lossless += int(lossless)
                    reader.command += int(command)
        elif kind == HELLO:
            self._register(identity, msgpack.unpackb(body))
        else:
            raise MessageError(f"{kind!r:.40} is not what a reader says")

    def _register(self, identity: bytes, hello: dict[str, Any]) -> None:
        name, incarnation = str(hello["reader"]), str(hello["incarnation"])
        topics = frozenset(map(str, hello["topics"]))
        unnamed = [t for t in sorted(topics) if name not in self._wanted.get(t, ())]
        if unnamed:
            reason = f"the graph names no reader {name!r} of {', '.join(unnamed)} from {self._name}"
            self._say(identity, REFUSED, {"reason": reason})
            raise MessageError(reason)
        wanted = {topic for topic, readers in self._wanted.items() if name in readers}
        if not topics or topics != wanted:
            # taken in place of the true one, it would keep this publisher waiting for good
            reason = f"{name!r:.40} does not ask {self._name} for all that the graph gives it"
            self._say(identity, REFUSED, {"reason": reason})
            raise MessageError(reason)
        old = self._readers.get(name)
        if old is not None and old.identity == identity and old.incarnation == incarnation:
            return
        reader = _Reader(name, identity, incarnation, topics, int(hello["credit_bytes"]))
        self._readers[name] = reader
        self._say(
            identity,
            WELCOME,
            {
                "publisher": self._name,
                "incarnation": self._incarnation,
                "next": {topic: self._sequence[topic] for topic in topics},
            },
        )
        for topic in sorted(topics):
            again = list(self._kept[topic].values())
            if topic in self._latched:
                again.append(self._latched[topic])
            for parts in again:
                self._send(self.router, identity, parts)
                if self._topics[topic].quality == LOSSLESS:
                    reader.lossless -= size_bytes(parts) + MESSAGE_OVERHEAD_BYTES
                else:
                    reader.command -= size_bytes(parts) + MESSAGE_OVERHEAD_BYTES
        self.events.append(PortEvent("reader", name, incarnation))

    def _say(self, identity: bytes, kind: bytes, body: dict[str, Any]) -> None:
        self.router.send_multipart([identity, kind, msgpack.packb(body)], DONTWAIT)

    def close(self) -> None:
        """Close both sockets; what was sent lingers for a second."""
        self.router.close()
        self.watch.close()
