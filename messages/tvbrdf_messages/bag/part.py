"""One file of a bag in the making: messages become records, and are counted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode

from ..envelope import Header
from ..errors import BusError
from ..topics import Topic, find_topic
from .about import (
    ABOUT_RECORD,
    PROFILE,
    STREAMS_RECORD,
    About,
    about_record,
    software_version,
    streams_record,
)
from .clock_jumps import ClockJumps
from .layout import media_type
from .mcap_file import McapFile
from .message_schema import MessageSchema
from .records import MESSAGE_HEAD, RECORD_HEAD
from .stored import RawMessage
from .streams import StreamCounts, StreamKey


@lru_cache(maxsize=1024)
def known_topic(topic: str) -> Topic | None:
    """Return a topic's row; None for one of another version."""
    try:
        return find_topic(topic)
    except BusError:
        return None


class Part(McapFile):
    """One file of a bag.

    Parameters
    ----------
    path, number
        A new file, and its place among those of the bag.
    about, attachments, time_ns
        What stands at its beginning, and the time that attachments get.
    compress
        See :class:`McapFile`.
    streams, clock_jumps
        What was noticed in the files before.
    """

    def __init__(
        self,
        path: Path,
        number: int,
        *,
        about: About,
        attachments: Mapping[str, bytes],
        time_ns: int,
        compress: bool,
        streams: StreamCounts,
        clock_jumps: ClockJumps,
    ) -> None:
        library = f"tvbrdf {software_version()}"
        super().__init__(path, profile=PROFILE, library=library, compress=compress)
        self.start_ns: int | None = None
        """Log time of the first message put into it."""
        self._streams, self._clock_jumps = streams, clock_jumps
        self._numbers: dict[tuple[str, str, MessageSchema, bool], int] = {}
        self._pending: list[tuple[StreamKey, str, Header, int, int]] = []
        try:
            self.add_metadata(ABOUT_RECORD, about_record(about, number))
            for name, data in attachments.items():
                self.attach(name, data, time_ns)
        except BaseException:
            self.close()
            path.unlink()
            raise

    def attach(self, name: str, data: bytes, time_ns: int) -> None:
        """Write an attachment; the present chunk must be closed."""
        self.add_attachment(name, media_type(name), data, time_ns)

    def put(self, message: RawMessage, pieces: Sequence[Any], header: Header | None) -> None:
        """Put a message into the present chunk; it is counted when the chunk is closed.

        Parameters
        ----------
        message
            What is told of it; its data are in ``pieces``.
        pieces
            Its data, to be joined.
        header
            Its header; None for one that does not count.
        """
        if self.start_ns is None:
            self.start_ns = message.log_time_ns
        number = self._channel(message)
        size = sum(map(_length, pieces))
        head = MESSAGE_HEAD.pack(
            Opcode.MESSAGE,
            MESSAGE_HEAD.size - RECORD_HEAD.size + size,
            number,
            message.sequence,
            message.log_time_ns,
            message.publish_time_ns,
        )
        self.add_message(number, message.log_time_ns, b"".join([head, *pieces]))
        if header is not None:
            key = StreamKey(message.topic, header.publisher, header.incarnation)
            self._pending.append((key, message.schema.type_name, header, message.log_time_ns, size))

    def _channel(self, message: RawMessage) -> int:
        """Return the number of the channel: one for each topic and publisher."""
        key = (message.topic, message.publisher, message.schema, message.repeated)
        number = self._numbers.get(key)
        if number is None:
            row = known_topic(message.topic)
            metadata = {"publisher": message.publisher, "quality": row.quality if row else ""}
            if message.repeated:
                metadata["repeated"] = "latched"
            number = self._numbers[key] = self.channel(message.topic, message.schema, metadata)
        return number

    def close_chunk(self) -> None:
        """Give the present chunk to the system, and count its messages."""
        super().close_chunk()
        for key, type_name, header, log_time_ns, size in self._pending:
            self._streams.add(key, type_name, header.sequence, log_time_ns, size)
            self._clock_jumps.note(key, header, log_time_ns)
        self._pending.clear()

    def forget_chunk(self) -> int:
        """Give up the chunk that could not be written; return how many messages it had."""
        self.drop_chunk()
        lost = len(self._pending)
        self._pending.clear()
        return lost

    def finish(self) -> None:
        """Write counts, jumps of clocks, index and end, and close; the chunk must be closed."""
        plain = [stream.plain() for stream in self._streams.all()]
        self.add_metadata(STREAMS_RECORD, streams_record(plain, self._clock_jumps.take()))
        super().finish()
        self.close()


def _length(piece: Any) -> int:
    return piece.nbytes if type(piece) is memoryview else len(piece)
