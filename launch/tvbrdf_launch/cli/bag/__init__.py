"""``tvbrdf bag``: what a run said, in files: look, select, put together, repair, check."""

from __future__ import annotations

from .._common import Subparsers
from . import check, control, export, filter, info, merge, play, record, recover

VERBS = (record, play, control, info, filter, merge, recover, export, check)


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb with its own verbs."""
    parser = subparsers.add_parser(
        "bag", help="record runs and play them; look at bags, cut, join and save them"
    )
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    for verb in VERBS:
        verb.add_parser(verbs)
