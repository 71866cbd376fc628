"""Whether the texts of a figure can be read."""

from __future__ import annotations

from itertools import combinations

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox


def texts_on_the_page(figure: Figure) -> list[tuple[str, Bbox]]:
    """Every text that is drawn, with its place, after a check that none is cut off."""
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()  # type: ignore[no-untyped-call]
    renderer = canvas.get_renderer()  # type: ignore[no-untyped-call]
    beyond, page = _ticks_beyond_the_axis(figure), figure.bbox
    found = []
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        if text.get_visible() and text.get_text().strip() and text not in beyond:
            box = text.get_window_extent(renderer)
            assert page.x0 <= box.x0 < box.x1 <= page.x1, f"{text} is cut off"
            assert page.y0 <= box.y0 < box.y1 <= page.y1, f"{text} is cut off"
            found.append((text.get_text(), box))
    return found


def _ticks_beyond_the_axis(figure: Figure) -> set[Text]:
    """Labels of ticks beyond an axis' limits: they exist, but are not drawn."""
    labels = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            for tick in axis.get_major_ticks() + axis.get_minor_ticks():
                if not low <= tick.get_loc() <= high:
                    labels |= {tick.label1, tick.label2}
    return labels


def check_labels(figure: Figure) -> None:
    """No text is cut off or overlaps another."""
    for (name, box), (other, its_box) in combinations(texts_on_the_page(figure), 2):
        assert not box.overlaps(its_box), f"{name} overlaps {other}"
