"""What a fit counts as equal misfit: in radiance, by projected solid angle, relative, in log.

Where a model explains the data within their noise, the noise alone decides: weights 1 / variance
are the best there are, and any other only loses precision. A metric is needed where it does not.
Then the model's own error is estimated and added to the variances (`losses`), and the metric says
how large an error of the model counts the same at each value: *unit* times one number e,

    variance of a value = stated variance + (e unit)^2

``radiance``
    unit = 1: a plain least-squares fit of pi BRDF cos(theta_i) once e dominates. That cosine is the
    one of Ngan, Durand and Matusik, "Experimental Analysis of BRDF Models", EGSR 2005.
``cosine_weighted``
    unit = 1 / sqrt(cos(theta_i)): squared residuals of that radiance are weighted by
    cos(theta_i), as in a mean over projected solid angle, so that grazing light counts less still.
``relative``
    unit = the value itself: squared residuals are weighted by 1 / radiance^2.
``log``
    The residual is ln(predicted) - ln(measured), of deviation std / radiance, and e is in log
    units. Only values > `LOG_SMALLEST_VALUE` with both angles < `LOG_LARGEST_ANGLE_DEG` count, as
    in the error measure `rms_log`. A prediction below that value goes on along the logarithm's
    tangent: a residual stays finite, and its slope leads back.

*Bias.* A weight that follows a value's own noise makes values that happen to be low weigh more, and
pulls a fit down by the squared relative noise. So "the value itself" is the mean of the measured
values in the nearest directions. The mean of a logarithm is low by half the squared relative noise,
which is added back; a value within `LOG_SMALLEST_SIGNAL` deviations of 0, whose logarithm says
nothing, is left out. What remains is the metric's own: a fit in ``relative`` lies low by about the
square of the model's relative error, as an arithmetic mean weighted by 1 / value^2 does; one in
``log`` does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from .error_measures import LOG_LARGEST_ANGLE_DEG, LOG_SMALLEST_VALUE
from .geometry import BoolArray, FloatArray

METRICS = ("radiance", "cosine_weighted", "relative", "log")
LOG_SMALLEST_SIGNAL = 3.0
"""Deviations above 0 below which a value has no useful logarithm."""
RELATIVE_RANGE = 1e-4
"""Smallest value, of the scan's largest, that a relative error is taken of."""
_NEIGHBOURS = 9
"""Three sweeps, each with the light a step to either side."""


@dataclass(frozen=True, eq=False)
class LogCurve:
    """Logarithms in units of radiance: reference x (ln(predicted) - target).

    A residual's slope is then 1 where the prediction is the reference, so that weights, model
    errors and linear starts mean the same in every metric.

    Attributes
    ----------
    reference
        (3, n) smoothed measured radiance, > 0.
    target
        (3, n) logarithm of the measured radiance, freed from its bias.
    """

    reference: FloatArray
    target: FloatArray

    def residual(self, radiance: FloatArray) -> FloatArray:
        """Residual (3, n) in units of radiance, of predictions (3, n) or (1, n)."""
        above = np.maximum(radiance, LOG_SMALLEST_VALUE)
        out = np.log(above) - self.target
        out += np.minimum(radiance - LOG_SMALLEST_VALUE, 0.0) / LOG_SMALLEST_VALUE
        out *= self.reference
        return np.asarray(out)

    def slope(self, radiance: FloatArray) -> FloatArray:
        """Derivative (3, n) of the residual by the predicted radiance."""
        return np.asarray(self.reference / np.maximum(radiance, LOG_SMALLEST_VALUE))


@dataclass(frozen=True, eq=False)
class Metric:
    """A metric at the values of one scan.

    Attributes
    ----------
    name
        One of `METRICS`.
    unit
        What broadcasts to (3, n): the model's error that counts as 1, in radiance.
    curve
        For "log"; None where a residual is linear in the radiance.
    """

    name: str = "radiance"
    unit: FloatArray = field(default_factory=lambda: np.ones((1, 1)))
    curve: LogCurve | None = None


def make_metric(
    name: str,
    light: FloatArray,
    view: FloatArray,
    radiance: FloatArray,
    variance: FloatArray,
    mask: BoolArray,
) -> tuple[Metric, BoolArray]:
    """Return a metric, and which values it uses.

    Parameters
    ----------
    name
        One of `METRICS`.
    light, view
        (n, 3) directions.
    radiance, variance, mask
        (3, n) measured; where the mask is False they may be anything.

    Returns
    -------
    The metric, and a mask (3, n) within the given one.
    """
    if name == "radiance":
        return Metric(), mask
    if name == "cosine_weighted":
        return Metric(name, light[None, :, 2] ** -0.5), mask
    measured = np.where(mask, radiance, 0.0)
    deviation = np.sqrt(np.where(mask, variance, 1.0))
    around = _smoothed(light, view, measured, deviation, mask)
    if name == "relative":
        smallest = RELATIVE_RANGE * around.max(initial=0.0)
        return Metric(name, np.maximum(around, smallest) if smallest > 0 else np.ones((1, 1))), mask
    kept = _with_logarithm(light, view, measured, deviation, around) & mask
    reference = np.where(kept, around, 1.0)
    bias = 0.5 * np.square(np.where(kept, deviation, 0.0) / reference)
    target = np.log(np.where(kept, measured, 1.0)) + bias
    return Metric(name, reference, LogCurve(reference, target)), kept


def _with_logarithm(
    light: FloatArray,
    view: FloatArray,
    measured: FloatArray,
    deviation: FloatArray,
    around: FloatArray,
) -> BoolArray:
    smallest_cosine = math.cos(math.radians(LOG_LARGEST_ANGLE_DEG))
    steep = (light[:, 2] > smallest_cosine) & (view[:, 2] > smallest_cosine)
    bright = (measured > LOG_SMALLEST_VALUE) & (around > LOG_SMALLEST_VALUE)
    return np.asarray(steep & bright & (around > LOG_SMALLEST_SIGNAL * deviation))


def _smoothed(
    light: FloatArray,
    view: FloatArray,
    measured: FloatArray,
    deviation: FloatArray,
    mask: BoolArray,
) -> FloatArray:
    """Mean (3, n) of the measured values in the nearest directions, weighted by their variances."""
    from scipy.spatial import cKDTree

    count = light.shape[0]
    if count < 2:
        return measured
    directions = np.concatenate([light, view], axis=1)
    _, nearest = cKDTree(directions).query(directions, k=min(_NEIGHBOURS, count))
    weight = np.where(mask, deviation**-2, 0.0)
    total = weight[:, nearest].sum(axis=2)
    mean = (weight * measured)[:, nearest].sum(axis=2) / np.where(total > 0, total, 1.0)
    return np.asarray(mean)
