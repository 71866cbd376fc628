"""The published text layout, written by the database writer's own node: as in a live run."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tvbrdf_messages.bag import BagReader
from tvbrdf_messages.bag.errors import BagError
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Log, Radiance, Stored
from tvbrdf_nodes.core.device import DeviceError

from ..errors import RunError
from ..refit.pipeline import WRITER, NodesInProcess, graph_of
from .result import Progress, Tell, Written

TOPICS = ("/scan/radiance", "/scan/parameters", "/scan/missing", "/operator/mark")
_COUNTED = {"radiance": "scans", "parameters": "parameters", "missing": "missing"}


def lacks(bag: BagReader) -> str:
    """Return why a bag can't be exported as text; empty if it can."""
    if "/scan/radiance" in bag.topics():
        return ""
    return (
        "has no radiances (/scan/radiance) for the text layout; make them from its frames: "
        "'tvbrdf refit BAG --out DIR' writes the same layout"
    )


def write_text(bag: BagReader, folder: Path, recorded: dict[str, Any], tell: Tell) -> Written:
    """Write a database as a run does: ``sample01/`` in the published layout, and its catalogue.

    Parameters
    ----------
    folder
        A new one.
    recorded
        Parameters of the run's database writer, if they are known.

    Raises
    ------
    BagError
        If the bag has scans of more than one sample.
    RunError
        If writing fails.
    """
    sample = _only_sample(bag)
    parameters = {"path": str(folder), "sample": sample, "process": recorded.get("process", "")}
    written = Written("text", folder.name)
    progress = Progress(tell, bag.start_ns, bag.end_ns)
    try:
        with NodesInProcess(graph_of({WRITER: parameters}, bag.start_ns, str(folder))) as nodes:
            nodes.work()
            for log_time_ns, envelope in bag.messages(TOPICS):
                nodes.feed(envelope)
                _judge(nodes.work(), written)
                progress.at(log_time_ns)
            waiting = nodes.counter(WRITER, "waiting")
    except DeviceError as error:
        raise RunError(str(error)) from error
    if waiting:
        written.remarks.append(f"parameters of {waiting} scans: their radiance is not in the bag")
    if not written.counts.get("scans"):
        reasons = "; ".join(written.remarks)
        raise BagError(bag.path, f"none of its radiances can be written as text: {reasons}")
    return written


def _only_sample(bag: BagReader) -> str:
    samples = {
        envelope.message.sample
        for _, envelope in bag.messages(["/scan/radiance"])
        if isinstance(envelope.message, Radiance)
    }
    if len(samples) != 1:
        names = ", ".join(sorted(samples)) or "none"
        raise BagError(
            bag.path,
            f"has scans of {len(samples)} samples ({names}), and the text layout is of one; cut it "
            "with 'tvbrdf bag filter --start --end' and export the parts",
        )
    return samples.pop()


def _judge(said: Iterable[Envelope], written: Written) -> None:
    for envelope in said:
        message = envelope.message
        if isinstance(message, Log) and message.level == "error" and "trying again" in message.text:
            raise RunError(message.text.split("; trying again")[0])
        if not isinstance(message, Stored):
            continue
        if message.refused:
            written.remarks.append(f"scan {message.scan}, {message.what}: {message.refused}")
        elif not message.already and message.what in _COUNTED:
            written.count(_COUNTED[message.what])
