"""Processes that work through shares of sources, and hand over scans soon after they are done."""

from __future__ import annotations

import gc
import importlib
import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import RunError
from .events import Event, Problem
from .settings import FRAMES
from .sources import input_errors

if TYPE_CHECKING:
    from .settings import Plan
    from .sources import Source, Unit

_STOP_S = 5.0
_TELL_S = 0.05
"""What is found meanwhile is handed over together: waking the one who writes costs both."""
_FOR_DATABASES = ("tvbrdf_nodes.database_writer.opening",)
_FOR_PUBLISHED = ("scipy.optimize", "tvbrdf_fitting.published.compiled")
_FOR_FRAMES = (
    "cv2",
    "tvbrdf_fitting.measurement.frame_reduction",
    "tvbrdf_fitting.measurement.light_grid",
    "tvbrdf_fitting.measurement.motion_blur",
)


@dataclass(frozen=True, slots=True)
class Task:
    """A share of a source."""

    number: int
    target: int
    """Index of the source among all."""
    source: Source
    unit: Unit
    plan: Plan


@dataclass(frozen=True, slots=True)
class Done:
    """The end of a task."""


def work(tasks: Sequence[Task], jobs: int) -> Iterator[tuple[Task, Event | Done]]:
    """Yield what comes of tasks, with one process here or several; each task ends with `Done`.

    What a task yields does not depend on ``jobs``; how tasks interleave does.

    Raises
    ------
    RunError
        If a process dies.
    """
    if jobs <= 1 or len(tasks) <= 1:
        for task in tasks:
            for event in _events(task):
                yield task, event
        return
    with _Pool(tasks, min(jobs, len(tasks))) as pool:
        yield from pool.run()


def _events(task: Task) -> Iterator[Event | Done]:
    """Yield what comes of a task; bad input ends this task, not the others."""
    from tvbrdf_nodes.core.device import DeviceError

    try:
        yield from task.source.work(task.unit, task.plan)
    except input_errors() as error:
        yield Problem(str(error))
    except (DeviceError, OSError, MemoryError) as error:
        yield Problem(f"{task.source.path}: {error}")
    yield Done()


def load(tasks: Sequence[Task] = ()) -> None:
    """Load what takes long; processes that are forked afterwards have it."""
    from tvbrdf_fitting.solve import separable

    separable.compile_all()
    names = ["tvbrdf_fitting.fit"]
    if any(task.source.keeps_radiance for task in tasks):
        names += _FOR_DATABASES
    if not all(task.source.keeps_radiance for task in tasks):
        names += _FOR_PUBLISHED
    if any(task.plan.start == FRAMES for task in tasks):
        names += _FOR_FRAMES
    for name in names:
        importlib.import_module(name)


def _threads() -> int:
    try:
        return sum(1 for _ in Path("/proc/self/task").iterdir())
    except OSError:
        return 2


class _Pool:
    """Forks its processes where that is safe, because compiled code takes seconds to load."""

    def __init__(self, tasks: Sequence[Task], count: int) -> None:
        method = "fork" if _threads() == 1 else "spawn"
        self._context: Any = multiprocessing.get_context(method)
        self._processes: list[Any] = []
        self._ends: list[Connection] = []
        self._tasks, self._count = tasks, count
        self._waiting = deque(range(len(tasks)))

    def __enter__(self) -> _Pool:
        try:
            for _ in range(self._count):
                mine, theirs = self._context.Pipe()
                process = self._context.Process(
                    target=_serve, args=(theirs, os.getpid(), self._tasks), daemon=True
                )
                process.start()
                theirs.close()
                self._processes.append(process)
                self._ends.append(mine)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for end in self._ends:
            end.close()
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join(_STOP_S)
            if process.is_alive():
                process.kill()
                process.join()
            process.close()

    def run(self) -> Iterator[tuple[Task, Event | Done]]:
        """Yield what comes of all tasks."""
        given: dict[Connection, deque[int]] = {end: deque() for end in self._ends}
        for end in self._ends:
            self._give(end, given[end])
        while busy := [end for end in self._ends if given[end]]:
            ready: list[Any] = wait(busy)
            for end in ready:
                task = self._tasks[given[end][0]]
                try:
                    events = end.recv()
                except (EOFError, OSError):
                    raise self._died(end, task) from None
                if isinstance(events[-1], Done):
                    given[end].popleft()
                    self._give(end, given[end])
                for event in events:
                    if isinstance(event, BaseException):
                        raise event
                    yield task, event

    def _give(self, end: Connection, given: deque[int]) -> None:
        """Give a process its next task; one more while many are left, so that it never waits."""
        while self._waiting and len(given) < 1 + (len(self._waiting) > 2 * self._count):
            given.append(self._waiting.popleft())
            with suppress(OSError):  # one that died is found when it is listened to
                end.send(given[-1])

    def _died(self, end: Connection, task: Task) -> RunError:
        process = self._processes[self._ends.index(end)]
        process.join(_STOP_S)
        code = process.exitcode
        why = f"signal {-code}" if code is not None and code < 0 else f"status {code}"
        hint = ": out of memory? give fewer --jobs" if code == -signal.SIGKILL else ""
        return RunError(
            f"{task.source.path}: the process that refitted it ended by {why}{hint}; what is "
            "finished is kept: run the same command again"
        )


def _serve(end: Connection, parent: int, tasks: Sequence[Task]) -> None:
    """Work in a process of its own, until the other end is closed or its owner is gone."""
    _die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends us in order
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    gc.freeze()  # what was loaded before stays: it need not be looked at again and again
    try:
        while True:
            _tell(end, tasks[end.recv()])
    except (EOFError, OSError):
        return


def _tell(end: Connection, task: Task) -> None:
    """Work through a task, and send what comes of it, several events at a time."""
    events: list[Event | Done | Exception] = []
    sent_s = time.monotonic()
    try:
        for event in _events(task):
            events.append(event)
            if time.monotonic() - sent_s >= _TELL_S:
                end.send(events)
                events, sent_s = [], time.monotonic()
    except (BrokenPipeError, ConnectionResetError):
        raise
    except Exception as error:  # noqa: BLE001  (it is raised again over there)
        error.add_note(f"while refitting {task.source.path}")
        events.append(error)
    if events:
        end.send(events)


def _die_with_parent(parent: int) -> None:
    """Ask the kernel to end us when our parent dies, in whatever way."""
    import ctypes
    import sys

    if sys.platform != "linux":
        return
    pr_set_pdeathsig = 1
    ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)
    if os.getppid() != parent:  # it died before we asked
        os._exit(1)
