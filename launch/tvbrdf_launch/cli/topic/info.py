"""``tvbrdf topic info``."""

from __future__ import annotations

import argparse

from .._common import Subparsers, add_json_option, add_run_option, add_verb, open_run, print_json
from ._watch import require_topic
from .list import describe


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "info", run, "tell about one topic")
    parser.add_argument("topic", help="full name, e.g. /camera_1/frame")
    add_run_option(parser)
    parser.add_argument("-v", "--verbose", action="store_true", help="name the nodes, and fields")
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from tvbrdf_messages.topics import find_topic

    _, graph = open_run(arguments)
    require_topic(graph, arguments.topic)
    row = describe(graph, arguments.topic)
    row["fields"] = {f.name: f.annotation for f in find_topic(arguments.topic).type.schema()}
    if arguments.json:
        print_json(row)
        return 0
    rate = f"{row['expected_rate_hz']:g} Hz" if row["expected_rate_hz"] else "on occasion"
    print(f"Type: {row['type']}")
    print(f"Description: {row['description']}")
    print(f"Quality: {row['quality']}{', latched' if row['latched'] else ''}")
    print(f"Expected rate: {rate}")
    print(f"Recorded: {'yes' if row['recorded'] else 'no'}")
    for title, key in (("Publisher", "publishers"), ("Subscription", "subscribers")):
        print(f"{title} count: {len(row[key])}")
        if arguments.verbose:
            for name in row[key]:
                print(f"  {name}")
    if arguments.verbose:
        print("Fields:")
        for name, annotation in row["fields"].items():
            print(f"  {name}: {annotation}")
    return 0
