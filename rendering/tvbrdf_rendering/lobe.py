"""The fitted lobe as a polar plot in the plane of incidence, its parts apart.

The radius is the BRDF. In the first panel the top camera stays and the light moves, as it was
measured; in the others the light stays, and the top camera has one measured value.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Wedge

from tvbrdf_fitting.geometry import BoolArray, FloatArray
from tvbrdf_fitting.models import DustOverSurface, ReflectanceModel, SumModel, get_model
from tvbrdf_fitting.observations import Observations
from tvbrdf_fitting.result import FitResult

from .style import (
    CHANNEL_COLOURS,
    FAINT,
    INK,
    SHADE,
    TICK_SIZE,
    TITLE_SIZE,
    channel_entries,
    legend_above,
    measured_entry,
    new_figure,
    save,
)

LARGEST_LINEAR = 30.0
"""Largest by median BRDF above which the radius is logarithmic."""
MOST_DECADES = 4
NEAREST_DEG = 0.5
"""A measured value belongs to a panel if its light is this near to the panel's."""
_STEP_DEG = 0.25
_STEEPEST_DEG = 89.0
_SHOWN_DEG = 80.0
_IN_PLANE = 1e-3


@dataclass(frozen=True, eq=False)
class Lobe:
    """The BRDF over the angle of one direction in the plane of incidence, the other one standing.

    Attributes
    ----------
    title
        Of the panel.
    standing_deg, moving
        Angle of the standing direction, and which of "light" and "view" moves.
    angle_deg, total, diffuse
        (k,) angles to the normal, (k, 3) BRDF in 1/sr, all of it and without specular lobes.
    measured_deg, measured
        (m,), (m, 3) what the top camera measured; NaN where not valid.
    """

    title: str
    standing_deg: float
    moving: str
    angle_deg: FloatArray
    total: FloatArray
    diffuse: FloatArray
    measured_deg: FloatArray = field(default_factory=lambda: np.empty(0))
    measured: FloatArray = field(default_factory=lambda: np.empty((0, 3)))

    @property
    def specular(self) -> FloatArray:
        """What the lobes add (k, 3)."""
        return np.asarray(self.total - self.diffuse)


def lobe_amplitudes(model: ReflectanceModel) -> tuple[str, ...]:
    """Return the parameters that a model's specular lobes are proportional to."""
    if isinstance(model, DustOverSurface):
        return () if model.above.diffuse else _amplitudes(model.above)
    if not isinstance(model, SumModel):
        return () if model.diffuse else _amplitudes(model)
    own = [
        name
        for part, where in zip(model.parts, model.slices, strict=True)
        if not part.diffuse
        for name in model.parameter_names[where]
    ]
    return tuple(name for name in _amplitudes(model) if name in own)


def _amplitudes(model: ReflectanceModel) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for term in model.terms for name in term.amplitudes))


def in_plane(angle_deg: FloatArray | float) -> FloatArray:
    """Unit vectors (n, 3) at angles to the normal, in the light's plane."""
    angle = np.deg2rad(np.atleast_1d(np.asarray(angle_deg, dtype=np.float64)))
    return np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)


def lobes(
    observations: Observations, fit: FitResult, lights_deg: tuple[float, ...] | None = None
) -> list[Lobe]:
    """Return the panels: the top camera's measured one if it is in the plane, then each light's.

    Parameters
    ----------
    observations, fit
        What was fitted, and the result.
    lights_deg
        Angles of the standing lights to the sample's normal; by default the mirror angle of the
        top camera and two steeper ones.
    """
    camera_deg, rows = _top_camera(observations)
    if lights_deg is None:
        mirror = -camera_deg if rows.any() and abs(camera_deg) > 1 else 12.0
        lights_deg = (mirror, 45.0, 70.0)
    angle = np.arange(-_STEEPEST_DEG, _STEEPEST_DEG + _STEP_DEG / 2, _STEP_DEG)
    found = []
    light = observations.light_direction[rows]
    light_deg = np.degrees(np.arctan2(light[:, 0], light[:, 2]))
    measured = _measured_brdf(observations, rows)
    if rows.any():
        views = np.broadcast_to(in_plane(camera_deg), (len(angle), 3))
        total, diffuse = _parts(fit, in_plane(angle), views)
        seen = np.abs(light_deg) <= _STEEPEST_DEG
        found.append(
            Lobe(
                f"light moves, camera at {_signed(camera_deg)}°",
                camera_deg,
                "light",
                angle,
                total,
                diffuse,
                light_deg[seen],
                measured[seen],
            )
        )
    for standing in lights_deg:
        lights = np.broadcast_to(in_plane(standing), (len(angle), 3))
        total, diffuse = _parts(fit, lights, in_plane(angle))
        near = np.abs(light_deg - standing) <= NEAREST_DEG
        one = np.nanmean(measured[near], axis=0)[None] if _known(measured[near]) else measured[:0]
        title = f"view moves, light at {_signed(standing)}°"
        at = np.full(len(one), camera_deg)
        found.append(Lobe(title, standing, "view", angle, total, diffuse, at, one))
    return found


def _signed(angle_deg: float) -> str:
    return f"{angle_deg:.3g}".replace("-", "−")


def _known(values: FloatArray) -> bool:
    return len(values) > 0 and bool(np.isfinite(values).any(axis=0).all())


def _top_camera(observations: Observations) -> tuple[float, BoolArray]:
    """Angle of the first camera in the light's plane, and a mask (n,) of its usable rows."""
    usable = observations.usable.any(axis=1)
    plane = np.abs(observations.view_direction[:, 1]) < _IN_PLANE
    plane &= np.abs(observations.light_direction[:, 1]) < _IN_PLANE
    rows = usable & plane
    if not rows.any():
        return math.nan, rows
    rows &= observations.camera == observations.camera[rows].min()
    view = observations.view_direction[rows][0]
    return float(np.degrees(np.arctan2(view[0], view[2]))), rows


def _measured_brdf(observations: Observations, rows: BoolArray) -> FloatArray:
    """BRDF (m, 3) in 1/sr; NaN where a channel is not valid."""
    radiance = np.where(observations.usable, observations.radiance, np.nan)[rows]
    return np.asarray(radiance / (np.pi * observations.cosine_light[rows][:, None]))


def _parts(fit: FitResult, light: FloatArray, view: FloatArray) -> tuple[FloatArray, FloatArray]:
    """BRDF (k, 3), whole and without specular lobes."""
    model = get_model(fit.model)
    without = fit.parameters | dict.fromkeys(lobe_amplitudes(model), 0.0)
    diffuse = model.evaluate(light, view, model.from_mapping(without))
    return fit.brdf(light, view), diffuse


def plot_lobe(
    observations: Observations, fit: FitResult, path: Path | str, *, title: str = ""
) -> Path:
    """Plot the fitted lobe into a PNG; see :func:`lobe_figure`."""
    return save(lobe_figure(observations, fit, title=title), path)


def lobe_figure(
    observations: Observations,
    fit: FitResult,
    *,
    title: str = "",
    lights_deg: tuple[float, ...] | None = None,
) -> Figure:
    """Draw the fitted BRDF over angle in the plane of incidence, diffuse and specular parts apart.

    Each panel has its own radius, logarithmic in all if a panel's largest value is more than
    `LARGEST_LINEAR` times its median.
    """
    panels = lobes(observations, fit, lights_deg)
    columns = min(len(panels), 2)
    rows = -(-len(panels) // columns)
    figure = new_figure(0.4 + 5.2 * columns, 0.9 + 3.2 * rows)
    axes = figure.subplots(rows, columns, squeeze=False)
    logarithmic = any(_is_spread(_shown(panel)) for panel in panels)
    for index, cell in enumerate(axes.flat):
        if index < len(panels):
            _draw(cell, panels[index], _Radius.of(_shown(panels[index]), logarithmic))
        else:
            cell.remove()
    shared = all(_shared(panel.specular) for panel in panels)
    legend_above(figure, _legend(panels, shared=shared, logarithmic=logarithmic), title)
    return figure


@dataclass(frozen=True)
class _Radius:
    """How a BRDF becomes a radius from 0 to 1."""

    low: float
    high: float
    decades: int
    """0: linear."""

    @classmethod
    def of(cls, values: FloatArray, logarithmic: bool) -> _Radius:
        """Scale that shows values (n,) above 0."""
        if not values.size:
            return cls(0.0, 1.0, 0)
        top = float(values.max())
        if not logarithmic:
            return cls(0.0, _round_up(top), 0)
        high = math.ceil(math.log10(top) - 0.02)
        low = max(math.floor(math.log10(float(np.median(values)))) - 1, high - MOST_DECADES)
        return cls(10.0**low, 10.0**high, high - low)

    def __call__(self, brdf: FloatArray) -> FloatArray:
        """Radius (n,) of BRDFs (n,); 0 below the smallest that is shown."""
        if not self.decades:
            return np.asarray(np.maximum(brdf, 0.0) / self.high)
        inside = np.maximum(brdf, self.low)
        return np.asarray(np.log10(inside / self.low) / self.decades)

    def circles(self) -> list[tuple[float, str]]:
        """Radii of the circles, and what they stand for."""
        if not self.decades:
            return [(r, f"{self.high * r:.3g}") for r in (0.25, 0.5, 0.75, 1.0)]
        first = round(math.log10(self.low))
        steps = range(1, self.decades + 1)
        return [(step / self.decades, _power(first + step)) for step in steps]


def _shown(panel: Lobe) -> FloatArray:
    """Values above 0 (n,) that must be in a panel: not what grazing angles alone reach."""
    steep = np.abs(panel.angle_deg) <= _SHOWN_DEG
    seen = np.abs(panel.measured_deg) <= _SHOWN_DEG
    values = np.concatenate([panel.total[steep].ravel(), panel.measured[seen].ravel()])
    return np.asarray(values[np.isfinite(values) & (values > 0)])


def _is_spread(values: FloatArray) -> bool:
    return values.size > 0 and bool(values.max() > LARGEST_LINEAR * np.median(values))


def _power(exponent: int) -> str:
    return f"{10.0**exponent:g}" if -3 < exponent < 4 else rf"$10^{{{exponent}}}$"


def _round_up(value: float) -> float:
    """Return the next larger of 1, 2, 4, 6, 8 with a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 2, 4, 6, 8, 10) if value <= step * power * 1.001)


def _draw(axes: Axes, panel: Lobe, scale: _Radius) -> None:
    """Draw a half disc: Cartesian axes, since matplotlib's polar ones leave its half empty."""
    axes.set_aspect("equal")
    axes.set_frame_on(False)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_xlim(-1.14, 1.14)
    axes.set_ylim(-0.1, 1.1)
    axes.set_title(panel.title, fontsize=TITLE_SIZE, color=INK)
    _draw_grid(axes, scale)
    disc = Wedge((0, 0), 1.0, 0, 180, transform=axes.transData)
    lines = []
    for channel, colour in enumerate(CHANNEL_COLOURS):
        moving = panel.moving == "light"
        lines += axes.plot(
            *_points(panel.measured_deg, scale(panel.measured[:, channel])),
            linestyle="none",
            marker="." if moving else "D",
            markersize=6,
            markeredgewidth=0,
            color=colour,
            alpha=0.35 if moving else 0.9,
        )
        for values, style in ((panel.total, "-"), (panel.diffuse, "--")):
            radius = scale(values[:, channel])
            points = _points(panel.angle_deg, radius)
            lines += axes.plot(*points, color=colour, linewidth=1.3, linestyle=style)
    lines += _draw_specular(axes, panel, scale)
    for line in lines:
        line.set_clip_path(disc)
    (x,), (y,) = _points(np.array([panel.standing_deg]), 1.0)
    tail, head = (0.0, 0.0), (float(x), float(y))
    if panel.moving == "view":
        tail, head = head, tail  # the light comes in
    arrow = {"arrowstyle": "-|>", "color": FAINT, "linewidth": 1.2, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=head, xytext=tail, arrowprops=arrow)


def _points(angle_deg: FloatArray, radius: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    angle = np.deg2rad(angle_deg)
    return np.asarray(radius * np.sin(angle)), np.asarray(radius * np.cos(angle))


def _draw_grid(axes: Axes, scale: _Radius) -> None:
    around = np.linspace(-90, 90, 181)
    for radius, label in scale.circles():
        edge = radius == 1.0
        axes.plot(*_points(around, radius), color=FAINT if edge else SHADE, linewidth=0.9, zorder=0)
        for side in (-1, 1):
            axes.text(
                side * radius,
                -0.03,
                label,
                ha="center",
                va="top",
                fontsize=TICK_SIZE,
                color=INK,
            )
    axes.plot([-1, 1], [0, 0], color=FAINT, linewidth=0.9, zorder=0)
    for angle in range(-60, 61, 30):
        (x,), (y,) = _points(np.array([angle]), 1.0)
        axes.plot([0, x], [0, y], color=SHADE, linewidth=0.9, zorder=0)
        axes.text(
            1.07 * x,
            1.05 * y,
            f"{_signed(angle)}°",
            ha="center",
            va="center",
            fontsize=TICK_SIZE,
            color=INK,
        )


def _draw_specular(axes: Axes, panel: Lobe, scale: _Radius) -> list[Line2D]:
    specular = panel.specular
    if not (specular > 0).any():
        return []
    colours = [INK] if _shared(specular) else CHANNEL_COLOURS
    lines = []
    for channel, colour in enumerate(colours):
        points = _points(panel.angle_deg, scale(specular[:, channel]))
        lines += axes.plot(*points, color=colour, linewidth=1.3, linestyle=":")
    return lines


def _shared(specular: FloatArray) -> bool:
    """Whether the channels have one lobe."""
    return bool(np.ptp(specular, axis=1).max() <= 1e-9 * max(float(np.abs(specular).max()), 1e-300))


def _legend(panels: list[Lobe], *, shared: bool, logarithmic: bool) -> list[Line2D]:
    radius = "BRDF / (1/sr), log scale" if logarithmic else "BRDF / (1/sr)"
    handles = [
        *channel_entries(),
        Line2D([], [], color=INK, linewidth=1.5, label=radius),
        Line2D([], [], color=INK, linewidth=1.3, linestyle="--", label="diffuse part"),
    ]
    if any((panel.specular > 0).any() for panel in panels):
        label = "specular part (all channels)" if shared else "specular part"
        handles.append(Line2D([], [], color=INK, linewidth=1.3, linestyle=":", label=label))
    if any(len(panel.measured) for panel in panels):
        handles.append(measured_entry())
    return handles
