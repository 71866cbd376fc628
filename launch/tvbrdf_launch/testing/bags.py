"""Bags of a test: opened, or written from what a run said or a test made up."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from tvbrdf_messages.bag import BagReader, BagWriter
from tvbrdf_messages.envelope import Envelope, Header, boot_id, host_name, new_incarnation
from tvbrdf_messages.schema import Message
from tvbrdf_messages.topics import find_topic
from tvbrdf_nodes.core.loading import NODES
from tvbrdf_nodes.recorder.attachments import attachments_of_run

from .errors import MisuseError, unknown
from .run import Run, Told

START_NS = 1_800_000_000_000_000_000
STEP_NS = 1_000_000
"""Between messages of which only the order is given."""
Entry = Envelope | tuple[str, Message]


class Bag:
    """A bag; a path wherever one is wanted (``os.fspath``)."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with BagReader(path) as bag:
            self.topics = tuple(sorted(bag.topics()))
            """Names of the topics in it."""

    def __fspath__(self) -> str:
        return str(self.path)

    def __str__(self) -> str:
        return str(self.path)

    def __iter__(self) -> Iterator[Envelope]:
        """Yield all messages in order."""
        return iter(self.envelopes())

    def envelopes(self, *topics: str) -> list[Envelope]:
        """Return the messages of some topics, or of all, with their headers."""
        for topic in topics:
            if topic not in self.topics:
                raise unknown(f"topic of {self.path.name}", topic, self.topics)
        with BagReader(self.path) as bag:
            return [envelope for _, envelope in bag.messages(topics=topics or None)]

    def messages(self, topic: str) -> list[Any]:
        """Return the messages of a topic."""
        return [envelope.message for envelope in self.envelopes(topic)]

    def player(self, **parameters: Any) -> tuple[str, dict[str, Any]]:
        """Return the node that plays it, for ``graph(player=bag.player(what="radiance"), ...)``.

        ``parameters`` are the player's; as fast as the readers take it by default.
        """
        return NODES["player"], {"bag": str(self.path), "rate": 0.0, **parameters}


class BagFactory:
    """Opens and writes bags.

    Parameters
    ----------
    folder
        Where bags are written, and looked for.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __call__(self, source: str | Path | Run | Iterable[Entry], name: str = "bag.mcap") -> Bag:
        """Open or write a bag.

        Parameters
        ----------
        source
            A path: that bag is opened. A run: what it said so far is written, with its calibration
            and graph (start it with ``keep_frames=True``). Messages, with their headers or as
            (topic, message): they are written in that order.
        name
            Of the bag that is written.

        Raises
        ------
        MisuseError
            If there is no such bag, or one is there already.
        BagError
            If it can't be read.
        """
        if isinstance(source, (str, Path)):
            return Bag(self._find(Path(source)))
        path = self._folder / name
        if path.exists():
            raise MisuseError(f"{path} is there already; give another name=")
        if isinstance(source, Run):
            if any(topic.endswith("/frame") for topic in source.counts) and not source.keep_frames:
                raise MisuseError("the run's frames were not kept; start it with keep_frames=True")
            _write(path, source.history, attachments_of_run(source.graph))
        else:
            _write(path, _with_headers(source), {})
        return Bag(path)

    def _find(self, given: Path) -> Path:
        path = self._folder / given
        if path.exists():
            return path
        folder = path.parent
        there = [p.name for p in folder.glob("*") if p.suffix == ".mcap" or any(p.glob("*.mcap"))]
        raise unknown("bag", given, there) from None


def _write(path: Path, told: Iterable[Told], attachments: dict[str, bytes]) -> None:
    with BagWriter(path, attachments=attachments, floor_free_bytes=0) as bag:
        for log_time_ns, envelope in told:
            if find_topic(envelope.topic).recorded:
                bag.write_envelope(envelope, log_time_ns)


def _with_headers(entries: Iterable[Entry]) -> Iterator[Told]:
    life = new_incarnation()
    sequences: defaultdict[str, int] = defaultdict(int)
    for index, entry in enumerate(entries):
        at_ns = START_NS + index * STEP_NS
        if isinstance(entry, Envelope):
            yield Told(at_ns, entry)
            continue
        topic, message = entry
        header = Header("test", life, host_name(), boot_id(), sequences[topic], at_ns)
        sequences[topic] += 1
        yield Told(at_ns, Envelope(topic, header, message))
