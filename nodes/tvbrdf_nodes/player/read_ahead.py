"""Reads a bag in a thread, ahead of the player: to unpack a chunk takes longer than it may wait."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

from tvbrdf_messages.envelope import Envelope

AHEAD_BYTES = 32 << 20
AHEAD_MESSAGES = 4096
"""So much is read ahead at most."""


class Item(NamedTuple):
    """A message to be played."""

    log_time_ns: int
    parts: list[bytes]
    """As on the bus."""
    size_bytes: int
    envelope: Envelope | None = None
    """The same, decoded, of topics by which the player knows what is to come of them."""


class ReadAhead:
    """A bounded queue that a thread fills.

    Parameters
    ----------
    read
        Called in the thread: gives the messages. What it raises is raised by :meth:`peek`, after
        the messages before.
    """

    def __init__(self, read: Callable[[], Iterator[Item]]) -> None:
        self._queue: deque[Item] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._stopped = self._read_all = self._is_full = False
        self._error: Exception | None = None
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._thread = threading.Thread(
            target=self._run, args=(read,), name="read_ahead", daemon=True
        )
        self._thread.start()

    def fileno(self) -> int:
        """Return what becomes readable when :meth:`peek` may have more than it had."""
        return self._wake

    def clear(self) -> None:
        """Take note of that."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake)

    def peek(self) -> Item | None:
        """Return the next message; None: none is there yet, or no more comes."""
        if self._queue:
            return self._queue[0]
        if self._read_all and not self._queue and self._error is not None:
            raise self._error
        return None

    def ended(self) -> bool:
        """Return whether all messages were taken."""
        return self._read_all and not self._queue and self._error is None

    def take(self) -> Item:
        """Remove and return the next message."""
        with self._changed:
            item = self._queue.popleft()
            self._bytes -= item.size_bytes
            if self._is_full and self._has_room():
                self._changed.notify()
        return item

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join()
        if self._wake >= 0:
            os.close(self._wake)
            self._wake = -1

    # -- in the thread

    def _full(self) -> bool:
        return self._bytes > AHEAD_BYTES or len(self._queue) >= AHEAD_MESSAGES

    def _has_room(self) -> bool:
        """Return whether half was taken: a thread that goes on for every message costs time."""
        return self._bytes <= AHEAD_BYTES // 2 and len(self._queue) <= AHEAD_MESSAGES // 2

    def _run(self, read: Callable[[], Iterator[Item]]) -> None:
        try:
            for item in read():
                if not self._put(item):
                    return
        except Exception as error:  # noqa: BLE001 - the player tells it
            self._error = error
        self._read_all = True
        os.eventfd_write(self._wake, 1)

    def _put(self, item: Item) -> bool:
        with self._changed:
            self._is_full = self._full()
            while self._is_full and not self._stopped:
                self._changed.wait()
                self._is_full = not self._has_room()
            if self._stopped:
                return False
            was_empty = not self._queue
            self._queue.append(item)
            self._bytes += item.size_bytes
        if was_empty:
            os.eventfd_write(self._wake, 1)
        return True
