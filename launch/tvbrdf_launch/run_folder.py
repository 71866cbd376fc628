"""A run's private directory: made, described, found as ``latest``, and removed when old."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tvbrdf_messages.errors import BusError
from tvbrdf_messages.run_directory import GRAPH_FILE, make_private, runs_directory

from .errors import RunError
from .process_table import PROCESSES_FILE, read_processes

if TYPE_CHECKING:
    from .plan import Plan

DEFAULT_KEPT_RUNS = 10
LAUNCH_FILE = "launch.json"
LOCK_FILE = "lock"


def choose_run_directory(given: str | None = None) -> Path:
    """Return where a new run will live: given, else ``$TVBRDF_RUN``, else a new short path."""
    chosen = given or os.environ.get("TVBRDF_RUN")
    if chosen:
        return Path(chosen).absolute()
    stamp = time.strftime("%y%m%d-%H%M%S")
    return runs_directory() / f"{stamp}-{os.getpid()}"


class RunFolder:
    """The directory of the run that this launcher owns, locked as long as it lives."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = -1

    def make(self, plan: Plan) -> None:
        """Make the directory, lock it, and write graph, launch files and arguments into it.

        Raises
        ------
        RunError
            If the directory is open to others, in use, or holds something else.
        """
        path = self.path
        try:
            make_private(runs_directory())
            _refuse_foreign(path)
            make_private(path)
            self._lock = os.open(path / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            self._refuse_busy()
            remove_sockets(path)
            for old in path.glob("*.log"):
                old.unlink()
            copies = path / "launch"
            copies.mkdir(exist_ok=True)
            for file in plan.launch.files:
                shutil.copyfile(file, copies / file.name)
            record = {
                "file": str(plan.launch.path),
                "description": plan.launch.description,
                "arguments": dict(plan.launch.arguments),
                "version": installed_version(),
            }
            (path / LAUNCH_FILE).write_text(json.dumps(record, indent=1))
            plan.graph.write()
            self._point_latest()
        except BusError as error:
            raise RunError(str(error)) from error
        except OSError as error:
            where = error.filename or path
            raise RunError(f"can't make the run's directory: {where}: {error.strerror}") from error

    def _refuse_busy(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunError(f"a run is going on in {self.path}; stop it: tvbrdf stop") from None
        if (self.path / PROCESSES_FILE).exists():
            alive = read_processes(self.path).alive()
            if alive:
                names = ", ".join(alive)
                raise RunError(f"{self.path}: {names} of an earlier run still end; try again")

    def _point_latest(self) -> None:
        """Let ``latest`` lead here, in one step."""
        beside = runs_directory() / f".latest-{os.getpid()}"
        beside.unlink(missing_ok=True)
        beside.symlink_to(self.path)
        beside.rename(runs_directory() / "latest")

    def release(self) -> None:
        """Remove the sockets and give the lock back; logs and graph stay."""
        if self._lock >= 0:
            remove_sockets(self.path)
            os.close(self._lock)
            self._lock = -1


def remove_sockets(run: Path) -> None:
    """Remove the sockets that ended processes left."""
    for path in run.iterdir():
        if path.is_socket():
            path.unlink(missing_ok=True)


def remove_old_runs(keep: int | None = None) -> None:
    """Remove runs older than the last ``keep`` ($TVBRDF_KEEP_RUNS, 10) whose processes are gone."""
    if keep is None:
        given = os.environ.get("TVBRDF_KEEP_RUNS", "")
        keep = int(given) if given.isdecimal() else DEFAULT_KEPT_RUNS
    runs = [
        p for p in runs_directory().iterdir() if (p / GRAPH_FILE).exists() and not p.is_symlink()
    ]
    runs.sort(key=lambda path: (path / GRAPH_FILE).stat().st_mtime_ns)
    for run in runs[: max(0, len(runs) - max(1, keep))]:
        with contextlib.suppress(RunError):
            if not (run / PROCESSES_FILE).exists() or not read_processes(run).alive():
                shutil.rmtree(run, ignore_errors=True)


def _refuse_foreign(path: Path) -> None:
    """Refuse a directory that holds something, but no run."""
    if path.is_dir() and any(path.iterdir()) and not (path / LOCK_FILE).exists():
        raise RunError(f"{path} holds something that is no run; choose an empty or new directory")


def installed_version() -> str:
    """Return the version of the installed distribution."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("tvbrdf")
    except PackageNotFoundError:
        return "unknown"
