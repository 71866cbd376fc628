"""What a person sees while a run goes on: plain lines here, a progress bar in the subclass."""

from __future__ import annotations

import contextlib
import sys
import time
from pathlib import Path
from typing import IO

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Diagnostics, Log, Parameters, ScanStatus

from .text import duration, plus_minus

_MIN_RATE_S = 2.0
"""Real time after which the speed of the run's clock is known well enough to foretell."""


class TimeLeft:
    """Turns what is left on the run's clock into real time, by how fast that clock has run."""

    def __init__(self, simulated: bool) -> None:
        self._simulated = simulated
        self._first: tuple[int, float] | None = None
        self._end_s: float | None = None

    def take(self, stamp_ns: int, remaining_s: float) -> None:
        """Take a status that was made at ``stamp_ns`` of the run's clock."""
        now_s = time.monotonic()
        if self._first is None:
            self._first = (stamp_ns, now_s)
        elapsed_s = now_s - self._first[1]
        rate = 1.0
        if self._simulated:
            run_s = (stamp_ns - self._first[0]) / 1e9
            rate = run_s / elapsed_s if elapsed_s > _MIN_RATE_S else 0.0
        self._end_s = now_s + remaining_s / rate if rate > 0 and remaining_s >= 0 else None

    def seconds(self) -> float | None:
        """Return the real seconds left, or None when that can't be told."""
        return None if self._end_s is None else max(0.0, self._end_s - time.monotonic())


class Display:
    """Shows a run as plain lines, and keeps them in the run's ``launch.log``.

    Parameters
    ----------
    simulated
        Whether the run's clock is told by the world.
    stream
        Where the lines go; one that fails (closed terminal, ended pipe) is written to no more.
    """

    tick_s: float | None = None
    """How often :meth:`tick` wants to be called."""

    def __init__(self, simulated: bool, stream: IO[str] | None = None) -> None:
        self.time_left = TimeLeft(simulated)
        self._stream: IO[str] | None = sys.stdout if stream is None else stream
        self._log: IO[str] | None = None
        self._faults: dict[str, str] = {}
        self._told: dict[str, str] = {}
        self._fitted: dict[int, str] = {}
        self._last_status = ""

    def open_log(self, run: Path) -> None:
        """Keep all lines in the run's directory too."""
        self._log = (run / "launch.log").open("w", buffering=1)

    def say(self, text: str) -> None:
        """Show a line."""
        self._keep(text)
        try:
            self._show(text)
        except OSError:  # nobody looks any more; the run goes on
            self._stream = None

    def fail(self, text: str) -> None:
        """Show what went wrong; plain lines go to standard error."""
        self._keep(f"error: {text}")
        with contextlib.suppress(OSError):
            self._show_error(f"tvbrdf: error: {text}")

    def take(self, envelope: Envelope) -> None:
        """Show what a message tells, if it tells something to people."""
        message = envelope.message
        if isinstance(message, ScanStatus):
            self.time_left.take(envelope.header.stamp_ns, message.remaining_s)
            self._take_status(message)
        elif isinstance(message, Parameters):
            line = fitted_line(message)
            if self._fitted.get(message.scan) != line:  # kept ones are sent again after a restart
                self._fitted[message.scan] = line
                self.say(line)
        elif isinstance(message, Log) and message.level in ("warning", "error"):
            self._told[message.node] = message.text
            self.say(f"{message.node}: {message.level}: {message.text}")
        elif isinstance(message, Diagnostics):
            self._take_diagnostics(message)

    def tick(self) -> None:
        """Show that time has passed."""

    def close(self) -> None:
        """Give the terminal back."""
        if self._log is not None:
            with contextlib.suppress(OSError):
                self._log.close()
            self._log = None

    def _keep(self, text: str) -> None:
        if self._log is not None:
            with contextlib.suppress(OSError):  # a full disk must not end the run
                self._log.write(f"{time.strftime('%H:%M:%S', time.gmtime())} {text}\n")

    def _show(self, text: str) -> None:
        if self._stream is not None:
            self._stream.write(f"{text}\n")
            self._stream.flush()

    def _show_error(self, text: str) -> None:
        sys.stderr.write(f"{text}\n")

    def _take_status(self, status: ScanStatus) -> None:
        line = status_line(status)
        if line == self._last_status:
            return
        self._last_status = line
        left_s = self.time_left.seconds()
        left = f", {duration(left_s)} left" if left_s is not None else ""
        self.say(f"[{100 * status.fraction:3.0f} %{left}] {line}")

    def _take_diagnostics(self, message: Diagnostics) -> None:
        fault = message.text or "fault" if message.state == "fault" else ""
        known = (self._faults.get(message.node), self._told.get(message.node))
        if fault and fault not in known:
            self.say(f"{message.node}: fault: {fault}")
        self._faults[message.node] = fault


def status_line(status: ScanStatus) -> str:
    """Return how far the measurement is, without percentage and time."""
    place = f"scan {status.scan}/{status.scans}"
    if status.sweep:
        place += f", sweep {status.sweep}/{status.sweeps}"
    return f"{place}: {status.text or status.state}"


def fitted_line(message: Parameters) -> str:
    """Return a fitted scan's parameters with their deviations, error and solve time."""
    values = ", ".join(
        f"{name} {plus_minus(value, deviation)}"
        + (" (at bound)" if name in message.at_bound else "")
        for name, value, deviation in zip(
            message.parameter_names, message.values, message.standard_deviations, strict=True
        )
    )
    rms = message.errors.get("rms_percent")
    error = f"{rms:.3g} %" if isinstance(rms, (int, float)) else "unknown"
    return (
        f"scan {message.scan} (t = {message.scan_time_s:g} s): {values}; "
        f"rms {error}; solved in {message.solve_time_ms:.0f} ms"
    )
