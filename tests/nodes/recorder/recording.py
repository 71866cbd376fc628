"""A recorder inside one process, and somebody who says things to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tvbrdf_messages.bag import BagReader
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import ArmState, CameraInfo, Diagnostics, Frame, Log
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_messages.schema import Message
from tvbrdf_nodes.core.inprocess import InProcessGraph
from tvbrdf_nodes.core.parameters import build
from tvbrdf_nodes.recorder.node import RecorderNode
from tvbrdf_nodes.recorder.parameters import RecorderParameters

START_NS = 1_800_000_000_000_000_000
STATE = ArmState(angle_deg=1.0, speed_deg_s=15.0, lamp=True, moving=True, homed=True)
GIVES = ("/camera_1/frame", "/camera_1/info", "/arm/state", "/operator/mark", "/diagnostics")
INFO = CameraInfo(
    camera="camera_1",
    model="m",
    serial="1",
    width=64,
    height=48,
    bit_depth=12,
    region_x=0,
    region_y=0,
    hardware_stamps=True,
    exact_exposure=True,
    frame_rate_hz=30.0,
)


def recorder_graph(
    folder: Path, utc_ns: int = START_NS, *, simulated: bool = False, **parameters: Any
) -> Graph:
    parameters = {"path": str(folder / "bag"), "floor_free_mb": 0, **parameters}
    use = RecorderNode.topics("recorder", build(RecorderParameters, parameters))
    assert use.selects is not None
    return Graph(
        directory=str(folder),
        utc_ns=utc_ns,
        monotonic_ns=0,
        simulated=simulated,
        participants=(
            Participant(name="source", gives=GIVES),
            Participant(
                name="recorder",
                takes=(*use.takes, *filter(use.selects, GIVES)),
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
        while self.graph.step():
            pass

    def errors(self) -> list[str]:
        said = [envelope.message for envelope in self.graph.published("/log")]
        return [m.text for m in said if isinstance(m, Log) and m.level == "error"]

    def counters(self) -> dict[str, Any]:
        self.runner.tell_diagnostics()
        message = self.graph.published("/diagnostics")[-1].message
        assert isinstance(message, Diagnostics)
        return message.counters


def frame(index: int = 0, kind: str = "light", height: int = 48, width: int = 64) -> Frame:
    rng = np.random.default_rng([7, index])
    return Frame(
        camera="camera_1",
        kind=kind,
        sample="paint",
        scan=1,
        sweep=0,
        attempt=1,
        index=index,
        exposure_ms=4.0,
        bit_depth=12,
        region_x=0,
        region_y=0,
        image=rng.integers(0, 4096, (height, width, 3), dtype=np.uint16),
    )


def messages(bag: Path) -> list[tuple[int, Envelope]]:
    with BagReader(bag) as reader:
        return [(each.log_time_ns, each.envelope) for each in reader.messages()]


def images(bag: Path) -> list[np.ndarray[Any, Any]]:
    found = [envelope.message for _, envelope in messages(bag)]
    return [message.image for message in found if isinstance(message, Frame)]
