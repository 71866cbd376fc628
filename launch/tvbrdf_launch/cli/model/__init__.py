"""``tvbrdf model``: the reflectance models, and how physical they are."""

from __future__ import annotations

from .._common import Subparsers
from . import check, info, list

VERBS = (list, info, check)


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb with its own verbs."""
    parser = subparsers.add_parser("model", help="list, explain and check the reflectance models")
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    for verb in VERBS:
        verb.add_parser(verbs)
