"""The wire between the simulated controller and its pseudo-terminal: delays, faults, stamps."""

from __future__ import annotations

import hashlib
import heapq
import math
import time

from .protocol import Message, annotate, encode
from .simulated_faults import PlannedFault


class Wire:
    """Turns messages into the bytes that a line monitor passes on, with its arrival stamps.

    Every delay is drawn by a counter-based generator, so a scene gives the same delays always.

    Parameters
    ----------
    seed
        Of the scene.
    latency_ns, jitter_ns
        Fixed delay each way, and mean of the exponential one on top.
    """

    def __init__(self, seed: int, latency_ns: int, jitter_ns: float) -> None:
        self._seed, self._latency_ns, self._jitter_ns = seed, latency_ns, jitter_ns
        self.waiting = bytearray()
        """Bytes that have not been written to the pseudo-terminal."""
        self.unplug_for_s: float | None = None
        """Set when the cable is to be pulled."""
        self._silent = False
        self._spoil: dict[str, PlannedFault] = {}
        self._left: dict[str, int] = {}
        self._late: list[tuple[float, int, bytes]] = []
        self._answers = 0
        self._last_arrival_ns = 0

    def take_fault(self, fault: PlannedFault) -> None:
        """Begin a fault of the wire."""
        if fault.kind == "silent":
            self._silent = True
        elif fault.kind == "unplug":
            self.unplug_for_s = fault.for_s
        else:
            self._spoil[fault.kind] = fault
            self._left[fault.kind] = fault.count

    def _next(self, kind: str) -> PlannedFault | None:
        """Return the fault that spoils the next line, if one does."""
        if self._left.get(kind, 0) == 0:
            return None
        self._left[kind] -= 1
        return self._spoil[kind]

    def _draw(self, what: str, counter: int) -> bytes:
        key = f"{self._seed}/arm/{what}/{counter}".encode()
        return hashlib.blake2b(key, digest_size=8).digest()

    def delay_ns(self, what: str, counter: int) -> int:
        """Return the delay of one way."""
        if self._jitter_ns == 0.0:
            return self._latency_ns
        uniform = (int.from_bytes(self._draw(what, counter), "big") + 1) * 2.0**-64
        return self._latency_ns + round(-self._jitter_ns * math.log(uniform))

    def report(self, message: Message, now_ns: int, tick: int) -> None:
        """Send a report or an event; of two that were sent one after the other, none overtakes."""
        line = encode(message)
        if self._next("wrong_checksum"):
            wrong = int(line[-5:-1], 16) ^ 0x0110
            line = b"%s%04X\n" % (line[:-5], wrong)
        if fault := self._next("lost_bytes"):
            at = self._draw("lost", tick)[0] % max(1, len(line) - 1 - fault.bytes)
            line = line[:at] + line[at + fault.bytes :]
        if fault := self._next("garbage"):
            line = self._noise(fault.bytes, tick)
        arrival_ns = max(self._last_arrival_ns, now_ns + self.delay_ns("report", tick))
        self._last_arrival_ns = arrival_ns
        # the monitor stamps what it sees as a line
        stamped = line.replace(b"\n", b"") + b"\n"
        self._put(annotate(stamped, arrival_ns))

    def _noise(self, count: int, tick: int) -> bytes:
        noise = b"".join(self._draw(f"noise/{i}", tick) for i in range(count // 8 + 1))
        return noise[:count].replace(b"\n", b"\x00")

    def answer(self, message: Message, now_ns: int) -> None:
        """Send an answer, stamped with the departure of its request and with its own arrival."""
        self._answers += 1
        sent_ns = now_ns - self.delay_ns("request", self._answers)
        arrival_ns = now_ns + self.delay_ns("answer", self._answers)
        fault = self._next("late_answers")
        if fault is None:
            self._put(annotate(encode(message), sent_ns, arrival_ns))
        else:
            line = annotate(encode(message), sent_ns, arrival_ns + round(1e9 * fault.delay_s))
            due_s = time.monotonic() + fault.delay_s
            heapq.heappush(self._late, (due_s, self._answers, line))

    def release_late(self) -> None:
        """Send the late answers whose time has come."""
        while self._late and self._late[0][0] <= time.monotonic():
            self._put(heapq.heappop(self._late)[2])

    def _put(self, line: bytes) -> None:
        if not self._silent:
            self.waiting += line
