"""Measured against fitted radiance of one scan, for every camera, over the light's world angle."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogFormatterSciNotation, LogLocator, NullLocator

from tvbrdf_fitting.geometry import (
    BoolArray,
    FloatArray,
    above_horizon,
    light_direction,
    light_world_angle_deg,
)
from tvbrdf_fitting.observations import Observations
from tvbrdf_fitting.result import FitResult

from .radiance_axes import (
    Gaps,
    dense_angles,
    draw_points,
    draw_residuals,
    gaps_between,
    legend_entries,
    shade_gaps,
)
from .style import (
    CHANNEL_COLOURS,
    INK,
    LABEL_SIZE,
    TITLE_SIZE,
    dress,
    legend_above,
    new_figure,
    save,
)

AxisKind = Literal["auto", "linear", "log"]
LARGEST_LINEAR = 30.0
"""Peak by median above which the axis of radiance is logarithmic: the rest would be a flat line."""
LOG_DECADES = 5.0
"""A logarithmic axis shows no more decades than this below the peak."""
LARGEST_LOG_RATIO = 5.0
"""A logarithmic residual's axis ends at this, a factor of 150."""
SMALLEST_GAP_DEG = 1.5
_IN_PLANE = 1e-3
_SMALLEST = 1e-9


@dataclass(frozen=True, eq=False)
class CameraCurve:
    """What one camera measured, ordered by the light's world angle, and the fit.

    Attributes
    ----------
    camera, camera_angle_deg
        Number, and angle to the light's plane.
    angle_deg, radiance, fitted
        (n,), (n, 3) and (n, 3) at the measured directions; radiance is NaN where not valid.
    curve_deg, curve
        (k,) and (k, 3): the fit on a dense grid.
    gaps_deg
        Between which world angles nothing was measured.
    """

    camera: int
    camera_angle_deg: float
    angle_deg: FloatArray
    radiance: FloatArray
    fitted: FloatArray
    curve_deg: FloatArray
    curve: FloatArray
    gaps_deg: Gaps

    @property
    def gaps_are_the_arms(self) -> bool:
        """Whether every gap is where the light crosses the cameras' plane."""
        return all(low < 0.0 < high for low, high in self.gaps_deg)


def camera_curves(observations: Observations, fit: FitResult) -> list[CameraCurve]:
    """Put each camera's usable values and the fit on the axis of the light's world angle.

    The plate's tilt follows from the view directions: every camera of the rig is in the plane that
    is perpendicular to the light's.
    """
    usable = observations.usable
    curves = []
    for camera in np.unique(observations.camera).tolist():
        rows = (observations.camera == camera) & usable.any(axis=1)
        if rows.any():
            curves.append(_camera_curve(observations, usable, rows, fit, camera))
    return curves


def _camera_curve(
    observations: Observations, usable: BoolArray, rows: BoolArray, fit: FitResult, camera: int
) -> CameraCurve:
    view = observations.view_direction[rows][0]
    tilt_deg = float(np.degrees(np.arctan2(-view[0], view[2])))
    light = observations.light_direction[rows]
    angle = light_world_angle_deg(light, tilt_deg)
    order = np.argsort(angle, kind="stable")
    angle, light = angle[order], light[order]
    radiance = np.where(usable, observations.radiance, np.nan)[rows][order]
    fitted = fit.radiance(light, observations.view_direction[rows][order])
    gaps = gaps_between(angle, SMALLEST_GAP_DEG)
    dense, curve = angle, fitted
    if np.abs(light[:, 1]).max() < _IN_PLANE:
        dense = dense_angles(angle)
        lights = light_direction(dense, tilt_deg)
        dense, lights = dense[above_horizon(lights)], lights[above_horizon(lights)]
        curve = fit.radiance(lights, np.broadcast_to(view, lights.shape))
    out_of_plane = float(np.degrees(np.arcsin(np.clip(view[1], -1.0, 1.0))))
    return CameraCurve(camera, out_of_plane, angle, radiance, fitted, dense, curve, gaps)


def plot_fit_curves(
    observations: Observations,
    fit: FitResult,
    path: Path | str,
    *,
    title: str = "",
    axis: AxisKind = "auto",
) -> Path:
    """Plot measured against fitted radiance into a PNG; see :func:`fit_curves_figure`."""
    return save(fit_curves_figure(observations, fit, title=title, axis=axis), path)


def fit_curves_figure(
    observations: Observations, fit: FitResult, *, title: str = "", axis: AxisKind = "auto"
) -> Figure:
    """Draw what each camera measured, the fitted curve, and the residuals below.

    Parameters
    ----------
    observations, fit
        What was fitted, and the result.
    title
        Above everything.
    axis
        Of radiance. "auto" takes a logarithmic one where the peak is more than `LARGEST_LINEAR`
        times the median; residuals are then those of the logarithm.
    """
    curves = camera_curves(observations, fit)
    columns = min(len(curves), 2)
    blocks = -(-len(curves) // columns)
    logarithmic = is_logarithmic(curves, axis)
    figure = new_figure(1.0 + 4.9 * columns, 1.1 + 3.9 * blocks)
    axes = figure.subplots(
        2 * blocks, columns, sharex=True, squeeze=False, height_ratios=(3.0, 1.15) * blocks
    )
    for index, curve in enumerate(curves):
        row, column = divmod(index, columns)
        above, below = axes[2 * row, column], axes[2 * row + 1, column]
        _draw_radiance(above, curve, logarithmic=logarithmic)
        _draw_residual(below, curve, logarithmic=logarithmic)
        above.set_title(
            f"camera {curve.camera}, {abs(curve.camera_angle_deg):.3g}° out of the light's plane",
            fontsize=TITLE_SIZE,
            color=INK,
        )
        if column == 0:
            above.set_ylabel(r"radiance  $\pi\,f_r\cos\theta_i$", fontsize=LABEL_SIZE, color=INK)
            text = "ln measured\n/ fitted" if logarithmic else "measured\n− fitted"
            below.set_ylabel(text, fontsize=LABEL_SIZE, color=INK)
        if index + columns >= len(curves):
            below.set_xlabel("light's world angle / °", fontsize=LABEL_SIZE, color=INK)
            below.tick_params(labelbottom=True)
    for spare in range(len(curves), blocks * columns):
        row, column = divmod(spare, columns)
        axes[2 * row, column].remove()
        axes[2 * row + 1, column].remove()
    figure.align_ylabels(axes[:, 0])
    legend_above(figure, legend_entries(curves, fitted=True), title)
    return figure


def is_logarithmic(curves: list[CameraCurve], axis: AxisKind) -> bool:
    """Whether the axis of radiance is logarithmic."""
    if axis != "auto":
        return axis == "log"
    values = np.concatenate([curve.radiance.ravel() for curve in curves])
    values = values[np.isfinite(values)]
    middle = float(np.median(values))
    return bool(middle > 0 and values.max() > LARGEST_LINEAR * middle)


def _draw_radiance(axes: Axes, curve: CameraCurve, *, logarithmic: bool) -> None:
    dress(axes)
    shade_gaps(axes, curve)
    for channel, colour in enumerate(CHANNEL_COLOURS):
        seen = np.isfinite(curve.radiance[:, channel])
        if logarithmic:
            seen &= np.nan_to_num(curve.radiance[:, channel]) > 0
        measured = curve.radiance[seen, channel]
        draw_points(axes, curve.angle_deg[seen], measured, channel=channel, size=5.5, alpha=0.35)
        if np.isfinite(curve.curve[:, channel]).all():
            axes.plot(curve.curve_deg, curve.curve[:, channel], color=colour, linewidth=1.2)
    axes.set_xlim(-93, 93)
    axes.xaxis.set_major_locator(FixedLocator(range(-90, 91, 30)))
    if logarithmic:
        _make_logarithmic(axes, curve)
    else:
        axes.set_ylim(bottom=min(0.0, float(np.nanmin(curve.radiance))))


def _make_logarithmic(axes: Axes, curve: CameraCurve) -> None:
    values = np.concatenate([curve.radiance.ravel(), curve.curve.ravel()])
    values = values[np.isfinite(values) & (values > _SMALLEST)]
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(numticks=7))
    axes.yaxis.set_major_formatter(LogFormatterSciNotation())
    axes.yaxis.set_minor_locator(NullLocator())
    if values.size:
        top = float(values.max())
        low = max(float(np.percentile(values, 1)), top * 10.0**-LOG_DECADES)
        axes.set_ylim(0.6 * low, 2.0 * top)


def residuals(curve: CameraCurve, *, logarithmic: bool) -> FloatArray:
    """Measured less fitted (n, 3), or the logarithm of their ratio; NaN where there is none."""
    if not logarithmic:
        return np.asarray(curve.radiance - curve.fitted)
    both = np.stack([curve.radiance, curve.fitted])
    measured, fitted = np.log(np.where(both > _SMALLEST, both, np.nan))
    return np.asarray(measured - fitted)


def _draw_residual(axes: Axes, curve: CameraCurve, *, logarithmic: bool) -> None:
    values = residuals(curve, logarithmic=logarithmic)
    draw_residuals(axes, curve, curve.angle_deg, values)
    known = np.abs(values[np.isfinite(values)])
    if logarithmic and known.size:  # a few dark values must not make the others a flat line
        reach = min(max(1.3 * float(np.percentile(known, 95)), 1e-3), LARGEST_LOG_RATIO)
        axes.set_ylim(-reach, reach)
