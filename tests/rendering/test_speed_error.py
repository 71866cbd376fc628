"""The picture of speed against error: everything is drawn, within the page."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations as combinations_of
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from tests.rendering.labels import texts_on_the_page
from tvbrdf_rendering.speed_error import plot_speed_error, speed_error_figure


@dataclass(frozen=True)
class One:
    solver: str
    lights: int
    cameras: int
    noise: float | None
    time_ms: float
    brdf: float
    brdf_95: float
    fast: bool = False
    precision: str = "float64"


def combinations(*noises: float | None) -> list[One]:
    speeds = {"separable": 0.1, "paper": 8.0, "scipy lm": 3.0, "somebody's": 1.0}
    return [
        One(
            solver,
            lights,
            cameras,
            noise,
            time_ms=speed * (1 + lights / 300) * cameras**0.2,
            brdf=(noise or 0.01) / math.sqrt(lights * cameras),
            brdf_95=3 * (noise or 0.01) / math.sqrt(lights * cameras),
            fast=solver == "separable" and cameras == 4,
        )
        for noise in noises
        for solver, speed in speeds.items()
        for lights in (12, 48, 361)
        for cameras in (1, 4)
    ]


def drawn_points(figure: Figure) -> int:
    """Points drawn as markers without a line, which the upper panels' are."""
    lines = [line for axes in figure.axes for line in axes.get_lines()]
    return sum(np.size(line.get_xdata()) for line in lines if line.get_linestyle() == "None")


@pytest.mark.parametrize("noises", [(None,), (0.005,), (0.001, 0.02), (0.001, 0.005, 0.02)])
def test_all_is_drawn_and_all_texts_are_on_the_page(noises: tuple[float | None, ...]) -> None:
    cells = combinations(*noises)
    figure = speed_error_figure(cells, title="sample07, scan 3, against the fit of all of it")
    assert len(figure.axes) == 2 * len(noises)
    assert drawn_points(figure) == len(cells)
    words = {text for text, _ in texts_on_the_page(figure)}
    assert {"separable", "paper", "scipy lm", "somebody's", "4 cameras"} <= words
    assert {"pale: fewer cameras", "number of lights"} <= words
    numbers = {text.get_text() for axes in figure.axes for text in axes.texts}
    assert numbers == {"12", "48", "361"}


def test_numbers_are_apart_from_each_other_and_from_the_points_they_name() -> None:
    """Errors that are nearly the same in all, which on one height would hide each other."""
    errors = {12: 1.0, 24: 0.00101, 48: 0.001, 96: 0.00103, 181: 0.00101, 361: 1e-9}
    times = {12: 0.15, 24: 0.16, 48: 0.18, 96: 0.2, 181: 0.25, 361: 0.35}
    cells = [
        One(solver, lights, cameras, noise, speed * times[lights], error, error, fast=speed == 1)
        for noise in (0.001, 0.02)
        for solver, speed in (("separable", 1), ("paper", 20))
        for lights, error in errors.items()
        for cameras in (1, 4)
    ]
    figure = speed_error_figure(cells, title="")
    figure.draw_without_rendering()
    for axes in figure.axes[:2]:
        boxes = {text.get_text(): Text.get_window_extent(text) for text in axes.texts}
        assert set(boxes) == {str(n) for n in errors}
        assert not any(a.overlaps(b) for a, b in combinations_of(boxes.values(), 2))
        places = axes.transData.transform(
            [(times[n], min(max(e, 1e-5), 1)) for n, e in errors.items()]
        )
        marker = 6.5 / 2 * figure.dpi / 72
        points = [
            Bbox.from_extents(x - marker, y - marker, x + marker, y + marker) for x, y in places
        ]
        assert not any(box.overlaps(point) for box in boxes.values() for point in points)
        assert all(axes.bbox.containsx(box.x0) for box in boxes.values())


def test_a_figure_of_one_solver_without_a_front_has_its_numbers() -> None:
    cells = [replace(c, fast=False) for c in combinations(0.005) if c.solver == "paper"]
    figure = speed_error_figure([c for c in cells if c.cameras == 4], title="")
    assert {text.get_text() for text in figure.axes[0].texts} == {"12", "48", "361"}
    assert "pale: fewer cameras" not in {text for text, _ in texts_on_the_page(figure)}


def test_other_precisions_are_left_to_the_table() -> None:
    cells = combinations(0.005)
    more = [replace(c, precision="float16") for c in cells]
    assert drawn_points(speed_error_figure([*cells, *more], title="")) == len(cells)


def test_errors_that_no_axis_has_are_drawn_at_its_ends(tmp_path: Path) -> None:
    cells = combinations(0.005)
    strange = [
        replace(cells[0], brdf_95=math.inf),
        replace(cells[1], brdf_95=math.nan, brdf=math.nan),
        replace(cells[2], brdf_95=0.0, brdf=0.0),
        *cells[3:],
    ]
    figure = speed_error_figure(strange, title="")
    for axes in figure.axes:
        for line in axes.get_lines():
            y = np.asarray(line.get_ydata(), dtype=float)
            assert ((y >= 1e-5) & (y <= 1.0)).all()
    picture = imread(plot_speed_error(strange, tmp_path / "a.png", title="strange"))
    assert picture[..., :3].std() > 0.05  # not one even colour
