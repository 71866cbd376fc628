"""``tvbrdf topic bw``."""

from __future__ import annotations

import argparse
from collections import deque

from .._common import Subparsers, add_verb, count, print_json
from ._watch import Ticker, Window, add_watch_options, watch


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "bw", run, "measure how many bytes a second a topic carries")
    add_watch_options(parser)
    parser.add_argument(
        "-w", "--window", type=count, default=100, metavar="COUNT", help="messages to average"
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    sizes, ticker = Window(arguments.window), Ticker()
    times_ns: deque[int] = deque(maxlen=arguments.window)
    try:
        for arrival in watch(arguments):
            if arrival is not None:
                sizes.values.append(arrival.size_bytes)
                times_ns.append(arrival.monotonic_ns)
            if ticker.due():
                _report(sizes, times_ns, arguments.json)
    except KeyboardInterrupt:
        pass
    _report(sizes, times_ns, arguments.json)
    return 0


def _report(sizes: Window, times_ns: deque[int], as_json: bool) -> None:
    from ...text import size

    if len(times_ns) < 2:
        if not as_json:
            print("no new messages", flush=True)
        return
    found = sizes.summary()
    elapsed_s = (times_ns[-1] - times_ns[0]) / 1e9
    # the first message only says when the count begins
    rate = (sum(sizes.values) - sizes.values[0]) / elapsed_s if elapsed_s > 0 else 0.0
    if as_json:
        print_json({"bytes_per_s": rate, "message_bytes": found})
        return
    print(f"{size(rate)}/s from {found['window']} messages")
    print(
        f"\tMessage size mean: {size(found['mean'])} min: {size(found['min'])} "
        f"max: {size(found['max'])}",
        flush=True,
    )
