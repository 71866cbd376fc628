"""What a camera node keeps of the command it carries out: frames, their order, what went wrong."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from tvbrdf_messages.messages import ScanCommand, SweepResult

from ..core.commands import result_of
from .driver import CaptureTag

LIGHT, DARK, STILL = "light", "dark", "still"
SETTLING = "settling"
"""Frames that are thrown away after a change of exposure."""
MAX_REASONS = 3


class FrameOrder:
    """Notices frames that a device lost, gave twice or gave late, from their numbers."""

    def __init__(self) -> None:
        self._last = -1
        self._missing: set[int] = set()

    @property
    def dropped(self) -> int:
        """Frames that have not come."""
        return len(self._missing)

    def see(self, frame_id: int) -> str:
        """Return what is wrong with a frame's number: empty, ``dropped`` (frames before it),
        ``repeated`` or ``reordered``."""
        if self._last < 0 or frame_id == self._last + 1:
            self._last = frame_id
            return ""
        if frame_id > self._last:
            self._missing.update(range(self._last + 1, min(frame_id, self._last + 10_000)))
            self._last = frame_id
            return "dropped"
        if frame_id in self._missing:
            self._missing.discard(frame_id)
            return "reordered"
        return "repeated"


@dataclass(slots=True)
class Capture:
    """One command that takes frames, while it is carried out."""

    command: ScanCommand
    kind: str
    exposures_ms: deque[float] = field(default_factory=deque)
    """Still to be done, the current one first."""
    wanted: int = 0
    """Frames at each exposure; 0: until the end of the sweep."""
    exposure_ms: float = 0.0
    """As read back."""
    at_exposure: int = 0
    frames: int = 0
    first_sequence: int = -1
    last_sequence: int = -1
    last_frame_ns: int = 0
    order: FrameOrder = field(default_factory=FrameOrder)
    reasons: list[str] = field(default_factory=list)

    @property
    def tag(self) -> CaptureTag:
        """What its frames are for."""
        command = self.command
        return CaptureTag(
            sample=command.sample,
            scan=command.scan,
            sweep=command.sweep,
            attempt=command.attempt,
            scan_time_s=command.scan_time_s,
            scan_start_ns=command.scan_start_ns,
            lamp=self.kind != DARK,
        )

    def sent(self, sequence: int, received_ns: int) -> None:
        """Count a frame that is sent under a sequence number."""
        if self.frames == 0:
            self.first_sequence = sequence
        self.last_sequence = sequence
        self.frames += 1
        self.at_exposure += 1
        self.last_frame_ns = received_ns

    def spoil(self, reason: str) -> bool:
        """Say that it is broken; return whether that is news."""
        if reason in self.reasons:
            return False
        self.reasons.append(reason)
        return len(self.reasons) <= MAX_REASONS

    def result(self, source: str) -> SweepResult:
        """Return the answer to its command."""
        return result_of(
            self.command,
            source,
            "broken" if self.reasons else "done",
            "; ".join(self.reasons[:MAX_REASONS]),
            frames=self.frames,
            first_sequence=self.first_sequence,
            last_sequence=self.last_sequence,
            exposure_ms=self.exposure_ms,
        )
