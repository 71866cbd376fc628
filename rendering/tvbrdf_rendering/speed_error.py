"""Speed against error of fits: what a cheaper solver, or fewer images, cost in exactness."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator
from scipy.optimize import isotonic_regression

from tvbrdf_fitting.geometry import BoolArray, FloatArray

from .style import (
    FAINT,
    INK,
    LABEL_SIZE,
    TICK_SIZE,
    TITLE_SIZE,
    frame,
    new_figure,
    save,
)

SOLVER_LOOKS = {
    "separable": ("#0072B2", "o"),
    "paper": ("#D55E00", "s"),
    "trust_region": ("#009E73", "^"),
    "scipy lm": ("#CC79A7", "D"),
}
"""Colour (Okabe and Ito's) and marker of each solver."""
_OTHER = ("#8A8A8A", "v")
CAMERA_COLOURS = ("#C0C0C0", "#949494", "#666666", "#111111")
CAMERA_MARKERS = ("v", "D", "s", "o")
SMALLEST_ERROR = 1e-5
LARGEST_ERROR = 1.0
"""Errors beyond are drawn here: a logarithmic axis has no 0, and what is lost is lost."""
PALE, PALE_SIZE = 0.3, 4.0
"""Opacity and size of points with fewer cameras than there are."""
NUMBER_SIZE = 8
NUMBER_ROOM_PT = 11.0
"""Height that a number needs for itself."""
NUMBER_AWAY_PT = 14.0
"""How far from all points numbers stand."""
NUMBER_LENGTH = 4.0
"""Factor in time that is kept free for numbers beside the fastest point."""


class Measured(Protocol):
    """One combination of solver, precision, lights, cameras and noise."""

    @property
    def solver(self) -> str:
        """Its name."""

    @property
    def precision(self) -> str:
        """Of the data, such as float64."""

    @property
    def lights(self) -> int:
        """Positions in a sweep."""

    @property
    def cameras(self) -> int:
        """How many looked."""

    @property
    def noise(self) -> float | None:
        """Relative deviation at white; None for real data."""

    @property
    def time_ms(self) -> float:
        """Of one fit."""

    @property
    def brdf(self) -> float:
        """Median relative error."""

    @property
    def brdf_95(self) -> float:
        """What 95 % of the fits stay below."""

    @property
    def fast(self) -> bool:
        """Whether nothing else is both faster and better."""


def plot_speed_error(cells: Sequence[Measured], path: Path | str, *, title: str) -> Path:
    """Plot speed against error into a PNG; see :func:`speed_error_figure`."""
    return save(speed_error_figure(cells, title=title), path)


def speed_error_figure(cells: Sequence[Measured], *, title: str) -> Figure:
    """Draw a column a noise level; two panels beside each other where there is only one.

    Above: error of 95 % of the fits against the time of one, both logarithmic; a marker a
    combination, small and pale where not all cameras were used; the line is the Pareto front,
    beyond which nothing is both faster and better. Numbers are those of lights, at the points of
    the front's solver with all cameras: the other solvers' errors are nearly the same. Below: error
    against the number of lights, a line a number of cameras, for the separable solver; dashed is
    the median.
    """
    exact = [c for c in cells if c.precision == "float64"]
    noises = list(dict.fromkeys(c.noise for c in exact))
    alone = len(noises) == 1
    figure = new_figure(10.5, 5.2) if alone else new_figure(1.2 + 4.4 * len(noises), 9.0)
    shape = (1, 2) if alone else (2, len(noises))
    axes = figure.subplots(*shape, squeeze=False, sharey="row", sharex=False if alone else "row")
    axes = axes.T if alone else axes
    for column, noise in enumerate(noises):
        own = [c for c in exact if c.noise == noise]
        above, below = axes[0, column], axes[1, column]
        _time_panel(above, own)
        _lights_panel(below, [c for c in own if c.solver == "separable"])
        if not alone:
            above.set_title(f"noise {noise:.1%} at white", fontsize=TITLE_SIZE, color=INK)
        above.set_xlabel("time of a fit / ms", fontsize=LABEL_SIZE, color=INK)
        below.set_xlabel("lights", fontsize=LABEL_SIZE, color=INK)
    for row in (0, 1):
        axes[row, 0].set_ylabel("error of the BRDF", fontsize=LABEL_SIZE, color=INK)
    figure.suptitle(title, fontsize=TITLE_SIZE, color=INK)
    _legend_below(figure, exact)
    _number(figure, {axes[0, i]: [c for c in exact if c.noise == n] for i, n in enumerate(noises)})
    return figure


def _look(solver: str) -> tuple[str, str]:
    return SOLVER_LOOKS.get(solver, _OTHER)


def _camera_look(cameras: int) -> tuple[str, str]:
    at = (cameras - 1) % len(CAMERA_COLOURS)
    return CAMERA_COLOURS[at], CAMERA_MARKERS[at]


def _per_cent(error: float, _: object = None) -> str:
    beyond = "≥ " if error >= LARGEST_ERROR else "≤ " if error <= SMALLEST_ERROR else ""
    return f"{beyond}{100 * error:g} %"


def _shown(error: float) -> float:
    """Return an error where it can be drawn; what is not a number is the worst."""
    return min(max(error, SMALLEST_ERROR), LARGEST_ERROR) if math.isfinite(error) else LARGEST_ERROR


def _time_panel(axes: Axes, cells: Sequence[Measured]) -> None:
    _dress(axes)
    axes.set_xscale("log")
    most = max(c.cameras for c in cells)
    for solver in dict.fromkeys(c.solver for c in cells):
        colour, marker = _look(solver)
        for whole in (False, True):
            chosen = [c for c in cells if c.solver == solver and (c.cameras == most) == whole]
            axes.plot(
                [c.time_ms for c in chosen],
                [_shown(c.brdf_95) for c in chosen],
                linestyle="none",
                marker=marker,
                markersize=6.5 if whole else PALE_SIZE,
                color=colour,
                alpha=1.0 if whole else PALE,
                markeredgecolor="white",
                markeredgewidth=0.6,
                zorder=3 if whole else 2,
            )
    front = sorted((c for c in cells if c.fast), key=lambda c: c.time_ms)
    axes.plot(
        [c.time_ms for c in front],
        [_shown(c.brdf_95) for c in front],
        color=INK,
        linewidth=1.2,
        drawstyle="steps-post",
        zorder=1,
    )
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _number(figure: Figure, panels: Mapping[Axes, Sequence[Measured]]) -> None:
    """Write the number of lights beside the points of each panel's leading solver."""
    for axes, cells in panels.items():
        fastest = min(c.time_ms for c in cells) / NUMBER_LENGTH
        axes.set_xlim(left=min(fastest, axes.get_xlim()[0]))
    figure.draw_without_rendering()  # lays the axes out: where points are is known from here on
    point = figure.dpi / 72
    for axes, cells in panels.items():
        named = _named(cells)
        places = axes.transData.transform([(c.time_ms, _shown(c.brdf_95)) for c in named]) / point
        limits = axes.bbox.y0 / point + NUMBER_SIZE, axes.bbox.y1 / point
        right = _to_the_right(places)
        for side, edge, sign in ((~right, places[:, 0].min(), -1), (right, places[:, 0].max(), 1)):
            rows = np.flatnonzero(side)
            heights = _spread(places[rows, 1], NUMBER_ROOM_PT, *limits)
            for row, height in zip(rows, heights, strict=True):
                there = np.array([edge + sign * NUMBER_AWAY_PT, height])
                _annotate(axes, named[row], there - places[row])


def _annotate(axes: Axes, cell: Measured, away_pt: FloatArray) -> None:
    axes.annotate(
        str(cell.lights),
        (cell.time_ms, _shown(cell.brdf_95)),
        xytext=(float(away_pt[0]), float(away_pt[1])),
        textcoords="offset points",
        ha="left" if away_pt[0] > 0 else "right",
        va="center",
        fontsize=NUMBER_SIZE,
        color=INK,
        path_effects=[withStroke(linewidth=2.0, foreground="white")],
        arrowprops={"arrowstyle": "-", "color": FAINT, "linewidth": 0.6, "shrinkA": 1},
        zorder=4,
    ).set_in_layout(False)


def _to_the_right(places: FloatArray) -> BoolArray:
    """Whether a point's number stands right of all points (n, 2), as another is in its way left."""
    x, y = places.T
    level = np.abs(y[:, None] - y) < NUMBER_ROOM_PT / 2
    blocked = (level & (x < x[:, None])).any(axis=1), (level & (x > x[:, None])).any(axis=1)
    return np.asarray(blocked[0] & ~blocked[1])


def _named(cells: Sequence[Measured]) -> list[Measured]:
    """Return one solver's points with all cameras: that with most of the front."""
    solvers = [c.solver for c in cells if c.fast] or [c.solver for c in cells]
    leader = Counter(solvers).most_common(1)[0][0]
    chosen = [c for c in cells if c.solver == leader]
    most = max(c.cameras for c in chosen)
    return [c for c in chosen if c.cameras == most]


def _spread(wanted: FloatArray, room: float, lowest: float, highest: float) -> FloatArray:
    """Return places at least `room` apart, near the wanted ones, within limits if they fit."""
    if not len(wanted):
        return wanted
    order = np.argsort(wanted, kind="stable")
    steps = room * np.arange(len(wanted))
    # places less their steps must not fall: the nearest such ones are a monotone regression
    even = isotonic_regression(wanted[order] - steps).x
    out = np.empty(len(wanted))
    out[order] = np.clip(even, lowest, max(lowest, highest - steps[-1])) + steps
    return out


def _lights_panel(axes: Axes, cells: Sequence[Measured]) -> None:
    _dress(axes)
    axes.set_xscale("log")
    for index, cameras in enumerate(sorted({c.cameras for c in cells})):
        own = sorted((c for c in cells if c.cameras == cameras), key=lambda c: c.lights)
        lights = [c.lights for c in own]
        colour, marker = _camera_look(cameras)
        axes.plot(
            lights,
            [_shown(c.brdf_95) for c in own],
            color=colour,
            marker=marker,
            markersize=5,
            linewidth=1.5,
            zorder=3 + index,
        )
        axes.plot(
            lights,
            [_shown(c.brdf) for c in own],
            color=colour,
            linewidth=1.0,
            linestyle="--",
            zorder=2,
        )
    axes.xaxis.set_major_locator(FixedLocator(sorted({float(c.lights) for c in cells})))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))


def _dress(axes: Axes) -> None:
    frame(axes)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(_per_cent))


def _legend_below(figure: Figure, cells: Sequence[Measured]) -> None:
    """Two rows: what the upper panels show, and what the lower ones do; then `_notes`."""
    upper = [
        Line2D([], [], color=colour, marker=marker, linestyle="none", markersize=6.5, label=solver)
        for solver in dict.fromkeys(c.solver for c in cells)
        for colour, marker in [_look(solver)]
    ]
    upper.append(Line2D([], [], color=INK, linewidth=1.2, label="Pareto front"))
    lower = []
    for cameras in sorted({c.cameras for c in cells}):
        colour, marker = _camera_look(cameras)
        name = f"{cameras} camera{'s' if cameras > 1 else ''}"
        lower.append(Line2D([], [], color=colour, marker=marker, label=name))
    lower.append(Line2D([], [], color=FAINT, linestyle="--", label="median, else 95 % of fits"))
    blank = Line2D([], [], linestyle="none", label=" ")
    pairs = [*zip_longest(upper, lower, fillvalue=blank), _notes(cells, blank)]
    figure.legend(
        handles=[handle for pair in pairs for handle in pair],
        loc="outside lower center",
        ncols=len(pairs),
        frameon=False,
        fontsize=TICK_SIZE,
        handletextpad=0.5,
        columnspacing=1.6,
    )


def _notes(cells: Sequence[Measured], blank: Line2D) -> tuple[Line2D, Line2D]:
    """Return a legend's entries for pale points, where there are any, and for numbers."""
    most = max(c.cameras for c in cells)
    pale = Line2D([], [], color=INK, marker="o", linestyle="none", label="pale: fewer cameras")
    pale.set(alpha=PALE, markersize=PALE_SIZE, markeredgecolor="white")
    number = Line2D([], [], color=INK, marker="$24$", linestyle="none", label="number of lights")
    number.set(markersize=10, markeredgewidth=0)
    return (pale if any(c.cameras < most for c in cells) else blank), number
