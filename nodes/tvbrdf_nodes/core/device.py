"""What drivers share: how the shell waits for them, and how simulated ones reach the world."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

from .loading import load_class
from .parameters import ParameterError, build

if TYPE_CHECKING:
    from pathlib import Path

    from tvbrdf_messages.bus import Port
    from tvbrdf_messages.clock import RunClock

    from .node import Logger, NodeContext


class DeviceError(RuntimeError):
    """A device does not do what it should; the text names it and says what to do."""


class DriverContext(NamedTuple):
    """What a driver is given besides its own parameters."""

    name: str
    """Of the node that it serves, e.g. ``camera_1``."""
    clock: RunClock
    log: Logger
    run_directory: Path
    open_link: Callable[[], Port]
    """Opens the port ``<name>.device``, for simulated devices (see their ``link_topics``)."""


def make_driver(context: NodeContext, path: str, parameters: Mapping[str, Any]) -> Any:
    """Return a node's driver.

    Parameters
    ----------
    context
        The node's.
    path
        ``module:Class``.
    parameters
        The driver's own, as the launch file has them.

    Raises
    ------
    LoadingError
        If there is no such class.
    ParameterError
        If it won't have the parameters.
    """
    driver_class = load_class(path)
    try:
        own = build(driver_class.parameters_type, parameters)
    except ParameterError as error:
        text = f"{context.name}: driver_parameters: {error}"
        raise ParameterError("driver_parameters", text) from None
    return driver_class(
        own,
        DriverContext(
            name=context.name,
            clock=context.clock,
            log=context.log,
            run_directory=context.run_directory,
            open_link=lambda: context.open_link(f"{context.name}.device"),
        ),
    )


class Driver(Protocol):
    """What every driver has. Real ones are ``live``: they can't wait for a slow reader."""

    live: ClassVar[bool]

    def open(self) -> None:
        """Open the device, or raise :class:`DeviceError`."""
        ...

    def close(self) -> None:
        """Release it; may be called twice."""
        ...

    def waitables(self) -> Sequence[Any]:
        """Return what becomes readable when there is something to read."""
        ...

    def pending(self) -> bool:
        """Return whether there is more to read at once."""
        ...


Item = TypeVar("Item")


class ReaderThread(Generic[Item]):
    """Runs a blocking ``grab`` in a thread, and makes its results pollable.

    For devices whose library only blocks. ``grab`` returns an item, or None after its own
    time-out; an exception it raises is raised by :meth:`take`.
    """

    def __init__(self, grab: Callable[[], Item | None], name: str, depth: int = 64) -> None:
        self._grab = grab
        self._queue: queue.Queue[Item | Exception] = queue.Queue(depth)
        self._wake = os.eventfd(0, os.EFD_NONBLOCK)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def fileno(self) -> int:
        """Return what becomes readable with the first item."""
        return self._wake

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                item: Item | Exception | None = self._grab()
            except Exception as error:  # noqa: BLE001 - handed to the thread that asks
                item = error
            if item is None:
                continue
            with contextlib.suppress(queue.Full):  # the gap shows in what follows
                self._queue.put_nowait(item)
            if not self._stopping.is_set():
                os.eventfd_write(self._wake, 1)
            if isinstance(item, Exception):
                return

    def take(self) -> list[Item]:
        """Return what has come since the last call."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake)
        found: list[Item] = []
        while True:
            try:
                item = self._queue.get_nowait()
            except queue.Empty:
                return found
            if isinstance(item, Exception):
                raise item
            found.append(item)

    def stop(self) -> None:
        """End the thread; returns when it has ended."""
        self._stopping.set()
        self._thread.join()
        os.close(self._wake)
