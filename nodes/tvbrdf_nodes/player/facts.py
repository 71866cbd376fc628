"""What a bag tells of the run that was recorded: what its merger and database writer were given."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tvbrdf_messages.bag import LAUNCH, BagError, BagReader
from tvbrdf_messages.run_directory import GRAPH_FILE

from .selection import cameras_of, command_topic

_MERGER, _WRITER = "HdrMergerNode", "DatabaseWriterNode"


@dataclass(frozen=True, slots=True, kw_only=True)
class BagFacts:
    """Facts of the recorded run, from its graph inside the bag or else from its messages."""

    sample: str
    process: str
    cameras: tuple[str, ...]
    """In the calibration's order."""
    arm: str
    bit_depth: int | None
    """Of the frames; None: the calibration's."""
    correct_motion_blur: bool

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return what can be asked for."""
        return tuple(cls.__dataclass_fields__)


def bag_facts(path: str | Path) -> BagFacts:
    """Return the facts.

    Raises
    ------
    BagError
        If the bag can't be read.
    """
    with BagReader(path) as bag:
        merger, writer = _given(bag, _MERGER), _given(bag, _WRITER)
        return BagFacts(
            sample=str(writer.get("sample") or _sample(bag)),
            process=str(writer.get("process", "")),
            cameras=tuple(merger.get("cameras") or cameras_of(bag.topics())),
            arm=str(merger.get("arm") or _arm(bag)),
            bit_depth=merger["bit_depth"] if "bit_depth" in merger else _bit_depth(bag),
            correct_motion_blur=bool(merger.get("correct_motion_blur", True)),
        )


def _given(bag: BagReader, node: str) -> dict[str, Any]:
    """Return the parameters of the run's node of that class; none without a graph inside."""
    name = f"{LAUNCH}/{GRAPH_FILE}"
    if name not in {each.name for each in bag.summary().attachments}:
        return {}
    try:
        graph = json.loads(bag.attachment(name))
        for participant in graph["participants"]:
            if participant["node"].endswith(f":{node}"):
                return dict(participant["parameters"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise BagError(
            bag.path, f"its attachment {name} is no graph of a run: {error!r}"
        ) from error
    return {}


def _sample(bag: BagReader) -> str:
    """Return the sample that the first message names which is about one."""
    topics = (command_topic(bag.topics()), "/scan/radiance", "/scan/parameters", "/scan/missing")
    for _, envelope in bag.messages(topics):
        sample = str(getattr(envelope.message, "sample", ""))
        if sample:
            return sample
    return ""


def _arm(bag: BagReader) -> str:
    streams = bag.summary().streams
    return next((each.publisher for each in streams if each.topic == "/arm/state"), "arm")


def _bit_depth(bag: BagReader) -> int | None:
    topics = [
        f"/{camera}/{end}" for camera in cameras_of(bag.topics()) for end in ("info", "frame")
    ]
    for _, envelope in bag.messages(topics):
        return int(getattr(envelope.message, "bit_depth", 0)) or None
    return None
