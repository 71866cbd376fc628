"""Measured and fitted radiance against the light's angle, at three times.

As in Fig. 5 of Sun et al., "Time-Varying BRDFs".
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray

from tvbrdf_fitting.models import get_model
from tvbrdf_fitting.published import CameraScan
from tvbrdf_fitting.published.database import DatabaseError, StoredFit, StoredSample, StoredScan

from .style import (
    CHANNEL_COLOURS,
    CHANNEL_NAMES,
    FAINT,
    INK,
    LABEL_SIZE,
    SHADE,
    TITLE_SIZE,
    dress,
    legend_above,
    new_figure,
    save,
)
from .times import time_unit

CURVE_STEP_DEG = 0.1
LARGEST_PEAK_RATIO = 5.0
"""Where the panels' peaks differ by more, the axis is logarithmic, or the small ones vanish."""
SMALLEST_SHOWN = 1e-4
GAP_STEPS = 3.0
"""Neighbouring lights further apart than this many usual steps have a gap between them."""


@dataclass(frozen=True, eq=False)
class Curve:
    """One camera's measured points in one scan, ordered by angle, and the fitted curve.

    Angles are those of the light to the sample's normal, in the light's plane, degrees.
    """

    angle_deg: NDArray[np.float64]
    radiance: NDArray[np.float64]
    gaps_deg: list[tuple[float, float]]
    fit_angle_deg: NDArray[np.float64]
    fit_radiance: NDArray[np.float64]
    residual: NDArray[np.float64]
    """Measured - fitted, at the measured angles; empty, as the fitted curve, without a fit."""
    view_angle_deg: float
    """Of the camera: where the light is behind it, the arm is in the way."""

    @property
    def gaps_are_the_arms(self) -> bool:
        """Whether every gap is where the arm is between camera and sample."""
        return all(low < self.view_angle_deg < high for low, high in self.gaps_deg)


def curve_of(camera_scan: CameraScan, fit: StoredFit | None) -> Curve:
    """Put a camera's scan and its fit on the axis of light angles."""
    light = camera_scan.light_direction
    angle_deg = np.degrees(np.arctan2(light[:, 0], light[:, 2]))
    order = np.argsort(angle_deg)
    angle_deg, light = angle_deg[order], light[order]
    radiance = camera_scan.radiance[order]
    steps = np.diff(angle_deg)
    usual = float(np.median(steps)) if steps.size else 0.0
    gaps = [
        (float(low), float(high))
        for low, high in pairwise(angle_deg)
        if high - low > GAP_STEPS * usual > 0
    ]
    view = camera_scan.view_direction
    view_deg = float(np.degrees(np.arctan2(view[0], view[2])))
    empty = np.empty((0, 3))
    if fit is None:
        return Curve(angle_deg, radiance, gaps, np.empty(0), empty, empty, view_deg)
    count = max(int((angle_deg[-1] - angle_deg[0]) / CURVE_STEP_DEG), 1) + 1
    dense_deg = np.linspace(angle_deg[0], angle_deg[-1], count)
    dense = np.stack([np.interp(dense_deg, angle_deg, light[:, axis]) for axis in range(3)], axis=1)
    dense /= np.linalg.norm(dense, axis=1, keepdims=True)
    residual = radiance - fitted_radiance(fit, light, view)
    fitted = fitted_radiance(fit, dense, view)
    return Curve(angle_deg, radiance, gaps, dense_deg, fitted, residual, view_deg)


def fitted_radiance(
    fit: StoredFit, light_direction: NDArray[np.float64], view_direction: NDArray[np.float64]
) -> NDArray[np.float64]:
    """π·BRDF·cosθi (n, 3) of a fit at (n, 3) light directions and one view direction."""
    views = np.broadcast_to(view_direction, light_direction.shape)
    brdf = get_model(fit.model).evaluate(light_direction, views, fit.values)
    radiance: NDArray[np.float64] = np.pi * brdf * light_direction[:, 2:]
    return radiance


def choose_scans(sample: StoredSample) -> list[StoredScan]:
    """First, middle and last scan of those that are fitted, or measured if none is."""
    scans = [scan for scan in sample.scans if scan.fit is not None] or list(sample.scans)
    if not scans:
        raise DatabaseError(f"{sample.folder}: sample {sample.name!r} has no scan to plot")
    chosen = {0, (len(scans) - 1) // 2, len(scans) - 1}
    return [scans[index] for index in sorted(chosen)]


def plot_curves(sample: StoredSample, path: Path | str, *, camera: int = 1) -> Path:
    """Plot measured points and fitted curves into a PNG; see :func:`curves_figure`."""
    return save(curves_figure(sample, camera=camera), path)


def curves_figure(sample: StoredSample, *, camera: int = 1) -> Figure:
    """Draw measured points, fitted curve and residuals of one camera at three times.

    Axes are shared. Where the peaks differ much from scan to scan, radiance is on a logarithmic
    axis and residuals are relative.

    Parameters
    ----------
    sample
        A sample of a database.
    camera
        1 is the top camera, the only one that sees sharp specular peaks.

    Raises
    ------
    DatabaseError
        If the sample has no scan, or the camera none of the chosen ones.
    """
    panels = []
    for scan in choose_scans(sample):
        cameras = scan.radiance().cameras
        if camera in cameras:
            panels.append((scan, curve_of(cameras[camera], scan.fit)))
    if not panels:
        raise DatabaseError(f"{sample.folder}: camera {camera} has no radiance to plot")
    unit = time_unit(scan.time_s for scan in sample.scans)
    figure = new_figure(max(1.7 + 2.6 * len(panels), 5.2), 4.7)
    axes = figure.subplots(
        2, len(panels), sharex=True, sharey="row", squeeze=False, height_ratios=(3, 1)
    )
    peaks = [float(curve.radiance.max()) for _, curve in panels]
    relative = max(peaks) > LARGEST_PEAK_RATIO * min(peaks) > 0
    for column, (scan, curve) in enumerate(panels):
        _plot_radiance(axes[0, column], curve)
        _plot_residual(axes[1, column], curve, relative=relative)
        title = f"{scan.time_s / unit.seconds:.3g} {unit.sign}  (scan {scan.scan})"
        axes[0, column].set_title(title, fontsize=TITLE_SIZE, color=INK)
        axes[1, column].set_xlabel("light angle / °", fontsize=LABEL_SIZE, color=INK)
    axes[0, 0].set_ylabel(r"radiance  $\pi\,f_r\,\cos\theta_i$", fontsize=LABEL_SIZE, color=INK)
    residual = "measured\n/ fitted − 1" if relative else "measured\n− fitted"
    axes[1, 0].set_ylabel(residual, fontsize=LABEL_SIZE, color=INK)
    if relative:
        _make_logarithmic(axes[0, 0], axes[1, 0], [curve for _, curve in panels])
    figure.align_ylabels(axes[:, 0])
    legend_above(figure, _legend([curve for _, curve in panels]))
    return figure


def _plot_radiance(axes: Axes, curve: Curve) -> None:
    dress(axes)
    _shade_gaps(axes, curve)
    for channel, colour in enumerate(CHANNEL_COLOURS):
        axes.plot(
            curve.angle_deg,
            curve.radiance[:, channel],
            linestyle="none",
            marker=".",
            markersize=6.5,
            markeredgewidth=0,
            color=colour,
            alpha=0.35,
        )
        axes.plot(curve.fit_angle_deg, curve.fit_radiance[:, channel], color=colour, linewidth=1.1)
    axes.set_xlim(-92, 92)
    axes.xaxis.set_major_locator(FixedLocator(range(-60, 90, 30)))
    axes.set_ylim(bottom=min(0.0, float(curve.radiance.min())))


def _make_logarithmic(radiance_axes: Axes, residual_axes: Axes, curves: list[Curve]) -> None:
    """Give shared axes of radiance a logarithmic scale, and of residuals a robust range."""
    positive = np.concatenate([curve.radiance[curve.radiance > SMALLEST_SHOWN] for curve in curves])
    radiance_axes.set_yscale("log")
    radiance_axes.set_ylim(0.7 * float(np.percentile(positive, 1)), 1.6 * float(positive.max()))
    residuals = np.concatenate([_relative(curve).ravel() for curve in curves])
    residuals = residuals[np.isfinite(residuals)]
    if residuals.size:
        largest = min(1.2 * float(np.percentile(np.abs(residuals), 98)), 1.0)
        residual_axes.set_ylim(-largest, largest)


def _relative(curve: Curve) -> NDArray[np.float64]:
    """Residuals by the fitted value (n, 3); NaN where that is dark."""
    if not len(curve.residual):
        return curve.residual
    fitted = curve.radiance - curve.residual
    relative: NDArray[np.float64] = curve.residual / np.where(
        fitted > SMALLEST_SHOWN, fitted, np.nan
    )
    return relative


def _plot_residual(axes: Axes, curve: Curve, *, relative: bool) -> None:
    dress(axes, ticks=3)
    _shade_gaps(axes, curve)
    axes.axhline(0, color=FAINT, linewidth=0.8)
    residual = _relative(curve) if relative else curve.residual
    if len(residual):
        for channel, colour in enumerate(CHANNEL_COLOURS):
            axes.plot(
                curve.angle_deg,
                residual[:, channel],
                linestyle="none",
                marker=".",
                markersize=3.5,
                markeredgewidth=0,
                color=colour,
                alpha=0.6,
            )


def _shade_gaps(axes: Axes, curve: Curve) -> None:
    for low, high in curve.gaps_deg:
        axes.axvspan(low, high, color=SHADE, linewidth=0, zorder=0)


def _legend(curves: list[Curve]) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=colour, linewidth=1.8, label=name)
        for colour, name in zip(CHANNEL_COLOURS, CHANNEL_NAMES, strict=True)
    ]
    handles.append(
        Line2D([], [], color=INK, linestyle="none", marker=".", markersize=7, label="measured")
    )
    if any(len(curve.fit_angle_deg) for curve in curves):
        handles.append(Line2D([], [], color=INK, linewidth=1.8, label="fitted"))
    if any(curve.gaps_deg for curve in curves):
        arm = all(curve.gaps_are_the_arms for curve in curves)
        handles.append(Patch(color=SHADE, label="hidden by the arm" if arm else "not measured"))
    return handles
