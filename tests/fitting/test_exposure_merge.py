"""Exposures merged pixel by pixel: exact, unbiased also in the dark, saturated light left out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.paths import CALIBRATION_FILE
from tvbrdf_fitting.measurement.calibration import CameraCalibration, load_calibration
from tvbrdf_fitting.measurement.exposure_merge import Exposed, PixelRadiance, merge_exposures

FLOAT32 = 1e-6
"""Relative: values are stored with 24 bits (6e-8)."""


@pytest.fixture(scope="module")
def camera() -> CameraCalibration:
    return load_calibration(CALIBRATION_FILE).camera(1)


def exposed(exposure_ms: float, radiance: Any, good: Any = True) -> Exposed:
    values = np.asarray(radiance, dtype=np.float64)
    return Exposed(exposure_ms, values, np.broadcast_to(good, values.shape))


def test_merging_keeps_what_exposures_agree_on(camera: CameraCalibration) -> None:
    values = np.linspace(0.0, 1.2, 4 * 5 * 3).reshape(4, 5, 3)
    found, known = merge_exposures([exposed(t, values) for t in (0.2, 4.0, 32.0)], camera)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, values, rtol=FLOAT32, atol=1e-9)
    assert known.all()


def test_saturated_exposures_have_no_part(camera: CameraCalibration) -> None:
    good = np.zeros((2, 2, 3), dtype=bool)
    good[0] = True
    short = exposed(0.2, np.full((2, 2, 3), 0.7))
    spoiled = exposed(4.0, np.where(good, 0.1, np.nan), good)
    found, known = merge_exposures([short, spoiled], camera)
    np.testing.assert_allclose(found[1], 0.7, rtol=FLOAT32)
    assert (found[0] < 0.2).all()
    assert known.all()
    both = [exposed(0.2, np.full((2, 2, 3), 0.7), good), exposed(4.0, np.zeros((2, 2, 3)), good)]
    found, known = merge_exposures(both, camera)
    np.testing.assert_allclose(found[1], 0.7, rtol=FLOAT32)  # the shortest: a lower limit
    np.testing.assert_array_equal(known, good)


@pytest.mark.parametrize("times_ms", [(0.2, 4.0, 32.0), (1.0, 2.0, 4.0)])
@pytest.mark.parametrize("truth", [0.0, 2e-4, 2e-3, 0.02])
def test_dark_values_are_not_drawn_down(
    camera: CameraCalibration, times_ms: tuple[float, ...], truth: float
) -> None:
    """Weights at each exposure's own value were off by 12 % of a deviation at 0.002."""
    rng = np.random.default_rng(11)
    pixels, taken = PixelRadiance(camera, camera.black_level_dn), []
    scale, best = np.asarray(camera.radiance_per_dn_per_ms), np.inf
    for exposure_ms in times_ms:
        signal = truth / scale * exposure_ms
        # rounding to codes adds a twelfth, which the noise model counts
        std = np.sqrt(camera.pixel_variance_dn2(signal) - 1 / 12)
        noisy = camera.black_level_dn + signal + std * rng.standard_normal((300, 300, 3))
        taken.append(pixels.exposed(np.round(noisy).astype(np.uint16), exposure_ms))
        best = min(best, float(std.max() * scale.max() / exposure_ms))
    found, _ = merge_exposures(taken, camera)
    error = found.astype(np.float64) - truth
    # 4.4 deviations of the mean of 270 000 values, 0.8 % of a value's deviation: once in 1e5
    assert abs(error.mean()) < 4.4 * error.std() / error.size**0.5
    assert error.std() < 1.01 * best


def test_interpolated_values_weigh_more(camera: CameraCalibration) -> None:
    """Where variances scale, so do weights: 1 and 4 for one exposure of a half and a quarter."""
    values = np.zeros((1, 1, 3))
    first = exposed(4.0, values + 1.0)._replace(weight_scale=1.0)
    second = exposed(4.0, values + 2.0)._replace(weight_scale=0.25)
    found, _ = merge_exposures([first, second], camera)
    np.testing.assert_allclose(found, (1.0 + 4 * 2.0) / 5, rtol=FLOAT32)


def test_codes_become_radiance(camera: CameraCalibration) -> None:
    dark = np.array([60.0, 64.0, 70.0])
    pixels = PixelRadiance(camera, dark)
    codes = np.full((2, 2, 3), 1064, dtype=np.uint16)
    codes[0, 0, 1] = camera.saturation_dn
    found = pixels.exposed(codes, 4.0)
    expected = (1064 - dark) * np.asarray(camera.radiance_per_dn_per_ms) / 4.0
    np.testing.assert_allclose(found.radiance[1, 1], expected, rtol=1e-12)
    assert found.good.sum() == 11
    assert not found.good[0, 0, 1]
    # codes that are no integers are linear as they are
    fine = pixels.exposed(codes.astype(np.float32), 4.0)
    np.testing.assert_allclose(fine.radiance, found.radiance, rtol=1e-6)
    other = PixelRadiance(replace(camera, saturation_dn=1000), dark).exposed(codes, 4.0)
    assert not other.good.any()
