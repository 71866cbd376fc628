"""Processes that work through shares of sources, and hand over each scan as soon as it is done."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
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
_FOR_DATABASES = ("tvbrdf_nodes.database_writer.opening",)
_FOR_PUBLISHED = ("scipy.optimize",)
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
    with _Pool(min(jobs, len(tasks))) as pool:
        yield from pool.run(tasks)


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

    def __init__(self, count: int) -> None:
        method = "fork" if _threads() == 1 else "spawn"
        self._context: Any = multiprocessing.get_context(method)
        self._processes: list[Any] = []
        self._ends: list[Connection] = []
        self._count = count

    def __enter__(self) -> _Pool:
        try:
            for _ in range(self._count):
                mine, theirs = self._context.Pipe()
                process = self._context.Process(
                    target=_serve, args=(theirs, os.getpid()), daemon=True
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

    def run(self, tasks: Sequence[Task]) -> Iterator[tuple[Task, Event | Done]]:
        waiting = iter(tasks)
        busy: dict[Connection, Task] = {}
        for end in self._ends:
            self._give(end, waiting, busy)
        while busy:
            ready: list[Any] = wait([*busy])
            for end in ready:
                task = busy[end]
                try:
                    event = end.recv()
                except (EOFError, OSError):
                    raise self._died(end, task) from None
                if isinstance(event, BaseException):
                    raise event
                if isinstance(event, Done):
                    del busy[end]
                    self._give(end, waiting, busy)
                yield task, event

    def _give(self, end: Connection, waiting: Iterator[Task], busy: dict[Connection, Task]) -> None:
        task = next(waiting, None)
        if task is not None:
            end.send(task)
            busy[end] = task

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


def _serve(end: Connection, parent: int) -> None:
    """Work in a process of its own, until the other end is closed or its owner is gone."""
    _die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends us in order
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        while True:
            task = end.recv()
            try:
                for event in _events(task):
                    end.send(event)
            except (BrokenPipeError, ConnectionResetError):
                return
            except Exception as error:  # noqa: BLE001  (it is raised again over there)
                error.add_note(f"while refitting {task.source.path}")
                end.send(error)
    except (EOFError, OSError):
        return


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
