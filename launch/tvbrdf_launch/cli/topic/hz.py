"""``tvbrdf topic hz``."""

from __future__ import annotations

import argparse

from .._common import Subparsers, add_verb, count, print_json
from ._watch import Ticker, Window, add_watch_options, watch


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "hz", run, "measure how often messages come")
    add_watch_options(parser)
    parser.add_argument(
        "-w", "--window", type=count, default=10000, metavar="COUNT", help="messages to average"
    )
    parser.add_argument(
        "--stamps",
        action="store_true",
        help="by the messages' stamps on the run's clock (simulation may run faster than time)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    window, ticker = Window(arguments.window), Ticker()
    last: dict[str, tuple[int, int]] = {}
    skipped = 0
    try:
        for arrival in watch(arguments):
            if arrival is not None:
                header = arrival.envelope.header
                at_ns = header.stamp_ns if arguments.stamps else arrival.monotonic_ns
                if header.publisher in last:
                    before_ns, sequence = last[header.publisher]
                    steps = header.sequence - sequence
                    if steps > 0:  # what this tool skipped counts too
                        skipped += steps - 1
                        window.values.append((at_ns - before_ns) / 1e9 / steps)
                last[header.publisher] = (at_ns, header.sequence)
            if ticker.due():
                _report(window, skipped, len(last), arguments.json)
    except KeyboardInterrupt:
        pass
    _report(window, skipped, len(last), arguments.json)
    return 0


def _report(window: Window, skipped: int, publishers: int, as_json: bool) -> None:
    if not window.values:
        if not as_json:
            print("no new messages", flush=True)
        return
    found = window.summary()
    # each publisher's own period was measured
    rate = publishers / found["mean"] if found["mean"] > 0 else 0.0
    if as_json:
        print_json({"rate_hz": rate, "skipped": skipped, "period_s": found})
        return
    print(f"average rate: {rate:.3f}")
    print(
        f"\tmin: {found['min']:.6f}s max: {found['max']:.6f}s "
        f"std dev: {found['std_dev']:.6f}s window: {found['window']}",
        flush=True,
    )
