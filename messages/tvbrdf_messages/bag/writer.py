"""Records messages into a bag: one MCAP file, or a folder of them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from ..codec import MAX_ARRAYS, encode
from ..envelope import Envelope, Header
from ..errors import BusError, MessageError
from ..topics import Topic, find_topic
from .about import About
from .clock_jumps import ClockJumps
from .errors import BagError, BagFloorError, BagWriteError
from .layout import Layout
from .message_schema import schema_of
from .part import Part, known_topic
from .stored import HeaderReader, RawMessage, packed_pieces
from .streams import Stream, StreamCounts, join_streams

CHUNK_S, CHUNK_BYTES = 1.0, 4 << 20
FLOOR_FREE_BYTES = 256 << 20
COMPRESSIONS = ("lz4", "none")
MAX_SEQUENCE = 1 << 32
MAX_NUMBER = 1 << 64


class BagWriter:
    """Records messages; used by one thread.

    A chunk is given to the system when ``chunk_s`` of the run's clock have passed or it holds
    ``chunk_bytes``; so a killed recorder loses a second at most. Call :meth:`tick` now and then
    where messages may pause.

    Parameters
    ----------
    path
        A new file ``NAME.mcap``; or, without that suffix, a new folder ``NAME``, which gets
        ``NAME_0.mcap``, ``NAME_1.mcap`` … as ``split_bytes`` and ``split_s`` say.
    about
        Where the bag comes from.
    attachments
        Launch file, scene, calibration, notes, by name (``calibration/rig.yaml``, see
        :func:`~tvbrdf_messages.bag.about.attachment_kind`); repeated in each file.
    chunk_s, chunk_bytes
        When a chunk is closed: run's clock in seconds, bytes before compression.
    compression
        ``lz4``: chunks that it shrinks by a tenth or more; or ``none``.
    split_bytes, split_s
        Size of a file, or time in it on the run's clock, after which the next one begins. The last
        message of each latched topic is repeated at its beginning.
    floor_free_bytes
        With less than that free on the disk, the bag is ended and :class:`BagFloorError` raised.

    Raises
    ------
    BagError
        If the path exists or can't be made, or an option has no meaning.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        about: About | None = None,
        attachments: Mapping[str, bytes] | None = None,
        chunk_s: float = CHUNK_S,
        chunk_bytes: int = CHUNK_BYTES,
        compression: str = "lz4",
        split_bytes: int | None = None,
        split_s: float | None = None,
        floor_free_bytes: int = FLOOR_FREE_BYTES,
    ) -> None:
        self.path = Path(path)
        self.about = about or About()
        if compression not in COMPRESSIONS:
            raise BagError(path, f"no compression {compression!r}; choose lz4 or none")
        for name, value in (
            ("chunk_s", chunk_s),
            ("chunk_bytes", chunk_bytes),
            ("split_bytes", split_bytes),
            ("split_s", split_s),
        ):
            if value is not None and not value > 0:
                raise BagError(path, f"{name} is {value}: it must be above 0")
        self._attachments = dict(attachments or {})
        self._chunk_ns, self._chunk_bytes = round(chunk_s * 1e9), chunk_bytes
        self._compress = compression == "lz4"
        self._split_bytes = split_bytes
        self._split_ns = None if split_s is None else round(split_s * 1e9)
        self._floor = floor_free_bytes
        self._headers = HeaderReader()
        self._latched: dict[tuple[str, str], RawMessage] = {}
        self._finished_streams: tuple[Stream, ...] = ()
        self._streams = StreamCounts()
        self._clock_jumps = ClockJumps()
        self._last_ns = 0
        self._closed = ""
        self._finished_bytes = 0
        in_parts = split_bytes is not None or split_s is not None
        self._layout = Layout(self.path, in_parts=in_parts)
        self._part = self._open_first()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
            return
        with contextlib.suppress(BagError):  # the first error is the one to tell
            self.close()

    # -- what is told

    @property
    def files(self) -> tuple[Path, ...]:
        """The files written so far, the present one last."""
        return tuple(self._layout.files)

    @property
    def size_bytes(self) -> int:
        """Bytes in all files; the present chunk is not among them yet."""
        return self._finished_bytes + self._part.size_bytes

    def counts(self) -> dict[str, int]:
        """Return how many messages of each topic are in closed chunks."""
        found: dict[str, int] = {}
        for stream in self.streams():
            found[stream.topic] = found.get(stream.topic, 0) + stream.messages
        return dict(sorted(found.items()))

    def streams(self) -> tuple[Stream, ...]:
        """Return counts and gaps of each publisher's life on each topic."""
        return join_streams([*self._finished_streams, *self._streams.all()])

    # -- writing

    def write(self, parts: Sequence[Any], log_time_ns: int) -> int:
        """Record a multipart message as it came from the bus; images are not decoded.

        Parameters
        ----------
        parts
            Topic, body, arrays: bytes, ``zmq.Frame``, arrays. They are copied.
        log_time_ns
            The run's clock when it came.

        Returns
        -------
        int
            How many messages that were: small ones travel together.

        Raises
        ------
        MessageError
            If the parts are no message of ours; nothing is recorded.
        BagFloorError
            If the disk is nearly full. This message is in the bag, which has been ended.
        BagWriteError
            If the system refuses to write. The bag has been ended after the last whole chunk.
        """
        self._require_open()
        if not 2 <= len(parts) <= 2 + MAX_ARRAYS:
            raise MessageError(f"a message of {len(parts)} parts")
        topic = _topic(parts[0])
        bodies = self._headers.split(parts[1])
        if len(bodies) > 1 and len(parts) > 2:
            raise MessageError(f"{topic.name}: {len(bodies)} bodies and arrays in one message")
        for header, body in bodies:
            self._store(topic, header, [parts[0], body, *parts[2:]], log_time_ns)
        return len(bodies)

    def write_envelope(self, envelope: Envelope, log_time_ns: int) -> None:
        """Record a decoded message; raises as :meth:`write` does."""
        self._require_open()
        topic = find_topic(envelope.topic)
        parts = encode(topic, envelope.header, envelope.message)
        self._store(topic, envelope.header, parts, log_time_ns)

    def write_raw(self, message: RawMessage) -> None:
        """Record a message of another bag as it is; raises as :meth:`write` does.

        One whose header can't be read is kept too, but not counted.
        """
        self._require_open()
        header = None
        if not message.repeated:
            with contextlib.suppress(MessageError):
                header = message.header()
        self._add(message, [message.data], header)

    def attach(self, name: str, data: bytes) -> None:
        """Add an attachment, to this file and those that follow."""
        self._require_open()
        self._attachments[name] = bytes(data)
        with self._guard():
            self._part.close_chunk()
            self._part.attach(name, bytes(data), self._last_ns or self.about.created_ns)

    def flush(self) -> None:
        """Give what was written to the system, so that a killed process does not lose it."""
        self._require_open()
        with self._guard():
            self._part.close_chunk()
        self._look_at_floor()

    def tick(self, now_ns: int) -> None:
        """Flush if the present chunk is older than ``chunk_s`` on the run's clock."""
        self._require_open()
        if self._chunk_due(now_ns):
            self.flush()

    def split(self) -> None:
        """End this file of a folder and begin the next."""
        self._require_open()
        self._layout.require_folder()
        self._split()

    def abandon(self) -> None:
        """Close the file as it is: without the present chunk, and without an index."""
        self._part.close()
        self._closed = "it was abandoned"

    def close(self) -> None:
        """Write the rest and the index; twice does no harm."""
        if self._closed:
            return
        with self._guard():
            self._part.close_chunk()
            self._part.finish()
        self._closed = "it was closed"

    # -- inside

    def _store(self, topic: Topic, header: Header, parts: Sequence[Any], log_time_ns: int) -> None:
        stamp_ns = header.stamp_ns
        if not (0 <= log_time_ns < MAX_NUMBER and 0 <= stamp_ns < MAX_NUMBER):
            raise MessageError(f"{topic.name}: stamp {stamp_ns} at {log_time_ns} is before 1970")
        if header.sequence < 0:
            raise MessageError(f"{topic.name}: sequence number {header.sequence}")
        message = RawMessage(
            log_time_ns,
            stamp_ns,
            header.sequence % MAX_SEQUENCE,
            topic.name,
            header.publisher,
            False,
            schema_of(topic.type),
            b"",
        )
        self._add(message, packed_pieces(parts), header)

    def _add(
        self,
        message: RawMessage,
        pieces: Sequence[Any],
        header: Header | None,
    ) -> None:
        """Put a message into the present chunk, after what is due before it."""
        self._last_ns = message.log_time_ns
        closed = self._chunk_due(message.log_time_ns)
        if closed:
            with self._guard():
                self._part.close_chunk()
        if self._split_due(message.log_time_ns):
            self._split()
        if self._part.start_ns is None:
            self._repeat_latched(message.log_time_ns)
        try:
            self._part.put(message, pieces, header)
        except ValueError as error:
            raise BagError(self.path, str(error)) from error
        row = known_topic(message.topic)
        if row is not None and row.latched:
            data = message.data or b"".join(pieces)
            self._latched[message.topic, message.publisher] = message._replace(data=data)
        if self._part.chunk_size >= self._chunk_bytes:
            self.flush()
        elif closed:
            self._look_at_floor()

    def _chunk_due(self, now_ns: int) -> bool:
        start_ns = self._part.chunk_start_ns
        return start_ns is not None and not 0 <= now_ns - start_ns < self._chunk_ns

    def _look_at_floor(self) -> None:
        """End the bag if the disk is nearly full."""
        free = self._part.free_bytes()
        if free >= self._floor:
            return
        with self._guard():
            self._part.close_chunk()
            self._part.finish()
        told = self._near_floor(free)
        self._closed = told
        raise BagFloorError(
            self.path, f"{told}: recording has ended, the bag is complete up to here"
        )

    def _near_floor(self, free: int) -> str:
        return (
            f"{free / 1e6:.0f} MB are free on the disk, less than the floor of "
            f"{self._floor / 1e6:.0f} MB (make room)"
        )

    # -- files

    def _open(self) -> Part:
        """Begin the next file."""
        number = len(self._layout.files)
        return Part(
            self._layout.next_file(),
            number,
            about=self.about,
            attachments=self._attachments,
            time_ns=self._last_ns or self.about.created_ns,
            compress=self._compress,
            streams=self._streams,
            clock_jumps=self._clock_jumps,
        )

    def _open_first(self) -> Part:
        try:
            part = self._open()
        except OSError as error:
            self._layout.remove()
            raise BagWriteError(self.path, f"can't be written: {error.strerror}") from error
        free = part.free_bytes()
        if free < self._floor:
            part.close()
            self._layout.remove()
            raise BagFloorError(self.path, f"{self._near_floor(free)}: nothing was recorded")
        return part

    def _split_due(self, log_time_ns: int) -> bool:
        start_ns = self._part.start_ns
        if start_ns is None:
            return False
        size = self._part.size_bytes + self._part.chunk_size
        return (self._split_bytes is not None and size >= self._split_bytes) or (
            self._split_ns is not None and log_time_ns - start_ns >= self._split_ns
        )

    def _split(self) -> None:
        """End this file and begin the next."""
        with self._guard():
            self._part.close_chunk()
            self._part.finish()
            self._finished_bytes += self._part.size_bytes
            self._finished_streams += self._streams.all()
            self._streams.next_part()
            self._part = self._open()

    def _repeat_latched(self, log_time_ns: int) -> None:
        for message in self._latched.values():
            again = message._replace(log_time_ns=log_time_ns, repeated=True)
            self._part.put(again, [again.data], None)

    @contextlib.contextmanager
    def _guard(self) -> Iterator[None]:
        """End the bag behind its last whole chunk if the system refuses to write."""
        try:
            yield
        except OSError as error:
            raise self._broken(error) from error

    def _broken(self, error: OSError) -> BagWriteError:
        """End the bag as well as the system allows, and return what to tell."""
        self._closed = f"writing failed: {error.strerror}"
        lost = self._part.forget_chunk()
        kept = "what was recorded before is complete"
        try:
            if not self._part.closed:
                self._part.finish()
        except OSError:
            kept = f"run 'tvbrdf bag recover {self._part.path}' for what was recorded before"
        finally:
            self._part.close()
        return BagWriteError(
            self.path,
            f"can't be written: {error.strerror}; recording has ended, "
            f"the last {lost} messages are not in the bag; {kept}",
        )

    def _require_open(self) -> None:
        if self._closed:
            raise BagError(self.path, f"nothing more can be recorded: {self._closed}")


def _topic(raw: Any) -> Topic:
    try:
        return find_topic(bytes(getattr(raw, "buffer", raw)).decode())
    except (BusError, UnicodeDecodeError) as error:
        raise MessageError(f"not a topic of ours: {error!s:.100}") from error
