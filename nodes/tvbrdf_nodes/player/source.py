"""A bag as the player sees it: what is to be sent, in order, and what comes first after a jump."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgpack

from tvbrdf_messages.bag import BagError, BagReader, BagVersionError, RawMessage
from tvbrdf_messages.bag.message_schema import why_unreadable
from tvbrdf_messages.bag.streams import Stream, StreamKey
from tvbrdf_messages.codec import decode
from tvbrdf_messages.envelope import Envelope, epoch_of, in_epoch
from tvbrdf_messages.messages import Radiance
from tvbrdf_messages.topics import find_topic

from .read_ahead import Item, ReadAhead
from .selection import COMMAND, RADIANCE, TOLD_COMMAND, cameras_of, needed, preset, select

NOTED = frozenset(
    {
        COMMAND,
        TOLD_COMMAND,
        "/scan/sweep_result",
        "/scan/radiance",
        "/scan/missing",
        "/operator/mark",
    }
)
"""Recorded topics that are decoded here: by them the player knows what is to be stored."""


class BagSource:
    """Reads the chosen topics of a bag from any moment on.

    Parameters
    ----------
    path
        A bag: a file, or the folder of one in parts.
    what
        ``frames`` or ``radiance``: what the pipeline is fed with; empty: ``topics``.
    topics, remap
        See :func:`.selection.select`.

    Raises
    ------
    BagError
        If it can't be read, has nothing of what was asked for, or its clock jumps.
    SelectionError
        If something was asked for that is not played.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        what: str = "",
        topics: tuple[str, ...] = (),
        remap: Mapping[str, str] | None = None,
    ) -> None:
        self._reader = BagReader(path)
        recorded = self._reader.topics()
        if what:
            _require(self._reader, what)
            topics = preset(what, cameras_of(recorded))
        self.topics = select(recorded, topics, remap)
        """Names under which recorded topics are played."""
        self.lacking = tuple(sorted(set(self.topics) - set(recorded)))
        """Chosen topics of which the bag has nothing."""
        if not set(self.topics) & set(recorded):
            raise BagError(
                path, f"holds none of {', '.join(self.topics) or 'the topics that are played'}; "
                f"it has: {', '.join(recorded) or 'no messages'}"
            )  # fmt: skip
        _refuse_jumps(self._reader)
        self.first_ns, self.last_ns = self._reader.start_ns, self._reader.end_ns
        self._names = {old: new.encode() for old, new in self.topics.items()}
        self._readable: set[tuple[str, Any]] = set()
        self._latched = [topic for topic in self.topics if find_topic(topic).latched]

    def read_ahead(self, from_ns: int, until_ns: int, epoch: int) -> ReadAhead:
        """Begin to read messages with log times in a range, both ends included."""
        return ReadAhead(lambda: self._items(from_ns, until_ns, epoch))

    def latched_before(self, time_ns: int, epoch: int) -> list[Item]:
        """Return the state that was last told on latched topics before a moment."""
        if not self._latched:
            return []
        found = self._reader.last_raw_before(self._latched, time_ns)
        return [self._item(raw, epoch) for raw in found]

    def _items(self, from_ns: int, until_ns: int, epoch: int) -> Iterator[Item]:
        order = _Order(self._reader.path)
        radiances: set[tuple[str, int, int]] = set()
        for raw in self._reader.messages(self.topics, from_ns, until_ns + 1, raw=True):
            order.check(raw)
            item = self._item(raw, epoch)
            if item.envelope is not None and isinstance(item.envelope.message, Radiance):
                scan = item.envelope.message
                key = (scan.sample, scan.scan, scan.attempt)
                if key in radiances:
                    continue  # merger and database may both have sent a scan
                radiances.add(key)
            yield item

    def _item(self, raw: RawMessage, epoch: int) -> Item:
        self._check_version(raw)
        parts = raw.parts()
        parts[0] = self._names[raw.topic]
        if epoch > 1:
            parts[1] = _in_epoch(parts[1], epoch)
        envelope: Envelope | None = decode(parts) if raw.topic in NOTED else None
        return Item(raw.log_time_ns, parts, len(raw.data), envelope)

    def _check_version(self, raw: RawMessage) -> None:
        key = (raw.topic, raw.schema)
        if key in self._readable:
            return
        why = why_unreadable(raw.topic, raw.schema)
        if why:
            raise BagVersionError(
                self._reader.path, f"{raw.topic}: {why}, or play it without: choose other topics"
            )
        self._readable.add(key)


def _in_epoch(body: bytes, epoch: int) -> bytes:
    """Return a message's body with the epoch in its header."""
    header, *rest = msgpack.unpackb(body, strict_map_key=True)
    header[1] = in_epoch(header[1], epoch)
    packed: bytes = msgpack.packb([header, *rest])
    return packed


def _require(reader: BagReader, what: str) -> None:
    """Refuse a bag without what the pipeline needs."""
    recorded = reader.topics()
    missing = [topic for topic in needed(what, recorded) if topic not in recorded]
    if what != RADIANCE and not cameras_of(recorded):
        missing.append("/CAMERA/frame")
    if not missing:
        return
    other = ""
    if what != RADIANCE and RADIANCE in " ".join(recorded):
        other = "; it has /scan/radiance: replay that with from:=radiance"
    raise BagError(
        reader.path,
        f"can't be replayed from {what}: it has no {', '.join(missing)}"
        f"{other or '; record these topics, or choose another bag'}",
    )


def _refuse_jumps(reader: BagReader) -> None:
    """Refuse what was recorded from a replay that jumped: its times lie over each other."""
    lives = {(s.publisher, s.incarnation) for s in reader.summary().streams}
    jumped = sorted(publisher for publisher, life in lives if epoch_of(life))
    if jumped:
        raise BagError(
            reader.path,
            f"was recorded from a replay that looped or was moved: its clock jumps (in what "
            f"{jumped[0]} said); play the bag that was replayed, or record it again without",
        )


class _Order:
    """Notices a clock that went back while the bag was recorded: then numbers come too late."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._streams: dict[StreamKey, Stream] = {}

    def check(self, raw: RawMessage) -> None:
        header = raw.header()
        key = StreamKey(raw.topic, header.publisher, header.incarnation)
        stream = self._streams.get(key)
        if stream is None:
            stream = self._streams[key] = Stream(*key, type="")
        lost = stream.lost
        stream.add(header.sequence, raw.log_time_ns, len(raw.data))
        if stream.lost < lost:
            raise BagError(
                self._path,
                f"its clock jumps at {raw.log_time_ns} ns: {raw.topic} {header.sequence} of "
                f"{header.publisher} stands after later ones; cut it before that with "
                "'tvbrdf bag filter --end'",
            )
