"""``tvbrdf scan``: begin the next scan now."""

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
    parser = add_verb(
        subparsers, "scan", run, "begin the next scan now (for samples that the operator changes)"
    )
    add_run_option(parser)
    add_json_option(parser)
    add_timeout_option(parser, 10.0)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    return tell(ask(arguments, "scan", {}, arguments.timeout), arguments.json)
