"""What a bag's index tells of it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from .about import About
from .clock_jumps import ClockJump
from .streams import Stream


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic of a bag."""

    topic: str
    type: str
    """Name of the message class."""
    quality: str
    messages: int
    bytes: int
    """Of the stored messages, before compression."""
    rate_hz: float
    """Mean between its first and its last message; 0 with fewer than two."""
    publishers: tuple[str, ...]
    lost: int
    """By sequence numbers: messages that were sent and are not in the bag."""
    again: int
    """Messages that are in it twice."""


@dataclass(frozen=True, slots=True)
class FileSummary:
    """One file of a bag."""

    path: Path
    split: int
    size_bytes: int
    start_ns: int
    end_ns: int
    messages: int
    """Latched state of before that is repeated in it among them."""
    chunks: int


@dataclass(frozen=True, slots=True)
class AttachmentSummary:
    """One attachment of a bag."""

    name: str
    media_type: str
    size_bytes: int


@dataclass(frozen=True, slots=True)
class BagSummary:
    """What is in a bag; times on the run's clock."""

    path: Path
    about: About
    files: tuple[FileSummary, ...]
    start_ns: int
    end_ns: int
    messages: int
    topics: tuple[TopicSummary, ...]
    streams: tuple[Stream, ...]
    """Counts and gaps of each publisher's life on each topic."""
    clock_jumps: tuple[ClockJump, ...]
    """As the recorder noticed them; :func:`~.check.check_bag` looks for them itself."""
    attachments: tuple[AttachmentSummary, ...]

    @property
    def duration_s(self) -> float:
        """Time between the first message and the last."""
        return (self.end_ns - self.start_ns) / 1e9

    @property
    def size_bytes(self) -> int:
        """Of all files."""
        return sum(file.size_bytes for file in self.files)

    def plain(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            **asdict(self),
            "path": str(self.path),
            "clock_jumps": [jump._asdict() for jump in self.clock_jumps],
            "files": [{**asdict(file), "path": str(file.path)} for file in self.files],
            "duration_s": self.duration_s,
            "size_bytes": self.size_bytes,
        }


def topic_summaries(
    streams: tuple[Stream, ...], qualities: dict[str, str]
) -> tuple[TopicSummary, ...]:
    """Return the sums over the streams of each topic."""
    found = []
    for topic in sorted({stream.topic for stream in streams}):
        mine = [stream for stream in streams if stream.topic == topic]
        count = sum(stream.messages for stream in mine)
        span_ns = max(s.last_ns for s in mine) - min(s.first_ns for s in mine)
        found.append(
            TopicSummary(
                topic=topic,
                type=mine[-1].type,
                quality=qualities.get(topic, ""),
                messages=count,
                bytes=sum(stream.bytes for stream in mine),
                rate_hz=(count - 1) * 1e9 / span_ns if count > 1 and span_ns > 0 else 0.0,
                publishers=tuple(sorted({stream.publisher for stream in mine})),
                lost=sum(stream.lost for stream in mine),
                again=sum(stream.again for stream in mine),
            )
        )
    return tuple(found)
