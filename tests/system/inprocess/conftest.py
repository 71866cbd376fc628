"""The whole simulated rig inside one process: same nodes, same graph, no sockets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tvbrdf_fitting.models import get_model
from tvbrdf_launch.testing.rigs import RigFactory
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Parameters, Radiance

LIMIT_S = 120.0


class Run:
    """A rig that has run to its end: what was published, and where its database is."""

    def __init__(
        self,
        folder: Path,
        arguments: Mapping[str, Any],
        changes: Mapping[str, Mapping[str, Any]],
        *,
        keep_frames: bool,
    ) -> None:
        with RigFactory(folder) as rig:
            run = rig(parameters=changes, keep_frames=keep_frames, **dict[str, Any](arguments))
            self.exit = run.wait_until_ended(LIMIT_S)
        self.graph, self.database = run.graph, run.database
        self.messages: list[Envelope] = [told.envelope for told in run.history]

    def on(self, topic: str) -> list[Any]:
        """Return the messages of a topic."""
        return [envelope.message for envelope in self.messages if envelope.topic == topic]

    @property
    def parameters(self) -> list[Parameters]:
        return self.on("/scan/parameters")

    @property
    def radiance(self) -> list[Radiance]:
        return self.on("/scan/radiance")


RunRig = Callable[..., Run]


@pytest.fixture
def run_rig(tmp_path: Path) -> RunRig:
    """Give a function that runs the simulated rig to its end.

    Its keywords are the launch file's arguments; ``changes`` are parameters by node.
    """

    def run(
        *,
        changes: Mapping[str, Mapping[str, Any]] | None = None,
        keep_frames: bool = False,
        **arguments: Any,
    ) -> Run:
        small = {"width": 32, "height": 32, "scans": 1, "warm_up_s": 1}
        return Run(tmp_path, small | arguments, changes or {}, keep_frames=keep_frames)

    return run


@pytest.fixture(scope="session")
def record(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """One scan of two sweeps with everything that was published, as a bag would have it."""
    arguments = {"width": 16, "height": 16, "scans": 1, "warm_up_s": 1, "exposures_ms": [0.2, 4.0]}
    return Run(tmp_path_factory.mktemp("record"), arguments, {}, keep_frames=True)


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
