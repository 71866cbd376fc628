"""How late messages were played, in bounded memory."""

from __future__ import annotations

BIN_NS = 10_000
BINS = 10_000
"""Up to a tenth of a second; what is later counts as that, and in the maximum as what it was."""


class Lateness:
    """A histogram of how long after they were due messages had been sent."""

    def __init__(self) -> None:
        self._bins = [0] * (BINS + 1)
        self._count = 0
        self._max_ns = 0

    def add(self, late_ns: int) -> None:
        """Count one message."""
        self._bins[min(max(0, late_ns) // BIN_NS, BINS)] += 1
        self._count += 1
        self._max_ns = max(self._max_ns, late_ns)

    def quantile_ms(self, part: float) -> float:
        """Return what that part of all messages was not later than, to a hundredth of a ms."""
        wanted, seen = part * self._count, 0
        for index, count in enumerate(self._bins):
            seen += count
            if seen >= wanted:
                return min((index + 1) * BIN_NS, max(self._max_ns, 0)) / 1e6
        return 0.0

    def as_dict(self) -> dict[str, float]:
        """Return the figures for diagnostics."""
        return {
            "timed": self._count,
            "late_p50_ms": self.quantile_ms(0.5),
            "late_p99_ms": self.quantile_ms(0.99),
            "late_max_ms": self._max_ns / 1e6,
        }
