"""A GenICam camera (GigE Vision, USB3 Vision) through Aravis: the reference real driver.

Exposure is read back from the camera after it is set, frames carry the camera's own time stamps
and frame numbers, and what a capture's first frames still show of earlier settings is dropped.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..core.device import DeviceError, DriverContext, ReaderThread
from .aravis_library import load_aravis
from .driver import (
    TRIGGER,
    CameraIdentity,
    CameraSettings,
    CaptureTag,
    RawFrame,
    Region,
    region_on,
)

PREFERRED_FORMATS = (
    "BayerRG12", "BayerGR12", "BayerGB12", "BayerBG12", "BGR8", "RGB8",
    "BayerRG8", "BayerGR8", "BayerGB8", "BayerBG8", "Mono12", "Mono8",
)  # fmt: skip
_FORMAT = re.compile(r"(Mono|RGB|BGR|Bayer(?:RG|GR|GB|BG))(8|10|12|14|16)")
_POP_US = 50_000
_ID_WRAP = 65_535
"""GigE Vision's frame numbers run from 1 to this and begin again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AravisParameters:
    """Which camera, and how its pixels come."""

    device: str = ""
    """Its id, serial number or address, as ``arv-tool-0.8`` lists it; empty: the first found."""
    pixel_format: str = ""
    """GenICam's name, e.g. ``BayerRG12``; empty: the best that the camera has."""
    stale_frames: int = 3
    """Frames that may still have the earlier exposure after it was changed."""
    buffers: int = 32

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        if self.stale_frames < 0 or self.buffers < 2:
            raise ValueError("stale_frames must be 0 or more, buffers 2 or more")
        if self.pixel_format and not _FORMAT.fullmatch(self.pixel_format):
            raise ValueError(
                f"pixel_format {self.pixel_format!r} is not known; use an unpacked Mono, Bayer, "
                f"RGB or BGR format such as {', '.join(PREFERRED_FORMATS)}"
            )


class AravisCamera:
    """See :class:`.driver.CameraDriver`."""

    live: ClassVar[bool] = True
    parameters_type = AravisParameters

    def __init__(self, parameters: AravisParameters, context: DriverContext) -> None:
        self._parameters, self._context = parameters, context
        self._aravis: Any = None
        self._camera: Any = None
        self._stream: Any = None
        self._payload = 0
        self._identity: CameraIdentity | None = None
        self._to_bgr: Callable[[NDArray[Any]], NDArray[Any]] = np.array
        self._settings = CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0)
        self._reader: ReaderThread[RawFrame] | None = None
        self._stale_left = 0
        self._last_id = -1
        self._rounds = 0

    @property
    def identity(self) -> CameraIdentity:
        """See :class:`.driver.CameraDriver`."""
        if self._identity is None:
            raise DeviceError(f"{self._name}: not open")
        return self._identity

    @property
    def _name(self) -> str:
        return f"{self._context.name} (Aravis, {self._parameters.device or 'first camera'})"

    @contextmanager
    def _errors_of(self, doing: str) -> Iterator[None]:
        """Turn Aravis's errors into ours, with the camera's name and what was done."""
        try:
            yield
        except DeviceError:
            raise
        except RuntimeError as error:  # GLib.GError
            text = str(error).split(": ", 1)[-1]
            raise DeviceError(f"{self._name}: {doing}: {text}; is it connected?") from error

    # -- opening and settings

    def open(self) -> None:
        """Connect to the camera, choose its pixel format, and switch automatics off."""
        if self._camera is not None:
            return
        self._aravis = load_aravis()
        with self._errors_of("can't open it"):
            camera = self._aravis.Camera.new(self._parameters.device or None)
            self._camera = camera
            pixel_format = self._choose_format(camera.dup_available_pixel_formats_as_strings())
            camera.set_pixel_format_from_string(pixel_format)
            for feature in ("ExposureAuto", "GainAuto", "BalanceWhiteAuto"):
                if camera.is_feature_available(feature):
                    camera.set_string(feature, "Off")
            width, height = camera.get_sensor_size()
            self._identity = CameraIdentity(
                model=f"{camera.get_vendor_name()} {camera.get_model_name()}",
                serial=camera.get_device_serial_number(),
                width=width,
                height=height,
                bit_depth=bit_depth(pixel_format),
                hardware_stamps=True,
                exact_exposure=True,
            )
        self._to_bgr = bgr_converter(pixel_format)

    def _choose_format(self, available: Sequence[str]) -> str:
        wanted = self._parameters.pixel_format
        for name in (wanted,) if wanted else PREFERRED_FORMATS:
            if name in available:
                return name
        what = f"no pixel format {wanted}" if wanted else "none of the pixel formats known here"
        raise DeviceError(f"{self._name}: has {what}; it has {', '.join(available)}")

    def close(self) -> None:
        """Let the camera go, for others to use."""
        self.stop()
        self._stream = self._camera = None
        self._payload = 0

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """See :class:`.driver.CameraDriver`."""
        if self._reader is not None:
            raise DeviceError(f"{self._name}: settings can't change during a capture")
        camera, identity = self._open_camera(), self.identity
        region = region_on(identity.width, identity.height, settings.region, self._name)
        with self._errors_of(f"can't set it to {settings}"):
            camera.set_region(*region)
            box = camera.get_region()
            exposure_us, rate = self._set_exposure(camera, settings)
            if settings.mode == TRIGGER:
                camera.set_trigger("Software")
        if exposure_us != 1e3 * self._settings.exposure_ms:
            self._stale_left = self._parameters.stale_frames
        self._settings = replace(
            settings,
            exposure_ms=exposure_us / 1e3,
            frame_rate_hz=rate,
            region=Region(box.x, box.y, box.width, box.height),
        )
        return self._settings

    def _set_exposure(self, camera: Any, settings: CameraSettings) -> tuple[float, float]:
        """Set exposure and rate, which may bound each other; return them as read back."""
        for _ in range(2):
            bounds = camera.get_exposure_time_bounds()
            wanted_us = min(max(1e3 * settings.exposure_ms, bounds.min), bounds.max)
            camera.set_exposure_time(wanted_us)
            rates = camera.get_frame_rate_bounds()
            camera.set_frame_rate(min(max(settings.frame_rate_hz, rates.min), rates.max))
            exposure_us = camera.get_exposure_time()
            if abs(exposure_us - wanted_us) <= 1e-3 * wanted_us:
                break
        return exposure_us, camera.get_frame_rate()

    # -- captures

    def start(self, tag: CaptureTag) -> None:
        """See :class:`.driver.CameraDriver`."""
        self.stop()
        camera = self._open_camera()
        with self._errors_of("can't start it"):
            payload = camera.get_payload()
            if self._stream is None or payload != self._payload:
                self._stream = None  # of two streams the camera would serve the older one
                self._stream, self._payload = camera.create_stream(None, None), payload
                for _ in range(self._parameters.buffers):
                    self._stream.push_buffer(self._aravis.Buffer.new_allocate(payload))
            self._last_id, self._rounds = -1, 0
            camera.start_acquisition()
        self._reader = ReaderThread(
            self._grab, f"{self._context.name} frames", self._parameters.buffers
        )

    def stop(self) -> None:
        """See :class:`.driver.CameraDriver`."""
        reader, self._reader = self._reader, None
        if reader is None:
            return
        reader.stop()
        try:
            with self._errors_of("can't stop it"):
                self._camera.stop_acquisition()
        finally:
            while (buffer := self._stream.try_pop_buffer()) is not None:
                self._stream.push_buffer(buffer)

    def trigger(self) -> None:
        """See :class:`.driver.CameraDriver`."""
        if self._reader is None or self._settings.mode != TRIGGER:
            raise DeviceError(f"{self._name}: trigger without a capture in trigger mode")
        with self._errors_of("can't trigger it"):
            self._camera.software_trigger()

    def waitables(self) -> Sequence[Any]:
        """Return the reader while a capture is under way."""
        return () if self._reader is None else (self._reader,)

    def pending(self) -> bool:
        """Return False: all that has come is read at once."""
        return False

    def read(self) -> list[RawFrame]:
        """See :class:`.driver.CameraDriver`."""
        frames = [] if self._reader is None else self._reader.take()
        while frames and self._stale_left:
            self._stale_left -= 1
            del frames[0]
            if self._settings.mode == TRIGGER:
                self.trigger()
        return frames

    def _grab(self) -> RawFrame | None:
        """Return the next frame; runs in the reader's thread."""
        buffer = self._stream.timeout_pop_buffer(_POP_US)
        if buffer is None:
            return None
        try:
            if buffer.get_status() != self._aravis.BufferStatus.SUCCESS:
                return None  # its number will be missing
            now_ns, utc_ns = self._context.clock.now_ns(), time.time_ns()
            # Aravis stamps arrival with the wall clock: only its age is used
            age_ns = min(max(utc_ns - buffer.get_system_timestamp(), 0), 10_000_000_000)
            width, height = buffer.get_image_width(), buffer.get_image_height()
            raw = np.frombuffer(buffer.get_data(), dtype=np.uint8)
            return RawFrame(
                image=self._to_bgr(_shaped(raw, width, height, self.identity.bit_depth)),
                exposure_ms=self._settings.exposure_ms,
                hardware_ns=buffer.get_timestamp(),
                received_ns=now_ns - age_ns,
                frame_id=self._unwrapped(buffer.get_frame_id()),
            )
        finally:
            self._stream.push_buffer(buffer)

    def _unwrapped(self, frame_id: int) -> int:
        """Return a frame number that goes on where the device's begins again."""
        if self._last_id - frame_id > _ID_WRAP // 2:
            self._rounds += 1
        self._last_id = frame_id
        return frame_id + self._rounds * _ID_WRAP

    def _open_camera(self) -> Any:
        if self._camera is None:
            raise DeviceError(f"{self._name}: not open")
        return self._camera


def bit_depth(pixel_format: str) -> int:
    """Return the bits of a pixel's channel."""
    match = _FORMAT.fullmatch(pixel_format)
    if match is None:
        raise ValueError(f"pixel format {pixel_format!r} is not known")
    return int(match[2])


def _shaped(raw: NDArray[np.uint8], width: int, height: int, depth: int) -> NDArray[Any]:
    """Return pixels (height, width) or (height, width, 3) of a buffer's bytes."""
    pixels = raw if depth == 8 else raw.view("<u2")
    channels = 3 if pixels.size >= 3 * width * height else 1
    shape = (height, width, 3) if channels == 3 else (height, width)
    return pixels[: width * height * channels].reshape(shape)


def bgr_converter(pixel_format: str) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Return a function from pixels as they come to an image (height, width, 3), B, G, R, its own.

    Raises
    ------
    ValueError
        If the format is not known.
    """
    import cv2

    match = _FORMAT.fullmatch(pixel_format)
    if match is None:
        raise ValueError(f"pixel format {pixel_format!r} is not known")
    kind = match[1]
    if kind == "BGR":
        return np.array
    # GenICam names a mosaic by its first row's two pixels
    code = {
        "Mono": cv2.COLOR_GRAY2BGR,
        "RGB": cv2.COLOR_RGB2BGR,
        "BayerRG": cv2.COLOR_BayerRGGB2BGR,
        "BayerGR": cv2.COLOR_BayerGRBG2BGR,
        "BayerGB": cv2.COLOR_BayerGBRG2BGR,
        "BayerBG": cv2.COLOR_BayerBGGR2BGR,
    }[kind]
    return lambda pixels: np.asarray(cv2.cvtColor(pixels, code))
