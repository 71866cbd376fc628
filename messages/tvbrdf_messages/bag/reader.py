"""Reads bags: messages in log-time order, chunk by chunk through the index."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple, overload

from mcap.records import AttachmentIndex, ChunkIndex

from ..codec import decode
from ..errors import BusError, MessageError
from ..topics import find_topic
from .about import About
from .errors import BagError, BagTopicError, BagVersionError
from .index import BagFile
from .layout import bag_files
from .message_schema import MessageSchema, why_unreadable
from .records import ChannelInfo, Entry
from .stored import RawMessage, Recorded, unpack_parts
from .streams import Stream, StreamCounts, StreamKey, join_streams
from .summary import AttachmentSummary, BagSummary, FileSummary, topic_summaries


class _Place(NamedTuple):
    """A chunk and which of its channels are wanted."""

    start_ns: int
    number: int
    """Of all chunks of the bag, in the order in which they were written."""
    file: BagFile
    chunk: ChunkIndex
    wanted: frozenset[int]


class BagReader:
    """Reads one bag: a file or a folder of the files that a recording was split into.

    Memory holds a chunk at a time, or as many as overlap in time. Every checksum that covers what
    is read is verified.

    Parameters
    ----------
    path
        A file, or a folder with the files of one recording.

    Raises
    ------
    BagError
        One of its kinds, if there is no whole bag of ours; the text says what to do.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.files = _open_files(self.path)
        self._unreadable: dict[tuple[str, MessageSchema], str] = {}

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Do nothing: no file stays open between calls."""

    # -- what is in it

    @property
    def about(self) -> About:
        """Where the bag comes from."""
        return self.files[0].about

    @property
    def start_ns(self) -> int:
        """Log time of the first message; 0 without messages."""
        found = [f.statistics.message_start_time for f in self.files if f.chunks]
        return min(found, default=0)

    @property
    def end_ns(self) -> int:
        """Log time of the last message; 0 without messages."""
        return max((f.statistics.message_end_time for f in self.files if f.chunks), default=0)

    def topics(self) -> tuple[str, ...]:
        """Return the topics that have messages, sorted."""
        counts = [(f, n) for f in self.files for n in f.statistics.channel_message_counts]
        return tuple(sorted({f.channels[n].topic for f, n in counts if n in f.channels}))

    def summary(self, *, recount: bool = False) -> BagSummary:
        """Return what the index tells; no chunk is read unless ``recount`` asks for it."""
        streams = self._recount() if recount else self._counted()
        qualities = {c.topic: c.quality for f in self.files for c in f.channels.values()}
        files = tuple(
            FileSummary(
                path=file.path,
                split=file.split,
                size_bytes=file.size_bytes,
                start_ns=file.statistics.message_start_time,
                end_ns=file.statistics.message_end_time,
                messages=file.statistics.message_count,
                chunks=len(file.chunks),
            )
            for file in self.files
        )
        return BagSummary(
            path=self.path,
            about=self.about,
            files=files,
            start_ns=self.start_ns,
            end_ns=self.end_ns,
            messages=sum(stream.messages for stream in streams),
            topics=topic_summaries(streams, qualities),
            streams=streams,
            clock_jumps=tuple(jump for file in self.files for jump in file.clock_jumps()),
            attachments=tuple(
                AttachmentSummary(index.name, index.media_type, index.data_size)
                for _, index in sorted(self._attachments().values(), key=lambda pair: pair[1].name)
            ),
        )

    def attachments(self) -> dict[str, bytes]:
        """Return all attachments by name; of one that was given again, the last."""
        return {name: file.attachment(index) for name, (file, index) in self._attachments().items()}

    def attachment(self, name: str) -> bytes:
        """Return one attachment.

        Raises
        ------
        BagError
            If there is none of that name; the text lists those that are.
        """
        found = self._attachments()
        if name not in found:
            known = ", ".join(sorted(found)) or "none"
            raise BagError(self.path, f"has no attachment {name!r}; it has: {known}")
        file, index = found[name]
        return file.attachment(index)

    # -- messages

    @overload
    def messages(
        self,
        topics: Iterable[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
        *,
        raw: Literal[False] = False,
    ) -> Iterator[Recorded]: ...

    @overload
    def messages(
        self,
        topics: Iterable[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
        *,
        raw: Literal[True],
    ) -> Iterator[RawMessage]: ...

    def messages(
        self,
        topics: Iterable[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
        *,
        raw: bool = False,
    ) -> Iterator[Recorded] | Iterator[RawMessage]:
        """Return an iterator over messages in the order of log time, then of recording.

        Parameters
        ----------
        topics
            Full names; None: all. One that the table of topics knows may be missing in the bag.
        start_ns, end_ns
            Log times: from ``start_ns`` on, before ``end_ns``.
        raw
            Yield :class:`RawMessage`, not decoded.

        Raises
        ------
        BagTopicError
            At once, if nobody knows a topic.
        BagDamagedError, BagVersionError
            From the iterator, where a chunk is damaged or a message can't be read.
        """
        places = self._places(self._wanted(topics), start_ns, end_ns)
        found = self._read(places, start_ns, end_ns)
        if raw:
            return (_raw(channel, entry, data) for _, channel, entry, data in found)
        return (self._decode(file, channel, entry, data) for file, channel, entry, data in found)

    def last_before(self, topics: Iterable[str], time_ns: int) -> list[Recorded]:
        """Return each publisher's last message on each topic with a log time before ``time_ns``.

        That is what a reader would know of latched topics after a seek. In order of log time.
        """
        return [self._decode(*found) for found in self._last_before(topics, time_ns)]

    def last_raw_before(self, topics: Iterable[str], time_ns: int) -> list[RawMessage]:
        """Return the same as :meth:`last_before`, not decoded."""
        return [_raw(*found[1:]) for found in self._last_before(topics, time_ns)]

    # -- inside

    def _attachments(self) -> dict[str, tuple[BagFile, AttachmentIndex]]:
        return {index.name: (file, index) for file in self.files for index in file.attachments}

    def _counted(self) -> tuple[Stream, ...]:
        """Return the counts that the recorder kept; a file without them is read through."""
        kept = [file.streams() for file in self.files]
        if any(part is None for part in kept):
            return self._recount()
        return join_streams(stream for part in kept if part for stream in part)

    def _recount(self) -> tuple[Stream, ...]:
        counts = StreamCounts()
        for message in self.messages(raw=True):
            if message.repeated:
                continue
            try:
                header = message.header()
            except MessageError:
                continue  # the writer did not count it either; 'check' tells it
            counts.add(
                StreamKey(message.topic, header.publisher, header.incarnation),
                message.schema.type_name,
                header.sequence,
                message.log_time_ns,
                len(message.data),
            )
        return counts.all()

    def _wanted(self, topics: Iterable[str] | None) -> Callable[[BagFile, ChannelInfo], bool]:
        """Return what tells the wanted channels; latched state is told once, where it begins."""
        first = self.files[0] if self.files else None
        if topics is None:
            return lambda file, channel: file is first or not channel.repeated
        asked = frozenset([topics] if isinstance(topics, str) else topics)
        known = {channel.topic for file in self.files for channel in file.channels.values()}
        for topic in sorted(asked - known):
            try:
                find_topic(topic)
            except BusError as error:
                names = ", ".join(sorted(known)) or "none"
                raise BagTopicError(
                    self.path, f"has no topic {topic!r}; there are: {names}"
                ) from error
        return lambda file, channel: (
            channel.topic in asked and (file is first or not channel.repeated)
        )

    def _places(
        self,
        wanted: Callable[[BagFile, ChannelInfo], bool],
        start_ns: int | None,
        end_ns: int | None,
    ) -> list[_Place]:
        """Return the chunks that may hold such messages, by their first log time."""
        found, number = [], 0
        for file in self.files:
            channels = frozenset(n for n, channel in file.channels.items() if wanted(file, channel))
            for index in file.chunks:
                number += 1
                if (start_ns is None or index.message_end_time >= start_ns) and (
                    end_ns is None or index.message_start_time < end_ns
                ):
                    mine = channels & index.message_index_offsets.keys()
                    if mine:
                        found.append(_Place(index.message_start_time, number, file, index, mine))
        found.sort(key=lambda place: place[:2])
        return found

    def _read(
        self, places: list[_Place], start_ns: int | None, end_ns: int | None
    ) -> Iterator[_Found]:
        """Yield the messages of chunks in order; a chunk is read when its first one is due."""
        live: list[tuple[int, int, int, _Loaded]] = []
        waiting = iter(places)
        following = next(waiting, None)
        while live or following is not None:
            while following is not None and (not live or following.start_ns <= live[0][0]):
                loaded = _Loaded(following, start_ns, end_ns)
                if loaded.entries:
                    heapq.heappush(live, (*loaded.key(), loaded))
                following = next(waiting, None)
            if not live:
                return
            loaded = live[0][3]
            yield loaded.take()
            if loaded.entries:
                heapq.heapreplace(live, (*loaded.key(), loaded))
            else:
                heapq.heappop(live)

    def _last_before(self, topics: Iterable[str], time_ns: int) -> list[_Found]:
        places = self._places(self._wanted(topics), None, time_ns)
        places.sort(key=lambda place: (place.chunk.message_end_time, place.number), reverse=True)
        best: dict[tuple[str, str], tuple[tuple[int, int, int], _Found]] = {}
        for place in places:
            mine = [place.file.channels[number] for number in place.wanted]
            if all(
                (c.topic, c.publisher) in best
                and best[c.topic, c.publisher][0][0] > place.chunk.message_end_time
                for c in mine
            ):
                continue
            plain, entries = place.file.chunk(place.chunk, place.wanted)
            for entry in entries:
                channel = place.file.channels[entry.channel]
                key = (channel.topic, channel.publisher)
                order = (entry.log_time_ns, place.number, entry.offset)
                if entry.log_time_ns < time_ns and (key not in best or best[key][0] < order):
                    # a copy: the chunk need not be kept
                    data = memoryview(bytes(plain[entry.offset : entry.end]))
                    best[key] = (order, (place.file, channel, entry, data))
        return [found for _, found in sorted(best.values(), key=lambda pair: pair[0])]

    def _decode(
        self, file: BagFile, channel: ChannelInfo, entry: Entry, data: memoryview
    ) -> Recorded:
        key = (channel.topic, channel.schema)
        why = self._unreadable.get(key)
        if why is None:
            why = self._unreadable[key] = why_unreadable(channel.topic, channel.schema)
        if why:
            raise BagVersionError(
                file.path,
                f"{channel.topic}: {why}, or leave it out: 'tvbrdf bag filter --exclude "
                f"{channel.topic}'",
            )
        try:
            return Recorded(entry.log_time_ns, decode(unpack_parts(data)))
        except MessageError as error:
            raise file.damaged(f"{channel.topic} at {entry.log_time_ns}: {error}") from error


_Found = tuple[BagFile, ChannelInfo, Entry, memoryview]
"""A message as it was found in a file; it holds its chunk."""


class _Loaded:
    """A chunk in memory, and which of its messages are still to be told, the next one last."""

    def __init__(self, place: _Place, start_ns: int | None, end_ns: int | None) -> None:
        self.file, self.number = place.file, place.number
        self.plain, entries = place.file.chunk(place.chunk, place.wanted)
        self.entries = [
            entry
            for entry in reversed(entries)
            if (start_ns is None or entry.log_time_ns >= start_ns)
            and (end_ns is None or entry.log_time_ns < end_ns)
        ]

    def key(self) -> tuple[int, int, int]:
        entry = self.entries[-1]
        return entry.log_time_ns, self.number, entry.offset

    def take(self) -> _Found:
        entry = self.entries.pop()
        channel = self.file.channels[entry.channel]
        return self.file, channel, entry, self.plain[entry.offset : entry.end]


def _raw(channel: ChannelInfo, entry: Entry, data: memoryview) -> RawMessage:
    return RawMessage(
        entry.log_time_ns,
        entry.publish_time_ns,
        entry.sequence,
        channel.topic,
        channel.publisher,
        channel.repeated,
        channel.schema,
        bytes(data),
    )


def _open_files(path: Path) -> tuple[BagFile, ...]:
    files = sorted((BagFile(one) for one in bag_files(path)), key=lambda file: file.split)
    first = files[0]
    for before, file in pairwise(files):
        if file.about.recording != first.about.recording:
            raise BagError(
                path,
                f"{file.path.name} and {first.path.name} are of different recordings: put each "
                "into a folder of its own, or name the files one by one",
            )
        if file.split != before.split + 1:
            raise BagError(
                path,
                f"of its files, number {before.split + 1} is missing: put it back, or put what "
                f"there is together with 'tvbrdf bag merge'",
            )
    return tuple(files)
