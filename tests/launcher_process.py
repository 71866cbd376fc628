"""A launcher in a process of its own, from which nothing may be left."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import pytest

T = TypeVar("T")
TVBRDF = (sys.executable, "-m", "tvbrdf_launch")


class LauncherProcess:
    """A launcher with a private runtime directory, which must have a short path for its sockets.

    Its folder holds what it prints.
    """

    limit_s = 30.0
    """Anything that takes longer hangs."""
    mark = "XDG_RUNTIME_DIR"
    """Variable that tells the run's processes, grandchildren too."""

    def __init__(self, runtime: Path, folder: Path) -> None:
        self.runtime, self.folder = runtime, folder
        self.output = folder / "output.txt"
        self.environment = {
            **{k: v for k, v in os.environ.items() if not k.startswith("TVBRDF_")},
            "XDG_RUNTIME_DIR": str(runtime),
            "PYTHONUNBUFFERED": "1",
        }
        self.process: subprocess.Popen[str] | None = None

    def popen(self, *words: str, **options: Any) -> subprocess.Popen[str]:
        """Start a verb."""
        options = {"stdin": subprocess.DEVNULL} | options
        return subprocess.Popen(
            [*TVBRDF, *words], env=self.environment, cwd=self.folder, text=True, **options
        )

    def start(self, *words: str) -> None:
        """Start ``tvbrdf launch``."""
        with self.output.open("w") as output:
            self.process = self.popen(
                "launch",
                *words,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def tvbrdf(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run another verb to its end."""
        return subprocess.run(
            [*TVBRDF, *words],
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=self.limit_s,
            cwd=self.folder,
            check=False,
        )

    def wait(self, limit_s: float | None = None) -> int:
        """Return the launcher's exit status."""
        assert self.process is not None
        limit_s = limit_s or self.limit_s
        try:
            return self.process.wait(limit_s)
        except subprocess.TimeoutExpired:
            pytest.fail(f"the run did not end within {limit_s} s:\n{self.text()}")

    def signal(self, number: signal.Signals = signal.SIGINT) -> None:
        """Send the launcher a signal."""
        assert self.process is not None
        self.process.send_signal(number)

    def text(self) -> str:
        """Return what the launcher printed."""
        return self.output.read_text() if self.output.exists() else ""

    def wait_for(self, find: Callable[[], T | None], what: str, limit_s: float | None = None) -> T:
        """Return what ``find`` gives once it is true."""
        limit_s = limit_s or self.limit_s
        deadline = time.monotonic() + limit_s
        while not (found := find()):
            if time.monotonic() > deadline:
                pytest.fail(f"waited {limit_s} s in vain for {what}:\n{self.text()}")
            time.sleep(0.005)  # nothing to block on
        return found

    def processes(self) -> list[int]:
        """Return every process that has this run's environment, grandchildren too."""
        mark = f"{self.mark}={self.runtime}".encode()
        found = []
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                variables = (path / "environ").read_bytes().split(b"\0")
                state = (path / "stat").read_text().rpartition(")")[2].split()[0]
                if mark in variables and state not in "ZX":
                    found.append(int(path.name))
        return found

    def expect_no_process(self, limit_s: float | None = None) -> None:
        """Wait until the last process of the run has ended."""
        self.wait_for(lambda: not self.processes(), f"the end of {self.processes()}", limit_s)

    @contextlib.contextmanager
    def cleared(self) -> Iterator[None]:
        """Whatever happens, end all processes and remove the runtime directory.

        A launcher that has ended must have left nothing.
        """
        left: list[int] = []
        try:
            yield
            if self.process is None or self.process.poll() is not None:
                left = self.processes()
        finally:
            for pid in self.processes():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            if self.process is not None:
                self.process.wait()
            shutil.rmtree(self.runtime, ignore_errors=True)
        assert not left, f"processes {left} outlived their launcher"
