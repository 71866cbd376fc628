"""Messages to bytes and back: multipart of topic, msgpack (header, fields, arrays' shapes), arrays.

Arrays travel as frames of their own, without a copy. Everything that comes in is checked against
the schema and against limits before it is used; nothing is ever pickled or evaluated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import msgpack

from .envelope import Envelope, Header
from .errors import BusError, MessageError
from .schema import ArraySpec, Message
from .topics import Topic, find_topic

if TYPE_CHECKING:
    import numpy as np

MAX_BODY_BYTES = 4 << 20
MAX_ARRAY_BYTES = 256 << 20
MAX_ARRAYS = 32
_ITEM_BYTES = {"uint8": 1, "uint16": 2, "bool": 1, "int64": 8, "float64": 8, "float32": 4}


class _ClassCodec:
    """The two directions for one message class, with everything looked up once."""

    def __init__(self, cls: type[Message]) -> None:
        fields = cls.schema()
        self.cls = cls
        self.plain = [(i, f.name, f.check) for i, f in enumerate(fields) if f.check is not None]
        self.arrays: list[tuple[str, ArraySpec]] = [
            (f.name, f.array) for f in fields if f.array is not None
        ]
        names = [name for _, name, _ in self.plain]
        self.names = names
        getter = attrgetter(*names)
        self.values: Callable[[Message], Any] = getter if len(names) > 1 else lambda m: (getter(m),)

    def decode(self, values: Any, metas: Any, parts: Sequence[Any], where: str) -> Message:
        if type(values) is not list:
            raise MessageError(f"{where}: fields are {type(values).__name__}, expected an array")
        if len(values) < len(self.plain):
            missing = ", ".join(self.names[len(values) :])
            raise MessageError(f"{where}: fields missing: {missing}; sent by an older version?")
        kwargs: dict[str, Any] = {}
        for (_, name, check), value in zip(self.plain, values, strict=False):
            if check is None or not check(value):
                raise MessageError(f"{where}: field {name} holds {value!r:.60}")
            kwargs[name] = tuple(value) if type(value) is list else value
        if self.arrays:
            self._decode_arrays(kwargs, metas, parts, where)
        elif parts:
            raise MessageError(f"{where}: {len(parts)} unexpected array frames")
        return self.cls(**kwargs)

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
        return [topic.name.encode(), msgpack.packb((header, codec.values(message), ()))]
    import numpy as np

    metas, parts = [], []
    for name, spec in codec.arrays:
        array = np.ascontiguousarray(getattr(message, name))
        spec.check(array.dtype.name, array.shape, f"{topic.name}.{name}")
        metas.append((array.dtype.name, array.shape))
        parts.append(array)
    body = msgpack.packb((header, codec.values(message), metas))
    return [topic.name.encode(), body, *parts]


def _decode_header(raw: Any, where: str) -> Header:
    if type(raw) is not list or len(raw) < 8:
        raise MessageError(f"{where}: no header")
    if not all(type(text) is str and len(text) <= 255 for text in raw[:4]) or not all(
        type(number) is int for number in raw[4:8]
    ):
        raise MessageError(f"{where}: header holds {raw!r:.100}")
    return Header(*raw[:8])


def decode(parts: Sequence[Any]) -> Envelope:
    """Return the message in the parts of a multipart message (bytes or ``zmq.Frame``).

    Raises
    ------
    MessageError
        If anything in it is not as the topic's type declares; the text says what.
    """
    if not 2 <= len(parts) <= 2 + MAX_ARRAYS:
        raise MessageError(f"a message of {len(parts)} parts")
    raw_topic, raw_body = (getattr(part, "buffer", part) for part in parts[:2])
    if len(raw_topic) > 255:
        raise MessageError("a topic name of more than 255 bytes")
    if len(raw_body) > MAX_BODY_BYTES:
        raise MessageError(f"a body of {len(raw_body)} bytes, the limit is {MAX_BODY_BYTES}")
    try:
        topic = find_topic(bytes(raw_topic).decode())
        body = msgpack.unpackb(raw_body, strict_map_key=True)
    except (BusError, UnicodeDecodeError) as error:
        raise MessageError(f"not a topic of ours: {error!s:.100}") from error
    except Exception as error:  # msgpack raises many kinds for broken bytes
        raise MessageError(f"{bytes(raw_topic)!r:.60}: broken msgpack: {error}") from error
    if type(body) is not list or len(body) < 3:
        raise MessageError(f"{topic.name}: not a header, fields and arrays")
    header = _decode_header(body[0], topic.name)
    return Envelope(
        topic.name, header, _codec(topic.type).decode(body[1], body[2], parts[2:], topic.name)
    )


def size_bytes(parts: Sequence[Any]) -> int:
    """Return how many bytes of credit the parts of a message take."""
    total = 0
    for part in parts:
        total += part.nbytes if hasattr(part, "nbytes") else len(part)
    return total
