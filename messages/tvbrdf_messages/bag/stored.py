"""A stored message: one msgpack array of the parts that travelled on the bus."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgpack

from ..codec import MAX_ARRAY_BYTES, MAX_ARRAYS, MAX_BODY_BYTES
from ..envelope import Envelope, Header
from ..errors import MessageError
from .message_schema import MessageSchema

MAX_MESSAGE_BYTES = MAX_ARRAY_BYTES + MAX_BODY_BYTES + (1 << 20)
_ARRAY_16 = 0xDC
_BINARY = {0xC4: struct.Struct(">B"), 0xC5: struct.Struct(">H"), 0xC6: struct.Struct(">I")}
"""How msgpack says the length of a binary string."""
_HEADER_TYPES = (str, str, str, str, int, int, int, int)
_BROKEN = (ValueError, TypeError, KeyError, msgpack.UnpackException)
"""What comes of unpacking bytes that nobody packed."""


class Recorded(NamedTuple):
    """A message as it was recorded."""

    log_time_ns: int
    """On the run's clock, when the recorder got it."""
    envelope: Envelope


class RawMessage(NamedTuple):
    """A stored message that was not decoded."""

    log_time_ns: int
    publish_time_ns: int
    """The header's ``stamp_ns``."""
    sequence: int
    """The header's, modulo 2^32."""
    topic: str
    publisher: str
    repeated: bool
    """Latched state of before, repeated at the beginning of a file."""
    schema: MessageSchema
    data: bytes
    """As stored; :meth:`parts` takes it apart."""

    def parts(self) -> list[bytes]:
        """Return the parts as on the bus: topic, body, arrays."""
        return unpack_parts(self.data)

    def header(self) -> Header:
        """Return the message's header; its fields and arrays are not decoded."""
        return header_of(self.data)


def _array_header(count: int) -> bytes:
    return struct.pack(">B", 0x90 | count) if count < 16 else struct.pack(">BH", _ARRAY_16, count)


def _binary_header(size: int) -> bytes:
    if size < 256:
        return struct.pack(">BB", 0xC4, size)
    if size < 65536:
        return struct.pack(">BH", 0xC5, size)
    return struct.pack(">BI", 0xC6, size)


def packed_pieces(parts: Sequence[Any]) -> list[Any]:
    """Return one msgpack array of the parts, in pieces to be joined; nothing is copied yet.

    Parts are bytes, arrays or ``zmq.Frame``.
    """
    pieces: list[Any] = [_array_header(len(parts))]
    for part in parts:
        view = memoryview(getattr(part, "buffer", part))
        pieces.append(_binary_header(view.nbytes))
        pieces.append(view)
    return pieces


def pack_parts(parts: Sequence[Any]) -> bytes:
    """Return one msgpack array of the parts."""
    return b"".join(packed_pieces(parts))


def unpack_parts(data: bytes | memoryview) -> list[bytes]:
    """Return the parts of a stored message, copied.

    Raises
    ------
    MessageError
        If it is no array of two or more binary strings.
    """
    try:
        parts = msgpack.unpackb(data)
    except _BROKEN as error:
        raise MessageError(f"broken msgpack: {error!r}") from error
    if type(parts) is not list or not 2 <= len(parts) <= 2 + MAX_ARRAYS:
        raise MessageError("not an array of a message's parts")
    if not all(type(part) is bytes for part in parts):
        raise MessageError("parts of a message that are no binary strings")
    return parts


def header_of(data: bytes | memoryview) -> Header:
    """Return the header of a stored message; its arrays are not touched.

    Raises
    ------
    MessageError
        If it is no stored message.
    """
    try:
        at = 3 if data[0] == _ARRAY_16 else 1
        _, at = _binary(data, at)
        begin, end = _binary(data, at)
        return _header(msgpack.unpackb(data[begin:end], strict_map_key=True)[0])
    except (*_BROKEN, IndexError, struct.error) as error:
        if isinstance(error, MessageError):
            raise
        raise MessageError(f"broken msgpack: {error!r}") from error


def _binary(data: bytes | memoryview, at: int) -> tuple[int, int]:
    """Return where the binary string at a place begins and ends."""
    form = _BINARY.get(data[at])
    if form is None:
        raise MessageError("parts of a message that are no binary strings")
    begin = at + 1 + form.size
    return begin, begin + form.unpack_from(data, at + 1)[0]


class HeaderReader:
    """Reads headers out of bodies; fields are skipped, not decoded."""

    def __init__(self) -> None:
        self._unpacker = self._new()

    @staticmethod
    def _new() -> Any:
        return msgpack.Unpacker(strict_map_key=True, max_buffer_size=MAX_BODY_BYTES)

    def one(self, body: Any) -> Header:
        """Return the header of the only message in a body."""
        found = self.split(body)
        if len(found) != 1:
            raise MessageError(f"{len(found)} messages where one was expected")
        return found[0][0]

    def split(self, body: Any) -> list[tuple[Header, Any]]:
        """Return each message's header and its own body: small ones may travel together.

        Raises
        ------
        MessageError
            If the bytes are no bodies of messages.
        """
        body = getattr(body, "buffer", body)
        if len(body) > MAX_BODY_BYTES:
            raise MessageError(f"a body of {len(body)} bytes, the limit is {MAX_BODY_BYTES}")
        unpacker = self._unpacker
        try:
            start = unpacker.tell()
            unpacker.feed(body)
            found, begin, end = [], 0, 0
            while end < len(body):
                if unpacker.read_array_header() < 3:
                    raise MessageError("not a header, fields and arrays")
                header = _header(unpacker.unpack())
                unpacker.skip()
                unpacker.skip()
                end = unpacker.tell() - start
                found.append((header, begin, end))
                begin = end
        except _BROKEN as error:
            self._unpacker = self._new()  # it holds the rest of the broken bytes
            if isinstance(error, MessageError):
                raise
            raise MessageError(f"broken msgpack: {error!r}") from error
        if len(found) == 1:
            return [(found[0][0], body)]
        return [(header, body[begin:end]) for header, begin, end in found]


def _header(raw: Any) -> Header:
    if type(raw) is not list or tuple(map(type, raw[:8])) != _HEADER_TYPES:
        raise MessageError(f"header holds {raw!r:.100}")
    return Header(*raw[:8])
