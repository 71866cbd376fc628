"""A camera, or a video file, through OpenCV's VideoCapture.

OpenCV can't set short exposures reliably, does not say which exposure a frame had and passes no
hardware stamp on; its drivers buffer some frames. So this driver calls itself approximate, and
scans refuse it unless the node's ``approximate_timing`` is true. It serves to look at a scene, and
to run the graph from a recorded video.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ..core.device import DeviceError, DriverContext, ReaderThread
from .driver import TRIGGER, CameraIdentity, CameraSettings, CaptureTag, RawFrame, region_on

MS_PER_V4L2_UNIT = 0.1
_MANUAL_EXPOSURE = 1
"""V4L2's value of the property "auto exposure" for manual."""
_LOOK_S = 0.05
"""How often a wait for the next frame of a file looks whether it should end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenCvParameters:
    """Which device or file."""

    source: str
    """Number of a device (``"0"``), or path of a video file."""
    stale_frames: int = 4
    """Frames of a device that its driver may have buffered when a capture begins."""
    exposure_ms: float = 0.0
    """At which a file was taken; 0: said to be what is set."""
    ms_per_unit: float = MS_PER_V4L2_UNIT
    """Unit of OpenCV's exposure property: 0.1 ms with V4L2."""

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        if not self.source:
            raise ValueError("source is empty: give a device number or the path of a video file")
        if self.stale_frames < 0 or self.exposure_ms < 0 or self.ms_per_unit <= 0:
            raise ValueError("stale_frames, exposure_ms: 0 or more; ms_per_unit: above 0")


class OpenCvCamera:
    """See :class:`.driver.CameraDriver`.

    A capture of a file goes on where the last one ended, at the file's own rate.
    """

    live: ClassVar[bool] = True
    parameters_type = OpenCvParameters

    def __init__(self, parameters: OpenCvParameters, context: DriverContext) -> None:
        self._parameters, self._context = parameters, context
        self._is_file = not parameters.source.isdecimal()
        self._device: Any = None
        self._identity: CameraIdentity | None = None
        self._settings = CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0)
        self._reader: ReaderThread[RawFrame] | None = None
        self._lock = threading.Lock()
        self._triggers: list[int] = []
        self._grabbed = 0
        self._delivered = 0
        self._started_s = 0.0

    @property
    def identity(self) -> CameraIdentity:
        """See :class:`.driver.CameraDriver`."""
        if self._identity is None:
            raise DeviceError(f"{self._name}: not open")
        return self._identity

    @property
    def _name(self) -> str:
        return f"{self._context.name} (OpenCV, {self._parameters.source})"

    def open(self) -> None:
        """Open device or file, and say what it can't do."""
        import cv2

        if self._device is not None:
            return
        source = self._parameters.source
        if self._is_file and not Path(source).is_file():
            raise DeviceError(f"{self._name}: no such file; give a video file or a device number")
        device = cv2.VideoCapture(source if self._is_file else int(source))
        if not device.isOpened():
            device.release()
            what = (
                "no video that OpenCV can read" if self._is_file else "no camera, or it is in use"
            )
            raise DeviceError(f"{self._name}: {what}")
        self._device = device
        self._identity = CameraIdentity(
            model=f"OpenCV {device.getBackendName()}",
            serial=source,
            width=int(device.get(cv2.CAP_PROP_FRAME_WIDTH)),
            height=int(device.get(cv2.CAP_PROP_FRAME_HEIGHT)),
            bit_depth=8,
            hardware_stamps=False,
            exact_exposure=False,
        )
        self._context.log.warning(
            f"{self._name}: exposures are approximate, and frames carry no hardware stamp; "
            "scans need approximate_timing: true"
        )

    def close(self) -> None:
        """Release it."""
        self.stop()
        if self._device is not None:
            self._device.release()
            self._device = None

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """See :class:`.driver.CameraDriver`; the region is cut out here."""
        import cv2

        if self._reader is not None:
            raise DeviceError(f"{self._name}: settings can't change during a capture")
        device, identity = self._open_device(), self.identity
        region = region_on(identity.width, identity.height, settings.region, self._name)
        if self._is_file:
            exposure_ms = self._parameters.exposure_ms or settings.exposure_ms
        else:
            device.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
            unit = self._parameters.ms_per_unit
            device.set(cv2.CAP_PROP_EXPOSURE, settings.exposure_ms / unit)
            device.set(cv2.CAP_PROP_FPS, settings.frame_rate_hz)
            read_back = device.get(cv2.CAP_PROP_EXPOSURE)
            # a device that knows no exposure tells 0 or less
            exposure_ms = read_back * unit if read_back > 0 else settings.exposure_ms
        rate = device.get(cv2.CAP_PROP_FPS)
        self._settings = replace(
            settings,
            exposure_ms=exposure_ms,
            frame_rate_hz=rate if rate > 0 else settings.frame_rate_hz,
            region=region,
        )
        return self._settings

    def start(self, tag: CaptureTag) -> None:
        """See :class:`.driver.CameraDriver`."""
        self.stop()
        self._open_device()
        self._triggers.clear()
        self._grabbed = self._delivered = 0
        self._started_s = time.monotonic()
        grab = self._grab_from_file if self._is_file else self._grab_from_device
        self._reader = ReaderThread(grab, f"{self._context.name} frames")

    def stop(self) -> None:
        """See :class:`.driver.CameraDriver`."""
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.stop()

    def trigger(self) -> None:
        """See :class:`.driver.CameraDriver`: the next frame to come is kept."""
        if self._reader is None or self._settings.mode != TRIGGER:
            raise DeviceError(f"{self._name}: trigger without a capture in trigger mode")
        self._triggers.append(self._context.clock.now_ns())

    def waitables(self) -> Sequence[Any]:
        """Return the reader while a capture is under way."""
        return () if self._reader is None else (self._reader,)

    def pending(self) -> bool:
        """Return False: all that has come is read at once."""
        return False

    def read(self) -> list[RawFrame]:
        """See :class:`.driver.CameraDriver`."""
        frames = [] if self._reader is None else self._reader.take()
        if self._settings.mode != TRIGGER:
            return frames
        wanted: list[RawFrame] = []
        for frame in frames:
            if self._triggers and frame.received_ns >= self._triggers[0]:
                self._triggers.pop(0)
                # frames between triggers are not meant to be seen
                wanted.append(frame._replace(frame_id=self._delivered))
                self._delivered += 1
        return wanted

    # -- in the reader's thread

    def _grab_from_device(self) -> RawFrame | None:
        found, image = self._device.read()
        if not found:
            raise DeviceError(f"{self._name}: gives no frame; is it unplugged?")
        self._grabbed += 1
        if self._grabbed <= self._parameters.stale_frames:
            return None
        return self._frame(image)

    def _grab_from_file(self) -> RawFrame | None:
        due_s = self._started_s + self._grabbed / self._settings.frame_rate_hz
        wait_s = due_s - time.monotonic()
        if wait_s > 0:
            time.sleep(min(wait_s, _LOOK_S))
            if wait_s > _LOOK_S:
                return None
        found, image = self._device.read()
        if not found:  # its end: nothing comes any more
            time.sleep(_LOOK_S)
            return None
        self._grabbed += 1
        return self._frame(image)

    def _frame(self, image: Any) -> RawFrame:
        region = self._settings.region
        if region is not None:
            rows = slice(region.y, region.y + region.height)
            image = np.array(image[rows, region.x : region.x + region.width], order="C")
        return RawFrame(
            image=image,
            exposure_ms=self._settings.exposure_ms,
            hardware_ns=0,
            received_ns=self._context.clock.now_ns(),
            frame_id=self._grabbed - 1,
        )

    def _open_device(self) -> Any:
        if self._device is None:
            raise DeviceError(f"{self._name}: not open")
        return self._device
