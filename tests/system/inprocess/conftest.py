"""The whole simulated rig inside one process: same nodes, same graph, no sockets."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tvbrdf_fitting.models import get_model
from tvbrdf_launch.find_files import find_launch_file
from tvbrdf_launch.launch_file import load_launch_file
from tvbrdf_launch.plan import make_plan
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Frame, Parameters, Radiance
from tvbrdf_messages.run_directory import Graph
from tvbrdf_nodes.core.inprocess import InProcessGraph

LIMIT_S = 120.0


class Run:
    """One run of the rig: what was published, and where its database is.

    Frames are kept only when asked for: they are most of all bytes.
    """

    def __init__(
        self,
        folder: Path,
        arguments: Mapping[str, Any],
        changes: Mapping[str, Mapping[str, Any]],
        *,
        keep_frames: bool,
    ) -> None:
        self.folder, self.database = folder, folder / "db"
        self._keep_frames = keep_frames
        self.graph = _graph(folder, {"database": self.database, **arguments}, changes)
        self.messages: list[Envelope] = []
        with InProcessGraph(self.graph) as graph:
            sequencer = graph.runners["sequencer"]

            def done() -> bool:
                self._collect(graph)
                return sequencer.exit is not None

            graph.run_until(done, LIMIT_S)
            self.exit = sequencer.exit
        self._collect(graph)

    def _collect(self, graph: InProcessGraph) -> None:
        keep = self._keep_frames
        self.messages += [
            envelope
            for envelope in graph.bus.taps
            if keep or not isinstance(envelope.message, Frame)
        ]
        graph.bus.taps.clear()

    def on(self, topic: str) -> list[Any]:
        """Return the messages of a topic."""
        return [envelope.message for envelope in self.messages if envelope.topic == topic]

    @property
    def parameters(self) -> list[Parameters]:
        return self.on("/scan/parameters")

    @property
    def radiance(self) -> list[Radiance]:
        return self.on("/scan/radiance")


def _graph(
    folder: Path, arguments: Mapping[str, Any], changes: Mapping[str, Mapping[str, Any]]
) -> Graph:
    """Return the graph of the shipped launch file, with changes of nodes' parameters."""
    words = {
        name: yaml.safe_dump(value).split("\n...")[0].strip()
        if not isinstance(value, (str, Path))
        else str(value)
        for name, value in arguments.items()
    }
    launch = load_launch_file(find_launch_file("simulated_rig"), words, folder)
    graph = make_plan(launch, folder).graph
    participants = tuple(
        replace(p, parameters={**p.parameters, **changes.get(p.name, {})})
        for p in graph.participants
    )
    return replace(graph, participants=participants)


RunRig = Callable[..., Run]


@pytest.fixture
def run_rig() -> Iterator[RunRig]:
    """Give a function that runs the simulated rig to its end.

    Its keywords are the launch file's arguments; ``changes`` are parameters by node.
    """
    # the path of a Unix socket has at most 107 characters
    folder = Path(tempfile.mkdtemp(prefix="tv"))
    count = 0

    def run(
        *,
        changes: Mapping[str, Mapping[str, Any]] | None = None,
        keep_frames: bool = False,
        **arguments: Any,
    ) -> Run:
        nonlocal count
        count += 1
        place = folder / str(count)
        place.mkdir()
        small = {"width": 32, "height": 32, "scans": 1, "warm_up_s": 1}
        return Run(place, small | arguments, changes or {}, keep_frames=keep_frames)

    yield run
    shutil.rmtree(folder)


@pytest.fixture(scope="session")
def record() -> Iterator[Run]:
    """One scan of two sweeps with everything that was published, as a bag would have it."""
    folder = Path(tempfile.mkdtemp(prefix="tv"))
    arguments = {"width": 16, "height": 16, "scans": 1, "warm_up_s": 1, "exposures_ms": [0.2, 4.0]}
    try:
        yield Run(folder, arguments, {}, keep_frames=True)
    finally:
        shutil.rmtree(folder)


MakeSample = Callable[..., tuple[str, dict[str, float]]]


@pytest.fixture
def constant_sample(tmp_path: Path) -> MakeSample:
    """Give a function that writes a sample that does not change: its path and its parameters."""

    def make(*values: float, model: str = "oren_nayar+torrance_sparrow") -> Any:
        parameters = get_model(model).as_mapping(np.array(values))
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.yaml"
        content = {"kind": "constant", "model": model, "parameters": parameters}
        path.write_text(yaml.safe_dump(content))
        return str(path), parameters

    return make
