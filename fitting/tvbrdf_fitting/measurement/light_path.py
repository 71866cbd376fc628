"""Where the light was when: the arm's reports of a sweep, interpolated at the frames' stamps.

The arm goes through a trapezoidal speed profile and reports at about 50 Hz. Straight lines between
reports are exact at constant speed; with the reported speeds, cubic Hermite pieces are exact at
constant acceleration too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import BoolArray, FloatArray, IntArray

DEFAULT_MAX_GAP_MS = 200.0


@dataclass(frozen=True, eq=False)
class LightPath:
    """World angle of the light over time, from the arm's reports. Build it by `from_reports`.

    Parameters
    ----------
    stamp_ns : ndarray of int64, (n,)
        On the run's clock, strictly increasing.
    angle_deg : ndarray, (n,)
        World angle: 0 above the plate, rising with the direction of a forward sweep.
    speed_deg_s : ndarray, (n,), or None
        As reported.
    max_gap_ms : float
        Between reports further apart than this the light's position is not known.
    """

    stamp_ns: IntArray
    angle_deg: FloatArray
    speed_deg_s: FloatArray | None
    max_gap_ms: float

    @classmethod
    def from_reports(
        cls,
        stamp_ns: ArrayLike,
        angle_deg: ArrayLike,
        speed_deg_s: ArrayLike | None = None,
        *,
        max_gap_ms: float = DEFAULT_MAX_GAP_MS,
    ) -> LightPath:
        """Build a path from reports in any order; a repeated stamp counts once.

        Raises
        ------
        ValueError
            If the rows differ in length, hold numbers that are not finite, or fewer than two
            reports are left.
        """
        stamps = np.asarray(stamp_ns)
        if stamps.ndim != 1 or (stamps.size and not np.issubdtype(stamps.dtype, np.integer)):
            raise ValueError(
                f"arm: stamps are {stamps.dtype}, {stamps.shape}; give integer ns, (n,)"
            )
        columns = [np.asarray(angle_deg, dtype=np.float64)]
        if speed_deg_s is not None:
            columns.append(np.asarray(speed_deg_s, dtype=np.float64))
        for column in columns:
            if column.shape != stamps.shape or not np.all(np.isfinite(column)):
                raise ValueError(
                    f"arm: {stamps.size} stamps with angles or speeds of shape {column.shape}; "
                    "give one finite angle (and speed) a stamp"
                )
        stamps, kept = np.unique(stamps.astype(np.int64), return_index=True)
        if stamps.size < 2:
            raise ValueError(
                f"arm: {stamps.size} position reports in the sweep; the light's position needs at "
                "least two: check the arm's connection and its report rate"
            )
        speeds = columns[1][kept] if len(columns) == 2 else None
        return cls(stamps, columns[0][kept], speeds, max_gap_ms)

    def known_at(self, stamp_ns: ArrayLike) -> BoolArray:
        """Whether the stamps (any shape) lie between reports that are close enough in time."""
        stamps = np.asarray(stamp_ns, dtype=np.int64)
        inside = (stamps >= self.stamp_ns[0]) & (stamps <= self.stamp_ns[-1])
        left = self._interval(stamps)
        wide = np.diff(self.stamp_ns) > self.max_gap_ms * 1e6
        exact = (stamps == self.stamp_ns[left]) | (stamps == self.stamp_ns[left + 1])
        return np.asarray(inside & (~wide[left] | exact))

    def angle_at(self, stamp_ns: ArrayLike) -> FloatArray:
        """World angle in degrees at the stamps (any shape); NaN where it is not known.

        Nothing is extrapolated: see `known_at`.
        """
        return self._interpolate(stamp_ns)[0]

    def speed_at(self, stamp_ns: ArrayLike) -> FloatArray:
        """Speed in degrees a second (signed) at the stamps (any shape); NaN where not known."""
        return self._interpolate(stamp_ns)[1]

    def _interval(self, stamps: IntArray) -> NDArray[np.intp]:
        left = np.searchsorted(self.stamp_ns, stamps, side="right") - 1
        return np.clip(left, 0, self.stamp_ns.size - 2)

    def _interpolate(self, stamp_ns: ArrayLike) -> tuple[FloatArray, FloatArray]:
        stamps = np.asarray(stamp_ns, dtype=np.int64)
        left = self._interval(stamps)
        # differences are taken as integers: UTC in ns is beyond float64's exact whole numbers
        length_s = (self.stamp_ns[left + 1] - self.stamp_ns[left]) / 1e9
        u = (stamps - self.stamp_ns[left]) / 1e9 / length_s
        start, end = self.angle_deg[left], self.angle_deg[left + 1]
        slope = (end - start) / length_s
        if self.speed_deg_s is None:
            angle, speed = start + u * (end - start), slope
        else:
            bend_start = self.speed_deg_s[left] - slope
            bend_end = self.speed_deg_s[left + 1] - slope
            # Hermite's cubic as the chord plus what the end speeds bend it by
            bend = u * (1.0 - u) * ((1.0 - u) * bend_start - u * bend_end)
            angle = start + u * (end - start) + length_s * bend
            speed = (
                slope + (1.0 - u) * (1.0 - 3.0 * u) * bend_start + u * (3.0 * u - 2.0) * bend_end
            )
        known = self.known_at(stamps)
        return np.where(known, angle, np.nan), np.where(known, speed, np.nan)
