"""What a fit takes, from a published scan or from the frames that a measurement has kept.

The published text has radiance alone. How far to trust it is estimated from the scan itself: a
smooth curve through three neighbouring light positions predicts the next one, and what is left is
noise. Third differences ``sum w_i y_i``, ``w_i = 1 / prod(x_i - x_j)`` scaled to ``sum w^2 = 1``
(von Neumann, "Distribution of the Ratio of the Mean Square Successive Difference to the Variance",
1941; of any order and spacing: Rice, "Bandwidth choice for nonparametric regression", 1984) vanish
on any parabola; the median of their squares passes over peaks. Their size against the radiance is
that of a camera: ``variance = read + shot x radiance + relative x radiance^2``, for each channel.

What it cannot see: errors that neighbouring lights share. Frames that were put on a common grid by
interpolation share their noise, which then comes out up to 0.7 x too small; gains of cameras and
offsets of the light are not in it at all.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import CHANNELS, FloatArray, IntArray
from ..inference.nuisances import CommonErrors
from ..observations import Observations
from .scan import CAMERAS, PublishedScan

if TYPE_CHECKING:
    from .database import StoredScan

ROUNDING: Final = 1e-6 / 12**0.5
"""Standard deviation of rounding to the 6 decimals of the layout."""
SMALLEST_RELATIVE: Final = 1e-3
"""No radiance is taken as known better than to this share of itself and of its channel's median.

A lamp's flicker and a camera's response are not known better in such a rig.
"""
ASSUMED_RELATIVE: Final = 0.01
"""Noise where a channel has too few values to tell."""
FEWEST_DIFFERENCES: Final = 16
_NORMAL_MEDIAN_SQUARE: Final = 0.4549364231195727
_IN_A_BIN, _MOST_BINS = 60, 12
_GAP_STEPS: Final = 3.0
_SMOOTHED: Final = 5
"""Values that a variance's signal is averaged over, so that it does not follow its own noise."""


def scan_observations(scan: PublishedScan, calibration: ArrayLike | None = None) -> Observations:
    """Return a published scan as a fit takes it: one sweep, one row a light position.

    Parameters
    ----------
    scan
        As `read_scan` gives it.
    calibration
        (4, 3) constants of cameras 1-4, B, G, R, that the radiances are divided by; by default 1.

    Raises
    ------
    ValueError
        The calibration is not (4, 3), finite and positive.
    """
    constants = np.ones((4, 3)) if calibration is None else np.asarray(calibration, dtype=float)
    if constants.shape != (4, 3) or not (np.isfinite(constants) & (constants > 0)).all():
        raise ValueError("calibration: constants must be (4, 3), finite and positive")
    cameras = scan.cameras
    counts = [len(one.radiance) for one in cameras.values()]
    numbers = np.array([*cameras])
    camera = np.repeat(numbers, counts)
    constant = np.repeat(constants[numbers - CAMERAS[0]], counts, axis=0)
    light = np.concatenate([one.light_direction for one in cameras.values()])
    views = np.array([one.view_direction for one in cameras.values()])
    radiance = np.concatenate([one.radiance for one in cameras.values()]) / constant
    return Observations(
        light_direction=light,
        view_direction=np.repeat(views, counts, axis=0),
        radiance=radiance,
        variance=estimate_variance(light, camera, radiance, ROUNDING / constant),
        valid=np.ones(radiance.shape, dtype=bool),
        camera=camera,
        sweep=np.ones(len(camera), dtype=np.int64),
        exposure_ms=np.full(len(camera), max(scan.exposures_ms)),
        time_s=np.zeros(len(camera)),
    )


def estimate_variance(
    light_direction: FloatArray, camera: IntArray, radiance: FloatArray, rounding: FloatArray
) -> FloatArray:
    """Variance (n, 3) of radiances, from the differences of those at neighbouring lights.

    Parameters
    ----------
    light_direction
        (n, 3), in the light's plane.
    camera
        (n,) number of the camera.
    radiance, rounding
        (n, 3), and the standard deviation that rounding alone has.
    """
    from .compiled import add_differences, running_mean  # takes long

    angle = np.arctan2(light_direction[:, 0], light_direction[:, 2])
    smooth = np.empty_like(radiance)
    square, level, count = np.empty(radiance.T.shape), np.empty(radiance.T.shape), 0
    for number in np.unique(camera):
        rows = np.flatnonzero(camera == number)
        rows = rows[np.argsort(angle[rows], kind="stable")]
        sorted_angle, values = angle[rows], radiance[rows]
        smooth[rows] = running_mean(values, _SMOOTHED)
        if len(rows) > 3:
            gap = _GAP_STEPS * float(_medians(np.diff(sorted_angle)))
            count = add_differences(sorted_angle, values, gap, square, level, count)
    variance = np.empty_like(radiance)
    for channel in range(len(CHANNELS)):
        signal = np.maximum(smooth[:, channel], 0.0)
        terms, largest = _camera_noise(square[channel, :count], level[channel, :count])
        # beyond what the terms were found from, as shot noise
        beyond = np.maximum(signal / largest, 1.0) if largest > 0 else 1.0
        found = _powers(np.minimum(signal, largest)) @ terms * beyond
        smallest = SMALLEST_RELATIVE * np.maximum(signal, _medians(signal))
        variance[:, channel] = np.maximum(found, np.square(smallest))
    return np.asarray(variance + np.square(rounding))


def _camera_noise(square: FloatArray, level: FloatArray) -> tuple[FloatArray, float]:
    """Terms (3,) of the variance by powers of the radiance, and up to which one they are known."""
    from scipy.optimize import nnls

    if len(square) < FEWEST_DIFFERENCES:
        return np.array([0.0, 0.0, ASSUMED_RELATIVE**2]), np.inf
    order = np.argsort(level, kind="stable")
    count = max(1, min(len(order) // _IN_A_BIN, _MOST_BINS))
    variance = _bin_medians(square[order], count) / _NORMAL_MEDIAN_SQUARE
    signal = np.maximum(_bin_medians(level[order], count), 0.0)
    # a bin that is known to a tenth of itself weighs as much as any other
    weight = 1.0 / np.maximum(variance, max(1e-6 * float(variance.max()), ROUNDING**2))
    terms, _ = nnls(_powers(signal) * weight[:, None], variance * weight)
    return np.asarray(terms), float(signal.max())


def _powers(values: FloatArray) -> FloatArray:
    """1, the value and its square (n, 3)."""
    return np.stack([np.ones_like(values), values, values * values], axis=-1)


def _bin_medians(values: FloatArray, count: int) -> FloatArray:
    """Medians (count,) of as many bins of nearly equal size, in order."""
    size, larger = divmod(len(values), count)
    cut = larger * (size + 1)
    blocks = (values[:cut].reshape(larger, size + 1), values[cut:].reshape(count - larger, size))
    return np.concatenate([_medians(block) for block in blocks])


def _medians(values: FloatArray) -> FloatArray:
    """Medians over the last axis of finite values; for few of them, quicker than numpy's own."""
    ascending, half = np.sort(values, axis=-1), values.shape[-1] // 2
    return np.asarray((ascending[..., half] + ascending[..., -1 - half]) / 2)


def stored_observations(scan: StoredScan) -> tuple[Observations, CommonErrors | None]:
    """Return the frames that a measurement has kept of a scan, and the errors that they share.

    They are what the fitter was given: each with its own direction, exposure, time and variance.

    Raises
    ------
    DatabaseError
        If the file cannot be read, or lacks a part; the message names it.
    """
    from .database import DatabaseError

    arrays = scan.observations()
    names = [name for name in Observations.__dataclass_fields__ if name != "time_s"]
    if "time_s" not in arrays and "stamp_ns" in arrays:
        since_start = arrays["stamp_ns"] - scan.start_stamp_ns
        arrays["time_s"] = scan.time_s + since_start / 1e9
    try:
        observations = Observations(**{name: arrays[name] for name in [*names, "time_s"]})
        return observations, _common_errors(scan, arrays.get("light_angle_std_deg"))
    except (KeyError, ValueError, TypeError) as error:
        what = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise DatabaseError(
            f"{scan.observations_path}: observations of scan {scan.scan} cannot be used: {what}; "
            "restore the file from a copy"
        ) from error


def _common_errors(scan: StoredScan, offsets: FloatArray | None) -> CommonErrors | None:
    gain = scan.quality.get("gain_relative_std")
    if offsets is None or gain is None:
        return None
    return CommonErrors(
        light_angle_std_deg=dict(enumerate(offsets.tolist())),
        gain_relative_std=float(gain),
        frame_relative_std=dict(enumerate(scan.quality.get("frame_relative_std", ()), start=1)),
    )
