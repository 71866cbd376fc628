"""The recorder: writes what other nodes say into a bag, and never holds them up.

Unless it is ``required`` it is a *counted* reader: bounded, with gaps that are told and recorded. A
full disk or a write error ends the recording, not the measurement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.errors import BusError, MessageError
from tvbrdf_messages.messages import Frame, Mark
from tvbrdf_messages.run_directory import Graph
from tvbrdf_messages.topics import find_topic

from ..core.device import DeviceError
from ..core.node import GIVE_UP, Exit, Node, NodeContext, Outputs, TopicUse
from .log_times import LogTimes, Timed
from .parameters import RecorderParameters
from .record_book import COMPLETE, ENDED, BagEntry, RecordBook, describe_bag, topic_rows

if TYPE_CHECKING:
    from tvbrdf_messages.bag import BagError, BagWriter
    from tvbrdf_messages.bag.streams import StreamCounts

    from .regions import UsedRegions

FLUSH_S = 1.0
"""Of real time: a killed recorder loses no more than that."""
_FLUSH = "flush"


class RecorderNode(Node[RecorderParameters]):
    """Records topics into a bag from which the run can be refitted."""

    parameters_type = RecorderParameters
    drains = True
    hears_itself = True

    def __init__(self, context: NodeContext, parameters: RecorderParameters) -> None:
        super().__init__(context, parameters)
        self._book: RecordBook | None = None
        self._entry: BagEntry | None = None
        self._writer: BagWriter | None = None
        self._regions: UsedRegions | None = None
        self._came: StreamCounts | None = None
        self._marks: list[tuple[int, str, bool]] = []
        self._lacks_scene = False
        self._times = LogTimes(context.graph, context.clock)
        self._ended = ""
        """Why nothing more is recorded."""
        self._told = False
        self._counters = dict.fromkeys(("recorded", "not_recorded", "unfit"), 0)

    @classmethod
    def topics(cls, name: str, parameters: RecorderParameters) -> TopicUse:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return TopicUse(
            takes=("/clock",),
            gives=("/diagnostics", "/log"),
            selects=selection(parameters.topics, parameters.regex, parameters.exclude),
            counted_bytes=0 if parameters.required else round(1e6 * parameters.queue_mb),
        )

    @classmethod
    def notices(cls, name: str, parameters: RecorderParameters, graph: Graph) -> Iterable[str]:
        """Return what it will record and how much disk that needs; refuse a bag that exists."""
        from .disk_need import describe_need, disk_need

        path = Path(parameters.path)
        if path.exists():
            raise ValueError(f"{path} exists already; record into another bag, or remove it")
        topics = set(graph.find(name).takes)
        for topic in parameters.topics:
            if topic not in topics:
                raise ValueError(f"no other node of this run gives {topic}, so nothing to record")
        try:
            need = disk_need(graph, parameters, topics)
        except DeviceError as error:
            raise ValueError(str(error)) from error
        if need is None:
            return [f"records {len(topics) - 1} topics into {path}"]
        return describe_need(need, parameters)

    # -- life

    def prepare(self) -> None:
        """Begin the bag: the first life's as it was named, later ones' beside it."""
        from tvbrdf_messages.bag import BagError

        from .attachments import SCENE_NAME, about_run, attachments_of_run, scene_of_run
        from .regions import UsedRegions

        own, graph = self.parameters, self.context.graph
        if not own.full_frames and own.calibration:
            self._regions = UsedRegions(own.calibration, own.cameras, own.margin)
        frames = "all pixels" if self._regions is None else "what the calibration uses of each"
        extra = {"recorder": f"{self.context.name} {self.context.incarnation}", "frames": frames}
        try:
            self._book = RecordBook(graph, self.context.name)
            about, attachments = about_run(graph, extra), attachments_of_run(graph)
        except (ValueError, OSError, BagError) as error:
            raise DeviceError(f"can't record: {error}") from error
        self._lacks_scene = bool(graph.publishers("/sim/scene")) and SCENE_NAME not in attachments
        again = bool(self._book.entries)
        path = self._book.next_path(Path(own.path))
        self._open(path, about, attachments, again)
        if self._lacks_scene and scene_of_run(graph) is not None:
            self._attach_scene()

    def _open(self, path: Path, about: Any, attachments: dict[str, bytes], again: bool) -> None:
        from tvbrdf_messages.bag import BagError, BagWriter

        own = self.parameters
        assert self._book is not None
        try:
            self._writer = BagWriter(
                path,
                about=about,
                attachments=attachments,
                compression=own.compression,
                split_s=own.split_s or None,
                split_bytes=round(1e6 * own.split_mb) or None,
                floor_free_bytes=round(1e6 * own.floor_free_mb),
            )
        except BagError as error:
            if own.required or not again:
                raise DeviceError(str(error)) from error
            self._ended = str(error)  # the measurement goes on, so its recorder stays quiet
            return
        self._entry = self._book.begin(path)

    def start(self) -> Outputs:
        """Say where it records to."""
        self.context.set_watchdog(_FLUSH, FLUSH_S)
        if self._entry is None:
            self._tell()
            return
        topics = len(self.context.graph.find(self.context.name).takes) - 1
        self.context.log.info(f"records {topics} topics into {self._entry.path}")
        yield from ()

    def stop(self) -> Outputs:
        """Finish the bag and say what is in it."""
        for each in self._times.release():
            yield from self._record(each)
        writer = self._writer
        if writer is None:
            return
        from tvbrdf_messages.bag import BagError

        from .attachments import NOTES_NAME, notes_text

        try:
            if self._marks:
                writer.attach(NOTES_NAME, notes_text(self._marks))
            writer.close()
        except BagError as error:
            yield from self._end(error)
            return
        self._close_entry(COMPLETE)
        if self._entry is not None:
            self.context.log.info("; ".join([describe_bag(self._entry), *topic_rows(self._entry)]))

    # -- messages

    def handle(self, envelope: Envelope) -> Outputs:
        """Record a message, or hold it until the run's clock is known."""
        for each in self._times.take(envelope):
            yield from self._record(each)

    def _record(self, timed: Timed) -> Outputs:
        if self._writer is None:
            self._counters["not_recorded"] += 1
            return
        from tvbrdf_messages.bag import BagError

        log_time_ns, envelope = timed
        if self._is_again(envelope):
            return
        message = envelope.message
        if isinstance(message, Frame) and self._regions is not None:
            envelope = envelope._replace(message=self._regions.blanked(message))
        elif isinstance(message, Mark):
            self._marks.append((envelope.header.stamp_ns, message.text, message.zero))
        try:
            self._writer.write_envelope(envelope, log_time_ns)
            self._counters["recorded"] += 1
        except MessageError as error:
            if not self._counters["unfit"]:
                self.context.log.warning(f"can't be recorded: {error}")
            self._counters["unfit"] += 1
        except BagError as error:
            yield from self._end(error)

    def _is_again(self, envelope: Envelope) -> bool:
        """Whether it is a kept message that came again because somebody else began to look on."""
        from tvbrdf_messages.bag.streams import StreamCounts, StreamKey

        if self._came is None:
            self._came = StreamCounts()
        header = envelope.header
        stream = StreamKey(envelope.topic, header.publisher, header.incarnation)
        return not self._came.add_new(stream, header.sequence)

    def on_timer(self, name: str) -> Outputs:
        """Give what was recorded to the system."""
        self.context.set_watchdog(_FLUSH, FLUSH_S)
        for each in self._times.release():
            yield from self._record(each)
        if self._writer is None:
            return
        from tvbrdf_messages.bag import BagError

        try:
            if self._lacks_scene:
                self._attach_scene()
            self._writer.flush()
        except BagError as error:
            yield from self._end(error)

    def _attach_scene(self) -> None:
        from .attachments import SCENE_NAME, scene_of_run

        scene = scene_of_run(self.context.graph)
        if scene is not None and self._writer is not None:
            self._writer.attach(SCENE_NAME, scene)
            self._lacks_scene = False

    # -- ends

    def _end(self, error: BagError) -> Outputs:
        """Record no more: the bag's writer has ended it as well as the system allowed."""
        self._ended = str(error)
        self._close_entry(ENDED, error.text)
        self._tell()
        self._writer = None
        if self.parameters.required:
            yield Exit(code=GIVE_UP, text=f"{self._ended} (the run requires its recorder)")

    def _tell(self) -> None:
        if not self._told:
            self._told = True
            rest = "" if self.parameters.required else "; the run goes on without a recording"
            self.context.log.error(f"{self._ended}{rest}")

    def _close_entry(self, state: str, text: str = "") -> None:
        entry, writer = self._entry, self._writer
        if entry is None or writer is None or self._book is None:
            return
        entry.state, entry.text = state, text
        entry.bytes, entry.files = writer.size_bytes, len(writer.files)
        entry.messages, entry.lost = writer.counts(), _lost(writer)
        try:
            self._book.write()
        except OSError as error:  # the disk that is full may be this one
            self.context.log.warning(f"can't note down what was recorded: {error}")

    def diagnostics(self) -> dict[str, Any]:
        """Return counts of each topic, its gaps, and why recording has ended."""
        entry, writer = self._entry, self._writer
        told: dict[str, Any] = {
            **self._counters,
            "bag": entry.path if entry is not None else "",
            "recording": writer is not None,
            "ended": self._ended,
        }
        if writer is not None:
            told |= {
                "bag_bytes": writer.size_bytes,
                "bag_files": len(writer.files),
                "bag_messages": writer.counts(),
                "bag_lost": _lost(writer),
            }
        elif entry is not None:
            told |= {
                "bag_bytes": entry.bytes,
                "bag_files": entry.files,
                "bag_messages": dict(entry.messages),
                "bag_lost": dict(entry.lost),
            }
        return told


def selection(topics: Iterable[str], regex: str, exclude: str) -> Callable[[str], bool]:
    """Return what says whether a recorder takes a topic.

    Without names and ``regex`` it is what the table of topics marks as recorded. Never the clock,
    which a replay tells anew, nor what only simulated devices may read.
    """
    from tvbrdf_messages.bag.topic_filter import TopicFilter

    names = tuple(topics)
    wanted = TopicFilter(names or None, regex or None, exclude or None)
    by_table = not names and not regex

    def selects(topic: str) -> bool:
        try:
            row = find_topic(topic)
        except BusError:
            return False
        if topic == "/clock" or row.simulation or (by_table and not row.recorded):
            return False
        return wanted(topic)

    return selects


def _lost(writer: BagWriter) -> dict[str, int]:
    found: dict[str, int] = {}
    for stream in writer.streams():
        if stream.lost:
            found[stream.topic] = found.get(stream.topic, 0) + stream.lost
    return found
