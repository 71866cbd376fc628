"""Parameters of the arm's node."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmParameters:
    """Which arm, and how its node deals with it."""

    driver: str = "tvbrdf_nodes.arm.serial_arm:SerialArm"
    driver_parameters: dict[str, Any] = field(default_factory=dict)
    idle_tick_rate_hz: float = 2.0
    """How often the controller's clock is asked for (run's clock)."""
    sweep_tick_rate_hz: float = 10.0
    home_limit_s: float = 120.0
    """On the run's clock; other motions have limits that follow from their speed."""
    stop_limit_s: float = 1.0
    """Real time to wait at the end until the controller acknowledges stop and lamp off."""
    commander_lost_s: float = 5.0
    """Real time without a sequencer after which the arm stops and the lamp goes off."""

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        names = ("idle_tick_rate_hz", "sweep_tick_rate_hz", "home_limit_s", "stop_limit_s")
        for name in (*names, "commander_lost_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected more than 0")
