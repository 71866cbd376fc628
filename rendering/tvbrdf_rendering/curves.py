"""Measured and fitted radiance against the light's angle, at three times.

As in Fig. 5 of Sun et al., "Time-Varying BRDFs".
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray

from tvbrdf_fitting.models import get_model
from tvbrdf_fitting.published import CameraScan
from tvbrdf_fitting.published.database import DatabaseError, StoredFit, StoredSample, StoredScan

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
from .times import time_unit

LARGEST_PEAK_RATIO = 5.0
"""Where the panels' peaks differ by more, the axis is logarithmic, or the small ones vanish."""
SMALLEST_SHOWN = 1e-4


@dataclass(frozen=True, eq=False)
class Curve:
    """One camera's measured points in one scan, ordered by angle, and the fitted curve.

    Angles are those of the light to the sample's normal, in the light's plane, degrees.
    """

    angle_deg: NDArray[np.float64]
    radiance: NDArray[np.float64]
    gaps_deg: Gaps
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
    gaps = gaps_between(angle_deg)
    view = camera_scan.view_direction
    view_deg = float(np.degrees(np.arctan2(view[0], view[2])))
    empty = np.empty((0, 3))
    if fit is None:
        return Curve(angle_deg, radiance, gaps, np.empty(0), empty, empty, view_deg)
    dense_deg = dense_angles(angle_deg)
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
        residual = _relative(curve) if relative else curve.residual
        draw_residuals(axes[1, column], curve, curve.angle_deg, residual)
        title = f"{scan.time_s / unit.seconds:.3g} {unit.sign}  (scan {scan.scan})"
        axes[0, column].set_title(title, fontsize=TITLE_SIZE, color=INK)
        axes[1, column].set_xlabel("light angle / °", fontsize=LABEL_SIZE, color=INK)
    axes[0, 0].set_ylabel(r"radiance  $\pi\,f_r\,\cos\theta_i$", fontsize=LABEL_SIZE, color=INK)
    label = "measured\n/ fitted − 1" if relative else "measured\n− fitted"
    axes[1, 0].set_ylabel(label, fontsize=LABEL_SIZE, color=INK)
    curves = [curve for _, curve in panels]
    if relative:
        _make_logarithmic(axes[0, 0], axes[1, 0], curves)
    figure.align_ylabels(axes[:, 0])
    fitted = any(len(curve.fit_angle_deg) for curve in curves)
    legend_above(figure, legend_entries(curves, fitted=fitted))
    return figure


def _plot_radiance(axes: Axes, curve: Curve) -> None:
    dress(axes)
    shade_gaps(axes, curve)
    for channel, colour in enumerate(CHANNEL_COLOURS):
        measured = curve.radiance[:, channel]
        draw_points(axes, curve.angle_deg, measured, channel=channel, size=6.5, alpha=0.35)
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
