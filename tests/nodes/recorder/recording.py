"""A recorder inside one process, and somebody who says things to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tests import sample_messages
from tests.messages.bag_samples import read
from tests.sample_messages import START_NS, noise
from tvbrdf_messages.messages import Diagnostics, Frame, Log
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_messages.schema import Message
from tvbrdf_nodes.core.inprocess import InProcessGraph
from tvbrdf_nodes.core.parameters import build
from tvbrdf_nodes.recorder.node import RecorderNode
from tvbrdf_nodes.recorder.parameters import RecorderParameters

GIVES = ("/camera_1/frame", "/camera_1/info", "/arm/state", "/operator/mark")
REPORTS = ("/diagnostics", "/log")
MOST_STEPS = 100
INFO = sample_messages.camera_info()


def recorder_graph(
    folder: Path,
    utc_ns: int = START_NS,
    *,
    simulated: bool = False,
    gives: tuple[str, ...] = GIVES,
    **parameters: Any,
) -> Graph:
    """Return a graph of a recorder and of who gives it something; only that is recorded."""
    parameters = {"path": str(folder / "bag"), "floor_free_mb": 0, **parameters}
    use = RecorderNode.topics("recorder", build(RecorderParameters, parameters))
    assert use.selects is not None
    return Graph(
        directory=str(folder),
        utc_ns=utc_ns,
        monotonic_ns=0,
        simulated=simulated,
        participants=(
            Participant(name="source", gives=gives),
            Participant(
                name="recorder",
                takes=(*use.takes, *filter(use.selects, gives)),
                gives=use.gives,
                node="tvbrdf_nodes.recorder.node:RecorderNode",
                parameters=parameters,
                counted_bytes=use.counted_bytes,
            ),
        ),
    )


class Recording:
    """A recorder and somebody who says things."""

    def __init__(self, graph: Graph) -> None:
        self.graph = InProcessGraph(graph, run=["recorder"])
        self.source = self.graph.bus.port("source")
        self.runner = self.graph.runners["recorder"]
        self._entered = False

    def __enter__(self) -> Recording:
        self.graph.__enter__()
        self._entered = True
        return self

    def __exit__(self, *_: object) -> None:
        self.graph.__exit__(None, None, None)

    def say(self, topic: str, message: Message, seconds: float = 0.0) -> None:
        at_ns = START_NS + round(1e9 * seconds)
        self.graph.clock.tell(at_ns)
        self.source.publish(topic, message, stamp_ns=at_ns)
        self.settle()

    def settle(self) -> None:
        """Let the recorder do all it can; it comes to an end."""
        for _ in range(MOST_STEPS):
            if not self.graph.step():
                return
        raise AssertionError(f"it is still busy after {MOST_STEPS} steps")

    def errors(self) -> list[str]:
        said = [envelope.message for envelope in self.graph.published("/log")]
        return [m.text for m in said if isinstance(m, Log) and m.level == "error"]

    def counters(self) -> dict[str, Any]:
        self.runner.tell_diagnostics()
        message = self.graph.published("/diagnostics")[-1].message
        assert isinstance(message, Diagnostics)
        return message.counters


def frame(index: int = 0, kind: str = "light", height: int = 48, width: int = 64) -> Frame:
    return sample_messages.frame(
        noise(7, index, height=height, width=width), index=index, kind=kind
    )


def images(bag: Path) -> list[np.ndarray[Any, Any]]:
    found = [envelope.message for _, envelope in read(bag)]
    return [message.image for message in found if isinstance(message, Frame)]
