"""A participant's place on the ZeroMQ bus."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import zmq

from ..envelope import Envelope, new_incarnation
from ..errors import StoppedError
from ..run_directory import Graph
from ..schema import Message
from .port import PortEvent
from .zmq_publisher import Ready, ZmqPublisher
from .zmq_subscriber import DEFAULT_CREDIT_BYTES, ZmqSubscriber

WAIT_MS = 100
"""How often a wait for credit looks whether it should end."""
COUNTED_START_S = 5.0
"""How long a start waits for counted readers, and theirs for publishers: after that without."""


class ZmqPort:
    """Publisher and subscriber of one participant over ZeroMQ (see :class:`.port.Port`).

    Parameters
    ----------
    graph, name
        The run's graph and this participant's name in it.
    context
        The process's one ZeroMQ context.
    stopping
        Asked while waiting for credit; True ends the wait.
    credit_bytes
        How much each publisher may have on its way to here.
    """

    def __init__(
        self,
        graph: Graph,
        name: str,
        context: zmq.Context[zmq.Socket[bytes]],
        *,
        stopping: Callable[[], bool] = lambda: False,
        credit_bytes: int = DEFAULT_CREDIT_BYTES,
    ) -> None:
        self.name = name
        self.incarnation = new_incarnation()
        self._stopping = stopping
        self._ready: Ready = None
        self._opened_s = time.monotonic()
        counted_bytes = graph.find(name).counted_bytes
        self._counted = counted_bytes > 0
        for channel in ("lossless", "latest"):
            # a socket file outlives a killed process; the launcher starts one process a name
            Path(graph.endpoint(name, channel).removeprefix("ipc://")).unlink(missing_ok=True)
        self.publisher = ZmqPublisher(graph, name, self.incarnation, context, self._wait_for_credit)
        self.subscriber = ZmqSubscriber(
            graph, name, self.incarnation, context, counted_bytes or credit_bytes
        )
        self._waiter = zmq.Poller()
        self._waiter.register(self.publisher.router, zmq.POLLIN)
        for link in self.subscriber.links:
            self._waiter.register(link.monitor, zmq.POLLIN)

    def sockets(self) -> list[zmq.Socket[bytes]]:
        """Return what to poll for reading."""
        return [self.publisher.router, self.publisher.watch, *self.subscriber.sockets()]

    def publish(
        self,
        topic: str,
        message: Message,
        *,
        stamp_ns: int,
        received_ns: int = 0,
        hardware_ns: int = 0,
        keep: str = "",
    ) -> bool:
        """See :meth:`.port.Port.publish`."""
        return self.publisher.publish(topic, message, (stamp_ns, received_ns, hardware_ns), keep)

    def forward(self, parts: Sequence[Any]) -> bool:
        """See :meth:`.port.Port.forward`."""
        return self.publisher.forward(list(parts))

    def begin_epoch(self, epoch: int) -> None:
        """See :meth:`.port.Port.begin_epoch`."""
        self.publisher.begin_epoch(epoch)

    def release(self, topic: str, key: str) -> None:
        """See :meth:`.port.Port.release`."""
        self.publisher.release(topic, key)

    def next_sequence(self, topic: str) -> int:
        """See :meth:`.port.Port.next_sequence`."""
        return self.publisher.next_sequence(topic)

    def receive(self, limit: int = 64) -> list[Envelope]:
        """See :meth:`.port.Port.receive`."""
        ready, self._ready = self._ready, None
        return self.subscriber.receive(limit, ready)

    def service(self, ready: Ready = None) -> None:
        """Handle registrations, credit and lost connections; never blocks.

        With the sockets that a poll of :meth:`sockets` found ``ready``, the others are not asked,
        also not by the next :meth:`receive`.
        """
        self._ready = ready
        self.subscriber.service(ready)
        self.publisher.service(ready)

    def flush(self) -> None:
        """Send small messages that wait to travel together; do it before waiting for anything."""
        self.publisher.flush()

    def events(self) -> list[PortEvent]:
        """See :meth:`.port.Port.events`."""
        found = self.publisher.events + self.subscriber.events
        self.publisher.events, self.subscriber.events = [], []
        return found

    def ready(self) -> bool:
        """Return whether all readers have registered here, and this one everywhere.

        What is counted is waited for a little while only.
        """
        registered = self.subscriber.registered()
        if self.publisher.missing_readers() or not (registered or self._counted):
            return False
        if registered and not self.publisher.lacks_counted():
            return True
        return time.monotonic() - self._opened_s > COUNTED_START_S

    def missing_readers(self) -> tuple[str, ...]:
        """See :meth:`.port.Port.missing_readers`."""
        return self.publisher.missing_readers()

    def counters(self) -> dict[str, Any]:
        """See :meth:`.port.Port.counters`."""
        publisher, subscriber = self.publisher, self.subscriber
        return {
            "sent": publisher.sent,
            "sent_bytes": publisher.sent_bytes,
            "undelivered": publisher.undelivered,
            "left_out": publisher.left_out,
            "received": subscriber.received,
            "received_bytes": subscriber.received_bytes,
            "gaps": subscriber.gaps,
            "repeats": subscriber.repeats,
            "refused": publisher.refused + subscriber.refused,
        }

    def _wait_for_credit(self) -> bool:
        """Wait a little for credit or a registration; raise when told to stop."""
        if self._stopping():
            raise StoppedError(f"{self.name} was stopped while a reader had no room")
        self._waiter.poll(WAIT_MS)
        self.service()
        return True

    def close(self) -> None:
        """See :meth:`.port.Port.close`."""
        self.subscriber.close()
        self.publisher.close()
