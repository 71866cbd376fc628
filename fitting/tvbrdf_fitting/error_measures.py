"""How far a fit is from what was measured: several measures, never one alone.

RMS divided by the peak cannot see a fit that fails below a sharp peak, so it always comes with the
absolute RMS, RMS over the mean, RMS of each channel, and the RMS of the log ratio.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from .geometry import CHANNELS, FloatArray
from .observations import Observations

LOG_SMALLEST_VALUE = 1e-4
LOG_LARGEST_ANGLE_DEG = 80.0


@dataclass(frozen=True)
class ErrorMeasures:
    """Error measures of one scan, or of several pooled. NaN where nothing is left to measure.

    The residual is that of pi x BRDF x cos(theta_i), over all cameras, lights and channels.

    Attributes
    ----------
    rms_percent
        100 x RMS of the residual / the scan's largest measured value.
    rms_absolute
        RMS of the residual.
    rms_over_mean
        RMS of the residual / the mean measured value.
    rms_b, rms_g, rms_r
        RMS of the residual of each channel.
    rms_log
        RMS of ln(predicted / measured), over values > 1e-4 (measured and predicted) and both
        angles < 80 degrees.
    largest, mean
        Of the measured values.
    count, count_b, count_g, count_r
        Values compared.
    log_count
        Values in `rms_log`; the dropped ones were near grazing, or else measured or predicted
        dark: `log_dropped_grazing`, `log_dropped_measured`, `log_dropped_predicted`.
    scans
        Number of scans pooled.
    """

    rms_percent: float
    rms_absolute: float
    rms_over_mean: float
    rms_b: float
    rms_g: float
    rms_r: float
    rms_log: float
    largest: float
    mean: float
    count: int
    count_b: int
    count_g: int
    count_r: int
    log_count: int
    log_dropped_grazing: int
    log_dropped_measured: int
    log_dropped_predicted: int
    scans: int = 1

    @property
    def log_dropped(self) -> int:
        """All values that `rms_log` left out."""
        return self.log_dropped_grazing + self.log_dropped_measured + self.log_dropped_predicted

    def as_dict(self) -> dict[str, float | int | None]:
        """Return plain numbers by name, None for NaN, so that it is valid JSON."""
        return {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in vars(self).items()
        }


def measure_errors(observations: Observations, predicted_radiance: FloatArray) -> ErrorMeasures:
    """Compare predicted with measured radiance where the observations are usable.

    Parameters
    ----------
    observations
        What was measured.
    predicted_radiance
        (n, 3) pi x BRDF x cos(theta_i) at the same directions, B, G, R.

    Raises
    ------
    ValueError
        The prediction's shape is not the observations', or a compared value is not finite.
    """
    predicted = np.ascontiguousarray(predicted_radiance, dtype=np.float64)
    if predicted.shape != observations.radiance.shape:
        raise ValueError(
            f"predicted radiance has shape {predicted.shape}, "
            f"the observations {observations.radiance.shape}"
        )
    used = observations.usable
    wrong = used & ~np.isfinite(predicted)
    if wrong.any():
        row, channel = (int(i) for i in np.argwhere(wrong)[0])
        raise ValueError(
            f"predicted radiance[{row}, {channel}] is {predicted[row, channel]}, not finite"
        )
    residual = np.zeros(used.shape)
    np.subtract(predicted, observations.radiance, out=residual, where=used)
    measured = observations.radiance[used]
    counts = [int(np.count_nonzero(channel)) for channel in used.T]
    squares = np.einsum("ij,ij->j", residual, residual)
    count = sum(counts)
    rms = _root_mean(float(squares.sum()), count)
    largest = float(measured.max()) if count else math.nan
    mean = float(measured.mean()) if count else math.nan
    of_channel = [_root_mean(float(s), n) for s, n in zip(squares, counts, strict=True)]
    rms_log, log_counts = _log_measure(observations, predicted)
    return ErrorMeasures(
        rms_percent=100 * _ratio(rms, largest),
        rms_absolute=rms,
        rms_over_mean=_ratio(rms, mean),
        rms_b=of_channel[0],
        rms_g=of_channel[1],
        rms_r=of_channel[2],
        rms_log=rms_log,
        largest=largest,
        mean=mean,
        count=count,
        count_b=counts[0],
        count_g=counts[1],
        count_r=counts[2],
        log_count=log_counts[0],
        log_dropped_grazing=log_counts[1],
        log_dropped_measured=log_counts[2],
        log_dropped_predicted=log_counts[3],
    )


def pool(measures: Sequence[ErrorMeasures]) -> ErrorMeasures:
    """Return one set of measures for all scans of a sample.

    Every RMS is pooled over the values it was taken of, ``sqrt(sum(n rms^2) / sum(n))``. Relative
    ones keep each scan's own largest or mean value: a dull late scan is not hidden by a bright
    early one. A measure that is NaN in one scan is pooled over the others.
    """
    if not measures:
        raise ValueError("no error measures to pool")
    counted = {"rms_log": "log_count"} | {f"rms_{c}": f"count_{c}" for c in CHANNELS}
    pooled: dict[str, float] = {}
    for field in fields(ErrorMeasures):
        name = field.name
        if name.startswith("rms_"):
            weights = [getattr(m, counted.get(name, "count")) for m in measures]
            pooled[name] = _pooled([getattr(m, name) for m in measures], weights)
        elif name not in {"largest", "mean"}:
            pooled[name] = sum(getattr(m, name) for m in measures)
    seen = [m for m in measures if m.count]
    total = sum(m.count for m in seen)
    pooled["largest"] = max((m.largest for m in seen), default=math.nan)
    pooled["mean"] = sum(m.mean * m.count for m in seen) / total if total else math.nan
    return ErrorMeasures(**pooled)  # type: ignore[arg-type]


def _log_measure(
    observations: Observations, predicted: FloatArray
) -> tuple[float, tuple[int, int, int, int]]:
    used = observations.usable
    smallest_cosine = math.cos(math.radians(LOG_LARGEST_ANGLE_DEG))
    steep = (observations.light_direction[:, 2] > smallest_cosine) & (
        observations.view_direction[:, 2] > smallest_cosine
    )
    masks = [used, used & steep[:, None]]
    for values in (observations.radiance, predicted):
        bright = np.zeros(used.shape, dtype=bool)
        np.greater(values, LOG_SMALLEST_VALUE, out=bright, where=masks[-1])
        masks.append(bright)
    ratio = np.log(predicted[bright] / observations.radiance[bright])
    all_used, steep_enough, measured, count = (int(np.count_nonzero(mask)) for mask in masks)
    counts = (count, all_used - steep_enough, steep_enough - measured, measured - count)
    return _root_mean(float(ratio @ ratio), count), counts


def _root_mean(sum_of_squares: float, count: int) -> float:
    return math.sqrt(sum_of_squares / count) if count else math.nan


def _ratio(value: float, reference: float) -> float:
    return value / reference if reference > 0 else math.nan


def _pooled(values: Sequence[float], weights: Sequence[int]) -> float:
    pairs = [(v, n) for v, n in zip(values, weights, strict=True) if n and math.isfinite(v)]
    total = sum(n for _, n in pairs)
    return _root_mean(sum(n * v * v for v, n in pairs), total)
