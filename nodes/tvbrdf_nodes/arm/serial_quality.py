"""How much of what comes over the line can be used."""

from __future__ import annotations

from collections import deque

from .protocol import Line, LineParser

LAST_LINES = 50


class WatchedParser(LineParser):
    """A parser that remembers which of the last lines could not be used."""

    def __init__(self) -> None:
        super().__init__()
        self._unusable: deque[bool] = deque(maxlen=LAST_LINES)

    def feed(self, data: bytes) -> list[Line]:
        """See :class:`.protocol.LineParser`."""
        before = self.unreadable
        lines = super().feed(data)
        self._unusable.extend([False] * len(lines))
        self._unusable.extend([True] * (self.unreadable - before))
        return lines

    def trouble(self, max_unreadable_fraction: float) -> str:
        """Return what is wrong where too many of the last lines could not be used, else ''."""
        bad = sum(self._unusable)
        full = len(self._unusable) == LAST_LINES
        if not full or bad <= max_unreadable_fraction * LAST_LINES:
            return ""
        return (
            f"{bad} of the last {LAST_LINES} lines were unreadable "
            f"({self.wrong_checksums} wrong checksums, {self.malformed} malformed, "
            f"{self.too_long} too long in all); check baud_rate, cable and shielding"
        )

    def counters(self) -> dict[str, float]:
        """Return how many lines could be used, and why others could not."""
        return {
            "lines": self.read,
            "wrong_checksums": self.wrong_checksums,
            "malformed_lines": self.malformed,
            "too_long_lines": self.too_long,
        }
