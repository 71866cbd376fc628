"""What pictures of radiance against the light's angle share: gaps, points, residuals, legend."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from tvbrdf_fitting.geometry import FloatArray

from .style import CHANNEL_COLOURS, FAINT, INK, SHADE, channel_entries, dress, measured_entry

CURVE_STEP_DEG = 0.1
GAP_STEPS = 3.0
"""Neighbouring lights further apart than this many usual steps have a gap between them."""
Gaps = tuple[tuple[float, float], ...]


class HasGaps(Protocol):
    """A curve that knows where nothing was measured, and why."""

    @property
    def gaps_deg(self) -> Gaps:
        """Angles between which nothing was measured."""

    @property
    def gaps_are_the_arms(self) -> bool:
        """Whether every gap is where the arm hides the sample."""


def gaps_between(angle_deg: FloatArray, smallest_deg: float = 0.0) -> Gaps:
    """Return where sorted angles (n,) are further apart than usual, and than `smallest_deg`."""
    steps = np.diff(angle_deg)
    usual = float(np.median(steps)) if steps.size else 0.0
    least = max(GAP_STEPS * usual, smallest_deg)
    return tuple((float(a), float(b)) for a, b in pairwise(angle_deg) if b - a > least > 0)


def dense_angles(angle_deg: FloatArray) -> FloatArray:
    """Angles (k,) every `CURVE_STEP_DEG` or so, from the first to the last of sorted ones."""
    count = max(int((angle_deg[-1] - angle_deg[0]) / CURVE_STEP_DEG), 1) + 1
    return np.linspace(angle_deg[0], angle_deg[-1], count)


def draw_points(
    axes: Axes,
    angle_deg: FloatArray,
    values: FloatArray,
    *,
    channel: int,
    size: float,
    alpha: float,
) -> None:
    """Draw one channel's values (n,)."""
    axes.plot(
        angle_deg,
        values,
        linestyle="none",
        marker=".",
        markersize=size,
        markeredgewidth=0,
        color=CHANNEL_COLOURS[channel],
        alpha=alpha,
    )


def draw_residuals(axes: Axes, curve: HasGaps, angle_deg: FloatArray, values: FloatArray) -> None:
    """Draw residuals (n, 3) about a line at zero; (0, 3): the line alone."""
    dress(axes, ticks=3)
    shade_gaps(axes, curve)
    axes.axhline(0, color=FAINT, linewidth=0.8)
    for channel in range(len(CHANNEL_COLOURS) if len(values) else 0):
        draw_points(axes, angle_deg, values[:, channel], channel=channel, size=3.5, alpha=0.6)


def shade_gaps(axes: Axes, curve: HasGaps) -> None:
    """Shade where nothing was measured."""
    for low, high in curve.gaps_deg:
        axes.axvspan(low, high, color=SHADE, linewidth=0, zorder=0)


def legend_entries(curves: Sequence[HasGaps], *, fitted: bool) -> list[Line2D | Patch]:
    """Return the legend's handles: channels, points, the fitted curve if any, shaded gaps."""
    handles: list[Line2D | Patch] = [*channel_entries(), measured_entry()]
    if fitted:
        handles.append(Line2D([], [], color=INK, linewidth=1.8, label="fitted"))
    if any(curve.gaps_deg for curve in curves):
        arm = all(curve.gaps_are_the_arms for curve in curves)
        handles.append(Patch(color=SHADE, label="hidden by the arm" if arm else "not measured"))
    return handles
