"""Parameters of the serial arm."""

from __future__ import annotations

from dataclasses import dataclass

MAX_WATCHDOG_S = 0.5
"""Of a controller that may be left alone with the lamp."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SerialArmParameters:
    """How the controller is reached, and what it may do."""

    port: str
    """``/dev/ttyUSB0``, ``socket://host:port``, ``rfc2217://host:port`` …"""
    baud_rate: int = 115200
    report_rate_hz: float = 50.0
    """Of position reports in a sweep."""
    idle_report_rate_hz: float = 5.0
    """Of position reports at other times."""
    arrival_stamps: str = "host"
    """``host``: lines are stamped when they are read; ``line``: a line monitor adds the stamp."""
    unattended: bool = True
    """Refuse a controller that would go on by itself if this program died."""
    min_angle_deg: float = -110.0
    max_angle_deg: float = 110.0
    max_speed_deg_s: float = 60.0
    max_acceleration_deg_s2: float = 90.0
    keepalive_s: float = 0.1
    answer_timeout_s: float = 0.5
    attempts: int = 3
    """How often a request is sent before the controller counts as gone."""
    connect_timeout_s: float = 5.0
    """Real time for the port to appear and the controller to answer."""
    max_unreadable_fraction: float = 0.2
    """Of the last 50 lines."""

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        if not self.port:
            raise ValueError("port is empty; give e.g. /dev/ttyUSB0 or socket://host:port")
        if self.arrival_stamps not in ("host", "line"):
            raise ValueError(f"arrival_stamps is {self.arrival_stamps!r}, expected host or line")
        if not self.min_angle_deg < self.max_angle_deg:
            raise ValueError("min_angle_deg must be below max_angle_deg")
        if not 0 < self.keepalive_s <= MAX_WATCHDOG_S / 2:
            raise ValueError(f"keepalive_s is {self.keepalive_s}, expected up to 0.25")
        positive = ("baud_rate", "max_speed_deg_s", "max_acceleration_deg_s2", "attempts")
        rates = ("report_rate_hz", "idle_report_rate_hz", "answer_timeout_s", "connect_timeout_s")
        for name in (*positive, *rates):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected more than 0")
