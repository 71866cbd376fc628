"""Walks through a file whose index is missing or whose bytes can't be trusted.

A record's length leads to the next one. Where it leads nowhere, the next record is looked for: of
a chunk, an index, an attachment or metadata several lengths must fit each other, so that pixels
are hardly ever taken for one. Checksums have the last word.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]
from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata

from .about import unsealed
from .errors import BagError
from .records import (
    BROKEN,
    MAGIC,
    MAX_RECORD_BYTES,
    RECORD_HEAD,
    ChunkHead,
    parse_chunk_head,
    parse_record,
    unpack_chunk,
)

WINDOW_BYTES = 1 << 20
HEAD_BYTES = 64
"""Enough for the fixed part of every record that is looked for."""
MAX_SMALL_BYTES = 1 << 28
"""Of records that are neither chunks nor attachments."""
_CANDIDATE = re.compile(rb"(?=[\x06\x07\x09\x0c\x0f].{5}\x00{3})", re.DOTALL)
"""Opcode and length of a chunk, message index, attachment, metadata or the end of data."""
_LARGE = (Opcode.CHUNK, Opcode.ATTACHMENT)
"""Enough lengths of these must fit; what follows may be damaged too, or cut."""
_OPCODES = frozenset(map(int, Opcode))
_ONLY_IN_CHUNKS = (bytes([Opcode.SCHEMA]), bytes([Opcode.CHANNEL]), bytes([Opcode.MESSAGE]))
"""Or behind the end of the data; never behind a chunk."""
_FIXED: dict[int, int] = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}
_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
_COMPRESSIONS = ("", "lz4", "zstd")


class Piece(NamedTuple):
    """A stretch of a file: a record, or bytes that are none.

    ``opcode`` is 0 for bytes that are none. ``whole`` is False for a record that the end of the
    file cuts.
    """

    opcode: int
    offset: int
    end: int
    whole: bool = True

    @property
    def size(self) -> int:
        """Bytes, head included."""
        return self.end - self.offset


class DamagedFile:
    """A file of records, read without its index."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise BagError(path, f"can't be read: {error.strerror}") from error
        self.size = os.fstat(self._fd).st_size

    def __enter__(self) -> DamagedFile:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._fd)

    def read(self, offset: int, size: int) -> bytes:
        """Return up to ``size`` bytes; fewer at the end of the file."""
        size = min(size, self.size - offset)
        return os.pread(self._fd, size, offset) if size > 0 else b""

    def body(self, piece: Piece) -> bytes:
        """Return a record's content."""
        return self.read(piece.offset + RECORD_HEAD.size, piece.size - RECORD_HEAD.size)

    def pieces(self) -> Iterator[Piece]:
        """Yield the stretches of the file from beginning to end."""
        at = len(MAGIC) if self.read(0, len(MAGIC)) == MAGIC else 0
        while at < self.size:
            if self.size - at == len(MAGIC) and self.read(at, len(MAGIC)) == MAGIC:
                return
            piece = self._record(at) or self._lost(at)
            yield piece
            at = piece.end

    def _record(self, at: int, *, look_on: bool = True) -> Piece | None:
        """Return the whole record that begins here; None if there is none.

        Where bytes are missing, a record's length leads into a later one: so either the next one
        must begin behind it, or its own checksum be right.
        """
        head = self.read(at, HEAD_BYTES)
        if len(head) < RECORD_HEAD.size:
            return None
        opcode, length = RECORD_HEAD.unpack_from(head)
        ends = [at + RECORD_HEAD.size + length]
        chunk = _chunk_head(head)
        if chunk is not None:
            inner = at + RECORD_HEAD.size + chunk.data_offset + chunk.data_size
            if inner == ends[0]:
                opcode = Opcode.CHUNK  # the lengths in it say so, whatever stands there
            elif opcode == Opcode.CHUNK:
                ends.append(inner)  # one of the two is right
        if len(ends) == 1 and not self._fits(at, opcode):
            return None
        for end in ends:
            piece = Piece(opcode, at, end)
            if at < end <= self.size and (self._goes_on(piece, look_on) or self._intact(piece)):
                return piece
        return None

    def _goes_on(self, piece: Piece, look_on: bool) -> bool:
        """Return whether another record begins behind this one."""
        first = self.read(piece.end, 1)
        if piece.opcode == Opcode.CHUNK and first in _ONLY_IN_CHUNKS:
            return False
        return self._begins(piece.end) or (
            look_on and self._record(piece.end, look_on=False) is not None
        )

    def _intact(self, piece: Piece) -> bool:
        """Return whether a record's own checksum is right."""
        try:
            if piece.opcode == Opcode.CHUNK:
                body = self.body(piece)
                head = parse_chunk_head(body)
                unpack_chunk(head, memoryview(body)[head.data_offset :], trust_size=False)
            elif piece.opcode == Opcode.ATTACHMENT:
                parse_record(Attachment, self.body(piece))
            elif piece.opcode == Opcode.METADATA:
                unsealed(self.path, parse_record(Metadata, self.body(piece)).metadata)
            else:
                return False
        except (*BROKEN, BagError):
            return False
        return True

    def _begins(self, at: int) -> bool:
        """Return whether a record seems to begin here, or the file to end."""
        head = self.read(at, HEAD_BYTES)
        if len(head) < RECORD_HEAD.size:
            return head in (MAGIC, b"") or head[0] in _OPCODES
        return head.startswith(MAGIC) or self._fits(at)

    def _fits(self, at: int, opcode: int | None = None) -> bool:
        """Return whether the lengths in a record's head fit each other."""
        told, length = RECORD_HEAD.unpack(self.read(at, RECORD_HEAD.size))
        opcode = told if opcode is None else opcode
        content = at + RECORD_HEAD.size
        try:
            if opcode in _FIXED:
                return bool(length == _FIXED[opcode])
            if opcode in _LENGTHS:
                return bool(length == _LENGTHS[opcode](self, content))
        except struct.error:  # cut within its head
            return content + HEAD_BYTES > self.size
        return opcode in _OPCODES and length <= MAX_SMALL_BYTES

    def _number(self, at: int, form: struct.Struct = _U32) -> int:
        found: int = form.unpack(self.read(at, form.size))[0]
        return found

    def _chunk_length(self, at: int) -> int:
        """Return how long a chunk's content is by the lengths in it; -1 if it can be none."""
        head = self.read(at - RECORD_HEAD.size, HEAD_BYTES)
        if len(head) < HEAD_BYTES:
            raise struct.error("cut")
        chunk = _chunk_head(head)
        return -1 if chunk is None else chunk.data_offset + chunk.data_size

    def _index_length(self, at: int) -> int:
        entries = self._number(at + 2)
        return -1 if entries % 16 else 2 + 4 + entries

    def _attachment_length(self, at: int) -> int:
        name = self._number(at + 16)
        media_type = self._number(at + 20 + name)
        before = 16 + 4 + name + 4 + media_type + 8
        return before + self._number(at + before - 8, _U64) + 4

    def _metadata_length(self, at: int) -> int:
        name = self._number(at)
        return 4 + name + 4 + self._number(at + 4 + name)

    def _lost(self, at: int) -> Piece:
        """Return the stretch up to the next record, or a record that the file's end cuts."""
        found = self._search(at + 1)
        if found is not None:
            return Piece(0, at, found)
        head = self.read(at, HEAD_BYTES)
        if len(head) >= RECORD_HEAD.size and self._fits(at):
            return Piece(head[0], at, self.size, whole=False)
        return Piece(0, at, self.size)

    def _search(self, start: int) -> int | None:
        """Return where the next record begins that can be told from pixels."""
        overlap = RECORD_HEAD.size - 1
        for window in range(start, self.size, WINDOW_BYTES):
            block = self.read(window, WINDOW_BYTES + overlap)
            for match in _CANDIDATE.finditer(block):
                at = window + match.start()
                if match.start() < WINDOW_BYTES and self._fits(at):
                    piece = self._record(at)
                    if block[match.start()] in _LARGE or (piece and self._begins(piece.end)):
                        return at
        return None


_LENGTHS: dict[int, Callable[[DamagedFile, int], int]] = {
    Opcode.CHUNK: DamagedFile._chunk_length,
    Opcode.MESSAGE_INDEX: DamagedFile._index_length,
    Opcode.ATTACHMENT: DamagedFile._attachment_length,
    Opcode.METADATA: DamagedFile._metadata_length,
}


def _chunk_head(head: bytes) -> ChunkHead | None:
    """Return a chunk's head if these bytes can be one."""
    try:
        chunk = parse_chunk_head(head[RECORD_HEAD.size :])
    except (struct.error, ValueError):
        return None
    good = chunk.compression in _COMPRESSIONS and chunk.data_size <= MAX_RECORD_BYTES
    return chunk if good else None


def begun_chunk(body: bytes) -> bytes:
    """Return as much of a cut chunk's records as can be decompressed; no checksum covers them."""
    try:
        head = parse_chunk_head(body)
    except (struct.error, ValueError):
        return b""
    data = body[head.data_offset :]
    if head.compression != "lz4":
        return data if head.compression == "" else b""
    try:
        plain: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=head.size)
    except RuntimeError:
        return b""
    return plain
