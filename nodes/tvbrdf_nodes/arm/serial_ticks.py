"""The controller's tick count, without its wrapping around."""

from __future__ import annotations


class TickCounter:
    """Makes a count that wraps around into one that does not.

    Two counts in a row must be less than half the range apart (35 minutes at 32 bits).
    """

    def __init__(self, bits: int) -> None:
        self._range = 1 << bits
        self._last: int | None = None

    def unwrap(self, raw: int) -> int:
        """Return the count that belongs to ``raw``; the first one is taken as it is."""
        if self._last is None:
            self._last = raw
        half = self._range // 2
        self._last += (raw - self._last + half) % self._range - half
        return self._last
