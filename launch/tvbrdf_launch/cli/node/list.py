"""``tvbrdf node list``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from .._common import (
    Subparsers,
    add_json_option,
    add_run_option,
    add_verb,
    open_run,
    print_json,
    print_table,
)

if TYPE_CHECKING:
    from tvbrdf_messages.run_directory import Participant

    from ...process_table import ProcessTable


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "list", run, "list the nodes of a run")
    add_run_option(parser)
    parser.add_argument("-c", "--count-nodes", action="store_true", help="print their number only")
    parser.add_argument("-v", "--verbose", action="store_true", help="with their processes")
    add_json_option(parser)


def describe(participant: Participant, table: ProcessTable) -> dict[str, Any]:
    """Return what the graph and the launcher know of a node."""
    record = table.nodes.get(participant.name)
    alive = record is not None and record.alive()
    return {
        "name": participant.name,
        "state": "alive" if alive else "ended",
        "pid": record.pid if record is not None else None,
        "restarts": record.incarnations - 1 if record is not None else 0,
        "exit_code": record.exit_code if record is not None else None,
        "node": participant.node,
        "driver": participant.driver,
    }


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from ...process_table import read_processes

    directory, graph = open_run(arguments)
    table = read_processes(directory)
    rows = [describe(p, table) for p in graph.participants if p.node]
    if arguments.json:
        print_json(rows)
    elif arguments.count_nodes:
        print(len(rows))
    elif arguments.verbose:
        print_table(rows, ("name", "state", "pid", "restarts", "node", "driver"))
    else:
        for row in rows:
            print(row["name"])
    return 0
