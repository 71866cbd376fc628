"""Parameters of a camera's node."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraParameters:
    """Which driver, and how the camera is used; what is special to a driver is in its own."""

    driver: str
    """``module:Class``."""
    driver_parameters: dict[str, Any] = field(default_factory=dict)
    frame_rate_hz: float = 30.0
    region: tuple[int, ...] | None = None
    """x, y, width, height in pixels; null: the whole sensor."""
    approximate_timing: bool = False
    """Whether scans may use a camera without exact exposure or without hardware stamps."""
    drop_stale_ms: float = 0.0
    """Frames that arrive within this time after a change of exposure are thrown away."""
    silence_s: float = 2.0
    """A capture without a frame for this long (and ten frames' time) is broken."""

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        if self.region is not None and len(self.region) != 4:
            raise ValueError(f"region is {list(self.region)}, expected [x, y, width, height]")
        if self.frame_rate_hz <= 0 or self.drop_stale_ms < 0 or self.silence_s <= 0:
            raise ValueError("frame_rate_hz, silence_s must be above 0, drop_stale_ms 0 or more")
