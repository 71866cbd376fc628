"""How the simulated arm moves: pieces of constant acceleration, planned exactly."""

from __future__ import annotations

import math
from bisect import bisect_right
from typing import NamedTuple


class Piece(NamedTuple):
    """From ``start_ns`` on: angle + speed·t + ½·acceleration·t² (degrees, seconds)."""

    start_ns: int
    angle_deg: float
    speed_deg_s: float = 0.0
    acceleration_deg_s2: float = 0.0

    def at(self, now_ns: int) -> Piece:
        """Return what is left of this piece from ``now_ns`` on."""
        t = (now_ns - self.start_ns) * 1e-9
        half = 0.5 * self.acceleration_deg_s2 * t
        return Piece(
            now_ns,
            self.angle_deg + (self.speed_deg_s + half) * t,
            self.speed_deg_s + self.acceleration_deg_s2 * t,
            self.acceleration_deg_s2,
        )


class Trajectory:
    """The arm's past and planned motion; its last piece is always one of rest."""

    def __init__(self, start_ns: int, angle_deg: float) -> None:
        self._pieces = [Piece(start_ns, angle_deg)]
        self._starts = [start_ns]

    @property
    def end_ns(self) -> int:
        """From when on it is at rest."""
        return self._starts[-1]

    def at(self, now_ns: int) -> Piece:
        """Return angle, speed and acceleration at a moment."""
        return self._pieces[max(0, bisect_right(self._starts, now_ns) - 1)].at(now_ns)

    def replace(self, pieces: list[Piece]) -> None:
        """Go on differently from the first of ``pieces`` on; the last one must be one of rest."""
        keep = bisect_right(self._starts, pieces[0].start_ns - 1)
        after = [*(piece.start_ns for piece in pieces[1:]), None]
        pieces = [p for p, end in zip(pieces, after, strict=True) if p.start_ns != end]
        self._pieces[keep:] = pieces
        self._starts[keep:] = [piece.start_ns for piece in pieces]

    def between(self, start_ns: int, end_ns: int) -> list[Piece]:
        """Return the pieces of an interval; the first one begins with it."""
        first = bisect_right(self._starts, start_ns)
        last = bisect_right(self._starts, end_ns - 1)
        return [self.at(start_ns), *self._pieces[first:last]]

    def forget(self, before_ns: int) -> None:
        """Drop pieces that ended before a moment."""
        keep = max(0, bisect_right(self._starts, before_ns) - 1)
        del self._pieces[:keep], self._starts[:keep]


def plan_halt(now: Piece, acceleration_deg_s2: float) -> list[Piece]:
    """Return how the arm brakes from a moment on."""
    speed = now.speed_deg_s
    if speed == 0.0:
        return [Piece(now.start_ns, now.angle_deg)]
    braking = Piece(now.start_ns, now.angle_deg, speed, math.copysign(acceleration_deg_s2, -speed))
    end_deg = now.angle_deg + speed * abs(speed) / (2.0 * acceleration_deg_s2)
    return [braking, Piece(_after(now.start_ns, abs(speed) / acceleration_deg_s2), end_deg)]


def plan_move(
    start_ns: int,
    from_deg: float,
    to_deg: float,
    max_speed_deg_s: float,
    acceleration_deg_s2: float,
) -> list[Piece]:
    """Return a motion from rest to rest: a trapezoid of speed, or a triangle where it is short."""
    way = abs(to_deg - from_deg)
    if way < 1e-9:
        return [Piece(start_ns, to_deg)]
    peak = min(max_speed_deg_s, math.sqrt(way * acceleration_deg_s2))
    cruise_deg = max(0.0, way - peak**2 / acceleration_deg_s2)
    return _trapezoid(start_ns, from_deg, to_deg, peak, cruise_deg, acceleration_deg_s2)


class SweepPlan(NamedTuple):
    """A sweep, and between which moments it passes its two ends at constant speed."""

    pieces: list[Piece]
    first_ns: int
    last_ns: int


def plan_sweep(
    now: Piece,
    from_deg: float,
    to_deg: float,
    duration_s: float,
    *,
    max_speed_deg_s: float,
    acceleration_deg_s2: float,
    settle_deg: float,
) -> SweepPlan:
    """Return the way to a sweep's start (at rest), and the sweep with run-up and run-down.

    Between ``from_deg`` and ``to_deg``, and ``settle_deg`` beyond, the speed is constant.
    """
    speed = abs(to_deg - from_deg) / duration_s
    outside = math.copysign(speed**2 / (2.0 * acceleration_deg_s2) + settle_deg, to_deg - from_deg)
    start, end = from_deg - outside, to_deg + outside
    approach = plan_move(now.start_ns, now.angle_deg, start, max_speed_deg_s, acceleration_deg_s2)
    start_ns = approach[-1].start_ns
    cruise_deg = abs(to_deg - from_deg) + 2.0 * settle_deg
    sweep = _trapezoid(start_ns, start, end, speed, cruise_deg, acceleration_deg_s2)
    first_ns = _after(sweep[1].start_ns, settle_deg / speed)
    return SweepPlan([*approach[:-1], *sweep], first_ns, _after(first_ns, duration_s))


def _trapezoid(
    start_ns: int, from_deg: float, to_deg: float, peak: float, cruise_deg: float, rate: float
) -> list[Piece]:
    """Return the pieces of a motion; each starts at its exact angle, so no error adds up."""
    sign = math.copysign(1.0, to_deg - from_deg)
    ramp_deg = sign * peak**2 / (2.0 * rate)
    cruise_ns = _after(start_ns, peak / rate)
    brake_ns = _after(cruise_ns, cruise_deg / peak)
    return [
        Piece(start_ns, from_deg, 0.0, sign * rate),
        Piece(cruise_ns, from_deg + ramp_deg, sign * peak, 0.0),
        Piece(brake_ns, to_deg - ramp_deg, sign * peak, -sign * rate),
        Piece(_after(brake_ns, peak / rate), to_deg),
    ]


def _after(start_ns: int, seconds: float) -> int:
    return start_ns + round(1e9 * seconds)
