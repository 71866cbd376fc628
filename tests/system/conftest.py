"""Whole simulated rigs in processes of their own, from which nothing may be left."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import pytest

from tvbrdf_fitting.published.database import StoredSample, read_database
from tvbrdf_launch.process_table import ProcessTable, read_processes
from tvbrdf_messages.bus.watcher import Watcher
from tvbrdf_messages.run_directory import Graph, read_graph
from tvbrdf_messages.schema import Message

LIMIT_S = 60.0
"""Any run here takes a few seconds: what takes longer hangs."""
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
T = TypeVar("T")


class Rig:
    """A launcher in a process of its own, with a short private directory for everything."""

    def __init__(self) -> None:
        # the path of a Unix socket has at most 107 characters
        self.folder = Path(tempfile.mkdtemp(prefix="tv"))
        self.run, self.database = self.folder / "r", self.folder / "db"
        self.output = self.folder / "output.txt"
        self.environment = {
            **{k: v for k, v in os.environ.items() if not k.startswith("TVBRDF_")},
            "XDG_RUNTIME_DIR": str(self.folder),
            "PYTHONUNBUFFERED": "1",
        }
        self.process: subprocess.Popen[bytes] | None = None

    # -- starting and ending

    def launch(self, *words: str, file: str | Path = "simulated_rig", **arguments: Any) -> None:
        """Start a small simulated rig, or another launch file with just these arguments."""
        if file == "simulated_rig":
            arguments = {**SMALL, "database": self.database, **arguments}
        words = (*words, *(f"{key}:={value}" for key, value in arguments.items()))
        command = [sys.executable, "-m", "tvbrdf_launch", "launch", str(file), "--plain"]
        with self.output.open("wb") as output:
            self.process = subprocess.Popen(
                [*command, "--run", str(self.run), *words],
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                cwd=self.folder,
                start_new_session=True,
            )

    def tvbrdf(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run another verb to its end."""
        return subprocess.run(
            [sys.executable, "-m", "tvbrdf_launch", *words],
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            cwd=self.folder,
            check=False,
        )

    def wait(self, limit_s: float = LIMIT_S) -> int:
        """Return the launcher's exit status."""
        assert self.process is not None
        try:
            return self.process.wait(limit_s)
        except subprocess.TimeoutExpired:
            pytest.fail(f"the run did not end within {limit_s} s:\n{self.text()}")

    def signal(self, number: signal.Signals) -> None:
        """Send the launcher a signal."""
        assert self.process is not None
        self.process.send_signal(number)

    def kill(self, node: str) -> None:
        """Kill a node's process."""
        assert self.table().nodes[node].send(signal.SIGKILL)

    # -- looking

    def wait_for(self, find: Callable[[], T | None], what: str, limit_s: float = LIMIT_S) -> T:
        """Return what ``find`` gives once it is true."""
        deadline = time.monotonic() + limit_s
        while not (found := find()):
            if time.monotonic() > deadline:
                pytest.fail(f"waited {limit_s} s in vain for {what}:\n{self.text()}")
            time.sleep(0.005)  # nothing to block on
        return found

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
        self, watcher: Watcher, wanted: Callable[[Message], bool], limit_s: float = LIMIT_S
    ) -> Message:
        """Return the first message that is wanted."""
        deadline = time.monotonic() + limit_s
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

    def text(self) -> str:
        """Return what the launcher printed."""
        return self.output.read_text() if self.output.exists() else ""

    def controller(self) -> dict[str, Any]:
        """Return what the simulated arm controller, the hardware, left."""
        found: dict[str, Any] = json.loads((self.run / "arm_controller.json").read_text())
        return found

    def sample(self) -> StoredSample:
        """Return the one sample in the database."""
        (sample,) = read_database(self.database).samples
        return sample

    def processes(self) -> list[int]:
        """Return every process with this run's environment, grandchildren too."""
        mark = f"XDG_RUNTIME_DIR={self.folder}".encode()
        found = []
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                variables = (path / "environ").read_bytes().split(b"\0")
                state = (path / "stat").read_text().rpartition(")")[2].split()[0]
                if mark in variables and state not in "ZX":
                    found.append(int(path.name))
        return found

    # -- what must always hold

    def expect_nothing_left(self, limit_s: float = 10.0) -> None:
        """No process, no socket; the arm stands still and its lamp is off."""
        self.wait_for(lambda: not self.processes(), f"the end of {self.processes()}", limit_s)
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
    left: list[int] = []
    try:
        yield one
        if one.process is None or one.process.poll() is not None:
            left = one.processes()
    finally:
        for pid in one.processes():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        if one.process is not None:
            one.process.wait()
        shutil.rmtree(one.folder, ignore_errors=True)
    assert not left, f"processes {left} outlived their launcher"
