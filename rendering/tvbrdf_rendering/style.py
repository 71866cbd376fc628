"""What all pictures share: size, fonts, colours, and how a figure becomes a file.

Only matplotlib's objects are used, no ``pyplot`` and no global settings, so that pictures can be
made in any thread.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from tvbrdf_fitting.published import write_atomically

CHANNEL_COLOURS = ("#0072B2", "#009E73", "#D55E00")
"""B, G, R as the blue, green and vermilion of Okabe and Ito, told apart by colour-blind eyes."""
CHANNEL_NAMES = ("blue", "green", "red")
CHANNEL_MARKERS = ("o", "s", "^")
INK = "#222222"
FAINT = "#8A8A8A"
SHADE = "#EBEBEB"

WIDEST_ENTRY_IN = 1.35
"""Room that an entry of a legend takes on average."""
TITLE_SIZE = 12
LABEL_SIZE = 11
TICK_SIZE = 10


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure that lays itself out, on the Agg canvas."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    engine = figure.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        engine.set(w_pad=0.1, h_pad=0.08)
    return figure


def frame(axes: Axes) -> None:
    """Give axes a light grid, a faint frame on two sides, and readable ticks."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)
    axes.grid(visible=True, color=SHADE, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=TICK_SIZE, color=FAINT, labelcolor=INK)


def dress(axes: Axes, *, ticks: int = 5) -> None:
    """Give axes a light grid, plain numbers, and readable ticks."""
    frame(axes)
    axes.yaxis.set_major_locator(MaxNLocator(ticks))
    formatter = ScalarFormatter(useOffset=False)
    formatter.set_powerlimits((-3, 5))
    axes.yaxis.set_major_formatter(formatter)


def channel_entries() -> list[Line2D]:
    """Return a legend's entries for the colours of the channels."""
    return [
        Line2D([], [], color=colour, linewidth=1.8, label=name)
        for colour, name in zip(CHANNEL_COLOURS, CHANNEL_NAMES, strict=True)
    ]


def measured_entry() -> Line2D:
    """Return a legend's entry for measured points."""
    return Line2D([], [], color=INK, linestyle="none", marker=".", markersize=7, label="measured")


def legend_above(figure: Figure, handles: Sequence[Any], title: str = "") -> None:
    """Put one legend for all axes above them, in as many rows as the width needs."""
    columns = max(int(figure.get_figwidth() / WIDEST_ENTRY_IN), 1)
    if len(handles) > columns:
        columns = -(-len(handles) // 2)
    legend = figure.legend(
        handles=list(handles),
        loc="outside upper center",
        ncols=min(columns, len(handles)),
        frameon=False,
        fontsize=TICK_SIZE,
        handletextpad=0.5,
        columnspacing=1.6,
    )
    if title:
        legend.set_title(title, prop=FontProperties(size=TITLE_SIZE))
        legend.get_title().set_multialignment("center")


def save(figure: Figure, path: Path | str, *, dpi: int = 150) -> Path:
    """Write a figure as PNG, whole or not at all."""
    path = Path(path)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    write_atomically(path, buffer.getvalue())
    return path
