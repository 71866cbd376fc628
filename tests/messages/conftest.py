"""Fixtures for the tests of the buses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import pytest
import zmq

from tests.messages.bus_bench import Bench
from tvbrdf_messages.bus import ZmqPort
from tvbrdf_messages.run_directory import Graph

MakeBench = Callable[[Graph], Bench[ZmqPort]]


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    made: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield made
    made.destroy(linger=0)  # also after a failure, when sockets are still open


@pytest.fixture
def zmq_bench(context: zmq.Context[zmq.Socket[bytes]]) -> Iterator[MakeBench]:
    """Give a function that makes a bench of ZeroMQ ports for a graph."""
    made: list[Bench[ZmqPort]] = []

    def make(graph: Graph) -> Bench[ZmqPort]:
        made.append(Bench(partial(_open, graph, context)))
        return made[-1]

    yield make
    for bench in made:
        bench.close()


def _open(
    graph: Graph, context: zmq.Context[zmq.Socket[bytes]], name: str, **options: object
) -> ZmqPort:
    return ZmqPort(graph, name, context, **options)  # type: ignore[arg-type]
