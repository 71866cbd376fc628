"""Substitutions in launch files.

``$(var NAME)``, ``$(given NAME)``, ``$(equals NAME VALUE)``, ``$(run)``, ``$(launch_dir)``,
``$(scene KEY)``, ``$(bag KEY)``.

A scene's key is one of the simulated world: ``camera.motion_blur``; a bag's is what the recorded
run was given: ``cameras``.
"""

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

    def lookup(self, text: str, place: Place) -> Any:  # noqa: PLR0911 - one a substitution
        """Return what stands between ``$(`` and ``)`` for."""
        words = text.split()
        match words:
            case ["run"]:
                return str(self.run)
            case ["launch_dir"]:
                return str(self.launch_directory)
            case ["var", name]:
                return self._argument(name, place)
            case ["given", name]:
                return self._argument(name, place) not in ("", None)
            case ["equals", name, value]:
                return str(self._argument(name, place)) == value
            case ["scene", key]:
                return self._of_scene(key, place)
            case ["bag", key]:
                return self._of_bag(key, place)
        raise LaunchError(
            f"unknown substitution $({text}); there are $(var NAME), $(given NAME), "
            "$(equals NAME VALUE), $(run), $(launch_dir), $(scene KEY) and $(bag KEY)",
            place,
        )

    def _argument(self, name: str, place: Place) -> Any:
        if name not in self.arguments:
            hint = did_you_mean(name, self.arguments, "arguments")
            raise LaunchError(f"no argument {name!r}; {hint}", place)
        return self.arguments[name]

    def _of_bag(self, key: str, place: Place) -> Any:
        """Return a fact of the recorded run in the bag that the argument ``bag`` names."""
        from tvbrdf_messages.bag import BagError
        from tvbrdf_nodes.player.facts import BagFacts, bag_facts

        if key not in BagFacts.names():
            hint = did_you_mean(key, BagFacts.names(), "there are")
            raise LaunchError(f"a bag tells no {key!r}; {hint}", place)
        try:
            found = getattr(bag_facts(str(self._argument("bag", place))), key)
        except BagError as error:
            raise LaunchError(str(error), place) from error
        return list(found) if isinstance(found, tuple) else found

    def _of_scene(self, key: str, place: Place) -> Any:
        """Return a field of the scene that the arguments ``sample`` and ``effects`` name."""
        from tvbrdf_nodes.world.scene import SceneError, load_scene

        sample, effects = (str(self.lookup(f"var {n}", place)) for n in ("sample", "effects"))
        try:
            found: Any = load_scene(sample, effects, seed=0).as_dict()
        except SceneError as error:
            raise LaunchError(str(error), place) from error
        for part in key.split("."):
            if not isinstance(found, dict) or part not in found:
                raise LaunchError(f"a scene has no {key!r}, such as camera.motion_blur", place)
            found = found[part]
        return found


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
