"""The bus inside one process: the same contract, for tests and for refitting."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Sequence
from typing import Any

from ..codec import decode
from ..envelope import Envelope, Header, boot_id, host_name, in_epoch, new_incarnation
from ..errors import MessageError
from ..run_directory import Graph
from ..schema import Message
from ..topics import find_topic
from .port import PortEvent


class InProcessBus:
    """Carries messages between the ports of one graph. Nothing is copied or encoded."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.ports: dict[str, InProcessPort] = {}
        self.taps: list[Envelope] = []
        """Everything published, in order, while :attr:`record` is set."""
        self.record = False

    def port(self, name: str) -> InProcessPort:
        """Open a participant's port; opening it again is a restart."""
        me = self.graph.find(name)
        port = InProcessPort(self, name, me.takes, me.gives)
        self.ports[name] = port
        for publisher in {p for t in me.takes for p in self.graph.publishers(t) if p != name}:
            if publisher in self.ports:
                self.ports[publisher].register(port)
        for topic in me.gives:
            for reader in self.graph.readers(name, topic):
                if reader in self.ports:
                    port.register(self.ports[reader])
        return port


class InProcessPort:
    """One participant's place on an :class:`InProcessBus` (see :class:`.port.Port`)."""

    def __init__(
        self, bus: InProcessBus, name: str, takes: tuple[str, ...], gives: tuple[str, ...]
    ) -> None:
        self.name, self.incarnation = name, new_incarnation()
        self._said_as = self.incarnation
        self._bus, self._takes, self._gives = bus, frozenset(takes), frozenset(gives)
        self._queue: deque[Envelope] = deque()
        self._events: list[PortEvent] = []
        self._sequence: defaultdict[str, int] = defaultdict(int)
        self._expected: dict[tuple[str, str, str], int] = {}
        self._latched: dict[str, Envelope] = {}
        self._kept: dict[str, dict[str, Envelope]] = defaultdict(dict)
        self._known: dict[str, str] = {}
        self._counted = frozenset(p.name for p in bus.graph.participants if p.counted_bytes)
        self._counters = dict.fromkeys(
            ("sent", "undelivered", "left_out", "received", "gaps", "repeats", "refused"), 0
        )

    def note(self, event: PortEvent) -> None:
        """Add an event for the owner of this port."""
        self._events.append(event)

    def register(self, reader: InProcessPort) -> None:
        """Take a reader, and send it what is latched and kept."""
        if self._known.get(reader.name) == reader.incarnation:
            return
        self._known[reader.name] = reader.incarnation
        reader.note(PortEvent("found", self.name, self.incarnation))
        for topic in sorted(self._gives & reader._takes):
            for envelope in self._kept[topic].values():
                reader.take(envelope)
            if topic in self._latched:
                reader.take(self._latched[topic])
        self.note(PortEvent("reader", reader.name, reader.incarnation))

    def take(self, envelope: Envelope) -> None:
        """Put a message into this port's queue."""
        key = (envelope.header.publisher, envelope.header.incarnation, envelope.topic)
        sequence = envelope.header.sequence
        expected = self._expected.get(key, sequence)
        if sequence < expected:
            self._counters["repeats"] += 1
        else:
            self._counters["gaps"] += sequence - expected
            self._expected[key] = sequence + 1
        self._queue.append(envelope)

    def publish(
        self,
        topic: str,
        message: Message,
        *,
        stamp_ns: int,
        received_ns: int = 0,
        hardware_ns: int = 0,
        keep: str = "",
    ) -> bool:
        """See :meth:`.port.Port.publish`; there is always room."""
        row = find_topic(topic)
        if topic not in self._gives:
            raise MessageError(f"{self.name} does not give {topic}")
        if type(message) is not row.type:
            raise MessageError(f"{topic} carries {row.type.__name__}, not {type(message).__name__}")
        sequence = self._sequence[topic]
        self._sequence[topic] = sequence + 1
        header = Header(
            self.name,
            self._said_as,
            host_name(),
            boot_id(),
            sequence,
            stamp_ns,
            received_ns,
            hardware_ns,
        )
        envelope = Envelope(topic, header, message)
        if keep:
            self._kept[topic][keep] = envelope
        return self._send_to_all(envelope)

    def forward(self, parts: Sequence[Any]) -> bool:
        """See :meth:`.port.Port.forward`."""
        envelope = decode(parts)
        if envelope.topic not in self._gives:
            raise MessageError(f"{self.name} does not give {envelope.topic}")
        return self._send_to_all(envelope)

    def _send_to_all(self, envelope: Envelope) -> bool:
        topic = envelope.topic
        if find_topic(topic).latched:
            self._latched[topic] = envelope
        delivered = True
        for reader in self._bus.graph.readers(self.name, topic):
            if reader in self._bus.ports:
                self._bus.ports[reader].take(envelope)
            elif reader in self._counted:
                self._counters["left_out"] += 1
            else:
                delivered = False
                self._counters["undelivered"] += 1
        if self._bus.record:
            self._bus.taps.append(envelope)
        self._counters["sent"] += 1
        return delivered

    def begin_epoch(self, epoch: int) -> None:
        """See :meth:`.port.Port.begin_epoch`."""
        self._said_as = in_epoch(self.incarnation, epoch)

    def release(self, topic: str, key: str) -> None:
        """See :meth:`.port.Port.release`."""
        self._kept[topic].pop(key, None)

    def next_sequence(self, topic: str) -> int:
        """See :meth:`.port.Port.next_sequence`."""
        return self._sequence[topic]

    def receive(self, limit: int = 64) -> list[Envelope]:
        """See :meth:`.port.Port.receive`."""
        found = [self._queue.popleft() for _ in range(min(limit, len(self._queue)))]
        self._counters["received"] += len(found)
        return found

    def events(self) -> list[PortEvent]:
        """See :meth:`.port.Port.events`."""
        found, self._events = self._events, []
        return found

    def missing_readers(self) -> tuple[str, ...]:
        """See :meth:`.port.Port.missing_readers`."""
        return tuple(
            f"{reader}:{topic}"
            for topic in sorted(self._gives)
            for reader in self._bus.graph.readers(self.name, topic)
            if reader not in self._bus.ports and reader not in self._counted
        )

    def counters(self) -> dict[str, Any]:
        """See :meth:`.port.Port.counters`."""
        return dict(self._counters)

    def close(self) -> None:
        """Leave the bus."""
        if self._bus.ports.get(self.name) is self:
            del self._bus.ports[self.name]
            for reader in self._known:
                if reader in self._bus.ports:
                    self._bus.ports[reader].note(PortEvent("lost", self.name, self.incarnation))
