"""``tvbrdf node info``."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

from .._common import Subparsers, add_json_option, add_run_option, add_verb, open_run, print_json
from .list import describe

if TYPE_CHECKING:
    from tvbrdf_messages.run_directory import Graph

DIAGNOSTICS_S = 2.5
"""Every node tells how it is once a second."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "info", run, "tell about one node")
    parser.add_argument("node", help="its name, e.g. camera_1")
    add_run_option(parser)
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from ...errors import RunError, did_you_mean
    from ...process_table import read_processes

    directory, graph = open_run(arguments)
    known = [p.name for p in graph.participants]
    if arguments.node not in known:
        hint = did_you_mean(arguments.node, known, "there are")
        raise RunError(f"no node {arguments.node!r} in this run; {hint}")
    participant = graph.find(arguments.node)
    row = describe(participant, read_processes(directory))
    row["subscribers"] = _typed(participant.takes)
    row["publishers"] = _typed(participant.gives)
    row["parameters"] = participant.parameters
    row["log"] = str(directory / f"{arguments.node}.log")
    if row["state"] == "alive":
        row["diagnostics"] = _diagnostics(graph, arguments.node)
    if arguments.json:
        print_json(row)
    else:
        _print(row)
    return 0


def _typed(topics: tuple[str, ...]) -> dict[str, str]:
    from tvbrdf_messages.topics import find_topic

    return {topic: find_topic(topic).type.__name__ for topic in topics}


def _diagnostics(graph: Graph, name: str) -> dict[str, Any] | None:
    """Return the next word of a node on how it is; None if none comes."""
    from tvbrdf_messages.bus.watcher import Watcher
    from tvbrdf_messages.messages import Diagnostics

    if name not in graph.publishers("/diagnostics"):
        return None
    with Watcher(graph, ["/diagnostics"]) as watcher:
        for envelope in watcher.until(time.monotonic() + DIAGNOSTICS_S):
            message = envelope.message
            if isinstance(message, Diagnostics) and message.node == name:
                return {
                    "state": message.state,
                    "text": message.text,
                    "missing_readers": list(message.missing_readers),
                    "counters": message.counters,
                    "resident_mb": message.resident_mb,
                }
    return None


def _print(row: dict[str, Any]) -> None:
    print(row["name"])
    for title, key in (("Subscribers", "subscribers"), ("Publishers", "publishers")):
        print(f"  {title}:")
        for topic, kind in row[key].items():
            print(f"    {topic}: {kind}")
    print("  Parameters:")
    for name, value in row["parameters"].items():
        print(f"    {name}: {value}")
    print(f"  Class: {row['node']}")
    if row["driver"]:
        print(f"  Driver: {row['driver']}")
    print(f"  Process: {row['pid']} ({row['state']}, restarts: {row['restarts']})")
    print(f"  Log: {row['log']}")
    found = row.get("diagnostics")
    if found:
        print(f"  Diagnostics: {found['state']} {found['text']}".rstrip())
        for name, value in found["counters"].items():
            print(f"    {name}: {value}")
        print(f"    resident_mb: {found['resident_mb']:.1f}")
