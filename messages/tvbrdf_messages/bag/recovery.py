"""Saves what is intact in a bag whose recorder was killed, or whose file was cut or changed."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema

from ..errors import MessageError
from .about import ABOUT_RECORD, PROFILE, About, read_about, software_version
from .damaged_file import DamagedFile, Piece, begun_chunk
from .errors import BagEmptyError, BagError, BagForeignError, BagIncompleteError, BagVersionError
from .index import is_locked
from .layout import bag_files
from .output import NewBag
from .records import (
    BROKEN,
    MESSAGE_HEAD,
    RECORD_HEAD,
    ChannelInfo,
    channel_info,
    parse_chunk_head,
    parse_record,
    unpack_chunk,
)
from .stored import RawMessage


@dataclass(frozen=True, slots=True)
class Lost:
    """A stretch of a file that could not be saved."""

    path: Path
    offset: int
    bytes: int
    why: str
    after_ns: int | None
    """Log time of the last message saved before it; None if there is none."""
    before_ns: int | None
    """Log time of the first message saved after it; None if there is none."""


@dataclass(slots=True)
class RecoverReport:
    """What was saved and what was not."""

    path: Path
    out: Path
    messages: int = 0
    complete: bool = True
    """Whether every file had its end; without it the recorder was killed or the file cut, and what
    was not yet written is missing too."""
    start_ns: int = 0
    end_ns: int = 0
    attachments: tuple[str, ...] = ()
    lost: list[Lost] = field(default_factory=list)
    removed: tuple[Path, ...] = ()
    """What recoveries that were killed had left of the same output."""

    @property
    def lost_bytes(self) -> int:
        """Bytes that could not be saved."""
        return sum(each.bytes for each in self.lost)

    def plain(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        lost = [{**asdict(each), "path": str(each.path)} for each in self.lost]
        return {
            **asdict(self),
            "path": str(self.path),
            "out": str(self.out),
            "lost": lost,
            "removed": [str(each) for each in self.removed],
            "lost_bytes": self.lost_bytes,
        }


def recover(path: str | Path, out: str | Path) -> RecoverReport:
    """Write the messages of all intact chunks, attachments and metadata into a new bag.

    Of the last chunk, if the end of the file cuts it, the messages that are whole are saved too.
    The new bag is read back before it gets its name.

    Parameters
    ----------
    path
        A file, or a folder of the files of one recording.
    out
        A new file ``NAME.mcap``, or a new folder.

    Raises
    ------
    BagError
        If nothing can be saved, or ``out`` can't be written.
    """
    path, out = Path(path), Path(out)
    files = [_Salvage(one) for one in bag_files(path) if one.stat().st_size]
    if not files:
        raise BagEmptyError(path, "is empty: there is nothing to recover")
    files.sort(key=lambda salvage: salvage.split)
    known = [salvage.about for salvage in files if salvage.about is not None]
    if len({about.recording for about in known}) > 1:
        raise BagError(path, "holds files of different recordings: recover them one by one")
    about = known[0] if known else About()
    note = f"from {path.name} by tvbrdf {software_version()}"
    about = dataclasses.replace(about, extra={**about.extra, "recovered": note})
    attachments = {name: data for f in files for name, data in f.attachments().items()}
    report = RecoverReport(path, out, attachments=tuple(sorted(attachments)))
    with NewBag(out, about, attachments) as bag:
        report.removed = bag.removed
        for salvage in files:
            if salvage is not files[0]:
                bag.writer.split()
            for message in salvage.messages(report):
                if message.repeated and salvage is not files[0]:
                    continue  # the writer repeats it by itself
                report.start_ns = min(report.start_ns or message.log_time_ns, message.log_time_ns)
                report.end_ns = max(report.end_ns, message.log_time_ns)
                report.messages += 1
                bag.add(message)
        if not report.messages and not known:
            raise BagError(path, "nothing in it is intact: no chunk and no metadata of a bag")
    return report


class _Salvage:
    """One file, and what can be read of it without its index."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.about: About | None = None
        number = re.search(r"_(\d+)$", path.stem)
        self.split = int(number[1]) if number else 0
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, ChannelInfo] = {}
        with path.open("rb") as stream:
            if is_locked(stream):
                raise BagIncompleteError(path, "is still being recorded; wait for its recorder")
        with DamagedFile(path) as file:
            self._pieces = list(file.pieces())
            for piece in self._pieces:
                self._look(file, piece)

    def _look(self, file: DamagedFile, piece: Piece) -> None:
        """Take what must be known before the first message is written."""
        try:
            if piece.opcode == Opcode.HEADER and piece.whole:
                header = parse_record(Header, file.body(piece))
                if header.profile != PROFILE:
                    raise BagForeignError(
                        self.path, f"is an MCAP file of another program ({header.library!r})"
                    )
            elif piece.opcode == Opcode.METADATA and piece.whole:
                record: Metadata = parse_record(Metadata, file.body(piece))
                if record.name == ABOUT_RECORD:
                    self.about, self.split = read_about(self.path, record.metadata)
        except (BagForeignError, BagVersionError):
            raise
        except (*BROKEN, BagError):
            return  # told as lost when it is the record's turn

    def attachments(self) -> dict[str, bytes]:
        """Return the attachments whose checksum is right."""
        found: dict[str, bytes] = {}
        with DamagedFile(self.path) as file:
            for piece in self._pieces:
                if piece.opcode == Opcode.ATTACHMENT and piece.whole:
                    try:
                        record: Attachment = parse_record(Attachment, file.body(piece))
                    except BROKEN:
                        continue
                    found[record.name] = record.data
        return found

    def messages(self, report: RecoverReport) -> Iterator[RawMessage]:
        """Yield what is intact in the order of the file; tell the report what is not."""
        last_ns: int | None = None
        open_losses: list[tuple[Piece, str]] = []
        with DamagedFile(self.path) as file:
            for piece in self._pieces:
                messages, why = self._save(file, piece)
                if messages:
                    self._tell(report, open_losses, last_ns, messages[0].log_time_ns)
                    yield from messages
                    last_ns = messages[-1].log_time_ns
                if why:
                    open_losses.append((piece, why))
        self._tell(report, open_losses, last_ns, None)
        footer = self._pieces and self._pieces[-1].opcode == Opcode.FOOTER
        report.complete &= bool(footer and self._pieces[-1].whole)

    def _tell(
        self,
        report: RecoverReport,
        losses: list[tuple[Piece, str]],
        after_ns: int | None,
        before_ns: int | None,
    ) -> None:
        for piece, why in losses:
            report.lost.append(Lost(self.path, piece.offset, piece.size, why, after_ns, before_ns))
        losses.clear()

    def _save(self, file: DamagedFile, piece: Piece) -> tuple[list[RawMessage], str]:
        """Return the messages in a stretch of the file, and why some of it can't be saved."""
        if piece.opcode == 0:
            return [], "bytes that are no record"
        body = file.body(piece)
        if not piece.whole:
            if piece.opcode != Opcode.CHUNK:
                return [], "the file ends within a record"
            messages = self._take(memoryview(begun_chunk(body)), cut=True)
            return messages, f"the file ends within a chunk, {len(messages)} messages are whole"
        try:
            if piece.opcode == Opcode.CHUNK:
                head = parse_chunk_head(body)
                data = memoryview(body)[head.data_offset :]
                # of a damaged head only the checksum and the compression must be right
                return self._take(unpack_chunk(head, data, trust_size=False), cut=False), ""
            if piece.opcode == Opcode.ATTACHMENT:
                parse_record(Attachment, body)
            elif piece.opcode == Opcode.METADATA:
                record: Metadata = parse_record(Metadata, body)
                if record.name == ABOUT_RECORD:
                    read_about(self.path, record.metadata)
        except (*BROKEN, BagError) as error:
            return [], str(error)
        return [], ""

    def _take(self, plain: memoryview, *, cut: bool) -> list[RawMessage]:
        """Return the messages of a chunk; of a cut one, those before the cut."""
        found: list[RawMessage] = []
        at = 0
        while at + RECORD_HEAD.size <= len(plain):
            opcode, size = RECORD_HEAD.unpack_from(plain, at)
            body = plain[at + RECORD_HEAD.size : at + RECORD_HEAD.size + size]
            if len(body) < size:
                if cut:
                    break
                raise ValueError("a record reaches beyond its chunk")
            if opcode == Opcode.SCHEMA:
                schema: Schema = parse_record(Schema, bytes(body))
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel: Channel = parse_record(Channel, bytes(body))
                info = channel_info(channel, self._schemas[channel.schema_id])
                self._channels[info.number] = info
            elif opcode == Opcode.MESSAGE:
                message = self._message(plain, at, at + RECORD_HEAD.size + size)
                if not cut or _is_message(message):
                    found.append(message)
            at += RECORD_HEAD.size + size
        return found

    def _message(self, plain: memoryview, at: int, end: int) -> RawMessage:
        _, _, number, sequence, log_time_ns, publish_time_ns = MESSAGE_HEAD.unpack_from(plain, at)
        channel = self._channels[number]
        return RawMessage(
            log_time_ns,
            publish_time_ns,
            sequence,
            channel.topic,
            channel.publisher,
            channel.repeated,
            channel.schema,
            bytes(plain[at + MESSAGE_HEAD.size : end]),
        )


def _is_message(message: RawMessage) -> bool:
    try:
        message.header()
    except MessageError:
        return False
    return True
