"""What one kind of export has made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

Tell = Callable[[float], None]
"""Told how much is done, 0 to 1."""


@dataclass
class Written:
    """What one kind of export has made, and what it had to leave out."""

    format: str
    path: str
    """Below the folder of the export."""
    counts: dict[str, int] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    """What was left out, and why."""

    def count(self, name: str, more: int = 1) -> None:
        """Count something that was written."""
        self.counts[name] = self.counts.get(name, 0) + more

    def plain(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "format": self.format,
            "path": self.path,
            "counts": self.counts,
            "remarks": self.remarks,
        }


class Progress:
    """Tells how far a bag has been read, by log time."""

    def __init__(self, tell: Tell, start_ns: int, end_ns: int) -> None:
        self._tell, self._start_ns = tell, start_ns
        self._span_ns = max(1, end_ns - start_ns)

    def at(self, log_time_ns: int) -> None:
        """Tell that everything before ``log_time_ns`` is done."""
        self._tell((log_time_ns - self._start_ns) / self._span_ns)
