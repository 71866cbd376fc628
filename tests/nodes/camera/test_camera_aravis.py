"""The Aravis driver, against Aravis's own fake GigE Vision camera on the loopback interface."""

from __future__ import annotations

import fcntl
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tvbrdf_messages.clock import SystemClock
from tvbrdf_nodes.camera import aravis_library
from tvbrdf_nodes.camera.aravis_camera import (
    PREFERRED_FORMATS,
    AravisCamera,
    AravisParameters,
    bgr_converter,
    bit_depth,
)
from tvbrdf_nodes.camera.conformance import check_camera_driver
from tvbrdf_nodes.camera.driver import CameraSettings, CaptureTag, RawFrame, Region
from tvbrdf_nodes.camera.simulated_bench import LogLines
from tvbrdf_nodes.core.device import DeviceError, DriverContext

FAKE_CAMERA = "arv-fake-gv-camera-0.8"
ADDRESS = "127.0.0.1"
LIMIT_S = 20.0
SMALL = Region(0, 0, 64, 48)


@pytest.fixture(scope="session")
def aravis() -> Any:
    """The library, or a skip that says what is missing."""
    if shutil.which(FAKE_CAMERA) is None:
        pytest.skip(f"no {FAKE_CAMERA}: apt-get install aravis-tools")
    try:
        return aravis_library.load_aravis()
    except DeviceError as error:
        pytest.skip(str(error))


@pytest.fixture
def fake_camera(aravis: Any) -> Iterator[subprocess.Popen[bytes]]:
    """A fake camera; its port is fixed, so tests that run side by side take turns."""
    with (Path(tempfile.gettempdir()) / "tvbrdf_fake_camera.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        process = subprocess.Popen(
            [FAKE_CAMERA, "-i", ADDRESS], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            deadline = time.monotonic() + LIMIT_S
            while not _answers(aravis):
                assert process.poll() is None, "the fake camera ended at once"
                assert time.monotonic() < deadline, "the fake camera does not answer"
            yield process
        finally:
            process.kill()
            process.wait()


def _answers(aravis: Any) -> bool:
    try:
        aravis.Camera.new(ADDRESS)
    except RuntimeError:
        return False
    return True


MakeCamera = Callable[..., AravisCamera]


@pytest.fixture
def make_camera(aravis: Any, tmp_path: Path) -> Iterator[MakeCamera]:
    made: list[AravisCamera] = []

    def no_link() -> Any:
        raise AssertionError("a real driver opened a link to a simulation")

    def make(device: str = ADDRESS, **parameters: Any) -> AravisCamera:
        context = DriverContext("camera_1", SystemClock(), LogLines(), tmp_path, no_link)
        made.append(AravisCamera(AravisParameters(device=device, **parameters), context))
        return made[-1]

    yield make
    for camera in made:
        camera.close()


@pytest.fixture
def camera(fake_camera: subprocess.Popen[bytes], make_camera: MakeCamera) -> AravisCamera:
    opened = make_camera()
    opened.open()
    return opened


def settings(exposure_ms: float = 4.0, rate_hz: float = 100.0, **more: Any) -> CameraSettings:
    return CameraSettings(
        **{"exposure_ms": exposure_ms, "frame_rate_hz": rate_hz, "region": SMALL, **more}
    )


def read(camera: AravisCamera, count: int) -> list[RawFrame]:
    found: list[RawFrame] = []
    deadline = time.monotonic() + LIMIT_S
    while len(found) < count and time.monotonic() < deadline:
        found += camera.read()
    assert len(found) >= count
    return found


def take(camera: AravisCamera, count: int) -> list[RawFrame]:
    camera.start(CaptureTag())
    found = read(camera, count)
    camera.stop()
    return found


def test_conforms(fake_camera: subprocess.Popen[bytes], make_camera: MakeCamera) -> None:
    """At 10 frames a second, as the whole sensor has 4 million pixels."""
    assert check_camera_driver(make_camera(stale_frames=1), frame_rate_hz=10.0) == []


def test_identity(camera: AravisCamera) -> None:
    identity = camera.identity
    assert "Fake" in identity.model
    assert identity.serial == "GV01"
    assert (identity.width, identity.height, identity.bit_depth) == (2048, 2048, 8)
    assert identity.hardware_stamps
    assert identity.exact_exposure


@pytest.mark.parametrize("exposure_ms", [0.2, 4.0, 32.0])
def test_exposure_is_read_back(camera: AravisCamera, exposure_ms: float) -> None:
    got = camera.configure(settings(exposure_ms))
    assert got.exposure_ms == pytest.approx(exposure_ms, rel=1e-6)
    assert take(camera, 1)[0].exposure_ms == got.exposure_ms


def test_exposure_beyond_the_cameras_bounds_is_read_back_as_its_bound(
    camera: AravisCamera,
) -> None:
    """The fake camera would take any number; its bounds are 10 µs and 10 s."""
    assert camera.configure(settings(0.001)).exposure_ms == pytest.approx(0.01)


def test_frames_carry_numbers_and_stamps(camera: AravisCamera) -> None:
    """The fake camera counts from 65 400 to 65 535 and begins again: numbers go on."""
    camera.configure(settings(1.0, 200.0))
    clock = SystemClock()
    began_ns = clock.now_ns()
    frames = take(camera, 200)
    ids = [frame.frame_id for frame in frames]
    assert ids == list(range(ids[0], ids[0] + len(ids)))
    assert ids[-1] > 65_535
    hardware = np.array([frame.hardware_ns for frame in frames])
    received = np.array([frame.received_ns for frame in frames])
    assert (np.diff(hardware) > 0).all()
    assert began_ns <= received[0]
    assert received[-1] <= clock.now_ns()
    # both clocks are this machine's: the span of 1 s agrees to a scheduling delay
    assert (hardware[-1] - hardware[0]) / (received[-1] - received[0]) == pytest.approx(1, abs=0.1)


def test_frames_that_wait_when_the_exposure_changes_are_dropped(camera: AravisCamera) -> None:
    """The fake camera's clock is this machine's: its stamps tell when a frame was exposed."""
    camera.configure(settings(2.0))
    camera.start(CaptureTag())
    read(camera, 3)
    deadline = time.monotonic() + LIMIT_S
    while camera._stream.get_n_buffers()[1] == 0 and camera._reader is not None:
        # nobody reads: frames pile up in the reader's queue
        if camera._reader._queue.qsize() > 3:
            break
        assert time.monotonic() < deadline
    camera.stop()
    camera.configure(settings(8.0))
    changed_ns = time.time_ns()
    frames = take(camera, 3)
    assert all(frame.hardware_ns > changed_ns for frame in frames)
    assert {frame.exposure_ms for frame in frames} == {8.0}


def test_first_frames_after_a_change_are_dropped_once(camera: AravisCamera) -> None:
    camera.configure(settings(2.0))
    first = take(camera, 1)[0].frame_id
    again = take(camera, 1)[0].frame_id
    camera.configure(settings(3.0))
    changed = take(camera, 1)[0].frame_id
    # 3 frames are thrown away after the change, and some between the captures
    assert changed - again >= 4
    assert first < again


def test_region_of_interest(camera: AravisCamera) -> None:
    region = Region(100, 60, 200, 120)
    assert camera.configure(settings(region=region)).region == region
    assert take(camera, 1)[0].image.shape == (120, 200, 3)
    # a larger one needs other buffers
    assert camera.configure(settings(region=Region(0, 0, 512, 400))).region is not None
    assert take(camera, 1)[0].image.shape == (400, 512, 3)


def test_trigger(camera: AravisCamera) -> None:
    camera.configure(settings(mode="trigger"))
    camera.start(CaptureTag())
    for _ in range(3):
        camera.trigger()
        assert len(read(camera, 1)) == 1
    camera.stop()
    camera.configure(settings())
    assert len(take(camera, 5)) >= 5


@pytest.mark.parametrize("pixel_format", ["Mono8", "BayerRG8", "BayerGB8", "RGB8", "Mono16"])
def test_pixel_formats(
    fake_camera: subprocess.Popen[bytes], make_camera: MakeCamera, pixel_format: str
) -> None:
    camera = make_camera(pixel_format=pixel_format)
    camera.open()
    camera.configure(settings())
    image: Any = take(camera, 1)[0].image
    assert image.shape == (48, 64, 3)
    assert image.dtype == (np.uint16 if pixel_format == "Mono16" else np.uint8)
    assert camera.identity.bit_depth == (16 if pixel_format == "Mono16" else 8)


def test_unknown_pixel_format(
    fake_camera: subprocess.Popen[bytes], make_camera: MakeCamera
) -> None:
    with pytest.raises(DeviceError, match=r"no pixel format BGR8; it has .*Mono8"):
        make_camera(pixel_format="BGR8").open()
    with pytest.raises(ValueError, match="'Mono12Packed' is not known"):
        AravisParameters(pixel_format="Mono12Packed")


def test_absent_camera(aravis: Any, make_camera: MakeCamera) -> None:
    with pytest.raises(DeviceError, match=r"127\.0\.0\.9\): can't open it: .*is it connected"):
        make_camera("127.0.0.9").open()


@pytest.mark.slow
def test_camera_that_is_unplugged(
    fake_camera: subprocess.Popen[bytes], camera: AravisCamera
) -> None:
    """What is asked of it then is an error that names it."""
    camera.configure(settings())
    camera.start(CaptureTag())
    read(camera, 2)
    fake_camera.kill()
    fake_camera.wait()
    with pytest.raises(DeviceError, match=r"camera_1 \(Aravis, 127\.0\.0\.1\): can't stop it"):
        camera.stop()


def test_no_library(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in [name for name in sys.modules if name == "gi" or name.startswith("gi.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(aravis_library, "SYSTEM_PACKAGES", tmp_path)
    monkeypatch.setitem(sys.modules, "gi", None)
    with pytest.raises(DeviceError, match=r"apt-get install gir1\.2-aravis-0\.8 python3-gi"):
        aravis_library.load_aravis()


# -- pixels, without a camera


def mosaic(pattern: str, bgr: tuple[int, int, int], dtype: type) -> Any:
    """Return a colour mosaic of a uniform colour; ``pattern`` names its first row."""
    blue, green, red = bgr
    colours = {"B": blue, "G": green, "R": red}
    second = {"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}[pattern]
    image: Any = np.zeros((8, 10), dtype=dtype)
    for row, letters in enumerate((pattern, second)):
        for column, letter in enumerate(letters):
            image[row::2, column::2] = colours[letter]
    return image


@pytest.mark.parametrize("pattern", ["RG", "GR", "GB", "BG"])
@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (12, np.uint16)])
def test_mosaics_become_blue_green_red(pattern: str, bits: int, dtype: type) -> None:
    colour = (200, 120, 40) if bits == 8 else (3200, 1920, 640)
    image = bgr_converter(f"Bayer{pattern}{bits}")(mosaic(pattern, colour, dtype))
    assert image.dtype == dtype
    assert (image == colour).all()


def test_other_formats_become_blue_green_red() -> None:
    colour = np.array([[[10, 20, 30]]], dtype=np.uint8)
    assert bgr_converter("RGB8")(colour).tolist() == [[[30, 20, 10]]]
    same = bgr_converter("BGR8")(colour)
    assert same.tolist() == colour.tolist()
    assert not np.shares_memory(same, colour)
    grey = np.array([[7]], dtype=np.uint16)
    assert bgr_converter("Mono12")(grey).tolist() == [[[7, 7, 7]]]


@pytest.mark.parametrize("name", PREFERRED_FORMATS)
def test_preferred_formats_are_known(name: str) -> None:
    assert bit_depth(name) in (8, 12)
    assert callable(bgr_converter(name))


@pytest.mark.parametrize("name", ["Mono12Packed", "YUV422_8", "", "BayerRG9"])
def test_other_formats_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="not known"):
        bit_depth(name)
    with pytest.raises(ValueError, match="not known"):
        bgr_converter(name)
