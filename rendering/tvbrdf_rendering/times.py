"""Times as people read them: seconds, minutes or hours, whichever suits a measurement's length."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class TimeUnit:
    """A unit of time: its sign and length in seconds."""

    sign: str
    seconds: float


def time_unit(times_s: Iterable[float]) -> TimeUnit:
    """Return the unit for an axis that shows these times."""
    longest = max((abs(time_s) for time_s in times_s), default=0.0)
    if longest <= 180:
        return TimeUnit("s", 1.0)
    return TimeUnit("min", 60.0) if longest <= 5 * 3600 else TimeUnit("h", 3600.0)
