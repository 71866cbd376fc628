"""``tvbrdf bag check``."""

from __future__ import annotations

import argparse

from .._common import Subparsers, add_json_option, add_verb, print_json
from ._options import add_bag


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "check",
        run,
        "verify every checksum and message of a bag; the exit status is 1 if anything is wrong",
    )
    add_bag(parser)
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from tvbrdf_messages.bag import check_bag

    report = check_bag(arguments.bag)
    if arguments.json:
        print_json(report.plain())
    else:
        for problem in report.problems:
            print(f"{problem.kind}: {problem.text}")
        if report.more:
            print(f"and {report.more} more")
        verdict = "nothing wrong" if report.ok else f"{len(report.problems) + report.more} problems"
        print(f"{report.path}: {report.messages} messages, {verdict}")
    return 0 if report.ok else 1
