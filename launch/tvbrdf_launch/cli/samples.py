"""``tvbrdf samples``: what can be put under the simulated rig."""

from __future__ import annotations

import argparse

from ._common import Subparsers, add_json_option, add_verb, print_json, print_table


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers, "samples", run, "list the samples and sets of effects for simulated rigs"
    )
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    import yaml

    from tvbrdf_nodes.world.scene import HERE, available

    rows = []
    for folder, kind in (("samples", "sample"), ("effects", "effects")):
        for name in available(folder):
            path = HERE / folder / f"{name}.yaml"
            text = path.read_text()
            raw = yaml.safe_load(text)
            row = {"kind": kind, "name": name, "description": _comment(text), "file": str(path)}
            if kind == "sample" and isinstance(raw, dict):
                row["material"] = str(raw.get("kind", ""))
            rows.append(row)
    if arguments.json:
        print_json(rows)
    else:
        print_table(rows, ("kind", "name", "description"))
        print("\nsample:=NAME effects:=NAME, a path of a .yaml file, or sample:=measured:FOLDER")
    return 0


def _comment(text: str) -> str:
    """Return the comment with which a file begins, on one line."""
    words = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        words.append(line.lstrip("# ").rstrip())
    return " ".join(words)
