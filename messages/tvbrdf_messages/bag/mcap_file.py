"""Writes one MCAP file, chunk by chunk; after a failed write it ends where the last chunk did.

The records are those of the ``mcap`` package. Its ``Writer`` is not used, for three reasons: after
a failed write it can't end the file any more; it names each channel in one chunk only, so that
damage there would make all later ones unreadable; and it copies images so often that it writes
them at about half the rate.
"""

from __future__ import annotations

import fcntl
import os
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from .message_schema import MESSAGE_ENCODING, MessageSchema
from .records import MAGIC

MAX_CHANNELS = 65535
SAMPLE_BYTES = 65536
WORTH_IT = 0.9
"""LZ4 is used for a chunk if it shrinks it to less than this part."""
JOIN_BYTES = 1 << 16
"""Smaller pieces are joined before they are given to the system."""
_CHUNK_HEAD = struct.Struct("<BQQQQII")
_FOOTER_HEAD = struct.Struct("<BQQQ")
_FOOTER_BYTES = 8 + 8 + 4


def record_bytes(*records: McapRecord) -> bytes:
    """Return records as they stand in a file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    found: bytes = builder.end()  # type: ignore[no-untyped-call]
    return found


class _Chunk:
    """A chunk in the making."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.size = 0
        self.crc = 0
        self.start_ns = self.end_ns = 0
        self.indexes: dict[int, list[tuple[int, int]]] = {}
        self.largest = b""
        self.large_bytes = 0

    def add(self, piece: bytes) -> int:
        """Append bytes and return where they begin."""
        offset = self.size
        self.pieces.append(piece)
        self.crc = zlib.crc32(piece, self.crc)
        self.size += len(piece)
        if len(piece) >= SAMPLE_BYTES:
            self.large_bytes += len(piece)
            if len(piece) > len(self.largest):
                self.largest = piece
        return offset

    def add_message(self, channel: int, log_time_ns: int, piece: bytes) -> None:
        entry = (log_time_ns, self.add(piece))
        if not self.indexes:
            self.start_ns = self.end_ns = log_time_ns
        self.start_ns, self.end_ns = min(self.start_ns, log_time_ns), max(self.end_ns, log_time_ns)
        self.indexes.setdefault(channel, []).append(entry)

    def compressed(self) -> tuple[str, Sequence[bytes]]:
        """Return the pieces under LZ4, or as they are if it would not shrink them."""
        if 2 * self.large_bytes > self.size:  # mostly images: look at one before all are tried
            middle = (len(self.largest) - SAMPLE_BYTES) // 2
            sample = self.largest[middle : middle + SAMPLE_BYTES]
            if len(lz4.frame.compress(sample)) > WORTH_IT * SAMPLE_BYTES:
                return "", self.pieces
        whole = lz4.frame.compress(b"".join(self.pieces))
        return ("lz4", [whole]) if len(whole) < WORTH_IT * self.size else ("", self.pieces)


class McapFile:
    """One MCAP file being written, locked as long as it is open.

    Parameters
    ----------
    path
        A new file.
    profile, library
        For its header.
    compress
        Whether chunks are compressed with LZ4 where that shrinks them.

    Raises
    ------
    OSError
        From every method that writes, if the system refuses. The file then ends behind the last
        whole record, and :meth:`finish` may still be called.
    """

    def __init__(self, path: Path, *, profile: str, library: str, compress: bool) -> None:
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        self.path = path
        self._compress = compress
        self._chunk = _Chunk()
        self._schemas: dict[MessageSchema, Schema] = {}
        self._channels: dict[tuple[str, int, tuple[tuple[str, str], ...]], Channel] = {}
        self._by_id: dict[int, Channel] = {}
        self._named: set[int] = set()  # channels that stand in the present chunk
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self.size_bytes = 0
        self._crc = 0
        self._fd = os.open(path, flags, 0o644)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._append([MAGIC, record_bytes(Header(profile=profile, library=library))])
        except BaseException:
            os.close(self._fd)
            path.unlink()
            raise

    @property
    def chunk_size(self) -> int:
        """Bytes in the present chunk, before compression."""
        return self._chunk.size

    @property
    def chunk_start_ns(self) -> int | None:
        """Earliest log time in the present chunk; None when it has no message."""
        return self._chunk.start_ns if self._chunk.indexes else None

    def free_bytes(self) -> int:
        """Return how much room is left on the disk."""
        disk = os.fstatvfs(self._fd)
        return disk.f_bavail * disk.f_frsize

    def channel(self, topic: str, schema: MessageSchema, metadata: dict[str, str]) -> int:
        """Return the number of a channel, made when it is asked for the first time.

        Raises
        ------
        ValueError
            If there are too many of them.
        """
        kept = self._schemas.get(schema)
        if kept is None:
            kept = Schema(
                id=len(self._schemas) + 1,
                name=schema.name,
                encoding=schema.encoding,
                data=schema.data,
            )
            self._schemas[schema] = kept
        key = (topic, kept.id, tuple(metadata.items()))
        channel = self._channels.get(key)
        if channel is None:
            if len(self._channels) >= MAX_CHANNELS:
                raise ValueError(f"more than {MAX_CHANNELS} pairs of topic and publisher")
            channel = Channel(
                id=len(self._channels) + 1,
                topic=topic,
                message_encoding=MESSAGE_ENCODING,
                metadata=metadata,
                schema_id=kept.id,
            )
            self._channels[key] = self._by_id[channel.id] = channel
        return channel.id

    def add_message(self, channel: int, log_time_ns: int, record: bytes) -> None:
        """Put a message's whole record, head included, into the present chunk."""
        if channel not in self._named:
            self._name(channel)
        self._chunk.add_message(channel, log_time_ns, record)

    def _name(self, number: int) -> None:
        """Write schema and channel into the present chunk: each can be read without the others."""
        channel = self._by_id[number]
        schema = next(s for s in self._schemas.values() if s.id == channel.schema_id)
        self._chunk.add(record_bytes(schema, channel))
        self._named.add(number)

    def close_chunk(self) -> None:
        """Give the present chunk to the system, with its index; an empty one is left out."""
        chunk = self._chunk
        if not chunk.indexes:
            return
        compression, pieces = chunk.compressed() if self._compress else ("", chunk.pieces)
        size = sum(map(len, pieces))
        name = compression.encode()
        head = _CHUNK_HEAD.pack(
            Opcode.CHUNK,
            _CHUNK_HEAD.size - 9 + len(name) + 8 + size,
            chunk.start_ns,
            chunk.end_ns,
            chunk.size,
            chunk.crc,
            len(name),
        )
        head += name + struct.pack("<Q", size)
        offsets, indexes = {}, b""
        for number, entries in chunk.indexes.items():
            offsets[number] = self.size_bytes + len(head) + size + len(indexes)
            indexes += record_bytes(MessageIndex(channel_id=number, records=entries))
        index = ChunkIndex(
            message_start_time=chunk.start_ns,
            message_end_time=chunk.end_ns,
            chunk_start_offset=self.size_bytes,
            chunk_length=len(head) + size,
            message_index_offsets=offsets,
            message_index_length=len(indexes),
            compression=compression,
            compressed_size=size,
            uncompressed_size=chunk.size,
        )
        self._append([head, *pieces, indexes])
        self.drop_chunk()
        self._chunks.append(index)
        for number, entries in chunk.indexes.items():
            self._counts[number] = self._counts.get(number, 0) + len(entries)

    def drop_chunk(self) -> None:
        """Forget the present chunk."""
        self._chunk = _Chunk()
        self._named.clear()

    def add_attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Write an attachment; the present chunk must be closed."""
        record = record_bytes(
            Attachment(
                create_time=time_ns, log_time=time_ns, name=name, media_type=media_type, data=data
            )
        )
        index = AttachmentIndex(
            offset=self.size_bytes,
            length=len(record),
            log_time=time_ns,
            create_time=time_ns,
            data_size=len(data),
            name=name,
            media_type=media_type,
        )
        self._append([record])
        self._attachments.append(index)

    def add_metadata(self, name: str, fields: dict[str, str]) -> None:
        """Write a metadata record; the present chunk must be closed."""
        record = record_bytes(Metadata(name=name, metadata=fields))
        index = MetadataIndex(offset=self.size_bytes, length=len(record), name=name)
        self._append([record])
        self._metadata.append(index)

    def finish(self) -> None:
        """Write the index and the end, and put everything on the disk; the chunk must be closed."""
        data_end = record_bytes(DataEnd(data_section_crc=self._crc))
        start = self.size_bytes + len(data_end)
        summary, offset_start = self._summary(start)
        head = _FOOTER_HEAD.pack(Opcode.FOOTER, _FOOTER_BYTES, start, offset_start)
        crc = zlib.crc32(head, zlib.crc32(summary))
        footer = Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=crc)
        self._append([data_end, summary, record_bytes(footer), MAGIC])
        os.fsync(self._fd)

    @property
    def closed(self) -> bool:
        """Whether it was closed."""
        return self._fd < 0

    def close(self) -> None:
        """Close the file as it is."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _summary(self, start: int) -> tuple[bytes, int]:
        """Return the summary section and where its offsets begin."""
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
            (Opcode.CHUNK_INDEX, self._chunks),
        ]
        texts, offsets, position = [], [], start
        for opcode, records in groups:
            if records:
                text = record_bytes(*records)
                offsets.append(
                    SummaryOffset(group_opcode=opcode, group_start=position, group_length=len(text))
                )
                texts.append(text)
                position += len(text)
        return b"".join([*texts, record_bytes(*offsets)]), position

    def _statistics(self) -> Statistics:
        starts = [chunk.message_start_time for chunk in self._chunks]
        ends = [chunk.message_end_time for chunk in self._chunks]
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max(ends, default=0),
            message_start_time=min(starts, default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _append(self, buffers: Sequence[Any]) -> None:
        """Write buffers at the end, all or none."""
        joined = _joined(buffers)
        try:
            for buffer in joined:
                view = memoryview(buffer)
                while view:
                    view = view[os.write(self._fd, view) :]
        except BaseException:  # an interrupt too: what follows must stand behind whole records
            os.ftruncate(self._fd, self.size_bytes)
            os.lseek(self._fd, self.size_bytes, os.SEEK_SET)
            raise
        for buffer in joined:
            self._crc = zlib.crc32(buffer, self._crc)
            self.size_bytes += len(buffer)


def _joined(buffers: Sequence[bytes]) -> list[bytes]:
    """Return buffers with small neighbours joined: fewer calls of the system."""
    found: list[bytes] = []
    small: list[bytes] = []
    for buffer in buffers:
        if len(buffer) < JOIN_BYTES:
            small.append(buffer)
        else:
            if small:
                found.append(b"".join(small))
                small = []
            found.append(buffer)
    if small:
        found.append(b"".join(small))
    return found
