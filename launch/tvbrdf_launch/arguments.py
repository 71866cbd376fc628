"""Arguments of launch files: declared with type and default, given as ``key:=value``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from .errors import COMMAND_LINE, LaunchError, Place, did_you_mean
from .substitution import Scope, substitute
from .yaml_items import Item, parse_value

TYPES: dict[str, type] = {
    "str": str,
    "int": int,
    "float": float,
    "bool": bool,
    "list": list,
    "dict": dict,
}
REFUSALS = {
    "speedup": "; speedup is for rigs that are simulated altogether: real devices take real time"
}
"""What else to say of arguments that people will try."""


@dataclass(frozen=True, slots=True)
class Argument:
    """One argument that a launch file declares."""

    name: str
    type: str
    """``str``, ``int``, ``float``, ``bool``, ``list``, ``dict`` or, for none of them, ``any``."""
    default: Item | None
    """None: it must be given."""
    description: str
    choices: tuple[Any, ...]
    place: Place

    def convert(self, value: Any, place: Place) -> Any:
        """Return a value in the declared type, or raise :class:`LaunchError`."""
        given = value
        if isinstance(value, str) and self.type not in ("str", "any"):
            value = parse_value(value, place.file)
        if value is None and self.default is not None and self.default.value is None:
            return None
        if self.type == "float" and type(value) is int:
            value = float(value)
        if self.type != "any" and type(value) is not TYPES[self.type]:
            raise LaunchError(
                f"argument {self.name!r} is {given!r}, expected {self.type} "
                f"(declared in {self.place})",
                place,
            )
        if self.choices and value not in self.choices:
            allowed = ", ".join(map(str, self.choices))
            raise LaunchError(f"argument {self.name!r} is {value!r}, expected {allowed}", place)
        return value


def parse_assignments(words: Iterable[str]) -> dict[str, str]:
    """Return what ``key:=value`` words of a command line assign.

    Raises
    ------
    LaunchError
        If a word is not of that form or assigns a key again.
    """
    found: dict[str, str] = {}
    for word in words:
        key, separator, value = word.partition(":=")
        if not separator or not key.isidentifier():
            raise LaunchError(f"{word!r} is not of the form key:=value", COMMAND_LINE)
        if key in found:
            raise LaunchError(f"argument {key!r} is given twice", COMMAND_LINE)
        found[key] = value
    return found


def resolve(declared: Mapping[str, Argument], given: Mapping[str, Item], scope: Scope) -> Scope:
    """Return ``scope`` with a value for every declared argument.

    Defaults may refer to arguments declared before them.

    Raises
    ------
    LaunchError
        If one is missing, surplus or of the wrong type.
    """
    for name, item in given.items():
        if name not in declared:
            hint = did_you_mean(name, declared, "there are")
            text = f"unknown argument {name!r}; {hint}{REFUSALS.get(name, '')}"
            raise LaunchError(text, item.place)
    values: dict[str, Any] = {}
    for name, argument in declared.items():
        if name in given:
            item = given[name]
        elif argument.default is not None:
            so_far = Scope(values, scope.run, scope.launch_directory)
            item = substitute(argument.default, so_far)
        else:
            what = f" ({argument.description})" if argument.description else ""
            text = f"argument {name!r}{what} must be given: {name}:=VALUE"
            raise LaunchError(text, argument.place)
        values[name] = argument.convert(item.plain(), item.place)
    return Scope(values, scope.run, scope.launch_directory)
