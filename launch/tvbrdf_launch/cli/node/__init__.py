"""``tvbrdf node``: look at the nodes of a run, as with ``ros2 node``."""

from __future__ import annotations

from .._common import Subparsers
from . import info, list

VERBS = (list, info)


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb with its own verbs."""
    parser = subparsers.add_parser("node", help="list the nodes of a run, tell about one")
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    for verb in VERBS:
        verb.add_parser(verbs)
