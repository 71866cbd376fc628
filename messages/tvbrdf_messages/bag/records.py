"""Records of MCAP files, taken apart; checksums are verified here."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import Any, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Schema

from .message_schema import MESSAGE_ENCODING, SCHEMA_ENCODING, MessageSchema

MAGIC = b"\x89MCAP0\r\n"
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time."""
RECORD_HEAD = struct.Struct("<BQ")
MAX_RECORD_BYTES = 1 << 29
_CHUNK_FIXED = struct.Struct("<QQQII")
BROKEN = (
    McapError,
    ValueError,
    KeyError,
    TypeError,
    struct.error,
    OverflowError,
    RuntimeError,
    MemoryError,
)
"""What comes of reading records out of bytes that are none."""


class ChannelInfo(NamedTuple):
    """What the messages of one channel share."""

    number: int
    topic: str
    publisher: str
    quality: str
    repeated: bool
    schema: MessageSchema


class Entry(NamedTuple):
    """Where a message stands in its chunk; sorted by log time, then place."""

    log_time_ns: int
    offset: int
    """Of its data."""
    end: int
    channel: int
    sequence: int
    publish_time_ns: int


class ChunkHead(NamedTuple):
    """What stands before the messages of a chunk."""

    start_ns: int
    end_ns: int
    size: int
    """Before compression."""
    crc: int
    compression: str
    data_offset: int
    """Within the record's content."""
    data_size: int


def parse_record(kind: Any, body: bytes) -> Any:
    """Return one of ``mcap``'s records from its content."""
    if kind is Attachment and zlib.crc32(body[:-4]) != struct.unpack("<I", body[-4:])[0]:
        raise ValueError("the checksum of an attachment is wrong")
    return kind.read(ReadDataStream(BytesIO(body)))


def parse_chunk_head(body: bytes | memoryview) -> ChunkHead:
    """Return the head of a chunk from the beginning of its content."""
    start_ns, end_ns, size, crc, name_size = _CHUNK_FIXED.unpack_from(body)
    if name_size > 16:
        raise ValueError(f"a chunk's compression has a name of {name_size} characters")
    at = _CHUNK_FIXED.size
    name = bytes(body[at : at + name_size]).decode()
    (data_size,) = struct.unpack_from("<Q", body, at + name_size)
    return ChunkHead(start_ns, end_ns, size, crc, name, at + name_size + 8, data_size)


def unpack_chunk(head: ChunkHead, data: memoryview, *, trust_size: bool = True) -> memoryview:
    """Return a chunk's records, decompressed, with their checksum verified.

    Parameters
    ----------
    head, data
        What stands before the messages, and they themselves.
    trust_size
        Whether they must be as long as the head says.

    Raises
    ------
    ValueError
        If the checksum or the length does not fit.
    RuntimeError
        If they can't be decompressed.
    """
    if head.compression == "lz4":
        size = head.size if trust_size else lz4.frame.get_frame_info(data)["content_size"]
        if not 0 <= size <= MAX_RECORD_BYTES:
            raise ValueError(f"a chunk of {size} bytes")
        # no more than that, so that a damaged length can't fill the memory
        plain = memoryview(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
    elif head.compression == "":
        plain = data
    else:
        raise ValueError(f"compression {head.compression!r} is none that bags have")
    if trust_size and len(plain) != head.size:
        raise ValueError(f"a chunk of {len(plain)} bytes, its head says {head.size}")
    if zlib.crc32(plain) != head.crc:
        raise ValueError("the checksum of a chunk is wrong")
    return plain


def parse_messages(plain: memoryview, wanted: frozenset[int] | None) -> list[Entry]:
    """Return the messages of a chunk, of the wanted channels, sorted by log time."""
    found, at, end = [], 0, len(plain)
    while at < end:
        opcode, size = RECORD_HEAD.unpack_from(plain, at)
        after = at + RECORD_HEAD.size + size
        if after > end:
            raise ValueError("a record reaches beyond its chunk")
        if opcode == Opcode.MESSAGE:
            _, _, channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(plain, at)
            if wanted is None or channel in wanted:
                offset = at + MESSAGE_HEAD.size
                found.append(Entry(log_time, offset, after, channel, sequence, publish_time))
        at = after
    found.sort()
    return found


def channel_info(channel: Channel, schema: Schema) -> ChannelInfo:
    """Return what a channel's and its schema's records say.

    Raises
    ------
    ValueError
        If it is no channel of ours.
    """
    if channel.message_encoding != MESSAGE_ENCODING or schema.encoding != SCHEMA_ENCODING:
        raise ValueError(
            f"topic {channel.topic} has messages of encoding {channel.message_encoding!r} "
            f"({schema.encoding!r})"
        )
    return ChannelInfo(
        channel.id,
        channel.topic,
        channel.metadata.get("publisher", ""),
        channel.metadata.get("quality", ""),
        "repeated" in channel.metadata,
        MessageSchema(schema.name, schema.encoding, schema.data),
    )


def walk(section: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and content of the records that follow each other."""
    at, end = 0, len(section)
    while at < end:
        opcode, size = RECORD_HEAD.unpack_from(section, at)
        at += RECORD_HEAD.size
        if at + size > end:
            raise ValueError("a record reaches beyond its section")
        yield opcode, section[at : at + size]
        at += size
