"""Counts of messages and gaps: by the sequence numbers of each publisher's life on each topic."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

MAX_GAPS = 1000
"""Of one stream that are listed; later ones are only counted."""


class StreamKey(NamedTuple):
    """Within one, sequence numbers go up by one."""

    topic: str
    publisher: str
    incarnation: str


@dataclass(slots=True)
class Stream:
    """What came of one publisher's life on one topic."""

    topic: str
    publisher: str
    incarnation: str
    type: str
    messages: int = 0
    bytes: int = 0
    first_ns: int = 0
    """Log time of the first message."""
    last_ns: int = 0
    first_sequence: int = 0
    last_sequence: int = -1
    """The highest one so far."""
    lost: int = 0
    """Messages that never came, between those that did."""
    again: int = 0
    """Messages that came a second time (a publisher sends kept ones to a restarted reader)."""
    late: int = 0
    """Messages that came after a later one."""
    gaps: list[tuple[int, int]] = field(default_factory=list)
    """First and last sequence number that did not come."""

    def add(self, sequence: int, log_time_ns: int, size: int) -> None:
        """Count one message."""
        if self.messages == 0:
            self.first_ns = log_time_ns
            if self.last_sequence < 0:
                self.first_sequence, self.last_sequence = sequence, sequence - 1
        self.messages += 1
        self.bytes += size
        self.last_ns = log_time_ns
        expected = self.last_sequence + 1
        if sequence == expected:
            self.last_sequence = sequence
        elif sequence > expected:
            self.lost += sequence - expected
            if len(self.gaps) < MAX_GAPS:
                self.gaps.append((expected, sequence - 1))
            self.last_sequence = sequence
        else:
            self._late(sequence)

    def _late(self, sequence: int) -> None:
        """Take one that came after a later one: it closes a gap, or came before."""
        if sequence < self.first_sequence:
            self.late += 1
            return
        for k in range(len(self.gaps) - 1, -1, -1):
            first, last = self.gaps[k]
            if first <= sequence <= last:
                rest = [(first, sequence - 1), (sequence + 1, last)]
                self.gaps[k : k + 1] = [gap for gap in rest if gap[0] <= gap[1]]
                self.lost -= 1
                self.late += 1
                return
        self.again += 1

    def has(self, sequence: int) -> bool:
        """Whether this one came already."""
        if not self.first_sequence <= sequence <= self.last_sequence:
            return False
        return not any(first <= sequence <= last for first, last in self.gaps)

    def next_part(self) -> Stream:
        """Return the beginning of its count in the next file: what is expected is known."""
        return Stream(
            self.topic,
            self.publisher,
            self.incarnation,
            self.type,
            first_sequence=self.first_sequence,
            last_sequence=self.last_sequence,
        )

    def plain(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)


class StreamCounts:
    """Counts of all streams of a bag."""

    def __init__(self) -> None:
        self._streams: dict[StreamKey, Stream] = {}

    def add(
        self, key: StreamKey, type_name: str, sequence: int, log_time_ns: int, size: int
    ) -> None:
        """Count one message."""
        stream = self._streams.get(key)
        if stream is None:
            stream = self._streams[key] = Stream(*key, type_name)
        stream.add(sequence, log_time_ns, size)

    def add_new(self, key: StreamKey, sequence: int) -> bool:
        """Count a message unless it came already; return whether it is new."""
        stream = self._streams.get(key)
        if stream is not None and stream.has(sequence):
            return False
        self.add(key, "", sequence, 0, 0)
        return True

    def next_part(self) -> None:
        """Begin to count another file of the same recording."""
        self._streams = {key: stream.next_part() for key, stream in self._streams.items()}

    def all(self) -> tuple[Stream, ...]:
        """Return the streams of which messages came, by topic, publisher and first message."""
        found = [stream for stream in self._streams.values() if stream.messages]
        return tuple(sorted(found, key=lambda s: (s.topic, s.publisher, s.first_ns)))


def read_streams(raw: Iterable[dict[str, Any]]) -> list[Stream]:
    """Return streams from plain values; what a newer version added is ignored."""
    known = Stream.__dataclass_fields__
    found = []
    for each in raw:
        stream = Stream(**{name: value for name, value in each.items() if name in known})
        stream.gaps = [(int(first), int(last)) for first, last in stream.gaps]
        found.append(stream)
    return found


def join_streams(parts: Iterable[Stream]) -> tuple[Stream, ...]:
    """Return the sum of the counts in several files of one recording, given in their order."""
    joined: dict[StreamKey, Stream] = {}
    for part in parts:
        key = StreamKey(part.topic, part.publisher, part.incarnation)
        whole = joined.get(key)
        if whole is None:
            joined[key] = Stream(**asdict(part))
            continue
        whole.messages += part.messages
        whole.bytes += part.bytes
        whole.last_ns = max(whole.last_ns, part.last_ns)
        whole.first_ns = min(whole.first_ns, part.first_ns)
        whole.last_sequence = max(whole.last_sequence, part.last_sequence)
        whole.lost += part.lost
        whole.again += part.again
        whole.late += part.late
        whole.gaps += part.gaps[: max(0, MAX_GAPS - len(whole.gaps))]
    return tuple(sorted(joined.values(), key=lambda s: (s.topic, s.publisher, s.first_ns)))
