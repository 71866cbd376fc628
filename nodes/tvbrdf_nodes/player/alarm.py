"""Real time for the player: a file number that is readable from a given moment on.

A poll's timeout is in whole milliseconds; the kernel's timers are a hundred times finer.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import time

_CLOEXEC, _NONBLOCK, _ABSOLUTE = os.O_CLOEXEC, os.O_NONBLOCK, 1


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class _TimerSpec(ctypes.Structure):
    _fields_ = (("interval", _Timespec), ("value", _Timespec))


class Alarm:
    """One timer of the kernel on the monotonic clock (timerfd; Python has it from 3.13 on)."""

    def __init__(self) -> None:
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._number: int = self._libc.timerfd_create(time.CLOCK_MONOTONIC, _CLOEXEC | _NONBLOCK)
        if self._number < 0:
            raise OSError(ctypes.get_errno(), "can't make a timer (timerfd_create)")
        self._set_ns = 0

    @staticmethod
    def now_ns() -> int:
        """Return the monotonic clock's time."""
        return time.monotonic_ns()

    def fileno(self) -> int:
        """Return what becomes readable."""
        return self._number

    def set(self, at_ns: int) -> None:
        """Go off at that moment, instead of at the one set before."""
        if at_ns == self._set_ns:
            return
        self._set_ns = at_ns
        seconds, nanoseconds = divmod(max(1, at_ns), 1_000_000_000)
        spec = _TimerSpec(_Timespec(0, 0), _Timespec(seconds, nanoseconds))
        if self._libc.timerfd_settime(self._number, _ABSOLUTE, ctypes.byref(spec), None) != 0:
            raise OSError(ctypes.get_errno(), "can't set a timer (timerfd_settime)")

    def clear(self) -> None:
        """Take note that it went off, if it did."""
        with contextlib.suppress(BlockingIOError):
            os.read(self._number, 8)
            self._set_ns = 0

    def close(self) -> None:
        """Give the file number back."""
        if self._number >= 0:
            os.close(self._number)
            self._number = -1
