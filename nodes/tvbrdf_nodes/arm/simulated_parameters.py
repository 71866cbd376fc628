"""What the simulated controller is, and its clock."""

from __future__ import annotations

from dataclasses import dataclass

from .driver import ArmLimits


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerParameters:
    """What the simulated controller is."""

    model: str = "TVBRDF-ARM"
    serial: str = "SIMULATED-1"
    min_angle_deg: float = -115.0
    max_angle_deg: float = 115.0
    max_speed_deg_s: float = 60.0
    max_acceleration_deg_s2: float = 60.0
    settle_deg: float = 0.5
    """Way at constant speed before and after a sweep."""
    home_deg: float = 0.0
    homing_speed_deg_s: float = 30.0
    power_up_deg: float = -20.0
    """Where the arm stands when the controller is switched on."""
    tick_bits: int = 32
    """Of the microsecond counter; 32 bits wrap around after 71.6 minutes."""
    keepalive_watchdog: bool = True
    watchdog_s: float = 0.5
    """Real time in which the twin ran, from the last keepalive until it stops by itself."""

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        if not self.min_angle_deg <= self.power_up_deg <= self.max_angle_deg:
            raise ValueError("power_up_deg is outside min_angle_deg to max_angle_deg")
        if not self.min_angle_deg <= self.home_deg <= self.max_angle_deg:
            raise ValueError("home_deg is outside min_angle_deg to max_angle_deg")
        positive = ("max_speed_deg_s", "max_acceleration_deg_s2", "homing_speed_deg_s")
        for name in (*positive, "watchdog_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected more than 0")
        if self.settle_deg < 0 or not 16 <= self.tick_bits <= 64:
            raise ValueError("settle_deg is 0 or more, tick_bits 16 to 64")

    def limits(self) -> ArmLimits:
        """Return its built-in limits."""
        return ArmLimits(
            min_angle_deg=self.min_angle_deg,
            max_angle_deg=self.max_angle_deg,
            max_speed_deg_s=self.max_speed_deg_s,
            acceleration_deg_s2=self.max_acceleration_deg_s2,
            settle_deg=self.settle_deg,
        )


class TickClock:
    """The controller's microsecond counter: its own offset and drift; integers, so exact."""

    def __init__(self, zero_ns: int, offset_s: float, drift_ppm: float) -> None:
        self._origin_ns = zero_ns - round(1e9 * offset_s)
        self._rate = 1_000_000_000 + round(1e3 * drift_ppm)

    def count(self, now_ns: int) -> int:
        """Return the microseconds that it has counted at a moment of the run's clock."""
        return (now_ns - self._origin_ns) * self._rate // 10**12

    def when(self, count: int) -> int:
        """Return the first nanosecond at which it has counted that far."""
        return self._origin_ns - (-count * 10**12 // self._rate)
