"""What the verbs share that watch a topic: options, the loop, and windows of numbers."""

from __future__ import annotations

import argparse
import math
import time
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING

from .._common import add_json_option, add_run_option, is_going_on, open_run, positive

if TYPE_CHECKING:
    from tvbrdf_messages.bus.watcher import Arrival
    from tvbrdf_messages.run_directory import Graph

LOOK_S = 0.5
"""How often it is looked whether the run still goes on."""
REPORT_S = 1.0


def add_watch_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of verbs that watch a topic."""
    parser.add_argument("topic", help="full name, e.g. /camera_1/frame")
    add_run_option(parser)
    parser.add_argument(
        "--duration", type=positive, metavar="SECONDS", help="end after that much real time"
    )
    add_json_option(parser)


def require_topic(graph: Graph, topic: str) -> None:
    """Raise unless the run has that topic."""
    from ...errors import RunError, did_you_mean

    known = list(graph.topics())
    if topic not in known:
        raise RunError(f"no topic {topic!r} in this run; {did_you_mean(topic, known)}")


def watch(arguments: argparse.Namespace, also: tuple[str, ...] = ()) -> Iterator[Arrival | None]:
    """Yield messages as they come, and None now and then, until the run or the time is over."""
    from tvbrdf_messages.bus.watcher import Watcher

    run, graph = open_run(arguments)
    require_topic(graph, arguments.topic)
    topics = [arguments.topic, *(topic for topic in also if graph.publishers(topic))]
    end_s = time.monotonic() + (arguments.duration or math.inf)
    with Watcher(graph, topics) as watcher:
        while (left_s := end_s - time.monotonic()) > 0:
            arrival = watcher.receive(min(LOOK_S, left_s))
            yield arrival
            if arrival is None and not is_going_on(run):
                return


class Window:
    """The last numbers of a series, with their mean, extremes and deviation."""

    def __init__(self, size: int) -> None:
        self.values: deque[float] = deque(maxlen=size)

    def summary(self) -> dict[str, float]:
        """Return mean, minimum, maximum, standard deviation and number."""
        values = self.values
        mean = math.fsum(values) / len(values)
        variance = math.fsum((value - mean) ** 2 for value in values) / len(values)
        return {
            "mean": mean,
            "min": min(values),
            "max": max(values),
            "std_dev": math.sqrt(variance),
            "window": len(values),
        }


class Ticker:
    """Says when a second has passed."""

    def __init__(self) -> None:
        self._next_s = time.monotonic() + REPORT_S

    def due(self) -> bool:
        """Return whether it is time for the next report."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return False
        self._next_s = now_s + REPORT_S
        return True
