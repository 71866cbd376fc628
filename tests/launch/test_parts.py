"""Parts of the launcher that need no run: display, process table, stills, numbers as text."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.paths import CALIBRATION_FILE
from tvbrdf_fitting.measurement.calibration import load_calibration
from tvbrdf_launch.display import Display, TimeLeft
from tvbrdf_launch.errors import RunError
from tvbrdf_launch.process_table import (
    ProcessRecord,
    ProcessTable,
    read_processes,
    start_ticks,
    wait_until_gone,
)
from tvbrdf_launch.still import BINS, bars, figures, merge_stills, write_exr
from tvbrdf_launch.text import duration, plus_minus, size
from tvbrdf_messages.envelope import Envelope, Header
from tvbrdf_messages.messages import Diagnostics, Frame, Log, ScanStatus

# -- numbers as text


@pytest.mark.parametrize(
    ("value", "deviation", "text"),
    [
        (0.123456, 0.00123, "0.1235 ± 0.0012"),
        (8.3, 0.25, "8.30 ± 0.25"),
        (123.4, 12.0, "123 ± 12"),
        (123456.0, 1200.0, "123456 ± 1200"),
        (0.5, 0.0, "0.5"),
        (0.5, float("nan"), "0.5 ± ?"),
        (0.5, float("inf"), "0.5 ± ?"),
        (float("nan"), 1.0, "undetermined"),
        (0.25, 1e-12, "0.25 ± 1.0e-12"),
    ],
)
def test_two_digits_of_the_deviation(value: float, deviation: float, text: str) -> None:
    assert plus_minus(value, deviation) == text


def test_durations_and_sizes() -> None:
    assert [duration(s) for s in (0, 59.6, 61, 3599.4, 3725, -3)] == [
        "0:00",
        "1:00",
        "1:01",
        "59:59",
        "1:02:05",
        "0:00",
    ]
    assert [size(n) for n in (12, 1234, 5.5e6, 7e12)] == [
        "12 B",
        "1.23 kB",
        "5.50 MB",
        "7000.00 GB",
    ]


# -- display


def envelope(message: Any, stamp_ns: int = 0) -> Envelope:
    return Envelope("/x", Header("n", "i", "h", "b", 0, stamp_ns), message)


def status(**fields: Any) -> ScanStatus:
    told: dict[str, Any] = {
        "state": "sweep",
        "sample": "s",
        "scan": 1,
        "scans": 2,
        "sweep": 1,
        "sweeps": 3,
        "fraction": 0.5,
        "remaining_s": 100.0,
        "text": "sweeping",
    }
    return ScanStatus(**{**told, **fields})


def test_time_left_follows_the_run_s_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    simulated, live = TimeLeft(simulated=True), TimeLeft(simulated=False)
    for one in (simulated, live):
        one.take(0, 100.0)
    assert simulated.seconds() is None, "how fast it runs is not known yet"
    assert live.seconds() == 100.0
    now[0] += 10.0
    simulated.take(50_000_000_000, 50.0)  # 50 s of the run's clock in 10 s
    assert simulated.seconds() == pytest.approx(10.0)
    assert live.seconds() == 90.0
    now[0] += 4.0
    assert simulated.seconds() == pytest.approx(6.0)
    live.take(0, -1.0)
    assert live.seconds() is None, "it depends on the operator"


def test_plain_lines_are_not_repeated() -> None:
    shown = io.StringIO()
    display = Display(simulated=False, stream=shown)
    for _ in range(3):
        display.take(envelope(status()))
        display.take(envelope(Log(node="arm", level="info", text="nobody needs to know")))
    display.take(envelope(Log(node="arm", level="error", text="no such port")))
    for _ in range(2):
        display.take(envelope(Diagnostics(node="arm", state="fault", text="no such port")))
        display.take(envelope(Diagnostics(node="camera_1", state="fault", text="cable pulled")))
    assert shown.getvalue().splitlines() == [
        "[ 50 %, 1:40 left] scan 1/2, sweep 1/3: sweeping",
        "arm: error: no such port",
        "camera_1: fault: cable pulled",
    ]


def test_a_failing_stream_is_left_alone(tmp_path: Path) -> None:
    class Closed(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    display = Display(simulated=False, stream=Closed())
    display.open_log(tmp_path)
    display.say("one")
    display.say("two")
    display.close()
    lines = (tmp_path / "launch.log").read_text().splitlines()
    assert [line.split(" ", 1)[1] for line in lines] == ["one", "two"]


# -- process table


def test_a_process_is_known_by_its_start_too() -> None:
    pid = os.getpid()
    assert ProcessRecord(pid, start_ticks(pid)).alive()
    other = ProcessRecord(pid, start_ticks(pid) + 1)
    assert not other.alive()
    assert not other.send(signal.SIGKILL), "this very process would be gone"


def test_an_ended_process_is_not_alive_before_it_is_reaped() -> None:
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    record = ProcessRecord(child.pid, start_ticks(child.pid))
    assert record.alive()
    assert not wait_until_gone([record], 0.05)
    assert record.send(signal.SIGKILL)
    assert wait_until_gone([record], 10)
    assert not record.alive()
    assert child.stdin is not None
    child.stdin.close()
    child.wait()
    assert wait_until_gone([record], 0)
    assert not record.send(signal.SIGKILL)


def test_the_table_survives_its_file(tmp_path: Path) -> None:
    table = ProcessTable(ProcessRecord(1, 2), "running", None, {"arm": ProcessRecord(3, 4, 2, -9)})
    table.write(tmp_path)
    assert read_processes(tmp_path) == table
    (tmp_path / "processes.json").write_text('{"launcher": {}}')
    with pytest.raises(RunError, match=r"processes\.json can't be used"):
        read_processes(tmp_path)
    with pytest.raises(RunError, match="holds no run"):
        read_processes(tmp_path / "nowhere")


# -- stills


def frame(codes: Any, exposure_ms: float, bit_depth: int = 12) -> Frame:
    return Frame(
        camera="camera_1",
        kind="still",
        sample="",
        scan=0,
        sweep=0,
        attempt=0,
        index=0,
        exposure_ms=exposure_ms,
        bit_depth=bit_depth,
        region_x=0,
        region_y=0,
        image=np.ascontiguousarray(codes),
    )


def test_figures_count_every_pixel() -> None:
    codes = np.zeros((4, 5, 3), dtype=np.uint16)
    codes[..., 1] = 2048
    codes[0, :, 2] = 4095
    found = figures(frame(codes, 1.0), 4095)
    assert found.mean.tolist() == [0.0, 2048.0, 4095.0 / 4]
    assert found.saturated_percent.tolist() == [0.0, 0.0, 25.0]
    assert found.histogram.shape == (3, BINS)
    assert found.histogram.sum(axis=1).tolist() == [20, 20, 20]
    assert (found.histogram[1, BINS // 2], found.histogram[2, BINS - 1]) == (20, 5)
    assert len(bars(found.histogram[2])) == BINS
    assert bars(found.histogram[1]).strip() == "█"


def test_merged_exposures_are_the_radiance_within_its_noise() -> None:
    camera = load_calibration(CALIBRATION_FILE).camera(1)
    generator = np.random.default_rng(7)
    scale = np.asarray(camera.radiance_per_dn_per_ms)
    radiance = np.broadcast_to(np.geomspace(0.002, 5.0, 400)[None, :, None], (100, 400, 3))
    stills = []
    for exposure_ms in (0.2, 4.0, 32.0):
        signal_dn = radiance / scale * exposure_ms
        noise = np.sqrt(camera.pixel_variance_dn2(signal_dn)) * generator.standard_normal(
            radiance.shape
        )
        codes = np.clip(np.round(signal_dn + camera.black_level_dn + noise), 0, 4095)
        stills.append(frame(codes.astype(np.uint16), exposure_ms))
    merged, known = merge_stills(stills, camera)
    assert merged.dtype == np.float32
    assert known.all()
    # a column's mean of 300 pixels; noise and rounding of the best exposure alone bound its own
    variance = np.stack(
        [
            (camera.pixel_variance_dn2(radiance[0] / scale * t) + 1 / 12) * (scale / t) ** 2
            for t in (0.2, 4.0, 32.0)
        ]
    )
    fits = np.stack([radiance[0] / scale * t < 3700 for t in (0.2, 4.0, 32.0)])
    best = np.sqrt(np.where(fits, variance, np.inf).min(axis=0).mean(axis=1) / 300)
    error = merged.mean(axis=(0, 2), dtype=np.float64) - radiance[0, :, 0]
    # 5 standard deviations over 400 columns fail once in 4000 seeds; float32 in the mean's sum
    assert np.all(np.abs(error) < 5 * best + 1e-6 * radiance[0, :, 0])


def test_where_all_is_saturated_the_shortest_exposure_bounds_it() -> None:
    camera = load_calibration(CALIBRATION_FILE).camera(1)
    codes = np.full((2, 2, 3), 4095, dtype=np.uint16)
    merged, known = merge_stills([frame(codes, 4.0), frame(codes, 0.2)], camera)
    assert not known.any()
    expected = (4095 - camera.black_level_dn) * camera.radiance_per_dn_per_ms[0] / 0.2
    np.testing.assert_allclose(merged, expected, rtol=1e-6)
    with pytest.raises(ValueError, match="stills of 2 shapes"):
        merge_stills([frame(codes, 4.0), frame(codes[:1], 0.2)], camera)


def test_exr_keeps_pixels_and_channels(tmp_path: Path) -> None:
    import OpenEXR

    bgr = np.random.default_rng(1).random((5, 7, 3)).astype(np.float32)
    before = bgr.copy()
    path = tmp_path / "x.exr"
    write_exr(path, bgr, [frame(np.zeros((5, 7, 3), np.uint16), 0.2)])
    with OpenEXR.File(str(path)) as file:
        rgb = file.channels()["RGB"].pixels.copy()
        assert file.header()["exposures_ms"] == "0.2"
    np.testing.assert_array_equal(rgb, bgr[..., ::-1])
    np.testing.assert_array_equal(bgr, before)
