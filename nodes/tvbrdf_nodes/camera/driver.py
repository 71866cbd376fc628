"""What a camera driver is: the Protocol that real and simulated cameras implement.

A driver class is named in a launch file as ``module:Class`` and constructed as
``Class(parameters, context)`` with its own ``parameters_type`` (a frozen dataclass) and a
:class:`~tvbrdf_nodes.core.device.DriverContext`. Check one with :mod:`.conformance`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

from ..core.device import DeviceError, Driver

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Image = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]

FREE_RUN, TRIGGER = "free_run", "trigger"
MODES = (FREE_RUN, TRIGGER)


class Region(NamedTuple):
    """Part of the sensor that is read out, in pixels; x runs right, y down."""

    x: int
    y: int
    width: int
    height: int


def region_on(width: int, height: int, wanted: Region | None, name: str) -> Region:
    """Return the region that is wanted of a sensor; the whole one for None.

    Raises
    ------
    DeviceError
        If it does not lie on the sensor; the text has the camera's name.
    """
    region = wanted or Region(0, 0, width, height)
    inside = region.x + region.width <= width and region.y + region.height <= height
    if min(region.x, region.y) < 0 or min(region.width, region.height) < 1 or not inside:
        raise DeviceError(
            f"{name}: region {tuple(region)} (x, y, width, height) does not lie on its sensor of "
            f"{width}x{height} pixels"
        )
    return region


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraIdentity:
    """What a camera is, known once it is open."""

    model: str
    serial: str
    width: int
    """Of the sensor, pixels."""
    height: int
    bit_depth: int
    """Codes of its images are below ``2**bit_depth``."""
    hardware_stamps: bool
    """Whether frames carry a time of the camera's own clock."""
    exact_exposure: bool
    """Whether the exposure that is read back is the one that the sensor uses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSettings:
    """How a camera is set, or is to be set."""

    exposure_ms: float
    frame_rate_hz: float
    """Of free running; a camera goes slower where the exposure takes longer."""
    mode: str = FREE_RUN
    """``free_run``, or ``trigger``: one frame a call of :meth:`CameraDriver.trigger`."""
    region: Region | None = None
    """None: the whole sensor. As read back it is never None."""

    def __post_init__(self) -> None:
        """Refuse values that no camera can have."""
        if not self.exposure_ms > 0 or not self.frame_rate_hz > 0:
            raise ValueError(
                f"exposure {self.exposure_ms} ms, rate {self.frame_rate_hz} Hz: both must be > 0"
            )
        if self.mode not in MODES:
            raise ValueError(f"camera mode {self.mode!r}, expected one of {', '.join(MODES)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureTag:
    """What frames are taken for. Real drivers ignore it; noise of simulated ones is keyed by it."""

    sample: str = ""
    scan: int = 0
    sweep: int = 0
    attempt: int = 0
    scan_time_s: float = 0.0
    scan_start_ns: int = 0
    lamp: bool = True
    """Whether the lamp is expected to be on."""


class RawFrame(NamedTuple):
    """One image as the device gave it."""

    image: Image
    """(height, width, 3), channels B, G, R; owned by the receiver, never used again by the
    driver."""
    exposure_ms: float
    """Of this frame, as read back."""
    hardware_ns: int
    """On the camera's own clock; 0 where it has none."""
    received_ns: int
    """On the run's clock, when it had arrived."""
    frame_id: int
    """Counts the frames of one capture as the device took them: one that is lost, repeated or late
    shows here. A driver whose device tells no number counts what it receives."""


class CameraDriver(Driver, Protocol):
    """A camera. Used by one thread; nothing blocks for longer than a device's settings take.

    A capture begins with :meth:`start` and ends with :meth:`stop`; settings are changed between
    captures. A driver may raise :class:`~tvbrdf_nodes.core.device.DeviceError` from any method.
    """

    @property
    def identity(self) -> CameraIdentity:
        """What it is; once it is open."""
        ...

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Change the settings, and return them as read back from the device.

        Frames that were exposed before the change must not be delivered afterwards.
        """
        ...

    def start(self, tag: CaptureTag) -> None:
        """Begin a capture: frames come by themselves, or with each :meth:`trigger`."""
        ...

    def stop(self) -> None:
        """End the capture; what was not read by then is gone. No error without a capture."""
        ...

    def trigger(self) -> None:
        """Take one frame (mode ``trigger``, within a capture)."""
        ...

    def read(self) -> list[RawFrame]:
        """Return the frames that have come, in the order in which they came; never blocks."""
        ...
