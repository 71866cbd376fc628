"""YAML in which every value knows its line.

Plain values follow the YAML 1.2 core rules, not the 1.1 ones of the library's default: ``on`` is a
text, ``1e-3`` a number and ``12:30`` no count of seconds. Tags, duplicate keys and loops of
aliases are refused.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from .errors import LaunchError, Place

_BASE: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_PREFIX = "tag:yaml.org,2002:"


class _Loader(_BASE):  # type: ignore[misc]
    yaml_implicit_resolvers: dict[Any, Any] = {}  # noqa: RUF012 - the library's own protocol


for _kind, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
):
    _Loader.add_implicit_resolver(_PREFIX + _kind, re.compile(f"^(?:{_pattern})$"), _first)


@dataclass(frozen=True, slots=True)
class Item:
    """A value with its line.

    ``value`` is a plain value, a list of items or a mapping of names to items; an item in a mapping
    has the line of its key.
    """

    value: Any
    place: Place

    def plain(self) -> Any:
        """Return the value without lines."""
        if isinstance(self.value, dict):
            return {key: item.plain() for key, item in self.value.items()}
        if isinstance(self.value, list):
            return [item.plain() for item in self.value]
        return self.value

    def find(self, key: str) -> Item | None:
        """Return the first item below that has this key, at any depth."""
        if isinstance(self.value, dict):
            if key in self.value:
                return self.value[key]  # type: ignore[no-any-return]
            below = list(self.value.values())
        else:
            below = self.value if isinstance(self.value, list) else []
        return next((found for item in below if (found := item.find(key)) is not None), None)


def as_item(value: Any, place: Place) -> Item:
    """Return a plain value as an item whose parts all have the same place."""
    if isinstance(value, dict):
        return Item({key: as_item(part, place) for key, part in value.items()}, place)
    if isinstance(value, (list, tuple)):
        return Item([as_item(part, place) for part in value], place)
    return Item(value, place)


def load_items(path: Path) -> Item:
    """Return the document in a YAML file.

    Raises
    ------
    LaunchError
        With file and line, if the file can't be read or is not such YAML.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise LaunchError(f"can't read it: {error.strerror}", Place(path, 0)) from error
    try:
        text = raw.decode()
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        raise LaunchError("not UTF-8 text", Place(path, line)) from error
    return _compose(text, path)


def parse_value(text: str, path: Path) -> Any:
    """Return the plain value that ``text`` has in YAML, e.g. of ``[0.2, 4]``."""
    return _compose(text, path).plain()


def _compose(text: str, path: Path) -> Item:
    try:
        root = yaml.compose(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = Place(path, mark.line + 1 if mark else 1)
        raise LaunchError(f"not YAML: {error.problem or error.context}", place) from error
    except (yaml.YAMLError, RecursionError) as error:
        raise LaunchError(f"not YAML: {error}".splitlines()[0], Place(path, 1)) from error
    if root is None:
        return Item(None, Place(path, 1))
    return _convert(root, path, Place(path, root.start_mark.line + 1), ())


def _convert(node: Any, path: Path, place: Place, above: tuple[int, ...]) -> Item:
    if id(node) in above:
        raise LaunchError("an alias that contains itself", place)
    above = (*above, id(node))
    if isinstance(node, yaml.SequenceNode):
        _check_tag(node, "seq", place)
        items = [_convert(n, path, Place(path, n.start_mark.line + 1), above) for n in node.value]
        return Item(items, place)
    if isinstance(node, yaml.MappingNode):
        _check_tag(node, "map", place)
        return Item(_convert_pairs(node, path, above), place)
    return Item(_convert_scalar(node.tag.removeprefix(_PREFIX), node.value, place), place)


def _convert_pairs(node: Any, path: Path, above: tuple[int, ...]) -> dict[str, Item]:
    pairs: dict[str, Item] = {}
    for key_node, value_node in node.value:
        at = Place(path, key_node.start_mark.line + 1)
        if not isinstance(key_node, yaml.ScalarNode) or key_node.tag != _PREFIX + "str":
            raise LaunchError("a key that is no text; put it in quotes", at)
        key = key_node.value
        if key in pairs:
            raise LaunchError(
                f"key {key!r} a second time; first in line {pairs[key].place.line}", at
            )
        pairs[key] = _convert(value_node, path, at, above)
    return pairs


def _check_tag(node: Any, kind: str, place: Place) -> None:
    if node.tag != _PREFIX + kind:
        raise LaunchError(f"tag {node.tag!r}; launch files have no tags", place)


def _convert_scalar(kind: str, text: str, place: Place) -> Any:
    lower = text.lower()
    match kind:
        case "str":
            return text
        case "null":
            return None
        case "bool":
            return lower == "true"
        case "int":
            return int(text, {"0o": 8, "0x": 16}.get(lower[:2], 10))
        case "float" if lower.endswith((".inf", ".nan")):
            return math.nan if lower == ".nan" else -math.inf if text[0] == "-" else math.inf
        case "float":
            return float(text)
    raise LaunchError(f"tag {kind!r}; launch files have no tags", place)
