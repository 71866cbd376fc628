"""``tvbrdf bag control``: pause, step and move a bag that is being played."""

from __future__ import annotations

import argparse
from typing import Any

from .._common import (
    Subparsers,
    add_json_option,
    add_run_option,
    add_timeout_option,
    add_verb,
    open_run,
    require_going_on,
    tell,
)

PLAIN = ("pause", "resume", "toggle", "step", "status")
WITH_NUMBER = {"seek": "seconds", "rate": "rate"}
PLAYER = "tvbrdf_nodes.player.node:PlayerNode"


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers, "control", run, "pause, go on with, step or move a bag that is being played"
    )
    parser.add_argument("action", choices=(*PLAIN, *WITH_NUMBER), help="what it shall do")
    parser.add_argument(
        "value",
        nargs="?",
        type=float,
        help="of seek: seconds after the bag's first message; of rate: bag time over real time",
    )
    add_run_option(parser)
    add_json_option(parser)
    add_timeout_option(parser, 10.0)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from tvbrdf_messages.bus.watcher import ServiceClient

    from ...errors import RunError

    fields: dict[str, Any] = {}
    name = WITH_NUMBER.get(arguments.action)
    if (arguments.value is None) != (name is None):
        needs = f"needs a number: {name}" if name else "takes no number"
        raise RunError(f"tvbrdf bag control {arguments.action} {needs}")
    if name:
        fields[name] = arguments.value
    run_directory, graph = open_run(arguments)
    require_going_on(run_directory)
    players = [p.name for p in graph.participants if p.node == PLAYER]
    if not players:
        raise RunError(f"the run in {run_directory} plays no bag")
    with ServiceClient(graph, players[0]) as client:
        return tell(client.ask(arguments.action, fields, arguments.timeout), arguments.json)
