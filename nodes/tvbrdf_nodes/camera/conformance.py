"""What every camera driver must do, checked: run it against your own.

From a test: ``assert_conforms(MyCamera(parameters, context))``. From the command line, with the
device connected and light on it::

    python -m tvbrdf_nodes.camera.conformance my_package.my_module:MyCamera key=value ...

It opens the camera, changes its exposure and region, takes some frames, and closes it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from tvbrdf_messages.clock import SystemClock

from ..core.device import DeviceError, DriverContext
from ..core.loading import LoadingError, load_class
from ..core.parameters import ParameterError, build
from .driver import FREE_RUN, TRIGGER, CameraDriver, CameraSettings, CaptureTag, RawFrame, Region
from .reports import EXPOSURE_TOLERANCE

LONGEST_READ_S = 0.5
"""read() must not block; a busy machine is forgiven this much."""
STAMP_TOLERANCE = 0.5
"""Relative difference of durations on the camera's and on the run's clock: a check of units, wide
enough for frames that wait on a busy machine."""


class Finding(NamedTuple):
    """Something that a driver does wrong."""

    check: str
    text: str


def assert_conforms(
    driver: CameraDriver,
    *,
    wait: Callable[[CameraDriver], None] | None = None,
    exposures_ms: tuple[float, float] = (2.0, 8.0),
    frame_rate_hz: float = 30.0,
    timeout_s: float = 10.0,
) -> None:
    """Raise ``AssertionError`` that lists all findings of :func:`check_camera_driver`, if any."""
    findings = check_camera_driver(
        driver,
        wait=wait,
        exposures_ms=exposures_ms,
        frame_rate_hz=frame_rate_hz,
        timeout_s=timeout_s,
    )
    text = "\n".join(f"{finding.check}: {finding.text}" for finding in findings)
    if findings:
        raise AssertionError(text)


def check_camera_driver(
    driver: CameraDriver,
    *,
    wait: Callable[[CameraDriver], None] | None = None,
    exposures_ms: tuple[float, float] = (2.0, 8.0),
    frame_rate_hz: float = 30.0,
    timeout_s: float = 10.0,
) -> list[Finding]:
    """Return what a driver does wrong; empty if nothing was found.

    Parameters
    ----------
    driver
        Constructed, not yet open. It is closed afterwards.
    wait
        Called when the driver has nothing to read: lets time pass. By default it waits for the
        driver's ``waitables()``.
    exposures_ms
        Two different exposures that the camera can have.
    frame_rate_hz
        At which it can run with them.
    timeout_s
        Real time to wait for frames.
    """
    checker = _Checker(driver, wait or _wait, exposures_ms, frame_rate_hz, timeout_s)
    checks = (
        checker.identity,
        checker.exposure_read_back,
        checker.free_run,
        checker.after_change,
        checker.region,
        checker.trigger,
        checker.stop,
    )
    try:
        driver.open()
        for check in checks:
            checker.now = check.__name__
            try:
                check()
            except Exception as error:  # noqa: BLE001 - whatever a driver raises is a finding
                checker.find(f"raised {type(error).__name__}: {error}")
            driver.stop()
    except Exception as error:  # noqa: BLE001
        checker.now = "open"
        checker.find(f"raised {type(error).__name__}: {error}")
    checker.now = "close"
    checker.close()
    return checker.findings


class _Checker:
    """The checks, one a method."""

    def __init__(
        self,
        driver: CameraDriver,
        wait: Callable[[CameraDriver], None],
        exposures_ms: tuple[float, float],
        frame_rate_hz: float,
        timeout_s: float,
    ) -> None:
        self._driver, self._wait = driver, wait
        self._exposures_ms, self._rate_hz, self._timeout_s = exposures_ms, frame_rate_hz, timeout_s
        self.findings: list[Finding] = []
        self.now = ""

    def find(self, text: str) -> None:
        """Add a finding of the current check."""
        self.findings.append(Finding(self.now, text))

    def _set(
        self, exposure_ms: float, mode: str = FREE_RUN, region: Region | None = None
    ) -> CameraSettings:
        return self._driver.configure(
            CameraSettings(
                exposure_ms=exposure_ms, frame_rate_hz=self._rate_hz, mode=mode, region=region
            )
        )

    def _read(self) -> list[RawFrame]:
        began_s = time.monotonic()
        frames = self._driver.read()
        took_s = time.monotonic() - began_s
        if took_s > LONGEST_READ_S:
            self.find(f"read() took {took_s:.2f} s; it must not block")
        return frames

    def _frames(self, count: int) -> list[RawFrame]:
        """Read until there are so many frames, or time is up."""
        found: list[RawFrame] = []
        deadline = time.monotonic() + self._timeout_s
        while len(found) < count and time.monotonic() < deadline:
            new = self._read()
            found += new
            if not new and not self._driver.pending():
                self._wait(self._driver)
        if len(found) < count:
            self.find(f"gave {len(found)} frames in {self._timeout_s:g} s, expected {count}")
        return found

    # -- the checks

    def identity(self) -> None:
        """What it says of itself is plausible."""
        identity = self._driver.identity
        if not identity.model or not identity.serial:
            self.find(f"model {identity.model!r} or serial {identity.serial!r} is empty")
        if identity.width < 1 or identity.height < 1 or not 8 <= identity.bit_depth <= 16:
            self.find(f"sensor of {identity.width}x{identity.height}, {identity.bit_depth} bits")

    def exposure_read_back(self) -> None:
        """Settings come back as the camera has them."""
        exact = self._driver.identity.exact_exposure
        for wanted_ms in self._exposures_ms:
            got = self._set(wanted_ms)
            if exact and abs(got.exposure_ms / wanted_ms - 1.0) > EXPOSURE_TOLERANCE:
                self.find(f"exposure reads back as {got.exposure_ms} ms after {wanted_ms} ms")
            if got.region is None or got.mode != FREE_RUN:
                self.find(f"settings do not read back region and mode: {got}")

    def free_run(self) -> None:
        """Frames come by themselves, in order, each with its stamps and its own memory."""
        settings = self._set(self._exposures_ms[0])
        self._driver.start(CaptureTag())
        frames = self._frames(6)
        self._check_images(frames, settings)
        self._check_order(frames)
        self._check_stamps(frames)

    def _check_images(self, frames: Sequence[RawFrame], settings: CameraSettings) -> None:
        import numpy as np

        depth, region = self._driver.identity.bit_depth, settings.region
        dtypes = ("uint8",) if depth == 8 else ("uint16",)
        for frame in frames:
            image = frame.image
            if str(image.dtype) not in (*dtypes, "float32"):
                self.find(f"image of {image.dtype}; {depth} bits come as {dtypes[0]}")
            if region is not None and image.shape != (region.height, region.width, 3):
                self.find(f"image of shape {image.shape} with region {tuple(region)}")
            if image.dtype != np.float32 and image.size and int(image.max()) >= 1 << depth:
                self.find(f"image has code {int(image.max())}, too large for {depth} bits")
            if not image.flags.c_contiguous:
                self.find("image is not contiguous")
        for one, other in pairwise(frames):
            if np.shares_memory(one.image, other.image):
                self.find("two frames share their memory; each must have its own")
                break

    def _check_order(self, frames: Sequence[RawFrame]) -> None:
        ids = [frame.frame_id for frame in frames]
        if ids and ids != list(range(ids[0], ids[0] + len(ids))):
            self.find(f"frame numbers {ids} do not count up by one (or frames were lost)")

    def _check_stamps(self, frames: Sequence[RawFrame]) -> None:
        received = [frame.received_ns for frame in frames]
        hardware = [frame.hardware_ns for frame in frames]
        if received != sorted(set(received)):
            self.find(f"received_ns do not rise: {received}")
        if not self._driver.identity.hardware_stamps:
            if any(hardware):
                self.find("hardware_ns is not 0 although it says that it has no hardware stamps")
            return
        if hardware != sorted(set(hardware)):
            self.find(f"hardware_ns do not rise: {hardware}")
        elif len(frames) > 2:
            ratio = (hardware[-1] - hardware[0]) / max(received[-1] - received[0], 1)
            if abs(ratio - 1.0) > STAMP_TOLERANCE:
                self.find(
                    f"hardware_ns runs {ratio:.3g} times as fast as received_ns: is it in ns?"
                )

    def after_change(self) -> None:
        """No frame of before a change of exposure comes after it."""
        stamps = []
        for wanted_ms in (*self._exposures_ms, self._exposures_ms[0]):
            settings = self._set(wanted_ms)
            self._driver.start(CaptureTag())
            frames = self._frames(2)
            self._driver.stop()
            for frame in frames:
                if abs(frame.exposure_ms / settings.exposure_ms - 1.0) > EXPOSURE_TOLERANCE:
                    self.find(
                        f"a frame of {frame.exposure_ms} ms came after the exposure was set to "
                        f"{settings.exposure_ms} ms"
                    )
            stamps += [frame.hardware_ns for frame in frames]
        if self._driver.identity.hardware_stamps and stamps != sorted(set(stamps)):
            self.find("hardware_ns do not rise from capture to capture: are frames kept back?")

    def region(self) -> None:
        """Part of the sensor can be read out, and no more than there is."""
        identity = self._driver.identity
        # even numbers, for sensors with a colour mosaic
        width, height = identity.width // 4 * 2, identity.height // 4 * 2
        wanted = Region(width // 4 * 2, height // 4 * 2, width, height)
        settings = self._set(self._exposures_ms[0], region=wanted)
        if settings.region != wanted:
            self.find(f"region reads back as {settings.region} after {wanted}")
        self._driver.start(CaptureTag())
        self._check_images(self._frames(1), settings)
        self._driver.stop()
        beyond = Region(0, 0, identity.width + 2, identity.height)
        try:
            got = self._set(self._exposures_ms[0], region=beyond)
            if got.region == beyond:
                self.find(f"takes region {tuple(beyond)}, beyond its sensor")
        except DeviceError:
            pass
        if self._set(self._exposures_ms[0]).region != Region(0, 0, identity.width, identity.height):
            self.find("region None does not give the whole sensor")

    def trigger(self) -> None:
        """One frame a trigger, none without."""
        self._set(self._exposures_ms[0], mode=TRIGGER)
        self._driver.start(CaptureTag())
        surplus = self._surplus()
        if surplus:
            self.find(f"gave {surplus} frames without a trigger")
        for count in range(1, 4):
            self._driver.trigger()
            if not self._frames(1):
                self.find(f"gave no frame after trigger {count}")
        surplus = self._surplus()
        if surplus:
            self.find(f"gave {surplus} frames more than triggers")

    def _surplus(self) -> int:
        """Count what comes within five frames' time."""
        count = 0
        deadline = time.monotonic() + 5.0 / self._rate_hz
        while time.monotonic() < deadline:
            count += len(self._read())
            self._wait(self._driver)
        return count

    def stop(self) -> None:
        """After the end of a capture nothing comes; another can begin."""
        self._set(self._exposures_ms[0])
        for _ in range(2):
            self._driver.start(CaptureTag())
            self._frames(1)
            self._driver.stop()
            self._driver.stop()
            if self._read():
                self.find("gave frames after stop()")

    def close(self) -> None:
        """Closing it, also during a capture, and twice, is no error."""
        try:
            self._driver.start(CaptureTag())
        except Exception as error:  # noqa: BLE001
            self.find(f"start() raised {type(error).__name__}: {error}")
        for _ in range(2):
            try:
                self._driver.close()
            except Exception as error:  # noqa: BLE001
                self.find(f"close() raised {type(error).__name__}: {error}")


def _wait(driver: CameraDriver) -> None:
    """Wait a little for what the driver waits for."""
    import zmq

    poller = zmq.Poller()
    for item in driver.waitables():
        poller.register(item, zmq.POLLIN)
    poller.poll(50)


class _StandardError:
    """A log for the command line."""

    def info(self, text: str) -> None:
        sys.stderr.write(f"info: {text}\n")

    def warning(self, text: str) -> None:
        sys.stderr.write(f"warning: {text}\n")

    def error(self, text: str) -> None:
        sys.stderr.write(f"error: {text}\n")


def main(arguments: Sequence[str]) -> int:
    """Check the driver that the command line names; return 0 if nothing was found."""
    import yaml

    if not arguments:
        sys.stderr.write(f"{__doc__}\n")
        return 2
    try:
        driver_class = load_class(arguments[0])
        values = {key: yaml.safe_load(value) for key, _, value in map(_pair, arguments[1:])}
        parameters = build(driver_class.parameters_type, values)
    except (LoadingError, ParameterError) as error:
        sys.stderr.write(f"{error}\n")
        return 2

    def no_link() -> None:
        raise DeviceError("a simulated camera can't be checked without its simulation")

    context = DriverContext("camera", SystemClock(), _StandardError(), Path.cwd(), no_link)  # type: ignore[arg-type]
    findings = check_camera_driver(driver_class(parameters, context))
    for finding in findings:
        sys.stdout.write(f"{finding.check}: {finding.text}\n")
    sys.stdout.write(f"{len(findings) or 'no'} findings\n")
    return 1 if findings else 0


def _pair(text: str) -> tuple[str, str, str]:
    return text.partition("=")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
