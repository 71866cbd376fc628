"""``tvbrdf bag play``: publish what a bag holds, in a run of its own."""

from __future__ import annotations

import argparse
import json
import math
from typing import Any

from .._common import Subparsers, add_verb
from ._options import add_bag


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers, "play", run, "publish what a bag holds, as ros2 bag play does; never commands"
    )
    add_bag(parser)
    parser.add_argument(
        "-r",
        "--rate",
        type=_rate,
        default=1.0,
        metavar="RATE",
        help="bag time over real time (default 1); 0: as fast as the slowest lossless reader",
    )
    parser.add_argument(
        "--start-offset",
        type=_seconds,
        default=0.0,
        metavar="SECONDS",
        help="begin so long after the bag's first message",
    )
    parser.add_argument(
        "--until", type=_seconds, metavar="SECONDS", help="end so long after the first message"
    )
    parser.add_argument("-l", "--loop", action="store_true", help="begin anew at the end")
    parser.add_argument(
        "-p", "--pause", action="store_true", help="begin paused (see tvbrdf bag control)"
    )
    parser.add_argument("--topics", nargs="+", default=[], metavar="TOPIC", help="only these")
    parser.add_argument(
        "-m",
        "--remap",
        nargs="+",
        default=[],
        metavar="OLD:=NEW",
        help="other names of topics; both must carry the same",
    )
    parser.add_argument(
        "--run",
        dest="run_directory",
        metavar="DIR",
        help="where the run lives (default: $TVBRDF_RUN, else a new private directory)",
    )
    parser.add_argument("--plain", action="store_true", help="lines in place of a progress bar")


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from ..launch import launch

    values: dict[str, Any] = {
        "topics": arguments.topics,
        "remap": _remap(arguments.remap),
        "rate": arguments.rate,
        "start_offset_s": arguments.start_offset,
        "until_s": arguments.until,
        "loop": arguments.loop,
        "paused": arguments.pause,
    }
    _check(arguments.bag, values)
    words = [f"{name}:={json.dumps(value)}" for name, value in values.items()]
    return launch(
        "play",
        [f"bag:={arguments.bag.resolve()}", *words],
        run_directory=arguments.run_directory,
        plain=arguments.plain,
    )


def _check(bag: Any, values: dict[str, Any]) -> None:
    """Refuse what can't be played, in the words of the command line rather than of a file."""
    from tvbrdf_messages.bag import BagError
    from tvbrdf_nodes.player.selection import SelectionError
    from tvbrdf_nodes.player.source import BagSource

    from ...errors import RunError

    try:
        source = BagSource(bag, topics=tuple(values["topics"]), remap=values["remap"])
    except SelectionError as error:
        raise RunError(str(error)) from error
    if source.lacking:
        raise BagError(bag, f"has nothing on {', '.join(source.lacking)}; see tvbrdf bag info")
    from tvbrdf_nodes.player.clock import PlaybackClock, PlaybackError

    settings = {name: values[name] for name in ("rate", "start_offset_s", "until_s", "loop")}
    try:
        PlaybackClock(source.first_ns, source.last_ns, **settings)
    except PlaybackError as error:
        raise RunError(f"{bag}: {error}") from error


def _remap(words: list[str]) -> dict[str, str]:
    from ...errors import RunError

    found: dict[str, str] = {}
    for word in words:
        old, separator, new = word.partition(":=")
        if not (separator and old and new):
            raise RunError(f"--remap {word!r} is not of the form OLD:=NEW")
        if old in found:
            raise RunError(f"--remap: {old} is given twice")
        found[old] = new
    return found


def _seconds(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value >= 0):
        raise argparse.ArgumentTypeError(f"{text} is not a number of 0 or more")
    return value


def _rate(text: str) -> float:
    from tvbrdf_nodes.player.clock import MAX_RATE

    value = float(text)
    if not 0 <= value <= MAX_RATE:
        raise argparse.ArgumentTypeError(f"{text} is not 0 to {MAX_RATE:g}")
    return value
