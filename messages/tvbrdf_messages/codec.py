"""Messages to bytes and back: multipart of topic, msgpack (header, fields, arrays' shapes), arrays.

Arrays travel as frames of their own, without a copy. Everything that comes in is checked against
the schema and against limits before it is used; nothing is ever pickled or evaluated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import msgpack

from .envelope import Envelope, Header
from .errors import BusError, MessageError
from .schema import SCALARS, ArraySpec, Message
from .topics import Topic, find_topic

if TYPE_CHECKING:
    import numpy as np

MAX_BODY_BYTES = 4 << 20
MAX_ARRAY_BYTES = 256 << 20
MAX_ARRAYS = 32
MAX_NAME = 255
_ITEM_BYTES = {"uint8": 1, "uint16": 2, "bool": 1, "int64": 8, "float64": 8, "float32": 4}
_DTYPE_NAMES = {
    "|u1": "uint8",
    "<u2": "uint16",
    "|b1": "bool",
    "<i8": "int64",
    "<f8": "float64",
    "<f4": "float32",
}
_HEADER_TYPES = (str, str, str, str, int, int, int, int)
_pack = msgpack.Packer().pack


class _ClassCodec:
    """The two directions for one message class, with everything looked up once."""

    def __init__(self, cls: type[Message]) -> None:
        fields = cls.schema()
        self.cls = cls
        self.plain = [(f.name, f.check) for f in fields if f.check is not None]
        self.arrays: list[tuple[str, ArraySpec]] = [
            (f.name, f.array) for f in fields if f.array is not None
        ]
        self.names = [name for name, _ in self.plain]
        scalars = [SCALARS.get(f.annotation) for f in fields if f.check is not None]
        self.types = tuple(scalars) if None not in scalars else None
        getter = attrgetter(*self.names)
        self.values: Callable[[Message], Any] = (
            getter if len(self.names) > 1 else lambda m: (getter(m),)
        )

    def decode(self, values: Any, metas: Any, parts: Sequence[Any], where: str) -> Message:
        if type(values) is not list:
            raise MessageError(f"{where}: fields are {type(values).__name__}, expected an array")
        if tuple(map(type, values)) == self.types:  # nearly always so, and far faster
            kwargs: dict[str, Any] = dict(zip(self.names, values, strict=True))
        else:
            kwargs = self._check(values, where)
        if self.arrays:
            self._decode_arrays(kwargs, metas, parts, where)
        elif parts:
            raise MessageError(f"{where}: {len(parts)} unexpected array frames")
        return self.cls(**kwargs)

    def _check(self, values: list[Any], where: str) -> dict[str, Any]:
        if len(values) < len(self.plain):
            missing = ", ".join(self.names[len(values) :])
            raise MessageError(f"{where}: fields missing: {missing}; sent by an older version?")
        kwargs = {}
        for (name, check), value in zip(self.plain, values, strict=False):
            if check is None or not check(value):
                raise MessageError(f"{where}: field {name} holds {value!r:.60}")
            kwargs[name] = tuple(value) if type(value) is list else value
        return kwargs

    def _decode_arrays(
        self, kwargs: dict[str, Any], metas: Any, parts: Sequence[Any], where: str
    ) -> None:
        if type(metas) is not list or len(metas) < len(self.arrays) or len(metas) != len(parts):
            raise MessageError(f"{where}: {len(parts)} array frames, expected {len(self.arrays)}")
        for (name, spec), meta, part in zip(self.arrays, metas, parts, strict=False):
            kwargs[name] = _decode_array(spec, meta, part, f"{where}.{name}")


def _decode_array(spec: ArraySpec, meta: Any, part: Any, where: str) -> np.ndarray[Any, Any]:
    import numpy as np

    if type(meta) is not list or len(meta) != 2 or type(meta[0]) is not str:
        raise MessageError(f"{where}: no dtype and shape")
    dtype, shape = meta
    if type(shape) is not list or not all(type(n) is int and n >= 0 for n in shape):
        raise MessageError(f"{where}: shape is {shape!r:.60}")
    spec.check(dtype, tuple(shape), where)
    size = math.prod(shape) * _ITEM_BYTES[dtype]
    if size > MAX_ARRAY_BYTES:
        raise MessageError(f"{where}: {size} bytes, the limit is {MAX_ARRAY_BYTES}")
    buffer = getattr(part, "buffer", part)
    if len(buffer) != size:
        raise MessageError(f"{where}: {len(buffer)} bytes, dtype and shape say {size}")
    array = np.frombuffer(buffer, dtype=dtype).reshape(shape)
    array.flags.writeable = False
    return array


_CODECS: dict[type[Message], _ClassCodec] = {}


def _codec(cls: type[Message]) -> _ClassCodec:
    found = _CODECS.get(cls)
    if found is None:
        found = _CODECS[cls] = _ClassCodec(cls)
    return found


def encode(topic: Topic, header: Header, message: Message) -> list[Any]:
    """Return the parts of a multipart message; the arrays are not copied.

    Raises
    ------
    MessageError
        If the message is not of the topic's type or an array is not as declared.
    """
    if type(message) is not topic.type:
        raise MessageError(
            f"{topic.name} carries {topic.type.__name__}, not {type(message).__name__}"
        )
    codec = _codec(topic.type)
    if not codec.arrays:
        return [topic.name.encode(), _pack((header, codec.values(message), ()))]
    import numpy as np

    metas, parts = [], []
    for name, spec in codec.arrays:
        array = np.ascontiguousarray(getattr(message, name))
        dtype = _DTYPE_NAMES.get(array.dtype.str, array.dtype.str)
        spec.check(dtype, array.shape, f"{topic.name}.{name}")
        metas.append((dtype, array.shape))
        parts.append(array)
    return [topic.name.encode(), _pack((header, codec.values(message), metas)), *parts]


def _decode_header(raw: Any, where: str) -> Header:
    if type(raw) is not list or tuple(map(type, raw[:8])) != _HEADER_TYPES:
        raise MessageError(f"{where}: header holds {raw!r:.100}")
    if max(map(len, raw[:4])) > MAX_NAME:
        raise MessageError(f"{where}: a name of more than {MAX_NAME} characters in the header")
    return Header(*raw[:8])


def decode(parts: Sequence[Any]) -> Envelope:
    """Return the one message in the parts of a multipart message.

    Raises
    ------
    MessageError
        If anything in it is not as the topic's type declares; the text says what.
    """
    found = decode_all(parts)
    if len(found) != 1:
        raise MessageError(f"{len(found)} messages where one was expected")
    return found[0]


def decode_all(parts: Sequence[Any]) -> list[Envelope]:
    """Return the messages in the parts of a multipart message (bytes or ``zmq.Frame``).

    Small messages of one topic may travel together: their bodies follow each other in one frame.

    Raises
    ------
    MessageError
        If anything in it is not as the topic's type declares; the text says what.
    """
    if not 2 <= len(parts) <= 2 + MAX_ARRAYS:
        raise MessageError(f"a message of {len(parts)} parts")
    raw_topic, raw_body = (getattr(part, "buffer", part) for part in parts[:2])
    if len(raw_topic) > MAX_NAME:
        raise MessageError(f"a topic name of more than {MAX_NAME} bytes")
    if len(raw_body) > MAX_BODY_BYTES:
        raise MessageError(f"a body of {len(raw_body)} bytes, the limit is {MAX_BODY_BYTES}")
    topic = _topic(bytes(raw_topic))
    bodies = _unpack(raw_body, topic.name)
    if len(bodies) > 1 and len(parts) > 2:
        raise MessageError(f"{topic.name}: {len(bodies)} bodies and arrays in one message")
    codec, arrays, name = _codec(topic.type), parts[2:], topic.name
    found = []
    for body in bodies:
        if type(body) is not list or len(body) < 3:
            raise MessageError(f"{name}: not a header, fields and arrays")
        header = _decode_header(body[0], name)
        found.append(Envelope(name, header, codec.decode(body[1], body[2], arrays, name)))
    return found


def _unpack(raw: Any, where: str) -> list[Any]:
    """Return the msgpack objects that follow each other in ``raw``; mostly it is one."""
    try:
        return [msgpack.unpackb(raw, strict_map_key=True)]
    except msgpack.ExtraData:
        pass
    except Exception as error:  # msgpack raises many kinds for broken bytes
        raise MessageError(f"{where}: broken msgpack: {error}") from error
    unpacker = msgpack.Unpacker(strict_map_key=True, max_buffer_size=MAX_BODY_BYTES)
    unpacker.feed(raw)
    try:
        bodies = list(unpacker)
    except Exception as error:
        raise MessageError(f"{where}: broken msgpack: {error}") from error
    if unpacker.tell() != len(raw):
        raise MessageError(f"{where}: broken msgpack: {len(bodies)} bodies and a rest")
    return bodies


@lru_cache(maxsize=1024)
def _topic(raw: bytes) -> Topic:
    try:
        return find_topic(raw.decode())
    except (BusError, UnicodeDecodeError) as error:
        raise MessageError(f"not a topic of ours: {error!s:.100}") from error


def size_bytes(parts: Sequence[Any]) -> int:
    """Return how many bytes of credit the parts of a message take."""
    total = 0
    for part in parts:
        # an array counts its bytes; bytes and zmq.Frame have none of it but a length
        total += len(part) if type(part) is bytes else getattr(part, "nbytes", None) or len(part)
    return total
