"""``tvbrdf topic delay``."""

from __future__ import annotations

import argparse

from .._common import Subparsers, add_verb, count, open_run, print_json
from ._watch import Ticker, Window, add_watch_options, watch


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers, "delay", run, "measure how old messages are: the run's clock minus their stamp"
    )
    add_watch_options(parser)
    parser.add_argument(
        "-w", "--window", type=count, default=10000, metavar="COUNT", help="messages to average"
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from tvbrdf_messages.clock import RunClock, SystemClock, ToldClock
    from tvbrdf_messages.messages import Clock

    _, graph = open_run(arguments)
    told = ToldClock(0)
    clock: RunClock = told if graph.simulated else SystemClock(graph.utc_ns, graph.monotonic_ns)
    window, ticker = Window(arguments.window), Ticker()
    try:
        for arrival in watch(arguments, also=("/clock",) if graph.simulated else ()):
            if arrival is not None:
                message = arrival.envelope.message
                if isinstance(message, Clock):
                    told.tell(message.now_ns, message.epoch)
                stamp_ns = arrival.envelope.header.stamp_ns
                if arrival.envelope.topic == arguments.topic and clock.now_ns():
                    window.values.append((clock.now_ns() - stamp_ns) / 1e9)
            if ticker.due():
                _report(window, arguments.json)
    except KeyboardInterrupt:
        pass
    _report(window, arguments.json)
    return 0


def _report(window: Window, as_json: bool) -> None:
    if not window.values:
        if not as_json:
            print("no new messages", flush=True)
        return
    found = window.summary()
    if as_json:
        print_json({"delay_s": found})
        return
    print(f"average delay: {found['mean']:.6f}")
    print(
        f"\tmin: {found['min']:.6f}s max: {found['max']:.6f}s "
        f"std dev: {found['std_dev']:.6f}s window: {found['window']}",
        flush=True,
    )
