"""Requests that a controller has not yet answered: sent again, or given up, in time."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from dataclasses import dataclass

from tvbrdf_messages.clock import RunClock

from ..core.awake_time import AwakeTime
from .protocol import MAX_ID, Answer, Request, encode

Handler = Callable[[Answer], None]


@dataclass(slots=True)
class Pending:
    """A request on its way."""

    request: Request
    line: bytes
    handler: Handler | None
    attempts: int
    deadline_s: float
    sent_ns: int
    """On the run's clock, when it was last sent."""


class PendingRequests:
    """Gives requests their numbers, and repeats those that stay without an answer.

    A repeated request keeps its number, so the controller carries it out once.

    Parameters
    ----------
    write
        Sends bytes.
    clock
        The run's clock, for the stamps of round trips.
    timeout_s
        Real time that an answer may take; a gap in which this process stood still is not counted.
    attempts
        How often a request is sent before it is given up.
    """

    def __init__(
        self, write: Callable[[bytes], None], clock: RunClock, timeout_s: float, attempts: int
    ) -> None:
        self._write, self._clock = write, clock
        self._timeout_s, self._attempts = timeout_s, attempts
        self._awake = AwakeTime()
        self._pending: dict[int, Pending] = {}
        # answers to an earlier life of this process must not be taken for answers to this one
        self._ids = itertools.count(random.randrange(1, MAX_ID // 2))
        self.repeated = 0

    def new_id(self) -> int:
        """Return a number that no request has had."""
        return next(self._ids)

    def ask(
        self,
        verb: str,
        *arguments: float,
        handler: Handler | None = None,
        request_id: int | None = None,
        once: bool = False,
    ) -> int:
        """Send a request, and return its number; ``once``: it is never repeated."""
        number = self.new_id() if request_id is None else request_id
        request = Request(number, verb, arguments)
        pending = Pending(request, encode(request), handler, 1 if once else self._attempts, 0.0, 0)
        self._pending[number] = pending
        self._send(pending)
        return number

    def _send(self, pending: Pending) -> None:
        pending.attempts -= 1
        pending.sent_ns = self._clock.now_ns()
        self._write(pending.line)
        pending.deadline_s = self._awake.now_s() + self._timeout_s

    def take(self, request_id: int) -> Pending | None:
        """Return and forget the request that an answer belongs to; None if there is none."""
        return self._pending.pop(request_id, None)

    def drop(self, *verbs: str) -> list[Pending]:
        """Forget requests that must not be sent again, and return them."""
        found = [p for p in self._pending.values() if p.request.verb in verbs]
        for pending in found:
            del self._pending[pending.request.request_id]
        return found

    def waiting(self, verb: str) -> bool:
        """Return whether a request of that verb is on its way."""
        return any(p.request.verb == verb for p in self._pending.values())

    def expire(self) -> list[Pending]:
        """Repeat what is late; return and forget what was sent often enough."""
        now_s = self._awake.now_s()
        given_up = []
        for number, pending in list(self._pending.items()):
            if pending.deadline_s > now_s:
                continue
            if pending.attempts > 0:
                self.repeated += 1
                self._send(pending)
            else:
                del self._pending[number]
                given_up.append(pending)
        return given_up
