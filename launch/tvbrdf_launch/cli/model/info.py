"""``tvbrdf model info``."""

from __future__ import annotations

import argparse
import inspect
from typing import Any

from .._common import Subparsers, add_json_option, add_verb, print_json, print_table
from ._models import find_model, plain


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "info", run, "tell formula, source and parameters of a model")
    parser.add_argument("name", help="a model, a sum or an alias, e.g. oren_nayar or ON+TS")
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    row = describe(arguments.name)
    if arguments.json:
        print_json(row)
        return 0
    print(row["name"])
    promises = ("reciprocal", "nonnegative", "isotropic")
    print("".join(f"  {name if row[name] else 'not ' + name}" for name in promises))
    if row["delta"]:
        print("  a delta function of the direction: for rendering, not for fits")
    print("\nParameters")
    shown = [
        {**p, "lower": _bound(p["lower"], "-inf"), "upper": _bound(p["upper"], "inf")}
        for p in row["parameters"]
    ]
    print_table(shown, ("name", "unit", "lower", "upper", "typical", "internal"))
    for first, second in row["confounded"]:
        print(f"  data may be unable to tell {first} from {second}")
    for part in row["parts"]:
        title = f"{part['name']}: {part['summary']}"
        options = ", ".join(part["options"])
        print(f"\n{title}{f' (options: {options})' if options else ''}\n")
        print(part["text"])
    return 0


def describe(name: str) -> dict[str, Any]:
    """Return what there is to know of a model."""
    from tvbrdf_fitting.models import split

    model = find_model(name)
    parts = {entry.name: entry for entry, _ in split(model.name)}
    return {
        "name": model.name,
        "reciprocal": model.reciprocal,
        "nonnegative": model.nonnegative,
        "isotropic": model.isotropic,
        "delta": model.delta,
        "parameters": [
            {
                "name": p.name,
                "unit": p.unit,
                "lower": plain(p.lower),
                "upper": plain(p.upper),
                "typical": float(p.typical),
                "internal": p.internal_name,
                "channel": p.channel,
            }
            for p in model.parameters
        ],
        "confounded": [[*pair] for pair in model.confounded],
        "parts": [
            {
                "name": entry.name,
                "summary": entry.summary,
                "options": [*entry.options],
                "text": inspect.getdoc(inspect.getmodule(entry.build)) or "",
            }
            for entry in parts.values()
        ],
    }


def _bound(value: float | None, otherwise: str) -> str:
    return otherwise if value is None else f"{value:.6g}"
