"""Launches a rig for a benchmark and notes what is seen of it, and when."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tvbrdf_messages.bus.watcher import Watcher
from tvbrdf_messages.messages import Diagnostics, Frame, Parameters, ScanCommand, SweepResult
from tvbrdf_messages.run_directory import read_graph

CAMERAS = tuple(f"camera_{number}" for number in range(1, 5))
TOPICS = ("/scan/command", "/scan/sweep_result", "/scan/parameters", "/diagnostics")


@dataclass
class Seen:
    """Messages of a run with the monotonic time (s) at which a watcher got them."""

    launched_s: float = 0.0
    graph_s: float = 0.0
    """When the graph was written, just before the processes are started."""
    first_frame_s: float = 0.0
    commands: list[tuple[float, ScanCommand]] = field(default_factory=list)
    results: list[tuple[float, SweepResult]] = field(default_factory=list)
    parameters: list[tuple[float, Parameters]] = field(default_factory=list)
    diagnostics: list[tuple[float, Diagnostics]] = field(default_factory=list)
    status: int = -1

    def sweeps(self) -> list[tuple[float, float, int]]:
        """Return for each good sweep: begin, end (merger's verdict), frames of all cameras."""
        found = []
        begins = {(c.scan, c.sweep, c.attempt): t for t, c in self.commands if c.action == "sweep"}
        for ended_s, result in self.results:
            if result.source != "hdr_merger" or result.state != "done":
                continue
            key = (result.scan, result.sweep, result.attempt)
            frames = sum(r.frames for _, r in self._of(key))
            found.append((begins[key], ended_s, frames))
        return found

    def latencies_ms(self, last_sweep: int) -> list[float]:
        """Return for each scan the time from its last frame to its parameters on the bus."""
        found = []
        for got_s, parameters in self.parameters:
            ends = [
                t
                for t, r in self.results
                if r.scan == parameters.scan
                and r.sweep == last_sweep
                and r.source in CAMERAS
                and r.action == "sweep"
            ]
            found.append(1e3 * (got_s - max(ends)))
        return found

    def _of(self, key: tuple[int, int, int]) -> list[tuple[float, SweepResult]]:
        return [
            (t, r)
            for t, r in self.results
            if (r.scan, r.sweep, r.attempt) == key and r.source in CAMERAS and r.action == "sweep"
        ]

    def counters(self, name: str) -> dict[str, int]:
        """Return a counter of each node, as last told."""
        return {d.node: int(d.counters[name]) for _, d in self.diagnostics if name in d.counters}


@contextlib.contextmanager
def _launched(arguments: dict[str, Any], directory: str) -> Iterator[subprocess.Popen[bytes]]:
    words = [f"{key}:={value}" for key, value in arguments.items()]
    run = Path(directory) / "r"
    command = [sys.executable, "-m", "tvbrdf_launch", "launch", "simulated_rig", "--plain"]
    with (Path(directory) / "out.txt").open("wb") as out:
        process = subprocess.Popen(
            [*command, "--run", str(run), f"database:={directory}/db", *words],
            stdout=out,
            stderr=out,
            start_new_session=True,
        )
        try:
            yield process
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
                process.wait(30)


def run_rig(watch_frames: bool = False, limit_s: float = 600.0, **arguments: Any) -> Seen:
    """Run a simulated rig to its end and return what was seen; raises if it fails."""
    seen = Seen()
    with tempfile.TemporaryDirectory(prefix="tvb") as directory:
        seen.launched_s = time.monotonic()
        with _launched(arguments, directory) as process:
            graph_file = Path(directory) / "r" / "graph.json"
            while not graph_file.exists() and process.poll() is None:
                time.sleep(0.001)
            seen.graph_s = time.monotonic()
            topics = [*TOPICS, *(["/camera_1/frame"] if watch_frames else [])]
            with Watcher(read_graph(graph_file.parent), topics) as watcher:
                deadline = time.monotonic() + limit_s
                while process.poll() is None and time.monotonic() < deadline:
                    arrival = watcher.receive(0.1)
                    if arrival is not None:
                        _note(seen, arrival.monotonic_ns / 1e9, arrival.envelope.message)
            seen.status = process.wait(60)
        if seen.status != 0:
            raise RuntimeError((Path(directory) / "out.txt").read_text()[-2000:])
    return seen


def _note(seen: Seen, at_s: float, message: Any) -> None:
    if isinstance(message, ScanCommand):
        seen.commands.append((at_s, message))
    elif isinstance(message, SweepResult):
        seen.results.append((at_s, message))
    elif isinstance(message, Parameters):
        seen.parameters.append((at_s, message))
    elif isinstance(message, Diagnostics):
        seen.diagnostics.append((at_s, message))
    elif isinstance(message, Frame) and not seen.first_frame_s:
        seen.first_frame_s = at_s
