"""A message with its topic and header, as handlers receive it."""

from __future__ import annotations

import socket
import uuid
from functools import cache
from pathlib import Path
from typing import NamedTuple

from .schema import Message


class Header(NamedTuple):
    """Who sent a message, as which of its kind, and when what it tells happened.

    All times are integer nanoseconds: ``stamp_ns`` and ``received_ns`` on the run's clock,
    ``hardware_ns`` on the device's own; 0 where one does not apply.
    """

    publisher: str
    incarnation: str
    host: str
    boot_id: str
    sequence: int
    stamp_ns: int
    received_ns: int = 0
    hardware_ns: int = 0


class Envelope(NamedTuple):
    """A message on a topic. Sort by :func:`order` to become independent of arrival."""

    topic: str
    header: Header
    message: Message

    def order(self) -> tuple[str, str, str, int]:
        """Return the key in which joined inputs are worked through."""
        return (self.topic, self.header.publisher, self.header.incarnation, self.header.sequence)


_EPOCH_MARK = "~"


def in_epoch(incarnation: str, epoch: int) -> str:
    """Return an incarnation as it is in a later epoch of a replay (after a loop or a seek).

    A message tells its epoch itself: ``/clock`` has no order with other topics. So do those that
    nodes make of what is played.
    """
    return f"{incarnation}{_EPOCH_MARK}{epoch}"


def epoch_of(incarnation: str) -> int:
    """Return the epoch of a replay in which a message was sent; 0: no clock has jumped."""
    epoch = incarnation.rpartition(_EPOCH_MARK)[2] if _EPOCH_MARK in incarnation else ""
    return int(epoch) if epoch.isdecimal() else 0


def new_incarnation() -> str:
    """Return a name for one life of a process; a restarted one gets another."""
    return uuid.uuid4().hex[:12]


@cache
def host_name() -> str:
    """Return this host's name."""
    return socket.gethostname()


@cache
def boot_id() -> str:
    """Return this boot's id: monotonic clocks of one boot can be compared."""
    path = Path("/proc/sys/kernel/random/boot_id")
    return path.read_text().strip()[:13] if path.exists() else "unknown"
