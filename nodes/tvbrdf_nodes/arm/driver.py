"""What an arm driver is: the Protocol that the arm's node needs, and what it reads.

A driver class is named in a launch file as ``module:Class`` and constructed as
``Class(parameters, context)`` with its own ``parameters_type`` (a frozen dataclass) and a
:class:`~tvbrdf_nodes.core.device.DriverContext`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from ..core.device import Driver


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmIdentity:
    """What a controller is."""

    model: str
    serial: str
    watchdog_s: float
    """It stops by itself that long after the last keepalive; 0: it never does."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmLimits:
    """Within what an arm may move."""

    min_angle_deg: float
    max_angle_deg: float
    max_speed_deg_s: float
    acceleration_deg_s2: float
    """With which it accelerates and brakes."""
    settle_deg: float = 0.0
    """Way at constant speed before and after a sweep."""

    def run_up_deg(self, speed_deg_s: float) -> float:
        """Return how far outside its ends a sweep begins and ends: v²/2a, and the settling way."""
        return speed_deg_s**2 / (2.0 * self.acceleration_deg_s2) + self.settle_deg

    def refuse_angle(self, angle_deg: float, what: str = "angle") -> str:
        """Return why the arm may not go to an angle; empty if it may."""
        if not math.isfinite(angle_deg):
            return f"{what} is {angle_deg}"
        if not self.min_angle_deg <= angle_deg <= self.max_angle_deg:
            return (
                f"{what} {angle_deg:.6g}° is outside the arm's limits of "
                f"{self.min_angle_deg:g}° to {self.max_angle_deg:g}°"
            )
        return ""

    def refuse_sweep(self, from_deg: float, to_deg: float, duration_s: float) -> str:
        """Return why a sweep is out of limits, run-up and run-down included; empty if it is not."""
        reason = self.refuse_angle(from_deg, "start") or self.refuse_angle(to_deg, "end")
        if reason:
            return reason
        if from_deg == to_deg or not (math.isfinite(duration_s) and duration_s > 0):
            return f"a sweep from {from_deg:g}° to {to_deg:g}° in {duration_s:g} s is none"
        speed = abs(to_deg - from_deg) / duration_s
        if speed > self.max_speed_deg_s:
            return (
                f"speed {speed:.6g}°/s is above the arm's limit of {self.max_speed_deg_s:g}°/s; "
                f"take at least {abs(to_deg - from_deg) / self.max_speed_deg_s:.3g} s"
            )
        start, end = self.sweep_ends_deg(from_deg, to_deg, duration_s)
        way = f"with {self.run_up_deg(speed):.3g}° to accelerate, the sweep's"
        return self.refuse_angle(start, f"{way} start") or self.refuse_angle(end, f"{way} end")

    def sweep_ends_deg(
        self, from_deg: float, to_deg: float, duration_s: float
    ) -> tuple[float, float]:
        """Return where a sweep begins and ends at rest."""
        run_up = self.run_up_deg(abs(to_deg - from_deg) / duration_s)
        side = math.copysign(run_up, to_deg - from_deg)
        return from_deg - side, to_deg + side


# -- what is read


@dataclass(frozen=True, slots=True, kw_only=True)
class Ready:
    """The controller is there, still and dark, and takes requests from now on."""

    identity: ArmIdentity
    limits: ArmLimits


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmReading:
    """Where the arm was."""

    tick_ns: int
    """On the controller's own clock, unwrapped."""
    received_ns: int
    """On the run's clock."""
    angle_deg: float
    speed_deg_s: float
    lamp: bool
    moving: bool
    homed: bool
    fault: str = ""
    emergency_stop: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundTrip:
    """The controller's clock was read between two moments of the run's clock."""

    sent_ns: int
    tick_ns: int
    received_ns: int
    one_way_ns: int
    """Delay of a reading, if both ways are alike."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledged:
    """The controller has accepted a request."""

    token: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionDone:
    """A motion (or a stop) has ended; ``reason`` is empty when it did what was asked."""

    token: int
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Refused:
    """The controller has not accepted a request."""

    token: int
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmFault:
    """The controller did something by itself."""

    code: str
    text: str


Reading = Ready | ArmReading | RoundTrip | Acknowledged | MotionDone | Refused | ArmFault


class ArmDriver(Driver, Protocol):
    """An arm. Used by one thread; nothing blocks but :meth:`halt`.

    Requests return a token. What became of one is read: :class:`Acknowledged` or
    :class:`Refused`, and for motions and stops a :class:`MotionDone` once the arm is at rest.
    Any method may raise :class:`~tvbrdf_nodes.core.device.DeviceError`.

    On :meth:`open` a driver stops the arm and switches the lamp off; :class:`Ready` is the first
    that it reads after that. Until then no motion may be asked for.
    """

    @property
    def identity(self) -> ArmIdentity:
        """What it is; once it is ready."""
        ...

    @property
    def limits(self) -> ArmLimits:
        """What its node may ask of it; once it is ready."""
        ...

    def home(self) -> int:
        """Find the reference position."""
        ...

    def move(self, angle_deg: float) -> int:
        """Go to an angle, as fast as the limits allow."""
        ...

    def sweep(self, from_deg: float, to_deg: float, duration_s: float) -> int:
        """Move at constant speed between two angles; accelerate and brake outside them."""
        ...

    def stop(self) -> int:
        """Brake. A motion under way is broken."""
        ...

    def lamp(self, on: bool) -> int:
        """Switch the lamp."""
        ...

    def keepalive(self) -> None:
        """Say that the node is well, if it is time to; called from the node's main loop only."""
        ...

    def ask_tick(self) -> None:
        """Ask for a :class:`RoundTrip`; nothing comes where an earlier one is still asked for."""
        ...

    def read(self) -> list[Reading]:
        """Return what has come; never blocks."""
        ...

    def halt(self, timeout_s: float) -> bool:
        """Stop and switch the lamp off, whatever else; return whether both were acknowledged.

        Waits for that at most ``timeout_s`` of real time; raises nothing.
        """
        ...

    def counters(self) -> dict[str, float]:
        """Return figures for the diagnostics: lines, retries …"""
        ...
