"""``tvbrdf bag filter``."""

from __future__ import annotations

import argparse

from .._common import Subparsers, add_json_option, add_verb, print_json
from ._options import add_bag, add_out, add_topic_options, print_edit


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "filter", run, "write a selection of a bag into a new one")
    add_bag(parser)
    add_out(parser)
    add_topic_options(parser)
    parser.add_argument(
        "--start", type=float, metavar="SECONDS", help="since the bag's first message"
    )
    parser.add_argument(
        "--end", type=float, metavar="SECONDS", help="since the bag's first message"
    )
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from tvbrdf_messages.bag import BagReader, filter_bag

    with BagReader(arguments.bag) as bag:
        start_ns = bag.start_ns

    def moment(seconds: float | None) -> int | None:
        return None if seconds is None else start_ns + round(seconds * 1e9)

    report = filter_bag(
        arguments.bag,
        arguments.out,
        topics=arguments.topics,
        regex=arguments.regex,
        exclude=arguments.exclude,
        start_ns=moment(arguments.start),
        end_ns=moment(arguments.end),
    )
    if arguments.json:
        print_json(report.plain())
    else:
        print_edit(report, "that were not selected")
    return 0
