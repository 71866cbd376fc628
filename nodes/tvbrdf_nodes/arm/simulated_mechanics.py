"""The simulated arm itself: its motion, its lamp, and what breaks a motion."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

from tvbrdf_messages.messages import SimMotion

from .driver import ArmLimits
from .simulated_motion import Piece, SweepPlan, Trajectory, plan_halt, plan_move, plan_sweep


class Ending(NamedTuple):
    """A motion or a stop that has ended; ``code`` is empty when it did what was asked."""

    request_id: int
    code: str = ""


class Mechanics:
    """Moves when it is told to, up to the moment ``now_ns`` that its owner sets.

    Parameters
    ----------
    limits
        With which it moves.
    now_ns
        Run-clock time at which it is switched on.
    angle_deg
        Where it stands then, as the controller counts.
    offset_deg
        True angle minus the angle that the controller counts.
    """

    def __init__(self, limits: ArmLimits, now_ns: int, angle_deg: float, offset_deg: float) -> None:
        self.limits, self.now_ns = limits, now_ns
        self._offset_deg = offset_deg
        self._trajectory = Trajectory(now_ns, angle_deg)
        self._motion = 0
        """Number of the request under way; 0: none."""
        self._homing = False
        self._broken = ""
        self._stops: list[int] = []
        self.last: tuple[int, str] = (0, "-")
        """Number and outcome of the last motion."""
        self.lamp = self.homed = False
        self._switched: list[tuple[int, bool]] = [(now_ns, False)]

    def state(self) -> Piece:
        """Return angle, speed and acceleration at this moment, as the controller counts."""
        return self._trajectory.at(self.now_ns)

    @property
    def true_angle_deg(self) -> float:
        """Where the arm really is."""
        return self.state().angle_deg + self._offset_deg

    @property
    def moving(self) -> bool:
        """Whether a motion is under way."""
        return self._motion != 0 or self._trajectory.end_ns > self.now_ns

    @property
    def still_or_braking(self) -> bool:
        """Whether it is at rest, or will be without being told."""
        return not self.moving or bool(self._broken)

    @property
    def next_end_ns(self) -> int | None:
        """When a motion or stop under way ends."""
        return self._trajectory.end_ns if self._motion or self._stops else None

    def home(self, request_id: int, to_deg: float, speed_deg_s: float) -> None:
        """Begin to find the reference position."""
        self.homed = False
        self._begin(request_id, self._way_to(to_deg, min(speed_deg_s, self.limits.max_speed_deg_s)))
        self._homing = True

    def move(self, request_id: int, to_deg: float) -> None:
        """Begin to go to an angle."""
        self._begin(request_id, self._way_to(to_deg, self.limits.max_speed_deg_s))

    def _way_to(self, to_deg: float, speed_deg_s: float) -> list[Piece]:
        now = self.state()
        acceleration = self.limits.acceleration_deg_s2
        return plan_move(now.start_ns, now.angle_deg, to_deg, speed_deg_s, acceleration)

    def sweep(
        self, request_id: int, from_deg: float, to_deg: float, duration_s: float
    ) -> SweepPlan:
        """Begin a sweep; return how it will go."""
        plan = plan_sweep(
            self.state(),
            from_deg,
            to_deg,
            duration_s,
            max_speed_deg_s=self.limits.max_speed_deg_s,
            acceleration_deg_s2=self.limits.acceleration_deg_s2,
            settle_deg=self.limits.settle_deg,
        )
        self._begin(request_id, plan.pieces)
        return plan

    def _begin(self, request_id: int, pieces: list[Piece]) -> None:
        self._trajectory.replace(pieces)
        self._motion, self._homing, self._broken = request_id, False, ""
        self.last = (request_id, "running")

    def stop(self, request_id: int) -> None:
        """Brake; the request ends when it is at rest."""
        self.brake("stopped")
        self._stops.append(request_id)

    def brake(self, why: str, *, at_once: bool = False) -> None:
        """Break a motion under way: brake, or (a stalled motor) stand still at once."""
        now = self.state()
        if at_once:
            self._trajectory.replace([Piece(now.start_ns, now.angle_deg)])
        elif self._trajectory.end_ns > self.now_ns:
            self._trajectory.replace(plan_halt(now, self.limits.acceleration_deg_s2))
        if self._motion:
            self._broken = self._broken or why

    def settle(self) -> list[Ending]:
        """Return what has ended by now."""
        if self._trajectory.end_ns > self.now_ns:
            return []
        ended = []
        if self._motion:
            ended.append(Ending(self._motion, self._broken))
            self.last = (self._motion, self._broken or "done")
            self.homed = self.homed or (self._homing and not self._broken)
            self._motion, self._homing, self._broken = 0, False, ""
        ended.extend(Ending(request_id) for request_id in self._stops)
        self._stops.clear()
        return ended

    def switch(self, on: bool) -> None:
        """Switch the lamp."""
        if on != self.lamp:
            self.lamp = on
            self._switched.append((self.now_ns, on))

    def run_down(self) -> None:
        """Let a motion that brakes come to its end."""
        self.now_ns = max(self.now_ns, self._trajectory.end_ns)

    def take_motion(self, start_ns: int, end_ns: int) -> SimMotion:
        """Return the light's true motion in an interval that is over, and forget it."""
        lamp = [on for t, on in self._switched if t <= start_ns][-1]
        switched = [(t, on) for t, on in self._switched if start_ns < t < end_ns]
        cuts = [(start_ns, lamp), *switched, (end_ns, lamp)]
        pieces = [
            (piece, on)
            for (begin, on), (end, _) in pairwise(cuts)
            if begin < end
            for piece in self._trajectory.between(begin, end)
        ]
        self._trajectory.forget(end_ns)
        last = [item for item in self._switched if item[0] <= end_ns][-1]
        self._switched = [last, *(item for item in self._switched if item[0] > end_ns)]
        return SimMotion(
            until_ns=end_ns,
            start_ns=tuple(piece.start_ns for piece, _ in pieces),
            angle_deg=tuple(piece.angle_deg + self._offset_deg for piece, _ in pieces),
            speed_deg_s=tuple(piece.speed_deg_s for piece, _ in pieces),
            acceleration_deg_s2=tuple(piece.acceleration_deg_s2 for piece, _ in pieces),
            lamp=tuple(on for _, on in pieces),
        )
