"""A progress bar with the time left, below the lines."""

from __future__ import annotations

import sys

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from tvbrdf_messages.messages import ScanStatus

from .display import Display, status_line
from .text import duration


class TerminalDisplay(Display):
    """Shows a run on a terminal."""

    tick_s = 1.0

    def __init__(self, simulated: bool) -> None:
        super().__init__(simulated, sys.stdout)
        self._console = Console(highlight=False, markup=False, soft_wrap=True)
        self._progress = Progress(
            BarColumn(bar_width=30),
            TextColumn("{task.percentage:3.0f} %", markup=False),
            TextColumn("{task.fields[left]:>12}", markup=False),
            TextColumn("{task.description}", markup=False),
            console=self._console,
            auto_refresh=False,
            transient=True,
        )
        self._task: TaskID | None = None

    def _show(self, text: str) -> None:
        if self._stream is not None:
            self._console.print(text, markup=False, highlight=False)

    def _show_error(self, text: str) -> None:
        self._show(text)

    def _take_status(self, status: ScanStatus) -> None:
        if self._task is None:
            self._progress.start()
            self._task = self._progress.add_task("", total=1.0, left="")
        self._progress.update(
            self._task, completed=status.fraction, description=status_line(status)
        )
        if status_line(status) != self._last_status:
            self._last_status = status_line(status)
            self._keep(f"[{100 * status.fraction:3.0f} %] {self._last_status}")
        self.tick()

    def tick(self) -> None:
        """Count down the time left."""
        if self._task is None or self._stream is None:
            return
        left_s = self.time_left.seconds()
        left = f"{duration(left_s)} left" if left_s is not None else ""
        try:
            self._progress.update(self._task, left=left)
            self._progress.refresh()
        except OSError:
            self._stream = None

    def close(self) -> None:
        """Take the bar away."""
        if self._task is not None and self._stream is not None:
            try:
                self._progress.stop()
            except OSError:
                self._stream = None
        super().close()
