"""Fitted parameters against time, with their uncertainty, and the truth where it is known."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from tvbrdf_fitting.published.database import DatabaseError, StoredSample

from .style import (
    CHANNEL_COLOURS,
    CHANNEL_MARKERS,
    CHANNEL_NAMES,
    FAINT,
    INK,
    LABEL_SIZE,
    TITLE_SIZE,
    dress,
    legend_above,
    new_figure,
    save,
)
from .times import TimeUnit, time_unit
from .truth import Truth

CHANNEL_ENDINGS = ("_b", "_g", "_r")
TITLES = {
    "kd": r"diffuse albedo  $K_d$",
    "sigma_d": r"diffuse roughness  $\sigma_d$ / rad",
    "ks": r"specular strength  $K_s$",
    "inverse_sigma_s": r"specular sharpness  $1/\sigma_s$",
    "w": r"dust strength  $w$",
    "g": r"dust scattering  $g$",
    "tau": r"dust thickness  $\tau$",
}
SMALLEST_RANGE = 0.1
"""A panel shows at least this fraction of its largest value, so that noise does not fill it."""
NEAR_ZERO = 0.35
"""A panel that begins below this fraction of its end begins at 0."""


@dataclass(frozen=True, eq=False)
class Series:
    """One parameter in all fitted scans."""

    name: str
    time_s: NDArray[np.float64]
    value: NDArray[np.float64]
    standard_deviation: NDArray[np.float64]
    doubtful: NDArray[np.bool_]
    """At a bound, or not determined by the data."""
    true_time_s: NDArray[np.float64]
    true_value: NDArray[np.float64]


def series_of(sample: StoredSample, truth: Truth) -> list[Series]:
    """Return each parameter of a sample's fits against time.

    Raises
    ------
    DatabaseError
        If no scan is fitted.
    """
    fitted = [(scan, scan.fit) for scan in sample.scans if scan.fit is not None]
    if not fitted:
        raise DatabaseError(f"{sample.folder}: sample {sample.name!r} has no fitted scan to plot")
    all_series = []
    for name in dict.fromkeys(name for _, fit in fitted for name in fit.parameter_names):
        # where models are chosen, not every scan has every parameter
        having = [(scan, fit) for scan, fit in fitted if name in fit.parameter_names]
        places = [fit.parameter_names.index(name) for _, fit in having]
        known = [(time, truth.of(scan, name)) for scan, time in sorted(_times(sample, truth))]
        true = np.array([pair for pair in known if pair[1] is not None], dtype=np.float64)
        true = true.reshape(-1, 2)
        pairs = list(zip(having, places, strict=True))
        all_series.append(
            Series(
                name,
                np.array([scan.time_s for scan, _ in having]),
                np.array([fit.values[at] for (_, fit), at in pairs]),
                np.array([fit.standard_deviations[at] for (_, fit), at in pairs]),
                np.array([name in fit.at_bound + fit.undetermined for _, fit in having]),
                true[:, 0],
                true[:, 1],
            )
        )
    return all_series


def _times(sample: StoredSample, truth: Truth) -> list[tuple[int, float]]:
    """(scan, time) of every scan whose truth is known; the measured times where there are."""
    measured = {scan.scan: scan.time_s for scan in sample.scans}
    return list((truth.time_s | measured).items())


def grouped(all_series: list[Series]) -> dict[str, list[Series]]:
    """Return parameters by panel: the channels of one parameter share it."""
    groups: dict[str, list[Series]] = {}
    names = {series.name for series in all_series}
    for series in all_series:
        stem = series.name[:-2]
        is_channel = all(stem + ending in names for ending in CHANNEL_ENDINGS)
        groups.setdefault(stem if is_channel else series.name, []).append(series)
    return groups


def plot_parameters(sample: StoredSample, path: Path | str, *, truth: Truth | None = None) -> Path:
    """Plot fitted parameters against time into a PNG; see :func:`parameters_figure`."""
    return save(parameters_figure(sample, truth=truth), path)


def parameters_figure(sample: StoredSample, *, truth: Truth | None = None) -> Figure:
    """Draw fitted parameters with ±1 standard deviation against time, a panel a parameter.

    Parameters
    ----------
    sample
        A sample of a database, with at least one fitted scan.
    truth
        True parameters, drawn as lines.
    """
    truth = truth or Truth({}, {})
    groups = grouped(series_of(sample, truth))
    unit = time_unit(scan.time_s for scan in sample.scans)
    missing_s = [scan.time_s for scan in sample.missing if scan.time_s is not None]
    columns = 2 if len(groups) <= 4 else 3
    rows = math.ceil(len(groups) / columns)
    figure = new_figure(1.0 + 3.9 * columns, 0.7 + 2.5 * rows)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False)
    panels = [axes[row, column] for row in range(rows) for column in range(columns)]
    for panel, (name, members) in zip(panels, groups.items(), strict=False):
        _plot_group(panel, members, unit)
        panel.plot(
            [time_s / unit.seconds for time_s in missing_s],
            [0.03] * len(missing_s),
            transform=panel.get_xaxis_transform(),
            linestyle="none",
            marker="x",
            markersize=6,
            color=FAINT,
        )
        panel.set_title(TITLES.get(name, name), fontsize=TITLE_SIZE, color=INK)
    for spare in panels[len(groups) :]:
        spare.remove()
    for index in range(len(groups)):
        if index + columns >= len(groups):  # nothing below it
            panels[index].set_xlabel(f"time / {unit.sign}", fontsize=LABEL_SIZE, color=INK)
            panels[index].tick_params(labelbottom=True)
    legend_above(figure, _legend(groups, missing=bool(missing_s)))
    return figure


def _plot_group(axes: Axes, members: list[Series], unit: TimeUnit) -> None:
    dress(axes)
    axes.xaxis.set_major_locator(MaxNLocator(6))
    for index, series in enumerate(members):
        by_channel = len(members) == len(CHANNEL_COLOURS)
        colour = CHANNEL_COLOURS[index] if by_channel else INK
        marker = CHANNEL_MARKERS[index] if by_channel else "o"
        axes.plot(
            series.true_time_s / unit.seconds,
            series.true_value,
            color=colour,
            linewidth=1.3,
            alpha=0.6,
            zorder=1,
        )
        for doubtful in (False, True):
            chosen = series.doubtful == doubtful
            if not chosen.any():
                continue
            axes.errorbar(
                series.time_s[chosen] / unit.seconds,
                series.value[chosen],
                yerr=np.nan_to_num(series.standard_deviation[chosen]),
                linestyle="none",
                marker=marker,
                markersize=5,
                color=colour,
                markerfacecolor="white" if doubtful else colour,
                elinewidth=1.2,
                capsize=2.5,
                zorder=2,
            )
    _widen(axes, members)


def _widen(axes: Axes, members: list[Series]) -> None:
    """Choose the range of values: not filled by noise alone, and from 0 where that is near."""
    values = np.concatenate([np.append(series.value, series.true_value) for series in members])
    values = values[np.isfinite(values)]
    if values.size == 0:
        return
    low, high = axes.get_ylim()
    largest = float(np.abs(values).max())
    smallest_range = SMALLEST_RANGE * largest or SMALLEST_RANGE
    if high - low < smallest_range:
        middle = 0.5 * (high + low)
        low, high = middle - 0.5 * smallest_range, middle + 0.5 * smallest_range
    if values.min() >= 0 and low < NEAR_ZERO * high:
        high = max(high, SMALLEST_RANGE) if largest == 0 else high
        low = -0.05 * high if values.min() < 0.05 * high else 0.0
    axes.set_ylim(low, high)


def _legend(groups: dict[str, list[Series]], *, missing: bool) -> list[Line2D]:
    handles = []
    if any(len(members) == len(CHANNEL_COLOURS) for members in groups.values()):
        handles += [
            Line2D([], [], color=colour, linestyle="none", marker=marker, markersize=6, label=name)
            for colour, marker, name in zip(
                CHANNEL_COLOURS, CHANNEL_MARKERS, CHANNEL_NAMES, strict=True
            )
        ]
    everything = [series for members in groups.values() for series in members]
    handles.append(
        Line2D([], [], color=INK, linestyle="none", marker="o", markersize=6, label="fitted ± 1 sd")
    )
    if any(series.doubtful.any() for series in everything):
        handles.append(
            Line2D(
                [],
                [],
                color=INK,
                linestyle="none",
                marker="o",
                markersize=6,
                markerfacecolor="white",
                label="at a bound or undetermined",
            )
        )
    if any(series.true_value.size for series in everything):
        handles.append(Line2D([], [], color=FAINT, linewidth=1.5, label="truth"))
    if missing:
        handles.append(
            Line2D([], [], color=FAINT, linestyle="none", marker="x", markersize=6, label="missing")
        )
    return handles
