"""Which pixels are recorded: a refit of them is the same bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.nodes.recorder.recording import (
    Recording,
    frame,
    images,
    recorder_graph,
)
from tests.paths import CALIBRATION_FILE
from tvbrdf_fitting.measurement.calibration import CameraCalibration, load_calibration
from tvbrdf_fitting.measurement.frame_reduction import FrameReducer, PatchStatistics
from tvbrdf_nodes.recorder.regions import UsedRegions


def small_patches(folder: Path) -> Path:
    """Write a calibration that makes use of a part of the image only."""
    content = yaml.safe_load(CALIBRATION_FILE.read_text())
    every = content["every_camera"]
    every["patch"] = {"x": 0.41, "y": 0.33, "width": 0.21, "height": 0.17}
    every["reference_patch"] = {"x": 0.07, "y": 0.81, "width": 0.11, "height": 0.09}
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def reduced(camera: CameraCalibration, image: Any) -> list[Any]:
    def flat(statistics: PatchStatistics) -> Iterator[Any]:
        for region in (statistics.patch, statistics.reference):
            assert region is not None
            yield region.pixel_count
            yield region.saturated_count.tolist()
            yield [value.hex() for value in region.mean_dn.tolist()]
            yield [value.hex() for value in region.variance_dn2.tolist()]

    return list(flat(FrameReducer(camera).reduce(image)))


@pytest.mark.parametrize(("height", "width"), [(48, 64), (61, 83), (480, 640), (9, 15)])
def test_the_merger_sees_the_same_bit_for_bit(tmp_path: Path, height: int, width: int) -> None:
    path = small_patches(tmp_path)
    camera = load_calibration(path).camera(1)
    for margin in (0.0, 0.05, 0.3):
        regions = UsedRegions(str(path), ("camera_1",), margin)
        for index in range(5):
            whole = frame(index, height=height, width=width)
            if index == 1:
                whole.image[:] = whole.image // 2  # nothing is saturated
                whole.image[0, 0] = 4095  # but a pixel that nobody uses
            kept = regions.blanked(whole)
            assert reduced(camera, kept.image) == reduced(camera, whole.image)
        share = regions.kept_fraction("camera_1", height, width)
        assert np.count_nonzero(kept.image) <= share * kept.image.size
        if margin == 0.05 and height > 40:
            # each side is 2·0.05 longer; the tolerance is for rounding to whole pixels
            assert share == pytest.approx(0.31 * 0.27 + 0.21 * 0.19, rel=0.1)


def test_stills_and_other_cameras_stay_whole(tmp_path: Path) -> None:
    regions = UsedRegions(str(small_patches(tmp_path)), ("camera_1",), 0.05)
    for whole in (frame(kind="still"), replace(frame(), camera="microscope")):
        assert regions.blanked(whole) is whole
    whole = frame()  # of which the rig's calibration uses every pixel
    assert UsedRegions(str(CALIBRATION_FILE), ("camera_1",), 0.0).blanked(whole) is whole


@pytest.mark.parametrize("full", [False, True])
def test_full_frames_are_recorded_on_request(tmp_path: Path, full: bool) -> None:
    path = str(small_patches(tmp_path))
    graph = recorder_graph(tmp_path, calibration=path, cameras=["camera_1"], full_frames=full)
    with Recording(graph) as recording:
        recording.say("/camera_1/frame", frame())
    (image,) = images(tmp_path / "bag")
    expected = frame() if full else UsedRegions(path, ("camera_1",), 0.05).blanked(frame())
    np.testing.assert_array_equal(image, expected.image)
    assert np.array_equal(image, frame().image) == full
