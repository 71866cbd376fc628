"""Which processes belong to a run: written by the launcher, read by every tool.

A process is known by its id together with its start time, so that another one which later got the
same id is never taken for it.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from .errors import RunError

PROCESSES_FILE = "processes.json"


def start_ticks(pid: int) -> int:
    """Return when a process started, in the kernel's ticks since boot; 0 if it is gone."""
    fields = _stat_fields(pid)
    return int(fields[19]) if fields else 0


def _stat_fields(pid: int) -> list[str]:
    """Return the fields of /proc/PID/stat after the command's name."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return []
    return text.rpartition(")")[2].split()


@dataclass(frozen=True, slots=True)
class ProcessRecord:
    """One process of a run."""

    pid: int
    start_ticks: int
    incarnations: int = 1
    """How often the node has been started."""
    exit_code: int | None = None
    """Negative: ended by that signal."""

    def alive(self) -> bool:
        """Return whether it is still there (one that only waits to be reaped is not)."""
        fields = _stat_fields(self.pid)
        return bool(fields) and fields[0] not in "ZX" and int(fields[19]) == self.start_ticks

    def send(self, number: signal.Signals) -> bool:
        """Send a signal; False if the process is gone."""
        with contextlib.suppress(ProcessLookupError):
            handle = os.pidfd_open(self.pid)
            try:
                if self.alive():
                    signal.pidfd_send_signal(handle, number)
                    return True
            finally:
                os.close(handle)
        return False


@dataclass(slots=True)
class ProcessTable:
    """The launcher and the nodes of a run."""

    launcher: ProcessRecord
    state: str = "starting"
    """``starting``, ``running``, ``stopping`` or ``ended``."""
    exit_code: int | None = None
    nodes: dict[str, ProcessRecord] = field(default_factory=dict)

    def write(self, run: Path) -> None:
        """Write it into the run's directory (beside, then renamed)."""
        path = run / PROCESSES_FILE
        beside = path.with_suffix(".json.new")
        beside.write_text(json.dumps(asdict(self), indent=1))
        beside.rename(path)

    def alive(self) -> dict[str, ProcessRecord]:
        """Return the processes that are still there, by name."""
        everybody = {"launcher": self.launcher, **self.nodes}
        return {name: record for name, record in everybody.items() if record.alive()}


def read_processes(run: Path) -> ProcessTable:
    """Return what the launcher wrote into a run's directory.

    Raises
    ------
    RunError
        If there is nothing, or not of this version.
    """
    path = run / PROCESSES_FILE
    try:
        raw = json.loads(path.read_text())
        raw["launcher"] = ProcessRecord(**raw["launcher"])
        raw["nodes"] = {name: ProcessRecord(**one) for name, one in raw["nodes"].items()}
        return ProcessTable(**raw)
    except FileNotFoundError:
        raise RunError(f"{run} holds no run: no {PROCESSES_FILE} in it") from None
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise RunError(f"{path} can't be used: {error}") from error


def wait_until_gone(records: Iterable[ProcessRecord], timeout_s: float) -> bool:
    """Wait until all the processes are gone; False if some are still there after the time-out."""
    deadline = time.monotonic() + timeout_s
    for record in records:
        try:
            handle = os.pidfd_open(record.pid)
        except ProcessLookupError:
            continue
        try:
            poller = select.poll()
            poller.register(handle, select.POLLIN)
            while record.alive():
                left_s = deadline - time.monotonic()
                if left_s <= 0:
                    return False
                poller.poll(1000 * left_s + 1)
        finally:
            os.close(handle)
    return True
