"""``tvbrdf mark``: note something down, or say that this moment is t = 0."""

from __future__ import annotations

import argparse

from ._common import (
    Subparsers,
    add_json_option,
    add_run_option,
    add_timeout_option,
    add_verb,
    ask,
    tell,
)


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "mark", run, "note something into the database, with its time")
    parser.add_argument("text", nargs="+", help="the note, e.g. paint applied")
    parser.add_argument("--zero", action="store_true", help="this moment is t = 0")
    add_run_option(parser)
    add_json_option(parser)
    add_timeout_option(parser, 10.0)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    fields = {"text": " ".join(arguments.text), "zero": arguments.zero}
    reply = ask(arguments, "mark", fields, arguments.timeout)
    return tell(reply, arguments.json)
