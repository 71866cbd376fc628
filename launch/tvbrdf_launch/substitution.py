"""Substitutions in launch files: ``$(var name)``, ``$(run)`` and ``$(launch_dir)``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import LaunchError, Place, did_you_mean
from .yaml_items import Item, as_item

_SUBSTITUTION = re.compile(r"\$\(([^()]*)(\)?)")


@dataclass(frozen=True, slots=True)
class Scope:
    """What a launch file's substitutions stand for."""

    arguments: Mapping[str, Any]
    run: Path
    launch_directory: Path

    def lookup(self, text: str, place: Place) -> Any:
        """Return what stands between ``$(`` and ``)`` for."""
        words = text.split()
        match words:
            case ["run"]:
                return str(self.run)
            case ["launch_dir"]:
                return str(self.launch_directory)
            case ["var", name]:
                if name not in self.arguments:
                    hint = did_you_mean(name, self.arguments, "arguments")
                    raise LaunchError(f"no argument {name!r}; {hint}", place)
                return self.arguments[name]
        raise LaunchError(
            f"unknown substitution $({text}); there are $(var NAME), $(run) and $(launch_dir)",
            place,
        )


def substitute(item: Item, scope: Scope) -> Item:
    """Return the item with all substitutions made.

    A value that is one whole substitution keeps the type of what it stands for; within a text, the
    value is written out.
    """
    if isinstance(item.value, dict):
        return Item({key: substitute(i, scope) for key, i in item.value.items()}, item.place)
    if isinstance(item.value, list):
        return Item([substitute(i, scope) for i in item.value], item.place)
    if not isinstance(item.value, str) or "$(" not in item.value:
        return item
    return as_item(_substitute_text(item.value, scope, item.place), item.place)


def _substitute_text(text: str, scope: Scope, place: Place) -> Any:
    whole = _SUBSTITUTION.fullmatch(text)
    if whole and whole[2]:
        return scope.lookup(whole[1], place)

    def replace(match: re.Match[str]) -> str:
        if not match[2]:
            raise LaunchError(f"$( without its ) in {text!r}", place)
        return str(scope.lookup(match[1], place))

    return _SUBSTITUTION.sub(replace, text)
