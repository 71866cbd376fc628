"""OpenEXR images: the pipeline's own radiance, exposures merged, attributes, bad input."""

from __future__ import annotations

import csv
import resource
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.launch.export_inputs import the_radiance
from tests.launch.refit_inputs import copy_bag, inside, shuffled
from tests.messages.bag_samples import header
from tests.replay.process_replay import BAG
from tests.replay.recorded_rig import read_all, write_bag
from tests.sample_messages import START_NS
from tvbrdf_fitting.geometry import light_direction
from tvbrdf_fitting.measurement.calibration import CameraCalibration, parse_calibration
from tvbrdf_launch.errors import RunError
from tvbrdf_launch.export import export_bag
from tvbrdf_launch.export.exr import COLUMNS, ExrOptions
from tvbrdf_launch.export.hdr import (
    BLOCK_FRAMES,
    KEPT_BLOCKS,
    BlockReader,
    hdr_images,
)
from tvbrdf_launch.export.scans import CameraSweep, LitFrame, Place
from tvbrdf_messages.bag import BagReader
from tvbrdf_messages.bag.errors import BagError
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Frame, SweepResult

FLOAT32 = 1e-6
"""Relative: values are stored with 24 bits (6e-8), and averaged after that."""


@pytest.fixture(scope="module")
def merged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("merged") / "out"
    export_bag(BAG, out, ["exr"])
    return out / "exr"


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "index.csv").open(newline="") as file:
        return [*csv.DictReader(file)]


def image(path: Path) -> tuple[dict[str, Any], Any]:
    """Return attributes, and pixels in B, G, R order."""
    import OpenEXR

    with OpenEXR.File(str(path)) as file:
        return dict(file.header()), file.channels()["RGB"].pixels[..., ::-1].copy()


def camera() -> CameraCalibration:
    """Return the first camera of the bag's calibration, its codes linear."""
    text = inside()["calibration/calibration.yaml"].decode()
    found = parse_calibration(text).camera(1)
    assert found.response.is_linear
    return found


# -- against the pipeline


def test_each_frame_has_the_radiance_and_light_of_the_merger(tmp_path: Path) -> None:
    options = ExrOptions(each_exposure=True)
    report = export_bag(BAG, tmp_path / "out", ["exr"], options=options)
    scan = the_radiance()
    place = {
        (number, stamp): row
        for row, (number, stamp) in enumerate(
            zip(scan.camera.tolist(), scan.stamp_ns.tolist(), strict=True)
        )
    }
    lamp = np.array(scan.quality["lamp_factor"])
    index = rows(tmp_path / "out" / "exr")
    assert report.written[0].counts == {"scans": 1, "images": len(place)}
    assert len(index) == len(place)
    for line in index:
        number = int(line["camera"].removeprefix("camera_"))
        row = place.pop((number, int(line["stamps_ns"])))
        assert float(line["light_angle_deg"]) == scan.light_angle_deg[row]
        _, pixels = image(tmp_path / "out" / "exr" / line["file"])
        valid = scan.valid[row]
        mean = pixels.mean(axis=(0, 1), dtype=np.float64) / lamp[scan.sweep[row], number - 1]
        np.testing.assert_allclose(mean[valid], scan.radiance[row][valid], rtol=FLOAT32)
    assert place == {}


def test_merged_images_have_the_longest_exposures_lights_and_fit_the_radiance(
    merged: Path,
) -> None:
    scan = the_radiance()
    index = rows(merged)
    assert len(index) > 150
    for number in range(1, 5):
        mine = [line for line in index if line["camera"] == f"camera_{number}"]
        angles = [float(line["light_angle_deg"]) for line in mine]
        assert angles == sorted(angles)
        wanted = (scan.camera == number) & (scan.exposure_ms > 1)
        assert {*angles} <= {*scan.light_angle_deg[wanted].tolist()}
        # at most the ends of the way and the sides of the hidden gap have no other exposure around
        assert wanted.sum() - len(angles) <= 4
        long = {scan.light_angle_deg[k]: k for k in np.flatnonzero(wanted)}
        for line, angle in zip(mine, angles, strict=True):
            row = long[angle]
            if not scan.valid[row].all():
                continue
            _, pixels = image(merged / line["file"])
            mean = pixels.mean(axis=(0, 1), dtype=np.float64)
            # the short exposure has a weight of 0.2 / 4.2 at most, and frames here lie 3.75
            # degrees apart: it may pull by 5 % of what the line between them is off
            np.testing.assert_allclose(mean, scan.radiance[row], rtol=0.05, atol=0.003)


def test_attributes(merged: Path) -> None:
    line = rows(merged)[10]
    assert (*line,) == COLUMNS
    facts, pixels = image(merged / line["file"])
    assert pixels.dtype == np.float32
    assert facts["sample"] == "drying_paint"
    assert (facts["scan"], facts["camera"]) == (1, "camera_1")
    assert facts["exposures_ms"] == line["exposures_ms"] == "0.2, 4"
    stamps = [int(word) for word in facts["stamps_ns"].split(", ")]
    scan = the_radiance()
    assert {*stamps} <= {*scan.stamp_ns[scan.camera == 1].tolist()}
    assert len(stamps) == 2
    angle = float(line["light_angle_deg"])
    np.testing.assert_allclose(facts["light_direction"], light_direction(angle), atol=1e-7)
    np.testing.assert_allclose(facts["view_direction"], scan.view_direction[0], atol=1e-7)
    assert facts["light_angle_deg"] == pytest.approx(angle, rel=1e-7)
    assert facts["calibration"] == "calibration.yaml"
    assert len(facts["calibration_sha256"]) == 64
    assert facts["saturated_fraction"] == float(line["saturated_fraction"])
    assert facts["camera_angle_deg"] == 0.0


def test_opencv_reads_it_in_b_g_r_order(
    merged: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENCV_IO_ENABLE_OPENEXR", "1")
    import cv2

    if not any("OpenEXR" in line and "NO" not in line for line in _image_formats(cv2)):
        pytest.skip("this OpenCV was built without OpenEXR")
    path = merged / rows(merged)[10]["file"]
    np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), image(path)[1])


def _image_formats(cv2: Any) -> list[str]:
    return [line for line in cv2.getBuildInformation().splitlines() if "EXR" in line]


def test_whole_frames_hold_the_patch(merged: Path, tmp_path: Path) -> None:
    export_bag(BAG, tmp_path / "out", ["exr"], options=ExrOptions(whole_frames=True))
    name = rows(merged)[10]["file"]
    patch_facts, patch = image(merged / name)
    whole_facts, whole = image(tmp_path / "out" / "exr" / name)
    assert whole.shape == (8, 8, 3)
    assert patch.shape != whole.shape
    y = patch_facts["region_y"] - whole_facts["region_y"]
    x = patch_facts["region_x"] - whole_facts["region_x"]
    np.testing.assert_array_equal(whole[y : y + patch.shape[0], x : x + patch.shape[1]], patch)


def test_images_do_not_depend_on_the_order_of_publishers(merged: Path, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "a.mcap", shuffled(read_all(BAG), seed=3), inside())
    export_bag(bag, tmp_path / "out", ["exr"])
    other = tmp_path / "out" / "exr"
    assert rows(other) == rows(merged)
    for line in rows(merged):
        assert (other / line["file"]).read_bytes() == (merged / line["file"]).read_bytes()


# -- between light positions


def synthetic(path: Path, sweeps: list[tuple[float, list[float]]]) -> list[CameraSweep]:
    """Write frames whose radiance is a straight line in the light's angle; float32 codes."""
    calibrated, envelopes, found = camera(), [], []
    scale = np.asarray(calibrated.radiance_per_dn_per_ms)
    slopes = np.linspace(1.0, 2.0, 12).reshape(2, 2, 3)
    sequence = 0
    for number, (exposure_ms, angles) in enumerate(sweeps):
        lit = []
        for angle in angles:
            radiance = slopes * (0.05 + angle / 1000)
            codes = radiance * exposure_ms / scale + calibrated.black_level_dn
            message = Frame(
                camera="camera_1",
                kind="light",
                sample="paint",
                scan=1,
                sweep=number,
                attempt=1,
                index=sequence,
                exposure_ms=exposure_ms,
                bit_depth=calibrated.bit_depth,
                region_x=0,
                region_y=0,
                image=codes.astype(np.float32),
            )
            stamp_ns = START_NS + sequence * 1_000_000
            sent = header("camera_1", sequence, stamp_ns)
            envelopes.append(Envelope("/camera_1/frame", sent, message))
            place = Place(stamp_ns, sent.incarnation, sequence)
            lit.append(LitFrame(place, exposure_ms, stamp_ns, angle))
            sequence += 1
        dark = np.full(3, calibrated.black_level_dn)
        frames = tuple(sorted(lit, key=lambda frame: frame.light_angle_deg))
        found.append(CameraSweep(number, exposure_ms, frames, dark))
    write_bag(path, envelopes, {})
    return found


def test_a_straight_line_in_the_angle_is_kept_to_and_fro(tmp_path: Path) -> None:
    to = [float(angle) for angle in np.arange(-20, 20, 0.5)]
    fro = [angle + 0.2 for angle in reversed(to)]
    sweeps = synthetic(tmp_path / "a.mcap", [(0.02, to), (0.1, fro)])
    with BagReader(tmp_path / "a.mcap") as bag:
        whole = [*hdr_images(bag, "camera_1", sweeps, camera(), whole=True)]
    # its positions are the second sweep's; the last has no frame of the first beyond it
    assert [each.light_angle_deg for each in whole] == pytest.approx(sorted(fro)[:-1])
    slopes = np.linspace(1.0, 2.0, 12).reshape(2, 2, 3)
    for each in whole:
        truth = slopes * (0.05 + each.light_angle_deg / 1000)
        # codes are float32 of some 100 dn, of which the signal is at least a tenth
        np.testing.assert_allclose(each.radiance, truth, rtol=1e-5)
        assert each.exposures_ms == (0.02, 0.1)
        assert each.saturated_fraction == 0.0


def test_nothing_is_drawn_across_a_gap(tmp_path: Path) -> None:
    full = [float(angle) for angle in np.arange(0, 20, 0.5)]
    broken = [angle + 0.1 for angle in full if not 8 <= angle < 12]
    sweeps = synthetic(tmp_path / "a.mcap", [(0.02, broken), (0.1, full)])
    with BagReader(tmp_path / "a.mcap") as bag:
        found = [*hdr_images(bag, "camera_1", sweeps, camera(), whole=True)]
    angles = [each.light_angle_deg for each in found]
    assert angles == [angle for angle in full if 0 < angle < 8 or angle > 12]
    assert max(b - a for a, b in pairwise(angles)) == pytest.approx(5.0)


def test_few_frames_are_in_memory(tmp_path: Path) -> None:
    (sweep,) = synthetic(tmp_path / "a.mcap", [(0.1, [float(n) for n in range(40)])])
    with BagReader(tmp_path / "a.mcap") as bag:
        reader = BlockReader(bag, "camera_1", sweep)
        for index in (0, 39, 7, 8, 9, 20, 39, 0):
            assert reader.frame(index).index == index
            kept = sum(len(block) for block in reader._blocks.values())
            assert kept <= KEPT_BLOCKS * BLOCK_FRAMES


def test_positions_without_all_exposures_are_told(tmp_path: Path) -> None:
    report = export_bag(BAG, tmp_path / "out", ["exr"])
    (written,) = report.written
    scan = the_radiance()
    told = 0
    for remark in written.remarks:
        assert remark.startswith("scan 1, camera_")
        _, what, count = remark.split(": ")
        assert what == "light positions that not every exposure has frames around"
        told += int(count)
    assert told + written.counts["images"] == (scan.exposure_ms > 1).sum()
    assert told > 0


# -- bad input


def test_more_cameras_than_calibrated_are_told(tmp_path: Path) -> None:
    def fifth(envelope: Envelope) -> list[Envelope]:
        message = envelope.message
        if isinstance(message, Frame) and message.camera == "camera_4":
            other = replace(message, camera="camera_5")
            return [envelope, envelope._replace(topic="/camera_5/frame", message=other)]
        return [envelope]

    only_calibration = {k: v for k, v in inside().items() if k.startswith("calibration")}
    envelopes = (each for e in read_all(BAG) for each in fifth(e))
    bag = write_bag(tmp_path / "a.mcap", envelopes, only_calibration)
    with pytest.raises(BagError, match=r"5 cameras, .* is of 4: leave camera_5 out"):
        export_bag(bag, tmp_path / "out", ["exr"])


def without_one_frame(envelope: Envelope) -> bool:
    message = envelope.message
    return not (
        isinstance(message, Frame)
        and (message.camera, message.kind, message.sweep) == ("camera_2", "light", 1)
        and message.index == 20
    )


def test_a_lost_frame_is_told(tmp_path: Path) -> None:
    bag = copy_bag(tmp_path / "a.mcap", without_one_frame)
    with pytest.raises(
        BagError,
        match=r"no whole scan.*scan 1: sweep 1: camera_2 sent 69 frames, 68 are in the bag",
    ):
        export_bag(bag, tmp_path / "out", ["exr"])
    assert not (tmp_path / "out").exists()


def test_codes_beyond_the_calibrations_bits_are_told(tmp_path: Path) -> None:
    def shifted(envelope: Envelope) -> Envelope:
        message = envelope.message
        if isinstance(message, Frame) and message.kind == "light":
            image = (message.image * 16).astype(np.uint16)
            return envelope._replace(message=replace(message, image=image))
        return envelope

    bag = write_bag(tmp_path / "a.mcap", (shifted(e) for e in read_all(BAG)), inside())
    with pytest.raises(BagError, match="codes must not be shifted"):
        export_bag(bag, tmp_path / "out", ["exr"])


def test_a_bag_cut_within_the_scan_is_told(tmp_path: Path) -> None:
    def before_the_end(envelope: Envelope) -> bool:
        message = envelope.message
        return not (isinstance(message, SweepResult) and message.sweep == 1)

    bag = copy_bag(tmp_path / "a.mcap", before_the_end)
    with pytest.raises(BagError, match="scan 1: the bag does not have all of it"):
        export_bag(bag, tmp_path / "out", ["exr"])


@pytest.mark.parametrize("kind", ["dark", "light"])
def test_frames_of_another_format_are_told(tmp_path: Path, kind: str) -> None:
    def other(envelope: Envelope) -> Envelope:
        message = envelope.message
        if isinstance(message, Frame) and message.kind == kind:
            return envelope._replace(message=replace(message, image=message.image.astype("uint8")))
        return envelope

    assert next(m for e in read_all(BAG) if isinstance(m := e.message, Frame)).bit_depth > 8
    bag = write_bag(tmp_path / "a.mcap", (other(e) for e in read_all(BAG)), inside())
    with pytest.raises(BagError, match="frame is uint8 of shape"):
        export_bag(bag, tmp_path / "out", ["exr"])


def test_a_full_disk_leaves_nothing(tmp_path: Path) -> None:
    """The system's own limit on a file's size."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(RunError, match=rf"{tmp_path}/out.*can't be written.*free some space"):
            export_bag(BAG, tmp_path / "out", ["exr"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [*tmp_path.iterdir()] == []
