"""The run's clock: UTC at launch plus monotonic time since, or told on ``/clock``.

Nodes see a :class:`Clock` only; watchdogs and serial time-outs use monotonic time directly.
"""

from __future__ import annotations

import time
from typing import Protocol


class RunClock(Protocol):
    """Something that tells the run's time."""

    def now_ns(self) -> int:
        """Return the run's time in integer nanoseconds."""
        ...


class SystemClock:
    """UTC at launch plus monotonic time since; never stepped.

    Parameters
    ----------
    utc_ns, monotonic_ns
        The pair that the launcher read together and wrote into the graph, so that all processes of
        a host share one clock.
    """

    def __init__(self, utc_ns: int | None = None, monotonic_ns: int | None = None) -> None:
        monotonic = time.monotonic_ns() if monotonic_ns is None else monotonic_ns
        self._origin_ns = (time.time_ns() if utc_ns is None else utc_ns) - monotonic

    def now_ns(self) -> int:
        """Return UTC at launch plus monotonic time since."""
        return self._origin_ns + time.monotonic_ns()


class ToldClock:
    """The last time told on ``/clock``; before the first one, ``start_ns``."""

    def __init__(self, start_ns: int) -> None:
        self._now_ns = start_ns
        self.epoch = 0

    def now_ns(self) -> int:
        """Return the last time told."""
        return self._now_ns

    def tell(self, now_ns: int, epoch: int = 0) -> None:
        """Take a new time; within an epoch the clock never goes back."""
        if epoch != self.epoch:
            self.epoch, self._now_ns = epoch, now_ns
        else:
            self._now_ns = max(self._now_ns, now_ns)
