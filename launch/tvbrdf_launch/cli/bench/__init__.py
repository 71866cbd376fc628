"""``tvbrdf bench``: how fast and how exact this machine fits."""

from __future__ import annotations

from .._common import Subparsers
from . import fit

VERBS = (fit,)


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb with its own verbs."""
    parser = subparsers.add_parser("bench", help="measure speed against error on this machine")
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    for verb in VERBS:
        verb.add_parser(verbs)
