"""Where the rig is blind: how uncertain a fitted BRDF is, over half and difference angles.

Along theta_h lies the highlight (0: mirror direction), along theta_d the angle of incidence on the
facets (0: retro-reflection, 90 degrees: grazing); see `tvbrdf_fitting.half_angle`. The third angle
phi_d has a panel for the plane of incidence (0), one across it (90 degrees), and one for the worst
of all. Camera 1 measures in the plane of incidence, the others on tracks through all phi_d.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from tvbrdf_fitting.choice.choose import ModelChoice
from tvbrdf_fitting.half_angle import from_half_angles, to_half_angles
from tvbrdf_fitting.models import get_model
from tvbrdf_fitting.observations import Observations
from tvbrdf_fitting.prediction import Contender, contenders, predict_over_models
from tvbrdf_fitting.result import FitResult

from .style import FAINT, INK, LABEL_SIZE, TICK_SIZE, TITLE_SIZE, new_figure, save

FloatArray = NDArray[np.float64]
Fits = FitResult | ModelChoice | Sequence[FitResult] | Sequence[Contender]

STEP_DEG = 1.0
PHI_STEP_DEG = 10.0
NEAR_DEG = 20.0
"""Measured directions this near to a panel's phi_d are drawn boldly."""
SMALLEST, LARGEST = 1e-4, 1.0
"""The colours' range at the most: a deviation as large as the value says nothing."""
LEVELS = (0.01, 0.1)
UNKNOWN = "#3B0F24"
"""For a deviation of the value itself and more."""
MEASURED, ELSEWHERE = "#0B4F80", "#4C8FBF"
_COLOURS = ("#FBFAF3", "#F6E3B4", "#EDB679", "#D97B56", "#B0434D", "#712248")


@dataclass(frozen=True, eq=False)
class BlindMap:
    """Relative standard deviations of a BRDF over half and difference angles.

    Attributes
    ----------
    theta_h_deg, theta_d_deg, phi_d_deg
        Centres of the cells, (h,), (d,), (f,).
    relative
        (f, d, h) standard deviation over value, of the three channels together; NaN where light or
        view is below the horizon, infinite where nothing is known.
    camera, measured_deg
        (m,) number of the camera and (m, 3) theta_h, theta_d, phi_d of each measured direction,
        phi_d folded to what `phi_d_deg` covers.
    models
        Names of the models that the map is of.
    model_error
        Whether noise does not explain the data: the deviations are those of a wrong model's best
        values, and of the models that do as well, not of what all of them get wrong.
    """

    theta_h_deg: FloatArray
    theta_d_deg: FloatArray
    phi_d_deg: FloatArray
    relative: FloatArray
    camera: NDArray[np.int64]
    measured_deg: FloatArray
    models: tuple[str, ...]
    model_error: bool

    @property
    def worst(self) -> FloatArray:
        """(d, h) largest deviation over phi_d, of the directions above the horizon."""
        return np.asarray(np.fmax.reduce(self.relative, axis=0))

    @property
    def has_unknown(self) -> bool:
        """Whether any deviation is larger than the value."""
        return bool((self.relative > LARGEST).any())

    def at(self, phi_d_deg: float) -> FloatArray:
        """(d, h) deviations at the phi_d nearest to the one given."""
        return np.asarray(self.relative[int(np.argmin(np.abs(self.phi_d_deg - phi_d_deg)))])


def draw_blind_map(fits: Fits, observations: Observations, path: Path | str) -> Path:
    """Draw where a fit does not know the BRDF, as a PNG; see `blind_map` and `blind_map_figure`."""
    return save(blind_map_figure(blind_map(fits, observations)), path)


def blind_map(fits: Fits, observations: Observations) -> BlindMap:
    """Predict a BRDF over half and difference angles.

    Parameters
    ----------
    fits
        A fit; several of the same data; or a model choice, which brings the fits that explain the
        data as well (`prediction.contenders`).
    observations
        The scan.

    Raises
    ------
    ValueError
        A model that is not isotropic has no such map.
    """
    chosen: Sequence[FitResult] | Sequence[Contender]
    if isinstance(fits, ModelChoice):
        chosen = contenders(fits, observations)
    else:
        chosen = [fits] if isinstance(fits, FitResult) else fits
    results = [f.result if isinstance(f, Contender) else f for f in chosen]
    models = [get_model(result.model) for result in results]
    turning = [model.name for model in models if not model.isotropic]
    if turning:
        raise ValueError(
            f"{', '.join(turning)} depends on how the sample is turned: half and difference angles "
            f"are for isotropic models"
        )
    last_deg = 90.0 if all(model.reciprocal for model in models) else 180.0
    theta_deg = np.arange(0.5 * STEP_DEG, 90.0, STEP_DEG)
    phi_deg = np.arange(0.0, last_deg + 1e-9, PHI_STEP_DEG)
    phi, theta_d, theta_h = np.meshgrid(phi_deg, theta_deg, theta_deg, indexing="ij")
    light, view = from_half_angles(
        *(np.radians(angle.ravel()) for angle in (theta_h, theta_d, phi))
    )
    predicted = predict_over_models(chosen, light, view)
    camera, measured_deg = _measured(observations, folded=last_deg == 90.0)
    return BlindMap(
        theta_h_deg=theta_deg,
        theta_d_deg=theta_deg,
        phi_d_deg=phi_deg,
        relative=predicted.relative.reshape(phi.shape),
        camera=camera,
        measured_deg=measured_deg,
        models=tuple(dict.fromkeys(result.model for result in results)),
        model_error=any(result.model_error_std > 0 for result in results),
    )


def blind_map_figure(found: BlindMap) -> Figure:
    """Draw the panels of a map: in the plane of incidence, across it, and the worst of all.

    Colours are relative standard deviations, with lines at `LEVELS`. Points are the directions that
    were measured, by camera; in a panel of one phi_d those within `NEAR_DEG` of it are bold.
    """
    panels = [
        ("in the plane of incidence, φd = 0°", found.at(0.0), 0.0),
        ("across it, φd = 90°", found.at(90.0), 90.0),
        ("worst over φd", found.worst, None),
    ]
    figure = new_figure(12.6, 4.75 if found.model_error else 4.55)
    axes = figure.subplots(1, len(panels), sharex=True, sharey=True)
    norm = _norm(found.relative)
    for ax, (title, relative, phi_deg) in zip(axes, panels, strict=True):
        _draw_panel(ax, found, relative, phi_deg, norm)
        _draw_tracks(ax, found, phi_deg)
        ax.set_title(title, fontsize=TITLE_SIZE, color=INK)
        ax.set_xlabel("half angle θh / °", fontsize=LABEL_SIZE, color=INK)
    axes[0].set_ylabel("difference angle θd / °", fontsize=LABEL_SIZE, color=INK)
    _draw_scale(figure, axes, norm, unknown=found.has_unknown)
    figure.legend(
        handles=_legend(found),
        loc="outside upper center",
        ncols=4,
        frameon=False,
        fontsize=TICK_SIZE,
        handletextpad=0.5,
        columnspacing=1.6,
    )
    if found.model_error:
        figure.supxlabel(
            "No model explains these data within their noise: shown is how well the best ones are "
            "defined, and how they differ, not what all of them get wrong.",
            fontsize=TICK_SIZE,
            color=INK,
        )
    return figure


def _measured(observations: Observations, *, folded: bool) -> tuple[NDArray[np.int64], FloatArray]:
    rows = observations.select(np.flatnonzero(observations.usable.any(axis=1)))
    angles = to_half_angles(rows.light_direction, rows.view_direction)
    phi_d = angles.folded_phi_d if folded else np.abs(angles.phi_d)
    return rows.camera, np.degrees(np.stack([angles.theta_h, angles.theta_d, phi_d], axis=1))


def _norm(relative: FloatArray) -> LogNorm:
    """Colours over whole decades, of what there is and what can be told apart."""
    known = relative[np.isfinite(relative) & (relative > 0)]
    if not known.size:
        return LogNorm(SMALLEST, LARGEST)
    highest = float(np.max(relative, where=~np.isnan(relative), initial=0.0))
    high = 10.0 ** np.ceil(np.log10(np.clip(highest, 10 * SMALLEST, LARGEST)))
    low = 10.0 ** np.floor(np.log10(np.percentile(known, 1)))
    return LogNorm(float(np.clip(low, SMALLEST, high / 10)), float(high))


def _colours() -> Colormap:
    colours = LinearSegmentedColormap.from_list("blind", _COLOURS)
    return colours.with_extremes(over=UNKNOWN, under=_COLOURS[0], bad="white")


def _draw_panel(
    ax: Axes, found: BlindMap, relative: FloatArray, phi_deg: float | None, norm: LogNorm
) -> None:
    edges = np.arange(0.0, 90.0 + 1e-9, STEP_DEG)
    below = np.isnan(relative)
    # cells that the horizon cuts are drawn whole, below its hatching
    shown = np.where(below, np.roll(relative, 1, axis=1), relative)
    # what is infinite, and exactly 0, still has a colour
    shown = np.clip(shown, 1e-12, 1e12)
    ax.pcolormesh(edges, edges, shown, norm=norm, cmap=_colours(), rasterized=True)
    if below.any() and phi_deg is not None:
        _hatch_below_horizon(ax, phi_deg)
    filled = np.where(relative <= LARGEST, shown, np.nan)  # no lines along what is unknown
    known = filled[np.isfinite(filled)]
    levels = [v for v in LEVELS if known.size and known.min() < v < known.max()]
    if levels:
        lines = ax.contour(
            found.theta_h_deg,
            found.theta_d_deg,
            np.log10(filled),
            levels=np.log10(levels),
            colors=INK,
            linewidths=0.9,
            linestyles="solid",
        )
        ax.clabel(lines, fmt=lambda v: _percent(10.0**v), fontsize=TICK_SIZE - 1)
    for side in ax.spines.values():
        side.set_color(FAINT)
    ax.set_aspect("equal")
    ax.set(xlim=(0, 90), ylim=(0, 90))
    ax.tick_params(labelsize=TICK_SIZE, color=FAINT, labelcolor=INK)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(FixedLocator(range(0, 91, 15)))


def _hatch_below_horizon(ax: Axes, phi_deg: float) -> None:
    """Light or view is below it where ``tan(theta_h) tan(theta_d) |cos(phi_d)| > 1``."""
    theta_h = np.linspace(0.0, 90.0, 361)
    height = np.cos(np.radians(theta_h))
    reach = np.sin(np.radians(theta_h)) * abs(np.cos(np.radians(phi_deg)))
    horizon = np.degrees(np.arctan2(height, reach))
    ax.fill_between(
        theta_h, horizon, 90.0, facecolor="white", edgecolor=FAINT, hatch="////", linewidth=0.8
    )


def _draw_tracks(ax: Axes, found: BlindMap, phi_deg: float | None) -> None:
    """Draw measured directions, bold near a panel's phi_d, and the cameras' numbers."""
    for camera in np.unique(found.camera).tolist():
        h, d, phi = found.measured_deg[found.camera == camera].T
        bold = np.ones(h.shape, dtype=bool) if phi_deg is None else np.abs(phi - phi_deg) < NEAR_DEG
        ax.plot(h[~bold], d[~bold], ".", ms=1.6, color=ELSEWHERE, mew=0)
        ax.plot(h[bold], d[bold], ".", ms=5.0, color="white", mew=0)
        ax.plot(h[bold], d[bold], ".", ms=3.4, color=MEASURED, mew=0)
        # where the track is at its smallest theta_d, clear of the others
        place = int(np.argmin(d))
        text = ax.annotate(
            str(camera),
            (h[place], d[place]),
            xytext=(0, -3 if d[place] > 8 else 4),
            textcoords="offset points",
            ha="center",
            va="top" if d[place] > 8 else "bottom",
            fontsize=TICK_SIZE,
            color=MEASURED,
        )
        text.set_path_effects([withStroke(linewidth=2.5, foreground="white")])


def _draw_scale(figure: Figure, axes: Sequence[Axes], norm: LogNorm, *, unknown: bool) -> None:
    decades = range(round(np.log10(norm.vmin or SMALLEST)), round(np.log10(norm.vmax or 1)) + 1)
    scale = figure.colorbar(
        ScalarMappable(norm=norm, cmap=_colours()),
        ax=list(axes),
        ticks=[10.0**k for k in decades],
        extend="max" if unknown else "neither",
        shrink=0.78,
        pad=0.015,
        aspect=22,
    )
    scale.set_label("standard deviation / value", fontsize=LABEL_SIZE, color=INK)
    scale.ax.tick_params(labelsize=TICK_SIZE, color=FAINT, labelcolor=INK)
    scale.ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: _percent(v)))
    scale.ax.yaxis.set_minor_locator(NullLocator())
    scale.outline.set_edgecolor(FAINT)


def _legend(found: BlindMap) -> list[Line2D | Patch]:
    near = f"measured, within {NEAR_DEG:g}° of the panel's φd"
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=MEASURED, linestyle="none", marker=".", ms=8, label=near),
        Line2D([], [], color=ELSEWHERE, linestyle="none", marker=".", ms=4, label="at another φd"),
        Patch(facecolor="white", edgecolor=FAINT, hatch="////", label="below the horizon"),
    ]
    if found.has_unknown:
        handles.append(Patch(color=UNKNOWN, label="unknown"))
    return handles


def _percent(value: float) -> str:
    return f"{100 * value:g} %"
