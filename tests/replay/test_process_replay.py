"""What merger and fitter make of a recorded bag is what they made of it before."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.replay.process_replay import (
    ACCEPT,
    BAG,
    COMPARED,
    RELATIVE,
    RESULTS,
    compare,
    replay,
    stored_results,
    table,
)
from tvbrdf_messages.envelope import Envelope


@pytest.fixture(scope="module")
def stored() -> list[Envelope]:
    return stored_results()


def changed(stored: list[Envelope], topic: str, **fields: Any) -> list[Envelope]:
    """Return the results with some fields of a topic's messages replaced."""
    found = []
    for each in stored:
        message: Any = each.message
        if each.topic == topic:
            message = replace(message, **fields)
        found.append(each._replace(message=message))
    return found


def of(stored: list[Envelope], topic: str) -> Any:
    return next(each.message for each in stored if each.topic == topic)


def test_results_are_what_they_were(stored: list[Envelope]) -> None:
    assert {each.topic for each in stored} == set(COMPARED)
    moved = compare(stored, replay())
    assert not moved, table(moved)


def test_the_bag_is_small_and_names_no_machine() -> None:
    for path in (BAG, RESULTS):
        assert path.stat().st_size < 300_000
    assert b"/home" not in BAG.read_bytes()


def test_what_moved_is_told_with_how_much_and_how_to_accept_it(stored: list[Envelope]) -> None:
    parameters = of(stored, "/scan/parameters")
    values = (parameters.values[0] * (1 + 1e-6), *parameters.values[1:])
    (found,) = compare(stored, changed(stored, "/scan/parameters", values=values))
    assert found.field == "values[0]"
    assert found.change == pytest.approx(1e-6, rel=1e-3)
    text = table([found])
    assert "1.00e-06" in text
    assert ACCEPT in text
    assert f"{values[0]:.12g}" in text


@pytest.mark.parametrize(
    ("relative", "moves"), [(0.5 * RELATIVE, False), (2.0 * RELATIVE, True)], ids=["below", "above"]
)
def test_the_tolerance_is_of_the_largest_value(
    stored: list[Envelope], relative: float, moves: bool
) -> None:
    radiance = of(stored, "/scan/radiance").radiance.copy()
    radiance[3, 1] += relative * np.abs(radiance).max()
    now = changed(stored, "/scan/radiance", radiance=radiance)
    assert [each.field for each in compare(stored, now)] == (["radiance[3, 1]"] if moves else [])


def test_a_message_more_or_less_another_shape_and_another_text_are_told(
    stored: list[Envelope],
) -> None:
    assert compare(stored, stored) == []
    assert compare(stored, stored[:-1])[0].now == "nothing"
    assert compare(stored[:-1], stored)[0].stored == "nothing"
    radiance = of(stored, "/scan/radiance")
    fewer = changed(stored, "/scan/radiance", camera=radiance.camera[:-1])
    assert [each.field for each in compare(stored, fewer)] == ["camera"]
    wrong = changed(stored, "/scan/parameters", reason="other")
    assert [each.field for each in compare(stored, wrong)] == ["reason"]
    valid = ~radiance.valid
    assert [each.field for each in compare(stored, changed(stored, "/scan/radiance", valid=valid))]
    unknown = changed(stored, "/scan/parameters", chi_square=float("nan"))
    assert [each.field for each in compare(stored, unknown)] == ["chi_square"]
    assert compare(unknown, unknown) == []
