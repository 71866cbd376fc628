"""Time in which this process ran: what to wait by for somebody's answer."""

from __future__ import annotations

import time

MAX_GAP_S = 0.2


class AwakeTime:
    """Monotonic time, of which no gap between two looks counts for more than ``MAX_GAP_S``.

    Where a whole machine has stood still, nobody could answer, and nothing says who is late. The
    clock must be looked at more often than ``MAX_GAP_S`` while somebody waits by it.
    """

    def __init__(self) -> None:
        self._looked_s = time.monotonic()
        self._awake_s = 0.0

    def now_s(self) -> float:
        """Return the seconds awake since this clock was made."""
        now_s = time.monotonic()
        self._awake_s += min(now_s - self._looked_s, MAX_GAP_S)
        self._looked_s = now_s
        return self._awake_s
