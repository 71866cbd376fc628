"""``tvbrdf topic``: look at the messages of a run, as with ``ros2 topic``."""

from __future__ import annotations

from .._common import Subparsers
from . import bw, delay, echo, hz, info, list

VERBS = (list, info, echo, hz, bw, delay)


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb with its own verbs."""
    parser = subparsers.add_parser("topic", help="list, echo and measure the topics of a run")
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    for verb in VERBS:
        verb.add_parser(verbs)
