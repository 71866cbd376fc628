"""Which scans are on disk: the sequencer's account of what the database has confirmed."""

from __future__ import annotations

from collections.abc import Iterable

from tvbrdf_messages.messages import ScanMissing, Stored

from ..core.node import Exit, Logger, Outputs, Release, Send
from .plan import Scan


class Storage:
    """Scans that were begun or given up, until they are stored and fitted, or stored as missing.

    Parameters
    ----------
    sample
        Their sample.
    log
        The sequencer's.
    """

    def __init__(self, sample: str, log: Logger) -> None:
        self._sample, self._log = sample, log
        self._wanted: dict[int, Scan] = {}
        self._on_disk: set[int] = set()
        """Scans of which the radiance is stored."""
        self._unfitted: set[int] = set()
        """Of those that were on disk at the beginning: their parameters are still to come."""
        self._missing: list[str] = []
        self._refused: list[str] = []

    def expect(self, scan: Scan) -> None:
        """A scan begins: something of it must come to the disk."""
        self._wanted[scan.number] = scan

    def expect_parameters(self, scans: Iterable[int]) -> None:
        """Scans were on disk before, but not fitted."""
        self._unfitted.update(scans)

    def missing(self, scan: Scan, reason: str) -> Outputs:
        """Record a scan as missing."""
        text = f"scan {scan.number} is missing: {reason}"
        self._log.warning(text)
        self._missing.append(text)
        self.expect(scan)
        message = ScanMissing(
            sample=self._sample, scan=scan.number, scan_time_s=scan.scan_time_s, reason=reason
        )
        yield Send(topic="/scan/missing", message=message, keep=str(scan.number))

    def take(self, stored: Stored) -> Outputs:
        """Take what the database says of one thing."""
        if stored.what == "missing":
            yield Release("/scan/missing", str(stored.scan))
        elif stored.what == "mark":
            yield Release("/operator/mark", str(stored.scan))
        if stored.refused:
            text = f"{stored.what} of scan {stored.scan} can't be stored: {stored.refused}"
            scan = self._wanted.get(stored.scan)
            if stored.what == "radiance" and scan is not None:
                yield from self.missing(scan, text)
            else:
                self._refused.append(text)
                self._log.error(text)
        elif stored.what == "radiance":
            self._on_disk.add(stored.scan)
        if stored.what in ("parameters", "missing"):
            self._wanted.pop(stored.scan, None)
            self._unfitted.discard(stored.scan)

    def unsaved(self, current: Scan | None) -> list[Scan]:
        """Return the scans before the current one of which no database has seen the radiance."""
        numbers = self._wanted.keys() - self._on_disk
        return [self._wanted[n] for n in sorted(numbers) if current is None or n < current.number]

    def has(self, scan: Scan | None) -> bool:
        """Return whether a scan's radiance is on disk."""
        return scan is not None and scan.number in self._on_disk

    def end(self) -> Exit | None:
        """Return how the run ends, once nothing is wanted any more."""
        if self._wanted or self._unfitted:
            return None
        if self._refused:
            return Exit(1, self._refused[-1])
        if self._missing and not self._on_disk:
            return Exit(1, f"nothing was measured: {self._missing[-1]}")
        return Exit(0)
