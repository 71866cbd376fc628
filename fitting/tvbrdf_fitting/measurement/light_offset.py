"""Time shift that clock models cannot see, from two sweeps in opposite directions.

If frames are stamped late by t, the light seems further on than it was: by v t in the direction of
its motion. In a forward and a backward sweep over a sample that did not change, the curves
radiance(angle) are then apart by 2 v t. Mechanical play of the arm that depends on direction looks
the same at one speed; two pairs of sweeps at different speeds tell them apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry import BoolArray, FloatArray
from .light_grid import interpolate

_ITERATIONS = 8
_DERIVATIVE = np.array([-2.0, -1.0, 0.0, 1.0, 2.0]) / 10.0  # least-squares slope over five points
_MIN_POSITIONS = 20


@dataclass(frozen=True, eq=False)
class SweepCurve:
    """What one camera saw of a static sample in one sweep: n samples, k channels.

    Parameters
    ----------
    light_angle_deg : ndarray, (n,)
        World angles from the stamps as they are.
    radiance, variance : ndarray, (n, k)
    valid : ndarray of bool, (n, k)
    """

    light_angle_deg: FloatArray
    radiance: FloatArray
    variance: FloatArray
    valid: BoolArray


@dataclass(frozen=True)
class LightOffset:
    """Residual shift: subtract ``time_shift_ns`` from the frames' stamps.

    ``angle_shift_deg`` is the same at the sweeps' speed. ``reduced_chi_square`` well above 1 says
    that the sample changed between the sweeps, or that the shift is no shift in time.
    """

    time_shift_ns: float
    time_shift_std_ns: float
    angle_shift_deg: float
    angle_shift_std_deg: float
    reduced_chi_square: float
    position_count: int


def light_offset_from_opposite_sweeps(
    forward: SweepCurve, backward: SweepCurve, speed_deg_s: float
) -> LightOffset:
    """Estimate how late frames are stamped from sweeps in opposite directions.

    Least squares on the difference of the two curves, which is -2 s f' + g f for a small shift s
    of the angle and a relative difference g of the lamp in each channel; the curves are shifted
    and the step repeated until it vanishes, so errors of the derivative do not matter.

    Parameters
    ----------
    forward, backward : SweepCurve
        Same camera and sample, light moving to larger and to smaller angles.
    speed_deg_s : float
        Speed of the light, positive, the same in both.

    Raises
    ------
    ValueError
        If the speed is not positive, or the curves overlap too little or have no slope.
    """
    if not speed_deg_s > 0.0:
        raise ValueError(f"speed {speed_deg_s} deg/s: give the light's speed, above 0")
    shift = 0.0
    for _ in range(_ITERATIONS):
        step, std, chi_square, count = _shift_step(forward, backward, shift)
        shift += step
        if abs(step) < 1e-3 * std:
            break
    return LightOffset(
        time_shift_ns=shift / speed_deg_s * 1e9,
        time_shift_std_ns=std / speed_deg_s * 1e9,
        angle_shift_deg=shift,
        angle_shift_std_deg=std,
        reduced_chi_square=chi_square,
        position_count=count,
    )


def _shift_step(
    forward: SweepCurve, backward: SweepCurve, shift: float
) -> tuple[float, float, float, int]:
    """One Gauss-Newton step of the shift: step, its std, reduced chi square, positions used."""
    channels = forward.radiance.shape[1]
    distance = float(np.median(np.diff(np.sort(forward.light_angle_deg))))
    low = max(forward.light_angle_deg.min(), backward.light_angle_deg.min())
    high = min(forward.light_angle_deg.max(), backward.light_angle_deg.max())
    grid = np.arange(low, high, distance) if high > low else np.zeros(0)
    rows, targets = [], []
    for channel in range(channels):
        ahead, ahead_variance = _on_grid(forward, channel, -shift, grid, distance)
        behind, behind_variance = _on_grid(backward, channel, shift, grid, distance)
        mean = (ahead + behind) / 2.0
        slope = np.full(grid.shape, np.nan)
        if grid.size >= 5:
            slope[2:-2] = np.correlate(mean, _DERIVATIVE, mode="valid") / distance
        used = np.isfinite(slope)
        weight = 1.0 / np.sqrt(ahead_variance[used] + behind_variance[used])
        design = np.zeros((np.count_nonzero(used), 1 + channels))
        design[:, 0] = -2.0 * slope[used] * weight
        design[:, 1 + channel] = mean[used] * weight
        rows.append(design)
        targets.append((ahead - behind)[used] * weight)
    design, target = np.concatenate(rows), np.concatenate(targets)
    if target.size < _MIN_POSITIONS:
        raise ValueError(
            f"opposite sweeps share only {target.size} usable positions; "
            "give two full sweeps of one camera"
        )
    # channels without usable positions have no gain to find
    present = np.any(design != 0.0, axis=0)
    present[0] = True
    design = design[:, present]
    normal = design.T @ design
    if np.linalg.matrix_rank(normal) < design.shape[1]:
        raise ValueError("opposite sweeps: the curve has no slope; use a sample that is not black")
    solution = np.linalg.solve(normal, design.T @ target)
    residual = target - design @ solution
    freedom = max(target.size - design.shape[1], 1)
    std = float(np.sqrt(np.linalg.inv(normal)[0, 0]))
    return float(solution[0]), std, float(residual @ residual) / freedom, int(target.size)


def _on_grid(
    curve: SweepCurve, channel: int, shift: float, grid: FloatArray, distance: float
) -> tuple[FloatArray, FloatArray]:
    """Shifted curve on the grid, with the variance of one sample (not of the smoothed value).

    Interpolation correlates neighbours, but keeps the sum of their errors: with a grid as dense as
    the samples, a smooth combination of grid values varies as one of independent samples does.
    """
    used = curve.valid[:, channel]
    angle = curve.light_angle_deg[used] + shift
    variance = curve.variance[used, channel]
    found = interpolate(angle, curve.radiance[used, channel], variance, grid, step_deg=distance)
    order = np.argsort(angle)
    sample_variance = np.interp(grid, angle[order], variance[order]) if angle.size else grid
    return np.where(found.bracketed, found.value, np.nan), sample_variance
