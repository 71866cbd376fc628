"""Bags out of bags: a selection of one, or several together."""

from __future__ import annotations

import bisect
import dataclasses
import heapq
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ..envelope import Header
from ..errors import MessageError
from .about import About
from .errors import BagDamagedError, BagError, BagTopicError
from .output import NewBag
from .part import known_topic
from .reader import BagReader
from .stored import RawMessage
from .streams import StreamKey
from .topic_filter import TopicFilter


@dataclass(slots=True)
class EditReport:
    """What came of making a bag."""

    out: Path
    messages: int = 0
    left_out: int = 0
    """Of a merge: messages that had come already. Of a filter: those not selected."""
    topics: dict[str, int] = field(default_factory=dict)
    """Messages of each topic."""
    removed: tuple[Path, ...] = ()
    """What others that were killed had left of the same output."""

    def count(self, message: RawMessage) -> None:
        """Count a message that was written."""
        self.messages += 1
        self.topics[message.topic] = self.topics.get(message.topic, 0) + 1

    def plain(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        removed = [str(each) for each in self.removed]
        return {**asdict(self), "out": str(self.out), "removed": removed}


def filter_bag(
    path: str | Path,
    out: str | Path,
    *,
    topics: Iterable[str] | None = None,
    regex: str | None = None,
    exclude: str | None = None,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> EditReport:
    """Write a selection of a bag's messages, and its attachments, into a new bag.

    Parameters
    ----------
    path, out
        A bag, and a new one.
    topics, regex, exclude
        See :class:`~tvbrdf_messages.bag.topic_filter.TopicFilter`.
    start_ns, end_ns
        Log times: from ``start_ns`` on, before ``end_ns``. Latched messages of before are repeated
        at the beginning.

    Raises
    ------
    BagError
        If a topic is unknown, nothing is selected, or a bag can't be read or written.
    """
    wanted = TopicFilter(topics, regex, exclude)
    report = EditReport(Path(out))
    with BagReader(path) as reader:
        have = reader.topics()
        for topic in sorted(wanted.topics - set(have)):
            raise BagTopicError(path, f"has no topic {topic!r}; there are: {', '.join(have)}")
        chosen = [topic for topic in have if wanted(topic)]
        with NewBag(report.out, _made("filtered", reader.about, path), reader.attachments()) as bag:
            report.removed = bag.removed
            if start_ns is not None:
                latched = [topic for topic in chosen if _is_latched(topic)]
                for message in reader.last_raw_before(latched, start_ns):
                    bag.add(message._replace(log_time_ns=start_ns, repeated=True))
            for message in reader.messages(chosen, start_ns, end_ns, raw=True):
                bag.add(message)
                report.count(message)
            if not report.messages:
                raise BagError(path, "has no message of those topics at that time")
        report.left_out = reader.summary().messages - report.messages
    return report


def merge_bags(
    paths: Sequence[str | Path], out: str | Path, *, different_runs: bool = False
) -> EditReport:
    """Write the messages of several bags into a new one, in the order of log time.

    Within a run a message that is in several bags, or several times in one, is written once: the
    first, by log time, with its topic, publisher, incarnation and sequence number. Attachments of
    one name are written once if they are the same, else the second bag's gets ``.2`` in its name.

    Parameters
    ----------
    paths
        Bags: files or folders.
    out
        A new bag.
    different_runs
        Whether they may be of different runs. Nothing is then left out across runs, and attachments
        of one name are told apart by their number.

    Raises
    ------
    BagError
        If the runs are different without permission, or a bag can't be read or written.
    """
    if not paths:
        raise BagError(out, "nothing to merge: name the bags")
    report = EditReport(Path(out))
    with ExitStack() as stack:
        readers = [stack.enter_context(BagReader(path)) for path in paths]
        runs = [reader.about.run or reader.about.recording for reader in readers]
        if len(set(runs)) > 1 and not different_runs:
            other = next(k for k, run in enumerate(runs) if run != runs[0])
            raise BagError(
                paths[other],
                f"is of run {runs[other]!r}, {paths[0]} of {runs[0]!r}; if they are to be in one "
                "bag nevertheless, say so with --different-runs",
            )
        about = _made("merged", readers[0].about, *paths)
        if len(set(runs)) > 1:
            about = dataclasses.replace(about, run="")
        seen: dict[tuple[str, StreamKey], _Seen] = {}
        with NewBag(report.out, about, _join_attachments(readers)) as bag:
            report.removed = bag.removed
            for run, message in heapq.merge(
                *(_of_run(run, reader) for run, reader in zip(runs, readers, strict=True)),
                key=lambda pair: pair[1].log_time_ns,
            ):
                header = _header(report.out, message)
                key = (run, StreamKey(message.topic, header.publisher, header.incarnation))
                if seen.setdefault(key, _Seen()).add(header.sequence):
                    bag.add(message)
                    report.count(message)
                else:
                    report.left_out += 1
    return report


def _header(out: Path, message: RawMessage) -> Header:
    try:
        return message.header()
    except MessageError as error:
        raise BagDamagedError(
            out,
            f"{message.topic} at {message.log_time_ns}: {error}; 'tvbrdf bag check' tells which "
            "bag it is in",
        ) from error


def _of_run(run: str, reader: BagReader) -> Iterator[tuple[str, RawMessage]]:
    for message in reader.messages(raw=True):
        yield run, message


def _made(verb: str, about: About, *paths: str | Path) -> About:
    """Return where a bag comes from that was made of others; it is a recording of its own."""
    names = ", ".join(Path(path).name for path in paths)
    return About(
        run=about.run,
        host=about.host,
        created_ns=about.created_ns,
        version=about.version,
        extra={**about.extra, verb: f"from {names}"},
    )


def _is_latched(topic: str) -> bool:
    row = known_topic(topic)
    return row is not None and row.latched


def _join_attachments(readers: Sequence[BagReader]) -> dict[str, bytes]:
    found: dict[str, bytes] = {}
    for number, reader in enumerate(readers, 1):
        for name, data in reader.attachments().items():
            if found.get(name, data) == data:
                found[name] = data
            else:
                stem, dot, suffix = name.rpartition(".")
                found[f"{stem}.{number}.{suffix}" if dot else f"{name}.{number}"] = data
    return found


class _Seen:
    """The sequence numbers that have come, as intervals: few, since publishers count up."""

    def __init__(self) -> None:
        self._starts: list[int] = []
        self._ends: list[int] = []  # the number behind each interval

    def add(self, number: int) -> bool:
        """Take a number; return whether it is new."""
        k = bisect.bisect_right(self._starts, number) - 1
        if k >= 0 and number < self._ends[k]:
            return False
        joins_before = k >= 0 and number == self._ends[k]
        joins_after = k + 1 < len(self._starts) and number + 1 == self._starts[k + 1]
        if joins_before and joins_after:
            self._ends[k] = self._ends.pop(k + 1)
            self._starts.pop(k + 1)
        elif joins_before:
            self._ends[k] += 1
        elif joins_after:
            self._starts[k + 1] = number
        else:
            self._starts.insert(k + 1, number)
            self._ends.insert(k + 1, number + 1)
        return True
