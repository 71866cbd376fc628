"""What was played and is not stored yet: a replay has ended when nothing is left of it."""

from __future__ import annotations

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import (
    Mark,
    Radiance,
    ScanCommand,
    ScanMissing,
    Stored,
    SweepResult,
)

from ..hdr_merger.sweep import SweepKey


class Ledger:
    """Knows which answers merger and database still owe for what was played.

    Parameters
    ----------
    cameras
        Whose ends of sweeps the merger waits for.
    arm
        The same of the arm.
    """

    def __init__(self, cameras: tuple[str, ...], arm: str) -> None:
        self._devices = {*cameras, arm}
        self._commands: dict[SweepKey, ScanCommand] = {}
        self._ended: dict[SweepKey, set[str]] = {}
        self._done: dict[int, set[int]] = {}
        self._sweeps: set[SweepKey] = set()
        """Played whole, and not answered by the merger."""
        self._waiting: set[tuple[str, int]] = set()
        """What the database owes an answer for: kind, and number of the scan or mark."""
        self._answered: set[tuple[str, int]] = set()
        """An answer may overtake the merger's, which says that there is something to answer."""
        self.stored: set[int] = set()
        """Scans whose radiance is on disk."""
        self.refused: list[str] = []
        """Why something never will be."""

    def played(self, envelope: Envelope) -> None:
        """Take note of a message that was played."""
        message = envelope.message
        if isinstance(message, ScanCommand) and message.action == "prepare":
            key = (message.scan, message.sweep, message.attempt)
            self._commands[key] = message
            self._close(key)
        elif isinstance(message, SweepResult):
            if (message.action, message.state) == ("sweep", "done"):
                key = (message.scan, message.sweep, message.attempt)
                self._ended.setdefault(key, set()).add(message.source)
                self._close(key)
        elif isinstance(message, Radiance):
            self._expect_scan(message.scan)
        elif isinstance(message, ScanMissing):
            self._expect("missing", message.scan)
        elif isinstance(message, Mark):
            self._expect("mark", envelope.header.sequence)

    def _close(self, key: SweepKey) -> None:
        """A sweep is whole once its command and everybody's end of it were played."""
        if key in self._commands and self._ended.get(key, set()) >= self._devices:
            del self._ended[key]
            self._sweeps.add(key)

    def _expect_scan(self, scan: int) -> None:
        self._expect("radiance", scan)
        self._expect("parameters", scan)

    def _expect(self, what: str, number: int) -> None:
        if (what, number) not in self._answered:
            self._waiting.add((what, number))

    def jumped(self) -> None:
        """Take note of a seek: the merger empties its buffers, and owes nothing for sweeps."""
        self._commands.clear()
        self._ended.clear()
        self._sweeps.clear()
        self._done.clear()

    def heard(self, message: object) -> None:
        """Take an answer of the merger or of the database."""
        if isinstance(message, SweepResult):
            self._merged(message)
        elif isinstance(message, Stored):
            self._answered.add((message.what, message.scan))
            self._waiting.discard((message.what, message.scan))
            if message.refused:
                self.refused.append(f"{_in_words(message.what, message.scan)}: {message.refused}")
            elif message.what == "radiance":
                self.stored.add(message.scan)

    def _merged(self, result: SweepResult) -> None:
        key = (result.scan, result.sweep, result.attempt)
        if key not in self._sweeps:
            return
        self._sweeps.discard(key)
        if result.state != "done":
            return
        # as the merger does it: the scan's last sweep sends its radiance
        done = self._done.setdefault(result.scan, set())
        if result.sweep == 0:
            done.clear()
        done.add(result.sweep)
        if len(done) == len(self._commands[key].exposures_ms):
            del self._done[result.scan]
            self._expect_scan(result.scan)

    def open(self) -> tuple[str, ...]:
        """Return what is not answered yet, in words."""
        sweeps = (f"sweep {sweep + 1} of scan {scan}" for scan, sweep, _ in sorted(self._sweeps))
        stored = (_in_words(what, number) for what, number in sorted(self._waiting))
        return (*sweeps, *stored)


def _in_words(what: str, number: int) -> str:
    names = {"mark": f"mark {number}", "missing": f"missing scan {number}"}
    return names.get(what, f"{what} of scan {number}")
