"""When scans are due and how their sweeps run: pure arithmetic of the sequencer."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from tvbrdf_messages.messages import ScanStatus


@dataclass(frozen=True, slots=True, kw_only=True)
class SequencerParameters:
    """What is measured."""

    sample: str
    scans: int = 3
    interval_s: float = 60.0
    """From the start of one scan to the next; 0: each waits for the operator (``tvbrdf scan``)."""
    exposures_ms: tuple[float, ...] = (0.2, 4.0, 32.0)
    cameras: tuple[str, ...] = ("camera_1", "camera_2", "camera_3", "camera_4")
    arm: str = "arm"
    sweep_s: float = 12.0
    """Over half a circle."""
    end_angle_deg: float = 90.0
    dark_frames: int = 8
    """At each exposure, lamp off, in each scan; 0: none."""
    lamp_settle_s: float = 2.0
    """Wait after the lamp is switched on again."""
    warm_up_s: float = 60.0
    """Wait after the lamp is switched on for the first time."""
    attempts: int = 3
    """Of one sweep, within the scan's time slot."""
    restart_limit_s: float = 30.0
    """Real time that a node may take to come back."""
    answer_limit_s: float = 60.0
    """Real time that a device may take for a command, beyond its own duration."""
    command_life_s: float = 60.0
    """On the run's clock: after that a command is refused as late."""

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        if self.scans < 1:
            raise ValueError(f"scans is {self.scans}, expected 1 or more")
        if not self.exposures_ms or min(self.exposures_ms) <= 0:
            raise ValueError(f"exposures_ms is {list(self.exposures_ms)}, expected some above 0")
        if not self.cameras:
            raise ValueError("cameras is empty: name at least one")
        if self.sweep_s <= 0 or not 0 < self.end_angle_deg <= 100:
            raise ValueError("sweep_s must be above 0, end_angle_deg in (0, 100]")
        if self.interval_s < 0 or self.attempts < 1 or self.dark_frames < 0:
            raise ValueError("interval_s, dark_frames: 0 or more; attempts: 1 or more")

    def sweep_range_deg(self, sweep_count: int) -> tuple[float, float]:
        """Return from where to where the ``sweep_count``-th sweep of all runs; they alternate."""
        end = self.end_angle_deg
        return (-end, end) if sweep_count % 2 == 0 else (end, -end)

    def scan_duration_s(self) -> float:
        """Return about how long one scan takes, without retakes."""
        sweeps = len(self.exposures_ms) * (self.sweep_s + 2.0)
        dark = self.lamp_settle_s + 2.0 if self.dark_frames else 0.0
        return sweeps + dark

    def slot_end_ns(self, start_ns: int) -> int:
        """Return until when a scan that was due at ``start_ns`` may still be retaken."""
        if self.interval_s <= 0:
            return start_ns + int(3e9 * self.scan_duration_s())
        return start_ns + int(1e9 * max(self.interval_s, self.scan_duration_s()))


@dataclass(slots=True)
class Scan:
    """The scan that is being measured."""

    number: int
    due_ns: int
    start_ns: int
    scan_time_s: float
    sweep: int = 0
    tries: Counter[int] = field(default_factory=Counter)
    """How often each sweep has been begun for nothing."""

    @property
    def attempt(self) -> int:
        """From 1; no two tries of one sweep have the same."""
        return self.tries[self.sweep] + 1

    @property
    def key(self) -> tuple[int, int, int]:
        """Scan, sweep and attempt."""
        return (self.number, self.sweep, self.attempt)

    @property
    def most_tries(self) -> int:
        """How often the sweep that broke most has been begun for nothing."""
        return max(self.tries.values(), default=0)

    def begin_again(self, *, from_first: bool) -> None:
        """Take this sweep again, or all up to it when the earlier ones are lost as well."""
        for sweep in range(0 if from_first else self.sweep, self.sweep + 1):
            self.tries[sweep] += 1
        if from_first:
            self.sweep = 0

    def command_fields(self, parameters: SequencerParameters, sweep_count: int) -> dict[str, Any]:
        """Return what every command of this scan says of it."""
        sweep = min(self.sweep, len(parameters.exposures_ms) - 1)
        from_deg, to_deg = parameters.sweep_range_deg(sweep_count)
        return {
            "scan": self.number,
            "sweep": sweep,
            "attempt": self.attempt,
            "scan_time_s": self.scan_time_s,
            "scan_start_ns": self.start_ns,
            "from_deg": from_deg,
            "to_deg": to_deg,
            "duration_s": parameters.sweep_s,
            "exposure_ms": parameters.exposures_ms[sweep],
        }


def progress(
    parameters: SequencerParameters, state: str, scan: Scan | None, next_scan: int, text: str
) -> ScanStatus:
    """Return how far the measurement is; the time left is negative where people decide."""
    sweeps = len(parameters.exposures_ms)
    done = next_scan - 1 + (scan.sweep / sweeps if scan else 0.0)
    left = parameters.scans - done
    remaining_s = parameters.interval_s * max(0.0, left - 1)
    remaining_s += parameters.scan_duration_s() * min(1.0, left)
    return ScanStatus(
        state=state,
        sample=parameters.sample,
        scan=scan.number if scan else min(next_scan, parameters.scans),
        scans=parameters.scans,
        sweep=scan.sweep + 1 if scan else 0,
        sweeps=sweeps,
        fraction=1.0 if state == "finished" else min(1.0, done / parameters.scans),
        remaining_s=remaining_s if parameters.interval_s > 0 else -1.0,
        text=text,
    )
