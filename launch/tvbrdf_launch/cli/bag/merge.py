"""``tvbrdf bag merge``."""

from __future__ import annotations

import argparse
from pathlib import Path

from .._common import Subparsers, add_json_option, add_verb, print_json
from ._options import add_out, print_edit


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "merge", run, "put bags together; each message comes once")
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="files or folders")
    add_out(parser)
    parser.add_argument(
        "--different-runs", action="store_true", help="also if they were recorded in different runs"
    )
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from tvbrdf_messages.bag import merge_bags

    report = merge_bags(arguments.bags, arguments.out, different_runs=arguments.different_runs)
    if arguments.json:
        print_json(report.plain())
    else:
        print_edit(report, "that had come already")
    return 0
