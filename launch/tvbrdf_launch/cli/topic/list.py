"""``tvbrdf topic list``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from .._common import Subparsers, add_json_option, add_run_option, add_verb, open_run, print_json

if TYPE_CHECKING:
    from tvbrdf_messages.run_directory import Graph


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "list", run, "list the topics of a run")
    add_run_option(parser)
    parser.add_argument("-t", "--show-types", action="store_true", help="show the types too")
    parser.add_argument("-c", "--count-topics", action="store_true", help="print their number only")
    parser.add_argument(
        "-v", "--verbose", action="store_true", help="show types and numbers of nodes"
    )
    add_json_option(parser)


def describe(graph: Graph, topic: str) -> dict[str, Any]:
    """Return what the table of topics and the graph say of a topic."""
    from tvbrdf_messages.topics import find_topic

    row = find_topic(topic)
    takes = [p.name for p in graph.participants if topic in p.takes]
    return {
        "name": topic,
        "type": row.type.__name__,
        "quality": row.quality,
        "expected_rate_hz": row.rate_hz,
        "recorded": row.recorded,
        "latched": row.latched,
        "description": row.text,
        "publishers": list(graph.publishers(topic)),
        "subscribers": takes,
    }


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    _, graph = open_run(arguments)
    rows = [describe(graph, topic) for topic in graph.topics()]
    if arguments.json:
        print_json(rows)
    elif arguments.count_topics:
        print(len(rows))
    elif arguments.verbose:
        _print_side("Published topics:", rows, "publishers")
        _print_side("\nSubscribed topics:", rows, "subscribers")
    else:
        for row in rows:
            print(f"{row['name']} [{row['type']}]" if arguments.show_types else row["name"])
    return 0


def _print_side(title: str, rows: list[dict[str, Any]], side: str) -> None:
    print(title)
    for row in rows:
        number = len(row[side])
        if number:
            word = side if number != 1 else side.removesuffix("s")
            print(f" * {row['name']} [{row['type']}] {number} {word}")
