"""Numbers for people: durations, sizes, and values with their uncertainty."""

from __future__ import annotations

import math


def duration(seconds: float) -> str:
    """Return a duration as ``m:ss`` or ``h:mm:ss``."""
    whole = max(0, round(seconds))
    hours, rest = divmod(whole, 3600)
    minutes, left = divmod(rest, 60)
    return f"{hours}:{minutes:02}:{left:02}" if hours else f"{minutes}:{left:02}"


def plus_minus(value: float, deviation: float) -> str:
    """Return ``value ± deviation`` with two significant digits of the deviation."""
    if not math.isfinite(value):
        return "undetermined"
    if not math.isfinite(deviation) or deviation <= 0:
        return f"{value:.4g} ± ?" if deviation != 0 else f"{value:.4g}"
    decimals = max(0, 1 - math.floor(math.log10(deviation)))
    if decimals > 9:
        return f"{value:.6g} ± {deviation:.1e}"
    return f"{value:.{decimals}f} ± {deviation:.{decimals}f}"


def size(count: float) -> str:
    """Return a number of bytes as people read it (1 kB = 1000 B)."""
    for unit in ("B", "kB", "MB", "GB"):
        if abs(count) < 1000 or unit == "GB":
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.2f} {unit}"
        count /= 1000
    raise AssertionError("unreachable")
