"""Bags as a source: frames that are merged again, or the radiances that a run has published."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from tvbrdf_messages.bag import CALIBRATION, BagReader, attachment_kind
from tvbrdf_messages.bag.errors import BagError
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Frame, Radiance, ScanCommand, ScanMissing, SweepResult
from tvbrdf_messages.topics import frame_topic
from tvbrdf_nodes.player.selection import COMMAND, TOLD_COMMAND, command_topic
from tvbrdf_nodes.recorder.attachments import SOURCE_NAME

from .events import Aside, Event, Progress, Unfinished
from .pipeline import FITTER, MERGER, WRITER, Pipeline
from .records import MessageRanges, file_facts, outcome, parts_of, settings_text
from .settings import FRAMES, RADIANCE, CalibrationFile, Plan, Settings
from .sources import Unit

GRAPH_ATTACHMENT = "launch/graph.json"
"""The run's graph: every node with the parameters that it was started with."""
_FRAME_TOPIC = re.compile(r"/([a-z][a-z0-9_]*)/frame")


@dataclass(frozen=True)
class BagSource:
    """A bag: a file, or a folder of the files that a recording was split into."""

    path: Path
    keeps_radiance: bool = True

    def plan(self, settings: Settings) -> Plan:
        """Return the parameters that the run had, changed as asked.

        Raises
        ------
        BagError
            If the bag lacks what the nodes need; the text says what to give.
        """
        with BagReader(self.path) as bag:
            recorded = recorded_parameters(bag)
            fitter = settings.fitter(recorded.get(FITTER, {}))
            cameras = _cameras(bag)
            start = settings.start or (FRAMES if cameras else RADIANCE)
            if start == RADIANCE:
                self._check_radiance(bag, settings, cameras)
                return Plan(RADIANCE, fitter)
            self._check_frames(bag, cameras)
            merger = _merger(bag, recorded.get(MERGER), cameras)
            calibration = settings.calibration or self._calibration(bag, merger)
            merger.pop("calibration", None)
            return Plan(FRAMES, fitter, merger, calibration)

    def _check_radiance(self, bag: BagReader, settings: Settings, cameras: list[str]) -> None:
        if settings.calibration is not None:
            raise BagError(
                self.path, "a calibration changes nothing from radiances; give --from frames"
            )
        if "/scan/radiance" not in bag.topics():
            hint = "; leave --from radiance out" if cameras else ""
            raise BagError(
                self.path,
                "has no radiances (/scan/radiance) to refit"
                + (hint or " and no frames (/camera_N/frame); record at least one of them"),
            )

    def _check_frames(self, bag: BagReader, cameras: list[str]) -> None:
        topics = bag.topics()
        if not cameras:
            raise BagError(
                self.path,
                "has no frames (/camera_N/frame) to merge; "
                + (
                    "refit from its radiances: --from radiance"
                    if "/scan/radiance" in topics
                    else "it has no radiances either: there is nothing to refit"
                ),
            )
        missing = [topic for topic in _needed(topics) if topic not in topics]
        if missing:
            raise BagError(
                self.path,
                f"frames can't be merged without {', '.join(missing)}; record these topics too, "
                "or refit from radiances: --from radiance",
            )

    def _calibration(self, bag: BagReader, merger: Mapping[str, Any]) -> CalibrationFile:
        names = [n for n in sorted(bag.attachments()) if attachment_kind(n) == CALIBRATION]
        wanted = Path(str(merger.get("calibration", ""))).name
        named = [name for name in names if wanted and Path(name).name == wanted]
        chosen = named or names
        if len(chosen) != 1:
            what = f"several calibrations ({', '.join(chosen)})" if chosen else "no calibration"
            raise BagError(self.path, f"has {what} inside; give the rig's with --calibration FILE")
        return CalibrationFile(Path(chosen[0]).name, bag.attachment(chosen[0]))

    def facts(self) -> dict[str, Any]:
        """See :class:`~.sources.Source`."""
        with BagReader(self.path) as bag:
            files = [file_facts(file.path) for file in bag.summary().files]
            recorded = recorded_parameters(bag).get(WRITER, {})
            return {
                "sample": recorded.get("sample", ""),
                "process": recorded.get("process", ""),
                "start_ns": bag.start_ns,
                "run": bag.about.run,
                "recorded_with": bag.about.version,
                "files": files,
            } | _replay_of(bag)

    def hashes(self, scan: int) -> list[dict[str, Any]] | None:
        """See :class:`~.sources.Source`."""
        return None

    def units(self, jobs: int, sources: int, done: frozenset[int], plan: Plan) -> list[Unit]:
        """Return one share, or several where there are fewer bags than processes."""
        count = 1 if plan.sequential else max(1, -(-jobs // sources))
        return [Unit(None, done, (k, count), with_asides=k == 0) for k in range(count)]

    def work(self, unit: Unit, plan: Plan) -> Iterator[Event]:
        """See :class:`~.sources.Source`."""
        with BagReader(self.path) as bag:
            reading, settings = _Reading(bag, unit, plan), settings_text(plan)
            with Pipeline(plan, bag.start_ns) as pipeline:
                for fitted in pipeline.run(reading.envelopes()):
                    scan = getattr(fitted.parameters.message, "scan", 0)
                    reading.finished.add(scan)
                    messages = reading.ranges.take(scan)
                    yield outcome(
                        fitted,
                        self.path.resolve().name,
                        settings,
                        unit.files,
                        messages,
                        with_messages=True,
                    )
                    yield Progress(reading.fraction())
                yield from reading.unfinished(pipeline.broken)
            if unit.with_asides:
                for _, envelope in bag.messages(["/operator/mark"]):
                    yield Aside(parts_of(envelope))


class _Reading:
    """A bag's messages as merger or fitter takes them, and what they told of the scans."""

    def __init__(self, bag: BagReader, unit: Unit, plan: Plan) -> None:
        self._bag, self._unit, self._plan = bag, unit, plan
        self.ranges = MessageRanges(str(plan.merger.get("arm", "arm")))
        self.finished: set[int] = set()
        self._begun: dict[int, ScanCommand] = {}
        self._missing: dict[int, ScanMissing] = {}
        self._span = max(1, bag.end_ns - bag.start_ns)
        self._at_ns = bag.start_ns

    def fraction(self) -> float:
        """Return how far it has been read."""
        return (self._at_ns - self._bag.start_ns) / self._span

    def envelopes(self) -> Iterator[Envelope]:
        """Yield the messages of the wanted scans."""
        wanted = self._frames() if self._plan.start == FRAMES else self._radiances()
        for envelope in wanted:
            self.ranges.note(envelope)
            told = envelope.topic == TOLD_COMMAND
            yield envelope._replace(topic=COMMAND) if told else envelope

    def _messages(self, topics: Iterable[str]) -> Iterator[Envelope]:
        for log_time_ns, envelope in self._bag.messages([*topics]):
            self._at_ns = log_time_ns
            yield envelope

    def _radiances(self) -> Iterator[Envelope]:
        seen: set[int] = set()
        for envelope in self._messages(["/scan/radiance", "/scan/missing"]):
            message = envelope.message
            if isinstance(message, ScanMissing) and self._unit.wants(message.scan):
                self._missing[message.scan] = message
            elif (
                isinstance(message, Radiance)
                and message.scan not in seen
                and self._unit.wants(message.scan)
            ):
                seen.add(message.scan)  # the first is the one that a database keeps
                yield envelope

    def _frames(self) -> Iterator[Envelope]:
        cameras = self._plan.merger["cameras"]
        known = {*self._bag.topics()}
        topics = [*_needed(known), "/scan/missing", *(frame_topic(camera) for camera in cameras)]
        for envelope in self._messages([t for t in topics if t in known]):
            message = envelope.message
            if isinstance(message, (Frame, ScanCommand, SweepResult, ScanMissing)):
                if not self._unit.wants(message.scan) or message.scan < 1:
                    continue
                if isinstance(message, ScanMissing):
                    self._missing[message.scan] = message
                    continue
                if isinstance(message, ScanCommand) and message.action == "prepare":
                    self._begun[message.scan] = message
            if envelope.header.publisher != MERGER:
                yield envelope

    def unfinished(self, broken: Callable[[int], str]) -> Iterator[Unfinished]:
        """Yield the scans of which nothing came, with the reason."""
        for scan in sorted({*self._begun, *self._missing} - self.finished):
            lost = self._missing.get(scan)
            if lost is not None:
                yield Unfinished(scan, lost.sample, lost.scan_time_s, lost.reason)
                continue
            begun = self._begun[scan]
            reason = broken(scan) or "the bag does not have all of it"
            yield Unfinished(scan, begun.sample, begun.scan_time_s, reason)


def _needed(topics: Iterable[str]) -> tuple[str, ...]:
    """Return what frames can't be merged without; a replay has its commands on another topic."""
    return (command_topic(topics), "/scan/sweep_result", "/arm/state")


def _cameras(bag: BagReader) -> list[str]:
    names = [found[1] for topic in bag.topics() if (found := _FRAME_TOPIC.fullmatch(topic))]
    return sorted(names, key=lambda name: (len(name), name))


def _replay_of(bag: BagReader) -> dict[str, Any]:
    """Return which bag was played, if it is a replay that was recorded."""
    if SOURCE_NAME not in {one.name for one in bag.summary().attachments}:
        return {}
    try:
        return {"replay_of": json.loads(bag.attachment(SOURCE_NAME))}
    except ValueError as error:
        raise BagError(
            bag.path, f"its attachment {SOURCE_NAME} does not name a bag: {error}"
        ) from error


def recorded_parameters(bag: BagReader) -> dict[str, dict[str, Any]]:
    """Return the parameters of our nodes in the run, by short name; without a graph, none."""
    from tvbrdf_nodes.core.loading import node_class_path

    if GRAPH_ATTACHMENT not in {one.name for one in bag.summary().attachments}:
        return {}
    try:
        graph = json.loads(bag.attachment(GRAPH_ATTACHMENT))
        nodes = {each["node"]: each["parameters"] for each in graph["participants"]}
    except (ValueError, KeyError, TypeError) as error:
        raise BagError(
            bag.path, f"its attachment {GRAPH_ATTACHMENT} is no graph of a run: {error!r}"
        ) from error
    found = {name: nodes.get(node_class_path(name)) for name in (MERGER, FITTER, WRITER)}
    return {name: dict(given) for name, given in found.items() if given is not None}


def _merger(
    bag: BagReader, recorded: Mapping[str, Any] | None, cameras: list[str]
) -> dict[str, Any]:
    """Return the merger's parameters; without those of the run, what the messages tell."""
    from tvbrdf_nodes.hdr_merger.node import HdrMergerParameters

    if recorded is not None:
        known = {part.name for part in fields(HdrMergerParameters)}
        found = {name: value for name, value in recorded.items() if name in known}
        found.pop("replayed", None)  # who commanded changes nothing in what comes of it
        return {**found, "cameras": [*found.get("cameras", cameras)]}
    streams = bag.summary().streams
    arm = next((s.publisher for s in streams if s.topic == "/arm/state"), "arm")
    found = {"cameras": cameras, "arm": arm}
    for _, envelope in bag.messages([frame_topic(cameras[0])]):
        if isinstance(envelope.message, Frame):
            found["bit_depth"] = envelope.message.bit_depth
        break
    return found
