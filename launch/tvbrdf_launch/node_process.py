"""One node's process: its own session, its log, and the lifeline that only the launcher holds."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from .plan import PlannedNode
from .process_table import ProcessRecord, start_ticks

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_AGAIN = b"--- started again: incarnation"
LOG_LINES = 15
"""Of a failed node's log, shown with the failure."""


def node_environment(run: Path) -> dict[str, str]:
    """Return the environment of nodes: one BLAS thread each, nothing held back in buffers."""
    threads = dict.fromkeys(_ONE_THREAD, "1")
    return {**os.environ, **threads, "PYTHONUNBUFFERED": "1", "TVBRDF_RUN": str(run)}


class NodeProcess:
    """A node that the launcher starts, watches and stops; it may be started again.

    The child's standard input is the read end of a pipe whose write end is nowhere but here: when
    the launcher closes it or dies in whatever way, the node reads end of file and ends.
    """

    def __init__(self, plan: PlannedNode, run: Path) -> None:
        self.plan, self.name = plan, plan.name
        self.log_path = run / f"{plan.name}.log"
        self.pidfd = -1
        self.incarnations = 0
        self.restarts = 0
        """In a row: since it last worked for long enough."""
        self.reports = 0
        """How often it has said that it runs, since it was last started."""
        self.has_run = False
        """Whether it ever said so a second time; before that, a failure is one of its start."""
        self.started_s = 0.0
        self.exit_code: int | None = None
        self.stop_sent = False
        self.record = ProcessRecord(0, 0)
        self._run = run
        self._lifeline = -1
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def alive(self) -> bool:
        """Return whether it has been started and not yet been reaped."""
        return self._process is not None

    def start(self) -> None:
        """Start it in a session of its own."""
        read_end, self._lifeline = os.pipe()
        self.incarnations += 1
        try:
            with self.log_path.open("ab", buffering=0) as log:
                if self.incarnations > 1:
                    log.write(b"%s %d\n" % (_AGAIN, self.incarnations))
                command = [sys.executable, "-P", "-m", "tvbrdf_nodes.core.process"]
                self._process = subprocess.Popen(
                    [*command, "--run", str(self._run), "--name", self.name],
                    stdin=read_end,
                    stdout=log,
                    stderr=log,
                    env=node_environment(self._run),
                    start_new_session=True,
                )
        except OSError:
            os.close(self._lifeline)
            self._lifeline = -1
            raise
        finally:
            os.close(read_end)
        pid = self._process.pid
        self.pidfd = os.pidfd_open(pid)
        self.exit_code = None
        self.reports = 0
        self.started_s = time.monotonic()
        self.record = ProcessRecord(pid, start_ticks(pid), self.incarnations)

    def report(self) -> None:
        """Take note that it has said that it runs."""
        self.reports += 1
        self.has_run |= self.reports > 1

    def ask_to_stop(self) -> None:
        """Ask it to end: by SIGINT, or by its lifeline while it may not yet have a handler."""
        self.stop_sent = True
        if self.reports:
            self.signal(signal.SIGINT)
        else:
            self._close_lifeline()

    def terminate(self) -> None:
        """Ask it to end once more: by SIGTERM and by the end of its lifeline."""
        self.signal(signal.SIGTERM)
        self._close_lifeline()

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to it alone."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self.pidfd, number)

    def reap(self) -> int:
        """Take the exit code of the ended process, and end what it left in its session."""
        process = self._process
        assert process is not None
        # until it is reaped, its id, and so its group's, can't belong to anybody else
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        self.exit_code = process.wait()
        os.close(self.pidfd)
        self.pidfd = -1
        self._process = None
        self._close_lifeline()
        self.record = ProcessRecord(
            self.record.pid, self.record.start_ticks, self.incarnations, self.exit_code
        )
        return self.exit_code

    def kill_and_reap(self) -> None:
        """End it at once, with all it started."""
        if self._process is not None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self.reap()

    def last_lines(self, count: int = LOG_LINES) -> list[str]:
        """Return the last lines of its log, since it was last started."""
        try:
            with self.log_path.open("rb") as log:
                log.seek(max(0, log.seek(0, os.SEEK_END) - 16384))
                text = log.read().decode(errors="replace")
        except OSError:
            return []
        lines = text.splitlines()
        marks = [i for i, line in enumerate(lines) if line.startswith(_AGAIN.decode())]
        return lines[marks[-1] + 1 if marks else 0 :][-count:]

    def _close_lifeline(self) -> None:
        if self._lifeline >= 0:
            os.close(self._lifeline)
            self._lifeline = -1


def describe_exit(code: int) -> str:
    """Return an exit code in words."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"ended by signal {-code}"
