"""The conformance test that ships: from the command line, and what it finds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from tvbrdf_messages.clock import SystemClock
from tvbrdf_nodes.camera import conformance
from tvbrdf_nodes.camera.conformance import assert_conforms, check_camera_driver, main
from tvbrdf_nodes.camera.driver import (
    TRIGGER,
    CameraIdentity,
    CameraSettings,
    CaptureTag,
    RawFrame,
    Region,
    region_on,
)

OPENCV = "tvbrdf_nodes.camera.opencv_camera:OpenCvCamera"


class Prompt:
    """A camera that has a frame whenever it is asked: a driver of a user, as small as can be."""

    live: ClassVar[bool] = True

    def __init__(self) -> None:
        self.clock = SystemClock()
        self.settings = CameraSettings(exposure_ms=1.0, frame_rate_hz=30.0)
        self.capturing = False
        self.triggers = 0
        self.count = 0
        self.closed = 0

    @property
    def identity(self) -> CameraIdentity:
        return CameraIdentity(
            model="prompt",
            serial="1",
            width=16,
            height=12,
            bit_depth=12,
            hardware_stamps=True,
            exact_exposure=True,
        )

    def open(self) -> None:
        """Nothing to open."""

    def close(self) -> None:
        self.capturing = False
        self.closed += 1

    def configure(self, settings: CameraSettings) -> CameraSettings:
        region = region_on(16, 12, settings.region, "prompt")
        self.settings = CameraSettings(
            exposure_ms=settings.exposure_ms,
            frame_rate_hz=settings.frame_rate_hz,
            mode=settings.mode,
            region=region,
        )
        return self.settings

    def start(self, tag: CaptureTag) -> None:
        self.capturing, self.triggers, self.count = True, 0, 0

    def stop(self) -> None:
        self.capturing = False

    def trigger(self) -> None:
        self.triggers += 1

    def waitables(self) -> tuple[Any, ...]:
        return ()

    def pending(self) -> bool:
        return False

    def image(self) -> Any:
        region = self.settings.region or Region(0, 0, 16, 12)
        return np.zeros((region.height, region.width, 3), dtype=np.uint16)

    def read(self) -> list[RawFrame]:
        if not self.capturing or (self.settings.mode == TRIGGER and not self.triggers):
            return []
        self.triggers -= 1
        self.count += 1
        now_ns = self.clock.now_ns()
        return [RawFrame(self.image(), self.settings.exposure_ms, now_ns, now_ns, self.count)]


def nothing(driver: Any) -> None:
    """Frames need no waiting for."""


def found(driver: Any) -> set[str]:
    findings = check_camera_driver(driver, wait=nothing, timeout_s=0.2, frame_rate_hz=200.0)
    return {finding.check for finding in findings}


def test_good_driver_has_no_findings() -> None:
    driver = Prompt()
    assert found(driver) == set()
    assert driver.closed == 2


class SharesItsBuffer(Prompt):
    buffer = np.zeros((12, 16, 3), dtype=np.uint16)

    def image(self) -> Any:
        image = super().image()
        return self.buffer[: image.shape[0], : image.shape[1]]


class EightBits(Prompt):
    def image(self) -> Any:
        return super().image().astype(np.uint8)


class TooManyBits(Prompt):
    def image(self) -> Any:
        return super().image() + np.uint16(4096)


class Turned(Prompt):
    def image(self) -> Any:
        return super().image().transpose(1, 0, 2)


class KeepsTheOldExposure(Prompt):
    def read(self) -> list[RawFrame]:
        return [frame._replace(exposure_ms=2.0) for frame in super().read()]


class SetsAnotherExposure(Prompt):
    def configure(self, settings: CameraSettings) -> CameraSettings:
        super().configure(settings)
        from dataclasses import replace

        self.settings = replace(self.settings, exposure_ms=1.05 * settings.exposure_ms)
        return self.settings


class IgnoresRegions(Prompt):
    def configure(self, settings: CameraSettings) -> CameraSettings:
        from dataclasses import replace

        return super().configure(replace(settings, region=None))


class IgnoresTriggers(Prompt):
    def configure(self, settings: CameraSettings) -> CameraSettings:
        from dataclasses import replace

        self.settings = replace(super().configure(settings), mode="free_run")
        return replace(self.settings, mode=settings.mode)


class LosesFrames(Prompt):
    def read(self) -> list[RawFrame]:
        return [f._replace(frame_id=f.frame_id * 2) for f in super().read()]


class StampsInMicroseconds(Prompt):
    def read(self) -> list[RawFrame]:
        return [f._replace(hardware_ns=f.hardware_ns // 1000) for f in super().read()]


class GoesOn(Prompt):
    def stop(self) -> None:
        """Does not stop."""


class ClosesOnce(Prompt):
    def close(self) -> None:
        super().close()
        if self.closed > 1:
            raise RuntimeError("not open")


class Fails(Prompt):
    def start(self, tag: CaptureTag) -> None:
        raise OSError("broken")


@pytest.mark.parametrize(
    ("driver", "check"),
    [
        (SharesItsBuffer, "free_run"),
        (EightBits, "free_run"),
        (TooManyBits, "free_run"),
        (Turned, "free_run"),
        (KeepsTheOldExposure, "after_change"),
        (SetsAnotherExposure, "exposure_read_back"),
        (IgnoresRegions, "region"),
        (IgnoresTriggers, "trigger"),
        (LosesFrames, "free_run"),
        (StampsInMicroseconds, "free_run"),
        (GoesOn, "stop"),
        (ClosesOnce, "close"),
        (Fails, "free_run"),
    ],
)
def test_wrong_driver_is_found(driver: type[Prompt], check: str) -> None:
    assert check in found(driver())


def test_assert_conforms_lists_the_findings() -> None:
    assert_conforms(Prompt(), wait=nothing, timeout_s=0.2, frame_rate_hz=200.0)
    with pytest.raises(AssertionError, match=r"exposure_read_back: exposure reads back as 2\.1 ms"):
        assert_conforms(SetsAnotherExposure(), wait=nothing, timeout_s=0.2, frame_rate_hz=200.0)


# -- from the command line


@pytest.fixture
def video(tmp_path: Path) -> Path:
    import cv2

    path = tmp_path / "scene.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 100.0, (32, 32))
    for _ in range(300):
        writer.write(np.full((32, 32, 3), 90, dtype=np.uint8))
    writer.release()
    return path


def test_command_line_checks_a_driver(video: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([OPENCV, f"source={video}"]) == 0
    assert capsys.readouterr().out == "no findings\n"


def test_command_line_says_what_is_wrong(
    video: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    checked: Callable[..., Any] = check_camera_driver
    monkeypatch.setattr(
        conformance, "check_camera_driver", lambda driver: checked(driver, timeout_s=0.2)
    )
    assert main([OPENCV, "source=/does/not/exist.avi"]) == 1
    assert "open: raised DeviceError" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "my_module:MyCamera"),
        (["nonsense"], "not of the form"),
        ([OPENCV], "'source' is missing"),
        ([OPENCV, "sauce=1"], "did you mean 'source'"),
    ],
)
def test_command_line_with_wrong_arguments(
    arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    assert text in capsys.readouterr().err
