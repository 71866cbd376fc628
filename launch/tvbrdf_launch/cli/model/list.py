"""``tvbrdf model list``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from .._common import Subparsers, add_json_option, add_verb, print_json, print_table
from ._models import short_names


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "list", run, "list the reflectance models that names may use")
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    rows = [*_models(), *_sums()]
    if arguments.json:
        print_json(rows)
        return 0
    shown = [
        {**row, "options": ", ".join(row["options"]), "summary": row["summary"] + _aliases(row)}
        for row in rows
    ]
    print_table(shown, ("name", "options", "symbols", "summary"))
    print(
        "\nA name is one model, with options in brackets, or a sum, as in "
        "'oren_nayar+torrance_sparrow(coloured)'\nor by aliases 'ON+TS(coloured)'; a layer comes "
        "first. [bgr]: one a channel."
    )
    return 0


def _aliases(row: dict[str, Any]) -> str:
    return "".join(f", alias {alias!r}" for alias in row["aliases"])


def _models() -> Iterator[dict[str, Any]]:
    """Yield what there is to know of each registered model, without options."""
    from tvbrdf_fitting.models import SURFACE, get_model, registered

    below = get_model(SURFACE)
    for entry in registered().values():
        model = get_model(f"{entry.name}+{SURFACE}" if entry.over else entry.name)
        surface = below.parameter_names if entry.over else ()
        own = [p for p in model.parameters if p.name not in surface]
        yield {
            "name": entry.name,
            "aliases": [entry.alias] if entry.alias else [],
            "options": [*entry.options],
            "exclusive": [[*group] for group in entry.exclusive],
            "layer": entry.over,
            "delta": model.delta,
            "reciprocal": model.reciprocal,
            "parameters": [p.name for p in own],
            "symbols": short_names(own),
            "summary": entry.summary,
        }


def _sums() -> Iterator[dict[str, Any]]:
    """Yield the sums in common use, and the aliases."""
    from tvbrdf_fitting.models import ALIASES, catalogue, get_model, split

    names = [n for n in catalogue() if "+" in n and not any(part.over for part, _ in split(n))]
    for name in dict.fromkeys([*names, *ALIASES.values()]):
        model = get_model(name)
        yield {
            "name": name,
            "aliases": [alias for alias, full in ALIASES.items() if full == name],
            "options": [],
            "exclusive": [],
            "layer": False,
            "delta": model.delta,
            "reciprocal": model.reciprocal,
            "parameters": [*model.parameter_names],
            "symbols": short_names(model.parameters),
            "summary": "sum in common use",
        }
