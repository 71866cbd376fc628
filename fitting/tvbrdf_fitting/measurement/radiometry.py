"""From the mean code of a rectangle to its radiance, with variance; dark level and lamp.

    radiance = (mean - dark) / exposure_ms * radiance_per_dn_per_ms / lamp factor

The lamp factor is what a reference of known albedo shows, divided by what it should show: drift of
the lamp, error of the camera's constants and error of the exposure time in one number a camera,
channel and sweep.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import BoolArray, FloatArray
from .calibration import Calibration, CameraCalibration
from .frame_reduction import RegionStatistics, is_saturated

MIN_REFERENCE_FRAMES = 10
# Spectralon is Lambertian to better than a per cent up to about 80 degrees from its normal
MIN_REFERENCE_COSINE = float(np.cos(np.deg2rad(80.0)))
LAMP_FACTOR_RANGE = (0.5, 2.0)
# a dark frame brighter than the nominal black level by this share of full scale is not dark
MAX_DARK_SHARE = 0.05
_SMOOTHED_FRAMES = 5


@dataclass(frozen=True, eq=False)
class DarkLevel:
    """Linear dn of a rectangle without light, mean and its variance, (3,) each."""

    mean_dn: FloatArray
    variance_dn2: FloatArray


@dataclass(frozen=True, eq=False)
class RegionRadiance:
    """Radiance of a rectangle in n frames of one camera: (n, 3) each, channels B, G, R.

    ``dark_variance`` is the part of ``variance`` that comes from the dark level: the same error in
    all frames. ``valid`` is False where light was clipped; values there are finite but wrong.
    """

    radiance: FloatArray
    variance: FloatArray
    dark_variance: FloatArray
    valid: BoolArray


@dataclass(frozen=True, eq=False)
class LampFactor:
    """Reference's radiance over the expected one, (3,); 1 with std 0 where not ``measured``."""

    factor: FloatArray
    std: FloatArray
    measured: BoolArray


def dark_level(regions: Sequence[RegionStatistics], camera: CameraCalibration) -> DarkLevel:
    """Dark level of a rectangle from lamp-off frames of one camera and exposure.

    Without any, it is the calibration's nominal black level. Its variance is that of the noise
    model, or the scatter of the frames if that is larger.

    Raises
    ------
    ValueError
        If the frames are too bright to have been taken in the dark.
    """
    if not regions:
        return DarkLevel(
            mean_dn=np.full(3, camera.black_level_dn),
            variance_dn2=np.full(3, camera.black_level_std_dn**2),
        )
    pixel_count = regions[0].pixel_count
    means = np.stack([region.mean_dn for region in regions])
    mean = means.mean(axis=0)
    brightest = camera.black_level_dn + MAX_DARK_SHARE * camera.saturation_linear_dn
    if np.any(mean > brightest):
        raise ValueError(
            f"camera {camera.camera}: dark frames have a mean of {np.max(mean):.1f} dn, nominal "
            f"black level is {camera.black_level_dn:g}: check that the lamp was off and the room "
            "dark, or correct black_level_dn in the calibration"
        )
    variance = camera.pixel_variance_dn2(np.zeros(3)) / pixel_count
    if len(regions) > 1:
        variance = np.maximum(variance, means.var(axis=0, ddof=1))
    return DarkLevel(mean, variance / len(regions))


def region_radiance(
    regions: Sequence[RegionStatistics],
    exposure_ms: ArrayLike,
    dark: DarkLevel,
    camera: CameraCalibration,
) -> RegionRadiance:
    """Radiance of a rectangle in frames of one camera and sweep, lamp factor not yet divided out.

    The variance is that of the mean: photon transfer over the number of pixels, plus the square
    of the noise common to a frame, plus the dark level's. Its signal is averaged over five
    neighbouring frames, since a variance that followed each frame's own noise would give the
    darker ones more weight in a fit.

    Parameters
    ----------
    regions : sequence of RegionStatistics
        One a frame, in order of time.
    exposure_ms : array_like
        Scalar or (n,), as read back.
    """
    exposure = np.broadcast_to(np.asarray(exposure_ms, dtype=np.float64), (len(regions),))
    scale = np.asarray(camera.radiance_per_dn_per_ms) / exposure[:, None]
    if not regions:
        none = np.zeros((0, 3))
        return RegionRadiance(none, none, none, none.astype(np.bool_))
    stacked = RegionStatistics(
        pixel_count=regions[0].pixel_count,
        saturated_count=np.stack([region.saturated_count for region in regions]),
        mean_dn=np.stack([region.mean_dn for region in regions]),
        variance_dn2=np.stack([region.variance_dn2 for region in regions]),
    )
    signal = stacked.mean_dn - dark.mean_dn
    expected = _smoothed(signal)
    variance = (
        camera.pixel_variance_dn2(expected) / stacked.pixel_count
        + (camera.relative_noise_std * expected) ** 2
        + dark.variance_dn2
    )
    return RegionRadiance(
        radiance=signal * scale,
        variance=variance * scale**2,
        dark_variance=dark.variance_dn2 * scale**2,
        valid=~is_saturated(stacked, dark.mean_dn, camera),
    )


def lamp_factor(
    reference: RegionRadiance,
    light: FloatArray,
    light_offset_std_deg: float,
    calibration: Calibration,
    camera: CameraCalibration,
) -> LampFactor:
    """Factor between what the reference shows in a sweep and albedo * cos(theta_i).

    Weighted least squares of radiance = albedo * (f cos(theta) - d sin(theta)) + e. The light's
    unknown offset times f, d, has a prior of width ``light_offset_std_deg``: at long exposures
    only grazing light leaves the reference unsaturated, and there an offset looks like a dimmer
    lamp. The dark level's error e has its own variance as prior. Light more than 80 degrees from
    the normal is left out.

    Parameters
    ----------
    light : ndarray
        Directions to the light in the sample's frame, (n, 3).

    Raises
    ------
    ValueError
        If the reference shows less than half or more than twice the expected radiance.
    """
    factor, std, measured = np.ones(3), np.zeros(3), np.zeros(3, dtype=np.bool_)
    steep = light[:, 2] >= MIN_REFERENCE_COSINE
    offset_std = np.deg2rad(light_offset_std_deg)
    for channel, albedo in enumerate(calibration.reference_albedo):
        used = steep & reference.valid[:, channel]
        if np.count_nonzero(used) < MIN_REFERENCE_FRAMES:
            continue
        own_variance = (reference.variance - reference.dark_variance)[used, channel]
        priors = np.array([offset_std**2, np.mean(reference.dark_variance[used, channel])])
        design = np.stack([albedo * light[used, 2], -albedo * light[used, 0], np.ones(used.sum())])
        # a parameter without uncertainty is no parameter
        free = np.concatenate([[True], priors > 0.0])
        weighted = design[free] / own_variance
        normal = weighted @ design[free].T
        normal += np.diag(np.concatenate([[0.0], 1.0 / priors[priors > 0.0]]))
        covariance = np.linalg.inv(normal)
        factor[channel] = (covariance @ (weighted @ reference.radiance[used, channel]))[0]
        std[channel] = np.sqrt(covariance[0, 0])
        measured[channel] = True
    if np.any((factor < LAMP_FACTOR_RANGE[0]) | (factor > LAMP_FACTOR_RANGE[1])):
        shown = ", ".join(f"{value:.3f}" for value in factor)
        raise ValueError(
            f"camera {camera.camera}: reference shows {shown} (B, G, R) times the radiance its "
            "albedo gives: check the lamp, reference_patch and reference_albedo in the "
            "calibration, and radiance_per_dn_per_ms"
        )
    return LampFactor(factor, std, measured)


def _smoothed(signal: FloatArray) -> FloatArray:
    """Mean over up to five neighbouring frames, shape kept (n, 3)."""
    kernel = np.ones(min(_SMOOTHED_FRAMES, signal.shape[0] - (signal.shape[0] + 1) % 2))
    count = np.convolve(np.ones(signal.shape[0]), kernel, mode="same")
    columns = [np.convolve(column, kernel, mode="same") / count for column in signal.T]
    return np.stack(columns, axis=1)
