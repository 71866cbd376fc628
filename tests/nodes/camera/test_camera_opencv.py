"""The OpenCV driver, with a real video file that the test writes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tvbrdf_messages.clock import SystemClock
from tvbrdf_messages.messages import Frame
from tvbrdf_nodes.camera.conformance import check_camera_driver
from tvbrdf_nodes.camera.driver import CameraSettings, CaptureTag, RawFrame, Region
from tvbrdf_nodes.camera.opencv_camera import OpenCvCamera, OpenCvParameters
from tvbrdf_nodes.camera.simulated_bench import LogLines
from tvbrdf_nodes.core.device import DeviceError, DriverContext

WIDTH, HEIGHT, RATE_HZ, FRAMES = 64, 48, 50.0, 240
LIMIT_S = 20.0
JPEG_ERROR = 4
"""Of a uniform area, in codes: the video's compression loses about that."""


def level(index: int) -> tuple[int, int, int]:
    """Return B, G, R of a frame: a colour that tells its number."""
    return 40 + index % 180, 100, 220 - index % 180


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video whose upper left quarter is black."""
    import cv2

    path = tmp_path_factory.mktemp("video") / "sweep.avi"
    fourcc = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), fourcc, RATE_HZ, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for index in range(FRAMES):
        image = np.full((HEIGHT, WIDTH, 3), level(index), dtype=np.uint8)
        image[: HEIGHT // 2, : WIDTH // 2] = 0
        writer.write(image)
    writer.release()
    return path


@pytest.fixture
def log() -> LogLines:
    return LogLines()


@pytest.fixture
def make_camera(log: LogLines, tmp_path: Path) -> Iterator[Callable[..., OpenCvCamera]]:
    made: list[OpenCvCamera] = []

    def no_link() -> Any:
        raise AssertionError("a real driver opened a link to a simulation")

    def make(source: Path | str, **parameters: Any) -> OpenCvCamera:
        context = DriverContext("camera_1", SystemClock(), log, tmp_path, no_link)
        made.append(OpenCvCamera(OpenCvParameters(source=str(source), **parameters), context))
        return made[-1]

    yield make
    for camera in made:
        camera.close()


MakeCamera = Callable[..., OpenCvCamera]


def take(camera: OpenCvCamera, count: int) -> list[RawFrame]:
    camera.start(CaptureTag())
    found: list[RawFrame] = []
    deadline = time.monotonic() + LIMIT_S
    while len(found) < count and time.monotonic() < deadline:
        found += camera.read()
    camera.stop()
    assert len(found) >= count
    return found[:count]


def test_frames_of_a_file_come_in_order_from_capture_to_capture(
    make_camera: MakeCamera, video: Path
) -> None:
    camera = make_camera(video)
    camera.open()
    camera.configure(CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0))
    first = take(camera, 12)
    assert [frame.frame_id for frame in first] == list(range(12))
    for index, frame in enumerate(first):
        assert frame.image.shape == (HEIGHT, WIDTH, 3)
        assert np.abs(frame.image[-8:, -8:].mean(axis=(0, 1)) - level(index)).max() < JPEG_ERROR
        assert frame.image[:8, :8].max() < 2 * JPEG_ERROR
        assert frame.hardware_ns == 0
    (after,) = take(camera, 1)
    seen = round(float(after.image[-8:, -8:, 0].mean())) - 40
    assert seen >= 12 - JPEG_ERROR


def test_a_file_runs_at_its_own_rate_and_not_faster(make_camera: MakeCamera, video: Path) -> None:
    camera = make_camera(video)
    camera.open()
    settings = camera.configure(CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0))
    assert settings.frame_rate_hz == pytest.approx(RATE_HZ)
    began_s = time.monotonic()
    take(camera, 21)
    assert time.monotonic() - began_s >= 20 / RATE_HZ


def test_region_is_cut_out(make_camera: MakeCamera, video: Path) -> None:
    camera = make_camera(video)
    camera.open()
    region = Region(WIDTH // 2 - 10, HEIGHT // 2 - 6, 20, 12)
    settings = CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0, region=region)
    assert camera.configure(settings).region == region
    (frame,) = take(camera, 1)
    assert frame.image.shape == (12, 20, 3)
    assert frame.image.flags.c_contiguous
    assert frame.image[:4, :6].max() < 30
    assert frame.image[-4:, -6:, 2].min() > 180
    with pytest.raises(DeviceError, match="does not lie on its sensor of 64x48 pixels"):
        camera.configure(
            CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0, region=Region(50, 0, 20, 20))
        )


def test_says_that_it_is_approximate(make_camera: MakeCamera, video: Path, log: LogLines) -> None:
    camera = make_camera(video)
    camera.open()
    assert not camera.identity.exact_exposure
    assert not camera.identity.hardware_stamps
    assert (camera.identity.width, camera.identity.height) == (WIDTH, HEIGHT)
    ((what, text),) = log.lines
    assert what == "warning"
    assert "approximate_timing" in text


def test_exposure_of_a_file_is_the_one_that_is_told(make_camera: MakeCamera, video: Path) -> None:
    camera = make_camera(video, exposure_ms=7.5)
    camera.open()
    got = camera.configure(CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0))
    assert got.exposure_ms == 7.5
    assert take(camera, 1)[0].exposure_ms == 7.5


def test_end_of_a_file_is_silence(make_camera: MakeCamera, tmp_path: Path) -> None:
    import cv2

    path = tmp_path / "short.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 100.0, (32, 32))
    for _ in range(4):
        writer.write(np.zeros((32, 32, 3), dtype=np.uint8))
    writer.release()
    camera = make_camera(path)
    camera.open()
    camera.configure(CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0))
    assert len(take(camera, 4)) == 4
    camera.start(CaptureTag())
    deadline = time.monotonic() + 0.3
    while time.monotonic() < deadline:
        assert camera.read() == []


def test_conforms(make_camera: MakeCamera, video: Path) -> None:
    assert check_camera_driver(make_camera(video)) == []


def test_missing_file(make_camera: MakeCamera, tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"missing\.avi\): no such file"):
        make_camera(tmp_path / "missing.avi").open()


def test_file_that_is_no_video(make_camera: MakeCamera, tmp_path: Path) -> None:
    path = tmp_path / "text.avi"
    path.write_text("this is no video")
    with pytest.raises(DeviceError, match="no video that OpenCV can read"):
        make_camera(path).open()


def test_missing_device(make_camera: MakeCamera) -> None:
    with pytest.raises(DeviceError, match=r"\(OpenCV, 97\): no camera"):
        make_camera("97").open()


def node_parameters(video: Path) -> dict[str, Any]:
    return {
        "driver": "tvbrdf_nodes.camera.opencv_camera:OpenCvCamera",
        "driver_parameters": {"source": str(video)},
        "live": True,
    }


def test_scans_refuse_it_unless_told_otherwise(make_rig: Callable[..., Any], video: Path) -> None:
    rig = make_rig(**node_parameters(video))
    rig.command("prepare")
    result = rig.result()
    assert result.state == "refused"
    assert "approximate_timing: true" in result.reason


def test_scans_take_it_when_told(make_rig: Callable[..., Any], video: Path) -> None:
    rig = make_rig(approximate_timing=True, **node_parameters(video))
    rig.command("prepare")
    assert rig.result().state == "done"
    rig.command("sweep")
    deadline = time.monotonic() + LIMIT_S
    frames: list[Frame] = []
    while len(frames) < 10 and time.monotonic() < deadline:
        rig.settle()
        frames += [envelope.message for envelope in rig.frames()]
    rig.command("end_sweep")
    result = rig.result()
    frames += [envelope.message for envelope in rig.frames()]
    assert (result.state, result.frames) == ("done", len(frames))
    assert [frame.index for frame in frames] == list(range(len(frames)))
    assert frames[0].image.shape == (HEIGHT, WIDTH, 3)
