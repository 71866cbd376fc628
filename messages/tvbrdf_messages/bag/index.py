"""One file of a bag, opened by its index; chunks are read one by one, checksums verified.

The ``mcap`` package's reader is not used: it verifies neither the index, nor attachments, nor that
a chunk's head is what the index says, falls back to reading everything into memory, and takes
small messages apart several times slower.
"""

from __future__ import annotations

import fcntl
import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from .about import ABOUT_RECORD, PROFILE, STREAMS_RECORD, About, read_about, unsealed
from .clock_jumps import ClockJump
from .errors import (
    BagDamagedError,
    BagEmptyError,
    BagError,
    BagForeignError,
    BagIncompleteError,
)
from .records import (
    BROKEN,
    MAGIC,
    MAX_RECORD_BYTES,
    RECORD_HEAD,
    ChannelInfo,
    Entry,
    channel_info,
    parse_chunk_head,
    parse_messages,
    parse_record,
    unpack_chunk,
    walk,
)
from .streams import Stream, read_streams

FOOTER_BYTES = RECORD_HEAD.size + 8 + 8 + 4
DATA_END_BYTES = RECORD_HEAD.size + 4
MAX_SUMMARY_BYTES = 1 << 30
_T = TypeVar("_T")
_INDEX_FIXED = struct.Struct("<QQQQI")
_INDEX_PAIR = struct.Struct("<HQ")


class BagFile:
    """One file of a bag; only its end and its metadata are read.

    Raises
    ------
    BagError
        One of its kinds if it is no whole bag of ours; the text says what to do.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data_bytes = 0
        """Up to the record that ends the data and has their checksum."""
        self.channels: dict[int, ChannelInfo] = {}
        self.chunks: list[ChunkIndex] = []
        self.attachments: list[AttachmentIndex] = []
        self._metadata: dict[str, MetadataIndex] = {}
        self.statistics = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
        try:
            with path.open("rb") as stream:
                self.size_bytes = os.fstat(stream.fileno()).st_size
                self._read_header(stream)
                self._read_summary(stream)
                self._read_metadata(stream)
        except OSError as error:
            raise BagError(path, f"can't be read: {error.strerror or error}") from error

    def _read_header(self, stream: BinaryIO) -> None:
        if not self.size_bytes:
            raise BagEmptyError(self.path, "is empty: nothing was recorded into it, remove it")
        begin = stream.read(4096)
        if not begin.startswith(MAGIC):
            if MAGIC.startswith(begin):
                raise BagIncompleteError(self.path, self._why_incomplete(stream))
            raise BagForeignError(self.path, "is no bag and no other MCAP file")
        try:
            header = parse_record(Header, begin[len(MAGIC) + RECORD_HEAD.size :])
        except BROKEN as error:
            raise BagIncompleteError(self.path, self._why_incomplete(stream)) from error
        if header.profile != PROFILE:
            raise BagForeignError(
                self.path,
                f"is an MCAP file of another program (library {header.library!r}, profile "
                f"{header.profile!r}), not a bag of tvbrdf",
            )

    def _why_incomplete(self, stream: BinaryIO) -> str:
        if is_locked(stream):
            return "is still being recorded; wait until its recorder has ended"
        return (
            "has no end: its recorder was killed or it was cut; "
            f"run 'tvbrdf bag recover {self.path}'"
        )

    def _read_summary(self, stream: BinaryIO) -> None:
        tail_size = FOOTER_BYTES + len(MAGIC)
        stream.seek(max(0, self.size_bytes - tail_size))
        tail = stream.read(tail_size)
        if not tail.endswith(MAGIC) or RECORD_HEAD.unpack_from(tail) != (Opcode.FOOTER, 20):
            raise BagIncompleteError(self.path, self._why_incomplete(stream))
        footer: Footer = parse_record(Footer, tail[RECORD_HEAD.size : FOOTER_BYTES])
        size = self.size_bytes - tail_size - footer.summary_start
        if not 0 < size <= MAX_SUMMARY_BYTES:
            raise self.damaged("its index lies outside of it")
        self.data_bytes = footer.summary_start - DATA_END_BYTES
        stream.seek(footer.summary_start)
        summary = stream.read(size)
        crc = zlib.crc32(tail[: FOOTER_BYTES - 4], zlib.crc32(summary))
        if crc != footer.summary_crc:
            raise self.damaged("the checksum of its index is wrong")
        try:
            self._take_summary(summary)
        except BROKEN as error:
            raise self.damaged(f"its index can't be read: {error}") from error

    def _take_summary(self, summary: bytes) -> None:
        schemas: dict[int, Schema] = {}
        for opcode, body in walk(summary):
            if opcode == Opcode.CHUNK_INDEX:
                self.chunks.append(_chunk_index(body))
            elif opcode == Opcode.SCHEMA:
                schema = parse_record(Schema, body)
                schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = parse_record(Channel, body)
                info = channel_info(channel, schemas[channel.schema_id])
                self.channels[info.number] = info
            elif opcode == Opcode.STATISTICS:
                self.statistics = parse_record(Statistics, body)
            elif opcode == Opcode.ATTACHMENT_INDEX:
                self.attachments.append(parse_record(AttachmentIndex, body))
            elif opcode == Opcode.METADATA_INDEX:
                index = parse_record(MetadataIndex, body)
                self._metadata[index.name] = index

    def _read_metadata(self, stream: BinaryIO) -> None:
        about = self.metadata(ABOUT_RECORD, stream)
        if about is None:
            raise self.damaged("it has no metadata of where it comes from")
        self.about: About
        self.about, self.split = read_about(self.path, about)

    # -- reading

    def damaged(self, text: str) -> BagDamagedError:
        """Return an error that says what is damaged and what to do."""
        advice = f"run 'tvbrdf bag recover {self.path}' for what is intact"
        return BagDamagedError(self.path, f"{text}; {advice}")

    def metadata(self, name: str, stream: BinaryIO) -> dict[str, str] | None:
        """Return a metadata record; None if there is none of that name."""
        index = self._metadata.get(name)
        if index is None:
            return None
        body = self._record(stream, Opcode.METADATA, index.offset, index.length)
        try:
            found: dict[str, str] = parse_record(Metadata, body).metadata
        except BROKEN as error:
            raise self.damaged(f"metadata {name!r} can't be read: {error}") from error
        return found

    def streams(self) -> list[Stream] | None:
        """Return the counts that the recorder kept; None if it kept none."""
        return self._noticed("streams", read_streams)

    def clock_jumps(self) -> list[ClockJump]:
        """Return the jumps of clocks that the recorder noticed."""
        found = self._noticed("clock_jumps", lambda raw: [ClockJump(**jump) for jump in raw])
        return found or []

    def _noticed(self, what: str, parse: Callable[[Any], list[_T]]) -> list[_T] | None:
        """Return what the recorder kept of what it noticed; None if it kept nothing of that."""
        with self.path.open("rb") as stream:
            record = self.metadata(STREAMS_RECORD, stream)
        if record is None:
            return None
        try:
            fields = unsealed(self.path, record)
            return parse(json.loads(fields[what])) if what in fields else None
        except BROKEN as error:
            raise self.damaged(f"its counts can't be read: {error}") from error

    def attachment(self, index: AttachmentIndex) -> bytes:
        """Return an attachment's content, its checksum verified."""
        with self.path.open("rb") as stream:
            body = self._record(stream, Opcode.ATTACHMENT, index.offset, index.length)
        try:
            data: bytes = parse_record(Attachment, body).data
        except BROKEN as error:
            raise self.damaged(f"attachment {index.name!r} can't be read: {error}") from error
        return data

    def chunk(
        self, index: ChunkIndex, wanted: frozenset[int] | None = None
    ) -> tuple[memoryview, list[Entry]]:
        """Return a chunk's records and where its messages stand, of the wanted channels."""
        offset, length = index.chunk_start_offset, index.chunk_length
        with self.path.open("rb") as stream:
            body = self._record(stream, Opcode.CHUNK, offset, length)
        try:
            head = parse_chunk_head(body)
            told = (head.start_ns, head.end_ns, head.size, head.compression, head.data_size)
            if told != (
                index.message_start_time,
                index.message_end_time,
                index.uncompressed_size,
                index.compression,
                index.compressed_size,
            ):
                raise ValueError("its head is not what the index says")
            plain = unpack_chunk(head, memoryview(body)[head.data_offset :])
            entries = parse_messages(plain, wanted)
            for entry in entries:
                if entry.channel not in self.channels:
                    raise ValueError(f"no channel {entry.channel}")
        except BROKEN as error:
            raise self.damaged(f"chunk at byte {offset}: {error}") from error
        return plain, entries

    def _record(self, stream: BinaryIO, opcode: int, offset: int, length: int) -> bytes:
        """Return the content of the record that the index says is there."""
        size = length - RECORD_HEAD.size
        if not (0 <= size <= MAX_RECORD_BYTES and offset + length <= self.size_bytes):
            raise self.damaged(f"its index has a record of {length} bytes at byte {offset}")
        stream.seek(offset)
        head = stream.read(RECORD_HEAD.size)
        if head != RECORD_HEAD.pack(opcode, size):
            raise self.damaged(f"record at byte {offset} is not what the index says")
        body = stream.read(size)
        if len(body) != size:
            raise self.damaged(f"record at byte {offset} is cut")
        return body


def is_locked(stream: BinaryIO) -> bool:
    """Return whether a recorder still holds the file."""
    try:
        fcntl.flock(stream.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    fcntl.flock(stream.fileno(), fcntl.LOCK_UN)
    return False


def _chunk_index(body: bytes) -> ChunkIndex:
    """Parse by hand: a long bag has a hundred thousand of them."""
    start_ns, end_ns, offset, length, pairs_size = _INDEX_FIXED.unpack_from(body)
    at = _INDEX_FIXED.size
    pairs = dict(_INDEX_PAIR.iter_unpack(body[at : at + pairs_size]))
    at += pairs_size
    index_length, name_size = struct.unpack_from("<QI", body, at)
    at += 12
    compressed, plain = struct.unpack_from("<QQ", body, at + name_size)
    return ChunkIndex(
        message_start_time=start_ns,
        message_end_time=end_ns,
        chunk_start_offset=offset,
        chunk_length=length,
        message_index_offsets=pairs,
        message_index_length=index_length,
        compression=body[at : at + name_size].decode(),
        compressed_size=compressed,
        uncompressed_size=plain,
    )
