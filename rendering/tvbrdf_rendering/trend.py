"""How a fitted parameter moves from scan to scan: within noise, along a line, or otherwise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from tvbrdf_fitting.geometry import FloatArray

SIGNIFICANT = 3.0
"""Deviations from which a change is one."""


@dataclass(frozen=True)
class Trend:
    """How one parameter moves from scan to scan, over the scans that determine it.

    Attributes
    ----------
    name, unit
        Parameter.
    scans
        Number of scans in which it is determined and not at a bound.
    first, last
        Values in the first and the last of them.
    mean, mean_deviation
        Weighted by the random variances.
    scatter
        Chi-square of a constant by its degrees of freedom.
    slope, slope_deviation
        Of a straight line, by `per` ("min" or "scan"). What it leaves beyond noise is added to the
        noise of every value.
    kind
        "constant" within noise, "rises" or "falls" where the line's slope is significant, else
        "varies"; "unknown" with fewer than three scans.
    """

    name: str
    unit: str
    scans: int
    first: float | None = None
    last: float | None = None
    mean: float | None = None
    mean_deviation: float | None = None
    scatter: float | None = None
    slope: float | None = None
    slope_deviation: float | None = None
    per: str = "scan"
    kind: Literal["constant", "rises", "falls", "varies", "unknown"] = "unknown"

    def as_dict(self) -> dict[str, Any]:
        """Everything as plain Python types."""
        return asdict(self)


def trend_of(
    name: str,
    unit: str,
    rows: Sequence[tuple[float, float, float]],
    *,
    per: Literal["min", "scan"],
) -> Trend:
    """Return the trend of a parameter from (time in `per`, value, deviation) of each scan."""
    if len(rows) < 3:
        return Trend(name, unit, len(rows))
    time, value, deviation = np.array(rows).T
    weight = deviation**-2
    mean = float(weight @ value / weight.sum())
    freedom = len(rows) - 1
    scatter = float(weight @ np.square(value - mean)) / freedom
    slope, slope_deviation = _slope(time, value, deviation)
    kind: Literal["constant", "rises", "falls", "varies"] = "varies"
    if abs(slope) > SIGNIFICANT * slope_deviation:
        kind = "rises" if slope > 0 else "falls"
    elif scatter <= 1.0 + SIGNIFICANT * math.sqrt(2.0 / freedom):
        kind = "constant"
    return Trend(
        name,
        unit,
        len(rows),
        first=float(value[0]),
        last=float(value[-1]),
        mean=mean,
        mean_deviation=float(weight.sum() ** -0.5),
        scatter=scatter,
        slope=slope,
        slope_deviation=slope_deviation,
        per=per,
        kind=kind,
    )


def _slope(time: FloatArray, value: FloatArray, deviation: FloatArray) -> tuple[float, float]:
    """Slope of a straight line and its deviation; what the line leaves counts as noise too."""
    whole = value - value.mean()
    away = time - time.mean()
    left = whole - float(away @ whole) / float(away @ away) * away
    excess = max(float(left @ left) / max(len(time) - 2, 1) - float(np.mean(deviation**2)), 0.0)
    weight = 1.0 / (np.square(deviation) + excess)
    away = time - float(weight @ time / weight.sum())
    leverage = float(weight @ np.square(away))
    return float(weight @ (away * value)) / leverage, leverage**-0.5
