"""Looks at every byte and every message of a bag, and lists what is wrong."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from ..codec import decode
from ..envelope import Header
from ..errors import MessageError
from .about import CALIBRATION, attachment_kind
from .clock_jumps import ClockJumps
from .errors import BagError
from .index import DATA_END_BYTES, BagFile
from .layout import bag_files
from .message_schema import why_unreadable
from .reader import BagReader
from .records import RECORD_HEAD, ChannelInfo, Entry
from .stored import unpack_parts
from .streams import Stream, StreamCounts, StreamKey, join_streams

MAX_PROBLEMS = 1000
SHOWN_GAPS = 5
_BLOCK_BYTES = 1 << 20


class Problem(NamedTuple):
    """One thing that is wrong.

    ``kind``: ``unreadable`` (no whole bag of ours), ``damaged`` (a checksum or length), ``message``
    (one does not decode), ``count`` (the recorder counted other than there is), ``gap``, ``order``,
    ``again`` (sequence numbers), ``clock``, ``calibration``.
    """

    kind: str
    text: str


@dataclass(slots=True)
class CheckReport:
    """What a check found."""

    path: Path
    messages: int = 0
    problems: list[Problem] = field(default_factory=list)
    more: int = 0
    """Problems beyond those listed."""

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems

    def add(self, kind: str, text: str) -> None:
        """Take a problem."""
        if len(self.problems) < MAX_PROBLEMS:
            self.problems.append(Problem(kind, text))
        else:
            self.more += 1

    def plain(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        problems = [problem._asdict() for problem in self.problems]
        return {**asdict(self), "path": str(self.path), "ok": self.ok, "problems": problems}


def check_bag(path: str | Path) -> CheckReport:
    """Verify every checksum, decode every message, and follow sequence numbers and clocks.

    Parameters
    ----------
    path
        A file, or a folder of the files of one recording.

    Raises
    ------
    BagError
        If there is no such file or folder.
    """
    path = Path(path)
    report = CheckReport(path)
    bag_files(path)
    try:
        with BagReader(path) as reader:
            _check_data(report, reader)
            _check_attachments(report, reader)
            _Messages(report, reader).check()
    except BagError as error:
        report.add("unreadable", str(error))
    return report


def _check_data(report: CheckReport, reader: BagReader) -> None:
    """Compare all bytes with the checksum at the end of the data."""
    for file in reader.files:
        crc = 0
        with file.path.open("rb") as stream:
            left = file.data_bytes
            while left > 0:
                block = stream.read(min(_BLOCK_BYTES, left))
                if not block:
                    break
                crc = zlib.crc32(block, crc)
                left -= len(block)
            end = stream.read(DATA_END_BYTES)
        if end != RECORD_HEAD.pack(Opcode.DATA_END, 4) + struct.pack("<I", crc):
            report.add("damaged", f"{file.path}: the checksum of its data is wrong")


def _check_attachments(report: CheckReport, reader: BagReader) -> None:
    names = set()
    for file in reader.files:
        for index in file.attachments:
            names.add(index.name)
            try:
                file.attachment(index)
            except BagError as error:
                report.add("damaged", str(error))
    if not any(attachment_kind(name) == CALIBRATION for name in names):
        report.add(
            "calibration",
            f"{reader.path}: has no calibration: it can be refitted only with one that is given",
        )


class _Messages:
    """Goes through all messages in the order in which they were recorded."""

    def __init__(self, report: CheckReport, reader: BagReader) -> None:
        self.report, self.reader = report, reader
        self._counts = StreamCounts()
        self._jumps = ClockJumps()
        self._unreadable: set[tuple[str, object]] = set()

    def check(self) -> None:
        """Fill the report."""
        found: list[Stream] = []
        for file in self.reader.files:
            self._file(file)
            for jump in self._jumps.take():
                where = f"{file.path}: {jump.topic} at {jump.log_time_ns}"
                self.report.add("clock", f"{where}: {jump.text}")
            mine = self._counts.all()
            self._compare(file, mine)
            found += mine
            self._counts.next_part()
        for stream in join_streams(found):
            self._sequence(stream)

    def _file(self, file: BagFile) -> None:
        per_channel: dict[int, int] = {}
        for chunk in file.chunks:
            for entry, data in self._chunk(file, chunk):
                self.report.messages += 1
                per_channel[entry.channel] = per_channel.get(entry.channel, 0) + 1
                self._message(file, file.channels[entry.channel], entry, data)
        if per_channel != file.statistics.channel_message_counts:
            self.report.add("count", f"{file.path}: its index counts other messages than it has")

    def _chunk(self, file: BagFile, chunk: ChunkIndex) -> Iterator[tuple[Entry, bytes]]:
        try:
            plain, entries = file.chunk(chunk)
        except BagError as error:
            self.report.add("damaged", str(error))
            return
        for entry in sorted(entries, key=lambda each: each.offset):
            yield entry, bytes(plain[entry.offset : entry.end])

    def _message(self, file: BagFile, channel: ChannelInfo, entry: Entry, data: bytes) -> None:
        where = f"{file.path}: {channel.topic} at {entry.log_time_ns}"
        try:
            header = self._decoded(file, channel, data)
        except MessageError as error:
            self.report.add("message", f"{where}: {error}")
            return
        if header is None or channel.repeated:
            return
        if (entry.publish_time_ns, channel.publisher) != (header.stamp_ns, header.publisher):
            self.report.add("message", f"{where}: stamp or publisher are not those of its header")
        key = StreamKey(channel.topic, header.publisher, header.incarnation)
        self._jumps.note(key, header, entry.log_time_ns)
        self._counts.add(
            key, channel.schema.type_name, header.sequence, entry.log_time_ns, len(data)
        )

    def _decoded(self, file: BagFile, channel: ChannelInfo, data: bytes) -> Header | None:
        """Return a message's header; None, told once, if this version can't read its kind."""
        kind = (channel.topic, channel.schema)
        if kind in self._unreadable:
            return None
        why = why_unreadable(channel.topic, channel.schema)
        if why:
            self._unreadable.add(kind)
            self.report.add("message", f"{file.path}: {channel.topic}: {why}")
            return None
        return decode(unpack_parts(data)).header

    def _sequence(self, stream: Stream) -> None:
        who = f"{self.reader.path}: {stream.topic} of {stream.publisher} ({stream.incarnation})"
        if stream.lost:
            shown = ", ".join(
                f"{first}" if first == last else f"{first} to {last}"
                for first, last in stream.gaps[:SHOWN_GAPS]
            )
            more = ", …" if len(stream.gaps) > SHOWN_GAPS else ""
            self.report.add(
                "gap",
                f"{who}: {stream.lost} messages missing: sequence numbers {shown}{more}",
            )
        if stream.again:
            self.report.add("again", f"{who}: {stream.again} messages are there twice")
        if stream.late:
            self.report.add("order", f"{who}: {stream.late} messages came after later ones")

    def _compare(self, file: BagFile, found: tuple[Stream, ...]) -> None:
        try:
            kept = file.streams()
        except BagError as error:
            self.report.add("damaged", str(error))
            return
        if kept is not None and [s.plain() for s in kept] != [s.plain() for s in found]:
            self.report.add(
                "count",
                f"{file.path}: its recorder counted other messages or gaps than there are",
            )
