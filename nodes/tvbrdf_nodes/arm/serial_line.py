"""Bytes over any pyserial URL, without blocking; errors name the port."""

from __future__ import annotations

import contextlib
import io
import select
from pathlib import Path
from typing import Any, NamedTuple

import serial

from tvbrdf_messages.clock import RunClock

from ..core.device import DeviceError, ReaderThread

WRITE_LIMIT_S = 0.5
READ_WAIT_S = 0.1
CHUNK_BYTES = 4096


class Chunk(NamedTuple):
    """Bytes, and when they were read on the run's clock."""

    data: bytes
    received_ns: int


class SerialLine:
    """An open serial port.

    Parameters
    ----------
    url
        Anything that ``serial.serial_for_url`` takes: a device's path, ``socket://host:port``,
        ``rfc2217://host:port``.
    baud_rate
        Bits a second; 8 data bits, no parity, 1 stop bit.
    clock
        The run's clock, for the stamps of what is read.

    Raises
    ------
    DeviceError
        If the port can't be opened.
    """

    def __init__(self, url: str, baud_rate: int, clock: RunClock) -> None:
        self.url = url
        self._clock = clock
        self._thread: ReaderThread[Chunk] | None = None
        try:
            self._port: Any = serial.serial_for_url(
                url,
                baudrate=baud_rate,
                timeout=0,
                exclusive=True if is_path(url) else None,
            )
        except (OSError, ValueError, NotImplementedError) as error:
            raise DeviceError(f"{url}: can't open the arm's port: {_text(error)}") from error
        with contextlib.suppress(OSError, ValueError, AttributeError):
            self._port.set_low_latency_mode(True)  # USB adapters hold bytes for 16 ms otherwise
        try:
            self._waitable: Any = self._port.fileno()
            self._port.write_timeout = 0
        except (AttributeError, io.UnsupportedOperation):
            self._port.timeout = READ_WAIT_S
            self._thread = ReaderThread(self._grab, "serial")
            self._waitable = self._thread.fileno()

    def _grab(self) -> Chunk | None:
        data = self._port.read(self._port.in_waiting or 1)
        return Chunk(data, self._clock.now_ns()) if data else None

    def fileno(self) -> int:
        """Return what becomes readable when bytes have come."""
        return int(self._waitable)

    def read(self) -> list[Chunk]:
        """Return what has come.

        Raises
        ------
        DeviceError
            If the port is gone.
        """
        try:
            if self._thread is not None:
                return self._thread.take()
            data = self._port.read(CHUNK_BYTES)
        except (OSError, TypeError) as error:  # pyserial lets a TypeError out of a closed port
            raise DeviceError(
                f"{self.url}: the arm's port is gone (unplugged?): {_text(error)}"
            ) from error
        return [Chunk(data, self._clock.now_ns())] if data else []

    def write(self, data: bytes) -> None:
        """Send bytes.

        Raises
        ------
        DeviceError
            If the port is gone, or takes no bytes for half a second.
        """
        try:
            while data:
                # pyserial's own limit strikes also where the machine stood still after the writing
                if self._thread is None and not self._takes_bytes():
                    raise DeviceError(
                        f"{self.url}: the arm's port takes no bytes for {WRITE_LIMIT_S} s; "
                        "check the cable and flow control"
                    )
                data = data[self._port.write(data) :]
        except (OSError, TypeError) as error:
            raise DeviceError(
                f"{self.url}: the arm's port is gone (unplugged?): {_text(error)}"
            ) from error

    def _takes_bytes(self) -> bool:
        return bool(select.select([], [self._waitable], [], WRITE_LIMIT_S)[1])

    def close(self) -> None:
        """Release the port; may be called twice."""
        if self._thread is not None:
            self._thread.stop()
            self._thread = None
        socket = getattr(self._port, "_socket", None)
        with contextlib.suppress(OSError):
            self._port.close()
        if socket is not None:  # pyserial leaves it open when the other end has gone first
            with contextlib.suppress(OSError):
                socket.close()


def is_path(url: str) -> bool:
    """Return whether a URL is a device of this machine."""
    return "://" not in url


def byte_time_ns(url: str, baud_rate: int) -> float:
    """Return how long one byte takes on the wire (10 bits); 0 where the baud rate says nothing.

    A pseudo-terminal imposes no baud rate, and behind a network address it is not known.
    """
    if not is_path(url) or str(Path(url).resolve()).startswith("/dev/pts/"):
        return 0.0
    return 10e9 / baud_rate


def _text(error: Exception) -> str:
    return str(error) or type(error).__name__
