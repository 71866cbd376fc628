"""What a simulated camera does wrong when the scene tells it to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from ..core.device import DeviceError
from ..core.parameters import ParameterError, build
from .driver import CaptureTag, RawFrame

KINDS = ("drop", "repeat", "reorder", "stop", "wrong_exposure", "stale")


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFault:
    """One entry of the scene's ``camera.faults``.

    ``kind``: ``drop``, ``repeat`` or ``reorder`` (swap with the next) ``count`` frames from
    ``frame`` on; ``stop``: deliver nothing from ``frame`` on; ``wrong_exposure``: the next
    ``count`` times that ``exposure_ms`` is set, it becomes ``factor`` times that; ``stale``: after
    each change of exposure, ``count`` frames still have the old one.
    """

    kind: str
    camera: int = 0
    """0: all."""
    scan: int = -1
    """-1: all; so for sweep and attempt."""
    sweep: int = -1
    attempt: int = -1
    frame: int = 0
    """Counts within a capture."""
    count: int = 1
    factor: float = 1.1
    exposure_ms: float = 0.0
    """0: any."""

    def __post_init__(self) -> None:
        """Refuse kinds that do not exist."""
        if self.kind not in KINDS:
            raise ValueError(f"kind {self.kind!r}, expected one of {', '.join(KINDS)}")

    def hits(self, tag: CaptureTag, index: int) -> bool:
        """Return whether it strikes a frame."""
        return (
            self.scan in (-1, tag.scan)
            and self.sweep in (-1, tag.sweep)
            and self.attempt in (-1, tag.attempt)
            and self.frame <= index
            and (self.kind == "stop" or index < self.frame + self.count)
        )


class FaultPlan:
    """The faults of one camera.

    Raises
    ------
    DeviceError
        If an entry is not a fault; the text says which and why.
    """

    def __init__(self, faults: Iterable[Mapping[str, Any]], camera: int) -> None:
        self._faults: list[CameraFault] = []
        for number, raw in enumerate(faults, start=1):
            try:
                fault = build(CameraFault, raw)
            except ParameterError as error:
                raise DeviceError(f"scene: camera fault {number}: {error}") from error
            if fault.camera in (0, camera):
                self._faults.append(fault)
        self._times_set: dict[int, int] = {}
        self._held: list[RawFrame] = []
        self.stale_frames = max((f.count for f in self._faults if f.kind == "stale"), default=0)

    def exposure_set(self, exposure_ms: float) -> float:
        """Return what the camera makes of an exposure that is set, ms."""
        for number, fault in enumerate(self._faults):
            if fault.kind == "wrong_exposure" and fault.exposure_ms in (0.0, exposure_ms):
                self._times_set[number] = self._times_set.get(number, 0) + 1
                if self._times_set[number] <= fault.count:
                    return exposure_ms * fault.factor
        return exposure_ms

    def begin(self) -> None:
        """Forget what was held back: a capture begins."""
        self._held.clear()

    def pass_on(self, tag: CaptureTag, frame: RawFrame) -> list[RawFrame]:
        """Return what the camera delivers when it should deliver ``frame``."""
        if not self._faults:
            return [frame]
        kinds = {fault.kind for fault in self._faults if fault.hits(tag, frame.frame_id)}
        if kinds & {"drop", "stop"}:
            return []
        if "reorder" in kinds and not self._held:
            self._held.append(frame)
            return []
        late, self._held = self._held, []
        return [frame, *late, *([frame] if "repeat" in kinds else [])]
