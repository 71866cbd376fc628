"""Whole simulated rigs in processes of their own, from which nothing may be left."""

from __future__ import annotations

import contextlib
import json
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.launcher_process import LauncherProcess
from tvbrdf_fitting.published.database import StoredSample, read_database
from tvbrdf_launch.process_table import ProcessTable, read_processes
from tvbrdf_messages.bus.watcher import Watcher
from tvbrdf_messages.run_directory import Graph, read_graph
from tvbrdf_messages.schema import Message

SMALL: dict[str, Any] = {
    "sweep_s": 4,  # 3 s would need more room to accelerate than the arm has
    "exposures_ms": "[0.2,4.0]",
    "width": 32,
    "height": 32,
    "warm_up_s": 1,
    "dark_frames": 3,
    "interval_s": 60,
    "scans": 2,
}


class Rig(LauncherProcess):
    """A launcher of the simulated rig, with a short private directory for everything."""

    limit_s = 60.0
    """Any run here takes a few seconds."""

    def __init__(self) -> None:
        # the path of a Unix socket has at most 107 characters
        folder = Path(tempfile.mkdtemp(prefix="tv"))
        super().__init__(folder, folder)
        self.run, self.database = folder / "r", folder / "db"

    # -- starting and ending

    def launch(self, *words: str, file: str | Path = "simulated_rig", **arguments: Any) -> None:
        """Start a small simulated rig, or another launch file with just these arguments."""
        if file == "simulated_rig":
            arguments = {**SMALL, "database": self.database, **arguments}
        words = (*words, *(f"{key}:={value}" for key, value in arguments.items()))
        self.start(str(file), "--plain", "--run", str(self.run), *words)

    def kill(self, node: str) -> None:
        """Kill a node's process."""
        assert self.table().nodes[node].send(signal.SIGKILL)

    # -- looking

    def graph(self) -> Graph:
        """Return the run's graph once it is written and its processes are started."""
        assert self.process is not None
        process = self.process

        def find() -> Graph | None:
            if process.poll() is not None:
                pytest.fail(f"the launcher ended: {self.text()}")
            with contextlib.suppress(Exception):
                table, graph = read_processes(self.run), read_graph(self.run)
                if table.launcher.pid == process.pid and table.nodes:
                    return graph
            return None

        return self.wait_for(find, "the run's graph")

    def watch(self, *topics: str) -> Watcher:
        """Return a connected watcher of the run that is under way."""
        return Watcher(self.graph(), topics)

    def until(
        self, watcher: Watcher, wanted: Callable[[Message], bool], limit_s: float | None = None
    ) -> Message:
        """Return the first message that is wanted."""
        deadline = time.monotonic() + (limit_s or self.limit_s)
        while time.monotonic() < deadline:
            arrival = watcher.receive(0.2)
            if arrival is not None and wanted(arrival.envelope.message):
                return arrival.envelope.message
            if self.process is not None and self.process.poll() is not None:
                break
        pytest.fail(f"waited in vain for a message:\n{self.text()}")

    def wait_state(self, state: str, scan: int = 1, sweep: int = 1) -> None:
        """Return as soon as the sequencer says that a sweep has come this far."""
        with self.watch("/scan/status") as watcher:
            self.until(watcher, lambda m: (m.state, m.scan, m.sweep) == (state, scan, sweep))  # type: ignore[attr-defined]

    def table(self) -> ProcessTable:
        """Return the run's processes."""
        return read_processes(self.run)

    def controller(self) -> dict[str, Any]:
        """Return what the simulated arm controller, the hardware, left."""
        found: dict[str, Any] = json.loads((self.run / "arm_controller.json").read_text())
        return found

    def sample(self) -> StoredSample:
        """Return the one sample in the database."""
        (sample,) = read_database(self.database).samples
        return sample

    # -- what must always hold

    def expect_nothing_left(self, limit_s: float = 10.0) -> None:
        """No process, no socket; the arm stands still and its lamp is off."""
        self.expect_no_process(limit_s)
        left = [path.name for path in self.run.iterdir() if path.is_socket()]
        assert left == [], f"socket files are left: {left}"
        self.expect_safe()

    def expect_safe(self) -> None:
        """The controller says that the arm is still and dark."""
        state = self.controller()
        assert (state["moving"], state["lamp"]) == (False, False), f"{state}\n{self.text()}"

    def expect_whole_database(self, scans: int = 2) -> StoredSample:
        """Each scan is in it exactly once, measured with all its files, or missing with a reason.

        That a scan is not there twice follows from the sum and the union together.
        """
        sample = self.sample()
        stored, missing = [s.scan for s in sample.scans], [m.scan for m in sample.missing]
        assert sorted(stored + missing) == list(range(1, scans + 1)), self.text()
        assert all(each.reason for each in sample.missing)
        for scan in sample.scans:
            assert scan.fit is not None, f"scan {scan.scan} was not fitted:\n{self.text()}"
            observations = scan.observations()
            assert len(observations["radiance"]) > 100
            # the files are the same set as the catalogue's: nothing half written beside them
            assert len(scan.radiance().cameras) == 4
        on_disk = {path.name for path in (sample.folder / "observations").iterdir()}
        assert on_disk == {f"scan{number:02d}.npz" for number in stored}
        return sample


@pytest.fixture
def rig() -> Iterator[Rig]:
    one = Rig()
    with one.cleared():
        yield one
