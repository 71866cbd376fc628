"""Runs in private directories, from which no process may be left."""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.launch.published_samples import Fit, fit_with, write_sample
from tests.launcher_process import LauncherProcess

HERE = Path(__file__).parent
RIG = """\
description: for tests
nodes:
  - name: arm
    node: launch_test_nodes:Probe
    parameters: {gives: [/arm/state]}
  - name: reader
    node: launch_test_nodes:Probe
    parameters: {takes: [/arm/state]}
  - {name: sequencer, node: "launch_test_nodes:Answerer"}
"""


class Run(LauncherProcess):
    """A launcher of nodes of these tests."""

    rig = RIG

    def __init__(self, runtime: Path, folder: Path) -> None:
        super().__init__(runtime, folder)
        self.environment["PYTHONPATH"] = str(HERE)

    def write(self, text: str, name: str = "test.yaml") -> Path:
        path = self.folder / name
        path.write_text(textwrap.dedent(text))
        return path

    def launch(self, text: str, *words: str) -> Path:
        """Start a launch file; return the run's directory once its nodes have been started."""
        self.start(str(self.write(text)), *words)
        return self.wait_for(self.find, "the run's directory")

    def ready(self, text: str = RIG) -> Path:
        """Start a launch file like RIG; return the run's directory once it works."""
        folder = self.launch(text)
        self.wait_event(folder, "reader", "first:arm")
        return folder

    def find(self) -> Path | None:
        for graph in self.runtime.glob("tvbrdf/*/processes.json"):
            with contextlib.suppress(OSError, ValueError):
                if json.loads(graph.read_text())["nodes"]:
                    return graph.parent.resolve()
        if self.process is not None and self.process.poll() is not None:
            pytest.fail(f"the launcher ended: {self.text()}")
        return None

    def wait_text(self, said: str) -> None:
        self.wait_for(lambda: said in self.text(), said)

    def table(self, run: Path) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((run / "processes.json").read_text())
        return found

    def events(self, run: Path) -> list[tuple[str, str, int, int]]:
        """Return (node, event, pid, monotonic time) as the probes have noted them."""
        path = run / "events.txt"
        if not path.exists():
            return []
        lines = [line.split() for line in path.read_text().splitlines()]
        return [(n, e, int(pid), int(at)) for n, e, pid, at in lines]

    def wait_event(self, run: Path, node: str, event: str, times: int = 1) -> list[Any]:
        def find() -> list[Any]:
            found = [each for each in self.events(run) if each[:2] == (node, event)]
            return found if len(found) >= times else []

        return self.wait_for(find, f"{times} × {event} of {node}")


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    one = Run(Path(tempfile.mkdtemp(prefix="tv-")), tmp_path)
    with one.cleared():
        yield one


@pytest.fixture(name="fit")
def fit_fixture(capsys: pytest.CaptureFixture[str]) -> Fit:
    return fit_with(capsys)


@pytest.fixture(scope="module")
def sample_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample(tmp_path_factory.mktemp("once") / "red_paint")


@pytest.fixture
def sample(sample_once: Path, tmp_path: Path) -> Path:
    """A sample with one scan, to be broken."""
    return shutil.copytree(sample_once, tmp_path / "red_paint")
