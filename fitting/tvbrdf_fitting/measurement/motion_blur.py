"""Motion blur: what a frame averages over, because the light moves while it is exposed.

At 15 degrees a second a 32 ms exposure goes over 0.48 degrees. The mean of a curve r(w) over an arc
s around w is ``r + s**2/24 r'' + s**4/1920 r'''' + ...``; taking the second term off leaves less
than a thousandth of it for lobes of sigma_s >= 0.03. Without this, 1/sigma_s of a lobe of
sigma_s = 0.05 comes out 2.4e-4 too small, three of its standard deviations.

r'' comes from a cubic fitted to five neighbouring samples of the sweep (Savitzky and Golay 1964),
so the noise it adds is 0.02 of a sample's at s = 0.96 of the samples' distance h. The cubic itself
is off by ``0.37 h**2 r''''``: with h = 0.5 degrees, 5 % of r'' at the top of a lobe of
sigma_s = 0.03.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..geometry import FloatArray
from .sweep_merge import SweepObservations

_SAMPLES = 5
_MAX_GAP_STEPS = 1.5
NEGLIGIBLE_ARC = 0.05
"""Arcs shorter than this, in steps between the samples, change nothing: 1e-4 of a difference."""


def second_derivative(angle: FloatArray, value: FloatArray) -> FloatArray:
    """Return the second derivative (n, k) of curves at their samples.

    From a cubic through the five nearest samples of the same stretch (four without a remainder,
    0 in stretches of fewer); never across a gap of more than 1.5 steps.

    Parameters
    ----------
    angle
        (n,) rising.
    value
        (n, k), one column a curve.
    """
    result = np.zeros_like(value)
    if angle.size < 4:
        return result
    steps = np.diff(angle)
    edges = np.flatnonzero(steps > _MAX_GAP_STEPS * np.median(steps)) + 1
    for rows in np.split(np.arange(angle.size), edges):
        if rows.size >= 4:
            result[rows] = _of_stretch(angle[rows], value[rows])
    return result


def _of_stretch(angle: FloatArray, value: FloatArray) -> FloatArray:
    count = min(_SAMPLES, angle.size)
    start = np.clip(np.arange(angle.size) - count // 2, 0, angle.size - count)
    nodes = start[:, None] + np.arange(count)
    scale = np.median(np.diff(angle))
    x = (angle[nodes] - angle[:, None]) / scale
    powers = x[:, :, None] ** np.arange(4.0)
    weights = np.linalg.pinv(powers)[:, 2]  # of x**2 at the sample itself
    return np.asarray(2.0 * np.einsum("nj,njk->nk", weights, value[nodes]) / scale**2)


def without_motion_blur(observations: SweepObservations) -> SweepObservations:
    """Return a sweep's observations with radiances as they are in the middle of each exposure.

    Values that are not valid neither change nor take part. Variances stay as they are.
    """
    radiance = observations.radiance.copy()
    for camera in np.unique(observations.camera):
        rows = np.flatnonzero(observations.camera == camera)
        rows = rows[np.argsort(observations.light_angle_deg[rows], kind="stable")]
        arc = observations.swept_deg[rows]
        angle = observations.light_angle_deg[rows]
        if rows.size < 4 or arc.max() <= NEGLIGIBLE_ARC * np.median(np.diff(angle)):
            continue
        for valid, channels in _alike(observations.valid[rows]):
            used = rows[valid]
            curves = observations.radiance[np.ix_(used, channels)]
            bend = second_derivative(angle[valid], curves)
            radiance[np.ix_(used, channels)] -= arc[valid, None] ** 2 / 24.0 * bend
    return replace(observations, radiance=radiance)


def _alike(
    valid: NDArray[np.bool_],
) -> list[tuple[NDArray[np.bool_], NDArray[np.int64]]]:
    """Return channels by where they are valid: most share it."""
    found: dict[bytes, list[int]] = {}
    for channel in range(valid.shape[1]):
        found.setdefault(valid[:, channel].tobytes(), []).append(channel)
    return [(valid[:, channels[0]], np.array(channels)) for channels in found.values()]
