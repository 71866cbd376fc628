"""Ports of a graph, opened and pumped by hand, for the tests of the buses."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from tvbrdf_messages.bus import InProcessPort, ZmqPort
from tvbrdf_messages.envelope import Envelope

DEADLINE_S = 20.0
P = TypeVar("P", ZmqPort, InProcessPort)


class Bench(Generic[P]):
    """Opens ports of one kind, serves them until something is so, and closes them."""

    def __init__(self, open_port: Callable[..., P]) -> None:
        self._open: Callable[..., P] = open_port
        self.ports: list[P] = []

    def port(self, name: str, **options: Any) -> P:
        """Open a participant's port."""
        port: P = self._open(name, **options)
        self.ports.append(port)
        return port

    def open(self, *names: str) -> list[P]:
        """Open ports, and wait until each has all its readers."""
        ports = [self.port(name) for name in names]
        self.pump(lambda: not any(port.missing_readers() for port in ports))
        return ports

    def drop(self, port: P) -> None:
        """Close a port, as when its process dies."""
        self.ports.remove(port)
        port.close()

    def close(self) -> None:
        """Close all ports."""
        while self.ports:
            self.drop(self.ports[-1])

    def pump(self, done: Callable[[], object]) -> None:
        """Serve all ports until something is so."""
        deadline = time.monotonic() + DEADLINE_S
        while not done():
            assert time.monotonic() < deadline, "it did not happen in time"
            for port in self.ports:
                if isinstance(port, ZmqPort):
                    port.service()

    def collect(self, port: P, count: int, limit: int = 64) -> list[Envelope]:
        """Read so many messages or more."""
        found: list[Envelope] = []

        def enough() -> bool:
            found.extend(port.receive(limit))
            return len(found) >= count

        self.pump(enough)
        return found
