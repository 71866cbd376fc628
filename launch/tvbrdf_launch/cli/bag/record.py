"""``tvbrdf bag record``: record a run that is under way, from outside."""

from __future__ import annotations

import argparse
import contextlib
import math
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._common import (
    Subparsers,
    add_json_option,
    add_run_option,
    add_verb,
    is_going_on,
    open_run,
    positive,
    print_json,
    print_table,
    require_going_on,
)
from ._options import add_topic_options

if TYPE_CHECKING:
    from tvbrdf_messages.bag import BagWriter
    from tvbrdf_messages.bus.watcher import Watcher
    from tvbrdf_messages.run_directory import Graph

LOOK_MS = 200
"""How often it is looked whether to go on."""
REST_S = 0.2
"""After that long without a message, an ended run has said everything."""
TEXT = (
    "record a run that is under way, until Ctrl-C or its end. It looks on as tools do and never "
    "slows the run, so it may miss messages, above all frames; gaps are counted and told. For a "
    "recording of all frames give the run a recorder of its own: tvbrdf launch ... record:=BAG"
)


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "record", run, TEXT)
    add_topic_options(parser)
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        metavar="BAG",
        help="a new file (NAME.mcap), or a new folder (NAME); default: a folder named by the time",
    )
    parser.add_argument("--split-s", type=positive, metavar="SECONDS", help="begin a new file then")
    parser.add_argument("--split-mb", type=positive, metavar="MB", help="begin a new file then")
    parser.add_argument(
        "--floor-free-mb",
        type=positive,
        default=256.0,
        metavar="MB",
        help="end when less of the disk is free (default %(default)g)",
    )
    parser.add_argument("--compression", choices=("lz4", "none"), default="lz4")
    parser.add_argument(
        "--duration", type=positive, metavar="SECONDS", help="end after that much real time"
    )
    add_run_option(parser)
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from tvbrdf_messages.bag import BagError, BagWriter
    from tvbrdf_nodes.recorder.attachments import about_run, attachments_of_run

    run_directory, graph = open_run(arguments)
    require_going_on(run_directory)
    topics = _topics(graph, arguments)
    path = arguments.out or Path(time.strftime("bag_%Y%m%d-%H%M%S"))
    writer = BagWriter(
        path,
        about=about_run(graph, {"recorder": "tvbrdf bag record"}),
        attachments=attachments_of_run(graph),
        compression=arguments.compression,
        split_s=arguments.split_s,
        split_bytes=None if arguments.split_mb is None else round(1e6 * arguments.split_mb),
        floor_free_bytes=round(1e6 * arguments.floor_free_mb),
    )
    failed: BagError | None = None
    with _Until(arguments.duration) as until:
        if not arguments.json:
            print(f"records {len(topics)} topics into {path}; Ctrl-C ends it", flush=True)
        try:
            with writer:
                _record(graph, topics, writer, until.over, run_directory)
        except BagError as error:
            failed = error
    _summary(writer, arguments.json)
    if failed is not None:
        raise failed
    return 0


def _topics(graph: Graph, arguments: argparse.Namespace) -> list[str]:
    """Return the topics that are meant, of those that somebody gives."""
    from tvbrdf_messages.bag.topic_filter import TopicFilter
    from tvbrdf_messages.topics import find_topic

    from ...errors import RunError, did_you_mean

    given = {topic for topic in graph.topics() if graph.publishers(topic)} - {"/clock"}
    for topic in arguments.topics or ():
        if topic not in given:
            raise RunError(f"nobody gives {topic!r} in this run; {did_you_mean(topic, given)}")
    wanted = TopicFilter(arguments.topics, arguments.regex, arguments.exclude)
    by_table = arguments.topics is None and arguments.regex is None
    found = sorted(t for t in given if wanted(t) and (find_topic(t).recorded or not by_table))
    if not found:
        raise RunError("no topic of this run is meant; see tvbrdf topic list")
    return found


def _record(
    graph: Graph, topics: list[str], writer: BagWriter, over: Callable[[], bool], run: Path
) -> None:
    """Record until it is over or the run has ended."""
    import zmq

    from tvbrdf_messages.bus.watcher import Watcher
    from tvbrdf_messages.clock import RunClock, SystemClock, ToldClock
    from tvbrdf_messages.messages import Clock
    from tvbrdf_nodes.recorder.log_times import LogTimes

    told = ToldClock(graph.utc_ns)
    clock: RunClock = told if graph.simulated else SystemClock(graph.utc_ns, graph.monotonic_ns)
    times = LogTimes(graph, clock)
    # frames have a short queue, which must not be that of the rest
    frames = [topic for topic in topics if topic.endswith("/frame")]
    rest = [topic for topic in topics if topic not in frames]
    if graph.publishers("/clock"):
        rest.append("/clock")
    with contextlib.ExitStack() as stack:
        watchers = [stack.enter_context(Watcher(graph, part)) for part in (rest, frames) if part]
        poller = zmq.Poller()
        for watcher in watchers:
            poller.register(watcher.socket, zmq.POLLIN)
        flush_s, quiet_s = time.monotonic() + 1.0, time.monotonic()
        while not over():
            poller.poll(LOOK_MS)
            for envelope in _arrived(watchers):
                quiet_s = time.monotonic()
                if envelope.topic == "/clock":
                    if isinstance(envelope.message, Clock):
                        told.tell(envelope.message.now_ns, envelope.message.epoch)
                    continue
                for each in times.take(envelope):
                    writer.write_envelope(each.envelope, each.log_time_ns)
            now_s = time.monotonic()
            if now_s >= flush_s:
                flush_s = now_s + 1.0
                for each in times.release():
                    writer.write_envelope(each.envelope, each.log_time_ns)
                writer.flush()
            if now_s - quiet_s > REST_S and not is_going_on(run):
                break
        for each in times.release():
            writer.write_envelope(each.envelope, each.log_time_ns)


def _arrived(watchers: list[Watcher]) -> Iterator[Any]:
    """Yield what has come, in turns."""
    for watcher in watchers:
        for _ in range(256):
            arrival = watcher.receive(0)
            if arrival is None:
                break
            yield arrival.envelope


class _Until:
    """Says when it is time to end: after a duration, or on Ctrl-C or SIGTERM, also in mid-write."""

    def __init__(self, duration_s: float | None) -> None:
        self._end_s = time.monotonic() + (duration_s or math.inf)
        self._told = False
        self._old: dict[int, Any] = {}

    def __enter__(self) -> _Until:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._old[number] = signal.signal(number, self._tell)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _tell(self, *_: object) -> None:
        self._told = True

    def over(self) -> bool:
        return self._told or time.monotonic() >= self._end_s


def _summary(writer: BagWriter, as_json: bool) -> None:
    """Print what was recorded, and what is missing."""
    from ...text import size

    rows: dict[str, dict[str, Any]] = {}
    for stream in writer.streams():
        row = rows.setdefault(stream.topic, {"topic": stream.topic, "messages": 0, "lost": 0})
        row["messages"] += stream.messages
        row["lost"] += stream.lost
    lost = sum(row["lost"] for row in rows.values())
    if as_json:
        files = [str(path) for path in writer.files]
        counted = {"bytes": writer.size_bytes, "lost": lost, "topics": list(rows.values())}
        print_json({"path": str(writer.path), "files": files, **counted})
        return
    messages = sum(row["messages"] for row in rows.values())
    gaps = f"{lost} messages lost in between" if lost else "no gaps"
    print(f"{writer.path}: {messages} messages, {size(writer.size_bytes)}, {gaps}")
    if rows:
        print_table(list(rows.values()), ("topic", "messages", "lost"))
