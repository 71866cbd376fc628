"""Models by name. A module of this folder that has `REGISTERED` adds its models: no list to edit.

A name is that of one model, with options in brackets, or a sum: ``"lambert"``,
``"oren_nayar+torrance_sparrow(coloured)"``, parts by name or alias: ``"ON+TS(coloured)"``. ``dust``
comes first and lies over the rest.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pkgutil import iter_modules

from .base import ReflectanceModel
from .combination import SumModel


@dataclass(frozen=True)
class Registration:
    """One model that names may use.

    Attributes
    ----------
    name
        As used in names.
    summary
        One line for lists.
    build
        Takes the options given, as keyword arguments that are True.
    options
        What may stand in brackets; of each group in `exclusive` at most one.
    over
        True for a layer: `build` takes the models below as its first arguments.
    alias
        Another name for it.
    """

    name: str
    summary: str
    build: Callable[..., ReflectanceModel]
    options: tuple[str, ...] = ()
    exclusive: tuple[tuple[str, ...], ...] = ()
    over: bool = False
    alias: str = ""


_PART = re.compile(r"([A-Za-z_]+)(?:\(([a-z_, ]*)\))?")


@cache
def registered() -> dict[str, Registration]:
    """Return every registration by name, diffuse models first, found by looking into the folder."""
    found: list[Registration] = []
    package = __name__.rpartition(".")[0]
    for module in iter_modules(import_module(package).__path__):
        found += getattr(import_module(f"{package}.{module.name}"), "REGISTERED", ())
    return {entry.name: entry for entry in found}


@cache
def _by_any_name() -> dict[str, Registration]:
    entries = registered()
    return entries | {entry.alias: entry for entry in entries.values() if entry.alias}


def build(name: str) -> ReflectanceModel:
    """Return the model of a name (without the aliases of whole models).

    Raises
    ------
    ValueError
        Unknown model or option; the message lists what is known.
    """
    parts = split(name)
    layers = [index for index, (entry, _) in enumerate(parts) if entry.over]
    if layers:
        if layers != [0] or len(parts) == 1:
            raise ValueError(
                f"model {name!r}: {parts[layers[-1]][0].name} is a layer: it comes first, once, "
                f"and needs a surface below, as in 'dust+oren_nayar+torrance_sparrow'"
            )
        entry, options = parts[0]
        return entry.build(*(_single(e, o) for e, o in parts[1:]), **dict.fromkeys(options, True))
    models = [_single(entry, options) for entry, options in parts]
    return models[0] if len(models) == 1 else SumModel(models)


def split(name: str) -> list[tuple[Registration, tuple[str, ...]]]:
    """Return the parts of a name with their options, in the order of the registration."""
    return [_part(part.strip(), name) for part in name.split("+")]


def _single(entry: Registration, options: Sequence[str]) -> ReflectanceModel:
    return entry.build(**dict.fromkeys(options, True))


def _part(part: str, whole: str) -> tuple[Registration, tuple[str, ...]]:
    match = _PART.fullmatch(part)
    entry = _by_any_name().get(match[1]) if match else None
    if match is None or entry is None:
        raise ValueError(
            f"unknown model {part!r} in {whole!r}; known models: {', '.join(sorted(registered()))}"
            if part != whole
            else f"unknown model {part!r}; known models: {', '.join(sorted(registered()))}; sums "
            f"as in 'oren_nayar+torrance_sparrow' (= ON+TS)"
        )
    given = [option.strip() for option in (match[2] or "").split(",") if option.strip()]
    unknown = [option for option in given if option not in entry.options]
    if unknown:
        raise ValueError(
            f"model {entry.name!r} has no option {', '.join(map(repr, unknown))}; "
            f"it has {', '.join(entry.options) or 'none'}"
        )
    for group in entry.exclusive:
        both = [option for option in given if option in group]
        if len(both) > 1:
            raise ValueError(f"model {entry.name!r}: choose one of {', '.join(both)}")
    return entry, tuple(option for option in entry.options if option in given)


def label(name: str, *options: str) -> str:
    """Return a model's name with its options in brackets."""
    return f"{name}({','.join(options)})" if options else name
