"""Reduction of frames: agreement with direct computation, refusals, and the saturation rule."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.paths import CALIBRATION_FILE
from tvbrdf_fitting.measurement.calibration import CameraCalibration, Rectangle, load_calibration
from tvbrdf_fitting.measurement.frame_reduction import FrameReducer, is_saturated
from tvbrdf_fitting.measurement.response import Response

CAMERA = load_calibration(CALIBRATION_FILE).camera(1)
RESPONSES = (
    Response(),
    Response("gamma", exponent=0.4545),
    Response("table", table_linear=(0.0, 0.1, 0.5, 1.0), table_code=(0.0, 0.3, 0.8, 1.0)),
)


@given(
    bit_depth=st.sampled_from([8, 10, 12, 16]),
    response=st.sampled_from(RESPONSES),
    height=st.integers(16, 90),
    width=st.integers(16, 90),
    patch=st.sampled_from([Rectangle(0, 0, 1, 0.875), Rectangle(0.2, 0.1, 0.5, 0.6)]),
    bright=st.booleans(),
    seed=st.integers(0, 2**32),
)
@settings(max_examples=60, deadline=None)
def test_agrees_with_direct_computation(
    bit_depth: int,
    response: Response,
    height: int,
    width: int,
    patch: Rectangle,
    bright: bool,
    seed: int,
) -> None:
    camera = replace(CAMERA.with_bit_depth(bit_depth), response=response, patch=patch)
    top = 2**bit_depth - 1
    dtype = np.uint8 if bit_depth == 8 else np.uint16
    low, high = (top - 5, top + 1) if bright else (top // 4, top // 2)
    random = np.random.default_rng(seed)
    image: Any = random.integers(low, high, (height, width, 3)).astype(dtype)

    statistics = FrameReducer(camera).reduce(image)

    assert statistics.reference is not None
    assert camera.reference_patch is not None
    for region, rectangle in (
        (statistics.patch, camera.patch),
        (statistics.reference, camera.reference_patch),
    ):
        codes = image[rectangle.pixels(width, height)].reshape(-1, 3)
        linear = response.linear_table(bit_depth)[codes]
        assert region.pixel_count == len(codes)
        assert region.saturated_count.tolist() == np.sum(codes == top, axis=0).tolist()
        # tables are float32 while averaging: each value is off by at most 2**-24 of full scale
        off = top * 6e-8
        np.testing.assert_allclose(region.mean_dn, linear.mean(axis=0), rtol=0, atol=off)
        allowed = 2.0 * linear.std(axis=0) * off + off**2 + 1e-9 * linear.var(axis=0)
        assert np.all(np.abs(region.variance_dn2 - linear.var(axis=0)) <= allowed + 1e-9)


def test_a_reducer_keeps_nothing_of_earlier_frames() -> None:
    reducer = FrameReducer(replace(CAMERA, response=RESPONSES[1]))
    dark = np.full((64, 64, 3), 70, dtype=np.uint16)
    bright = np.full((64, 64, 3), 4095, dtype=np.uint16)
    before = reducer.reduce(dark)
    assert reducer.reduce(bright).patch.saturated_count.tolist() == [56 * 64] * 3
    after = reducer.reduce(dark)
    assert after.patch.mean_dn.tolist() == before.patch.mean_dn.tolist()
    assert after.patch.saturated_count.tolist() == [0, 0, 0]


def test_the_frame_is_not_changed_and_may_be_read_only() -> None:
    image = np.full((32, 32, 3), 4095, dtype=np.uint16)
    image.setflags(write=False)
    assert FrameReducer(CAMERA).reduce(image).patch.mean_dn.tolist() == [4095.0] * 3


def test_without_a_reference_there_is_none() -> None:
    image = np.full((32, 32, 3), 100, dtype=np.uint16)
    assert FrameReducer(replace(CAMERA, reference_patch=None)).reduce(image).reference is None


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((32, 32, 3), np.uint8), "camera 1: frame is uint8 .* check the driver's pixel"),
        (np.zeros((32, 32), np.uint16), r"of shape \(32, 32\)"),
        (np.zeros((32, 32, 4), np.uint16), r"of shape \(32, 32, 4\)"),
        (np.zeros((0, 32, 3), np.uint16), r"of shape \(0, 32, 3\)"),
        (np.full((32, 32, 3), 4096, np.uint16), "code 4096, but 12 bits end at 4095"),
    ],
)
def test_frames_that_are_not_the_cameras_are_refused(image: NDArray[Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FrameReducer(CAMERA).reduce(image)


def noisy(camera: CameraCalibration, signal_dn: float, seed: int) -> NDArray[np.uint16]:
    """A frame of one level with the camera's own noise, clipped and rounded to codes."""
    random = np.random.default_rng(seed)
    # rounding adds its 1/12 by itself
    deviation = np.sqrt(camera.pixel_variance_dn2(signal_dn) - 1.0 / 12.0)
    level = camera.black_level_dn + signal_dn + deviation * random.standard_normal((64, 64, 3))
    return np.clip(np.rint(level), 0, 4095).astype(np.uint16)


def test_partly_saturated_patches_do_not_bias() -> None:
    """From far below saturation to above: what is not masked is right within its noise."""
    black = np.full(3, CAMERA.black_level_dn)
    kept: list[float] = []
    masked_any = 0
    noise = float(np.sqrt(CAMERA.pixel_variance_dn2(3900.0)))
    for index, distance in enumerate(np.linspace(-12.0, 2.0, 141)):
        signal = 4095.0 - 64.0 + distance * noise
        region = FrameReducer(CAMERA).reduce(noisy(CAMERA, signal, index)).patch
        masked = is_saturated(region, black, CAMERA)
        masked_any += int(masked.sum())
        std = np.sqrt(CAMERA.pixel_variance_dn2(signal) / region.pixel_count)
        kept.extend(((region.mean_dn - 64.0 - signal) / std)[~masked])
        if distance > -3.5:
            assert masked.all()
        if distance < -5.0:
            assert not masked.any()
    errors = np.array(kept)
    assert len(errors) > 200
    assert masked_any > 100
    # 4.4 standard deviations of a mean and of a sum of squares of independent normal numbers
    assert abs(errors.mean()) < 4.4 / np.sqrt(len(errors))
    assert abs(np.mean(errors**2) - 1.0) < 4.4 * np.sqrt(2.0 / len(errors))


def test_leaving_out_saturated_pixels_would_bias() -> None:
    """Why channels are masked as a whole: the mean of the unsaturated pixels is far too low."""
    signal = 4095.0 - 64.0 - 50.0
    codes = noisy(CAMERA, signal, 0)[..., 1]
    unsaturated = codes[codes < 4095]
    std = np.sqrt(CAMERA.pixel_variance_dn2(signal) / unsaturated.size)
    assert unsaturated.mean() - 64.0 - signal < -5.0 * std


def test_hot_pixels_are_allowed_for_when_the_calibration_says_so() -> None:
    image = noisy(CAMERA, 1000.0, 1)
    image[3, 5] = 4095
    black = np.full(3, CAMERA.black_level_dn)
    tolerant = replace(CAMERA, max_saturated_fraction=1e-3)
    region = FrameReducer(CAMERA).reduce(image).patch
    assert region.saturated_count.tolist() == [1, 1, 1]
    assert is_saturated(region, black, CAMERA).all()
    assert not is_saturated(region, black, tolerant).any()
