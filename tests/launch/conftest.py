"""Runs in private directories, from which no process may be left."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import pytest

HERE = Path(__file__).parent
LIMIT_S = 30.0
"""Anything that takes longer hangs."""
T = TypeVar("T")
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


def wait_for(find: Callable[[], T | None], what: str, limit_s: float = LIMIT_S) -> T:
    """Return what ``find`` gives once it is true."""
    deadline = time.monotonic() + limit_s
    while not (found := find()):
        if time.monotonic() > deadline:
            pytest.fail(f"waited {limit_s} s in vain for {what}")
        time.sleep(0.01)
    return found


class Run:
    """A launcher in a process of its own, with a private runtime directory."""

    rig = RIG

    def __init__(self, runtime: Path, folder: Path) -> None:
        self.runtime, self.folder = runtime, folder
        self.environment = {
            **{k: v for k, v in os.environ.items() if not k.startswith("TVBRDF_")},
            "XDG_RUNTIME_DIR": str(runtime),
            "PYTHONPATH": str(HERE),
            "PYTHONUNBUFFERED": "1",
        }
        self.process: subprocess.Popen[str] | None = None
        self.output = folder / "output.txt"

    @staticmethod
    def wait_for(find: Callable[[], T | None], what: str) -> T:
        return wait_for(find, what)

    def write(self, text: str, name: str = "test.yaml") -> Path:
        path = self.folder / name
        path.write_text(textwrap.dedent(text))
        return path

    def launch(self, text: str, *words: str) -> Path:
        """Start a launch file; return the run's directory once its nodes have been started."""
        path = self.write(text)
        with self.output.open("w") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tvbrdf_launch", "launch", str(path), *words],
                env=self.environment,
                stdout=output,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                cwd=self.folder,
                text=True,
            )
        return wait_for(self.find, "the run's directory")

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

    def tvbrdf(self, *words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "tvbrdf_launch", *words],
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            cwd=self.folder,
            check=False,
        )

    def text(self) -> str:
        return self.output.read_text()

    def wait_text(self, said: str) -> None:
        wait_for(lambda: said in self.text(), said)

    def wait(self, limit_s: float = LIMIT_S) -> int:
        assert self.process is not None
        return self.process.wait(limit_s)

    def interrupt(self, number: signal.Signals = signal.SIGINT) -> None:
        assert self.process is not None
        self.process.send_signal(number)

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

        return wait_for(find, f"{times} × {event} of {node}; {self.text()}")

    def processes(self) -> list[int]:
        """Return every process that has this run's environment, grandchildren too."""
        mark = f"XDG_RUNTIME_DIR={self.runtime}".encode()
        found = []
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                variables = (path / "environ").read_bytes().split(b"\0")
                if mark in variables and (path / "stat").read_text().split(") ")[1][0] != "Z":
                    found.append(int(path.name))
        return found

    def expect_no_process(self, limit_s: float = LIMIT_S) -> None:
        wait_for(lambda: not self.processes(), f"the end of {self.processes()}", limit_s)


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    # sockets need a short path
    runtime = Path(tempfile.mkdtemp(prefix="tv-"))
    one = Run(runtime, tmp_path)
    try:
        yield one
        left = []
        if one.process is None or one.process.poll() is not None:
            left = one.processes()
    finally:
        for pid in one.processes():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        if one.process is not None:
            one.process.wait()
        shutil.rmtree(runtime, ignore_errors=True)
    assert not left, f"processes {left} outlived their launcher"
