"""Parameters from launch files: what is taken, and what is refused how."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest

from tvbrdf_nodes.core.parameters import ParameterError, build


@dataclass(frozen=True, kw_only=True)
class Inner:
    width: int = 1


@dataclass(frozen=True, kw_only=True)
class Everything:
    """One field of each kind that a node may declare."""

    name: str
    rate_hz: float = 1.0
    count: int = 2
    flag: bool = False
    exposures_ms: tuple[float, ...] = (1.0,)
    cameras: tuple[str, ...] = ()
    region: tuple[int, ...] | None = None
    bit_depth: int | None = None
    anything: Any = None
    more: dict[str, Any] = field(default_factory=dict)
    inner: Inner = field(default_factory=Inner)
    hidden: int = field(default=5, init=False)

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError(f"count is {self.count}, expected 0 or more")


def test_defaults_are_the_classes_own() -> None:
    assert build(Everything, {"name": "x"}) == Everything(name="x")


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("rate_hz", 3, 3.0),  # a whole number is a number
        ("rate_hz", 2.5, 2.5),
        ("exposures_ms", [1, 2.5], (1.0, 2.5)),
        ("exposures_ms", (4.0,), (4.0,)),
        ("exposures_ms", [], ()),
        ("cameras", ["camera_1"], ("camera_1",)),
        ("region", None, None),
        ("region", [0, 0, 4, 4], (0, 0, 4, 4)),
        ("bit_depth", None, None),
        ("bit_depth", 12, 12),
        ("flag", True, True),
        ("anything", {"a": [1]}, {"a": [1]}),
        ("more", {"a": 1}, {"a": 1}),
        ("inner", {"width": 7}, Inner(width=7)),
    ],
)
def test_values_are_converted_to_what_is_declared(key: str, value: Any, expected: Any) -> None:
    found = getattr(build(Everything, {"name": "x", key: value}), key)
    assert found == expected
    assert type(found) is type(expected)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("name", 1),
        ("rate_hz", "1"),
        ("rate_hz", True),
        ("rate_hz", None),
        ("count", 2.0),
        ("count", True),
        ("flag", 1),
        ("flag", "true"),
        ("exposures_ms", 1.0),
        ("exposures_ms", "12"),
        ("exposures_ms", [1.0, "2"]),
        ("cameras", "camera_1"),
        ("region", 4),
        ("bit_depth", "12"),
        ("more", [1]),
        ("inner", 7),
    ],
)
def test_values_of_another_type_are_refused_by_name(key: str, value: Any) -> None:
    with pytest.raises(ParameterError, match=f"parameter '{key}' is .*expected") as caught:
        build(Everything, {"name": "x", key: value})
    assert caught.value.key == key


def test_a_missing_parameter_is_named() -> None:
    with pytest.raises(ParameterError, match="parameter 'name' is missing") as caught:
        build(Everything, {})
    assert caught.value.key == "name"


@pytest.mark.parametrize("key", ["rate_khz", "hidden"])
def test_an_unknown_parameter_is_named_with_the_nearest_known(key: str) -> None:
    with pytest.raises(ParameterError, match=f"unknown parameter '{key}'") as caught:
        build(Everything, {"name": "x", key: 1})
    assert caught.value.key == key
    if key == "rate_khz":
        assert "did you mean 'rate_hz'?" in str(caught.value)


def test_an_unknown_parameter_inside_another_is_named() -> None:
    with pytest.raises(ParameterError, match=r"unknown parameter 'widht'; did you mean 'width'\?"):
        build(Everything, {"name": "x", "inner": {"widht": 1}})


def test_values_out_of_range_are_refused_with_the_classes_own_words() -> None:
    with pytest.raises(ParameterError, match="count is -1, expected 0 or more"):
        build(Everything, {"name": "x", "count": -1})


def test_what_is_given_is_not_kept() -> None:
    """A later change of the launch file's values does not reach a node."""
    more = {"a": 1}
    found = build(Everything, {"name": "x", "more": more})
    more["a"] = 2
    assert found.more == {"a": 1}
