"""``tvbrdf arm``: move the light by hand, through the sequencer, when the rig is free."""

from __future__ import annotations

import argparse
from typing import Any

from ._common import (
    Subparsers,
    add_json_option,
    add_run_option,
    add_timeout_option,
    add_verb,
    ask,
    tell,
)

MOVE_S = 120.0
"""Default time-out of what moves."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = subparsers.add_parser("arm", help="home, jog or stop the arm; lamp on or off")
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    home = add_verb(verbs, "home", run, "find the arm's reference position")
    home.set_defaults(verb="home")
    jog = add_verb(verbs, "jog", run, "move the light to an angle")
    jog.add_argument("angle_deg", type=float, help="degrees, 0: above the sample")
    jog.set_defaults(verb="jog")
    stop = add_verb(
        verbs, "stop", run, "stop the arm and go on only when told (in danger: tvbrdf stop)"
    )
    stop.set_defaults(verb="stop")
    lamp = add_verb(verbs, "lamp", run, "switch the lamp")
    lamp.add_argument("switch", choices=("on", "off"))
    lamp.set_defaults(verb="lamp")
    for verb in (home, jog, stop, lamp):
        add_run_option(verb)
        add_json_option(verb)
        add_timeout_option(verb, MOVE_S if verb in (home, jog) else 10.0)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    fields: dict[str, Any] = {}
    if arguments.verb == "jog":
        fields["angle_deg"] = arguments.angle_deg
    elif arguments.verb == "lamp":
        fields["on"] = arguments.switch == "on"
    reply = ask(arguments, arguments.verb, fields, arguments.timeout)
    return tell(reply, arguments.json)
