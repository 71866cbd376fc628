"""A whole refit: sources to folders of results."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from . import pool
from .events import Aside, Outcome, Problem, Progress, Unfinished
from .settings import Settings
from .sources import Source, input_errors, result_names
from .writer import ResultFolder

Tell = Callable[[float, str], None]
"""Takes the part that is done, 0 to 1, and what is being done."""


@dataclass(slots=True)
class TargetReport:
    """What came of one source."""

    source: Path
    folder: Path
    scans: int = 0
    """In the result, with those of before."""
    refitted: int = 0
    """Just now."""
    unfinished: dict[int, str] = field(default_factory=dict)
    """Scans that the source does not have whole, with the reason."""
    problems: list[str] = field(default_factory=list)

    def plain(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "source": str(self.source),
            "folder": str(self.folder),
            "scans": self.scans,
            "refitted": self.refitted,
            "not_whole": {str(scan): reason for scan, reason in self.unfinished.items()},
            "problems": self.problems,
        }


@dataclass(slots=True)
class Report:
    """What came of a refit."""

    targets: list[TargetReport]
    seconds: float = 0.0
    """From the beginning of the work to its end; before that, compiled code was loaded."""

    @property
    def problems(self) -> list[str]:
        """All that could not be refitted; each text names the file."""
        return [text for target in self.targets for text in target.problems]

    @property
    def refitted(self) -> int:
        """How many scans were refitted just now."""
        return sum(target.refitted for target in self.targets)


@dataclass(slots=True)
class _Target:
    source: Source
    report: TargetReport
    folder: ResultFolder | None = None
    left: dict[int, float] = field(default_factory=dict)
    """Tasks that are not done, and how much of each is."""
    share: float = 0.0
    """Of one of its tasks in all that is to do."""
    failed: bool = False


class Refit:
    """Refits sources.

    Parameters
    ----------
    sources
        As :func:`~.sources.find_sources` gives them.
    out
        Gets a folder for each source.
    settings
        What is asked for.
    jobs
        Processes; results do not depend on it.
    again
        Make results anew where there are some.
    tell
        Called as work goes on.
    """

    def __init__(
        self,
        sources: Sequence[Source],
        out: Path,
        settings: Settings,
        *,
        jobs: int = 1,
        again: bool = False,
        tell: Tell = lambda fraction, text: None,
    ) -> None:
        names = result_names(sources)
        self._targets = [
            _Target(source, TargetReport(source.path, out / name))
            for source, name in zip(sources, names, strict=True)
        ]
        self._settings, self._jobs, self._again, self._tell = settings, jobs, again, tell
        self._fraction, self._refitted = 0.0, 0

    def run(self) -> Report:
        """Do it; input that can't be used is in the report, and the others are refitted.

        Raises
        ------
        RunError
            If nothing more can be written, or results of another refit are in the way; what is
            finished is kept, and the same command goes on from there.
        """
        with ExitStack() as stack:
            tasks = self._open(stack)
            if tasks:
                self._tell(0.0, "loading the solver")
                pool.load(tasks)
            began = time.monotonic()
            for task, event in pool.work(tasks, self._jobs):
                self._take(task, event)
            seconds = time.monotonic() - began
        for target in self._targets:
            if target.folder is not None:
                target.report.scans = target.folder.scans
        return Report([target.report for target in self._targets], seconds)

    def _open(self, stack: ExitStack) -> list[pool.Task]:
        """Open sources and folders; return the tasks in the order of the sources."""
        opened = []
        for target in self._targets:
            self._tell(0.0, f"looking at {target.source.path.name}")
            try:
                plan = target.source.plan(self._settings)
                facts = target.source.facts()
            except input_errors() as error:
                target.report.problems.append(str(error))
                continue
            except OSError as error:
                target.report.problems.append(f"{target.source.path}: {error.strerror or error}")
                continue
            folder = ResultFolder(target.report.folder, target.source, facts, plan)
            stack.callback(folder.close)
            done = folder.open(again=self._again)
            target.folder = folder
            if not folder.complete:
                opened.append((target, plan, done, tuple(facts.get("files", ()))))
        tasks: list[pool.Task] = []
        for target, plan, done, files in opened:
            units = target.source.units(self._jobs, len(opened), done, plan)
            target.share = 1.0 / (len(units) * len(opened))
            for unit in units:
                number, index = len(tasks), self._targets.index(target)
                mine = replace(unit, files=files)
                tasks.append(pool.Task(number, index, target.source, mine, plan))
                target.left[number] = 0.0
        return tasks

    def _take(self, task: pool.Task, event: Any) -> None:
        target = self._targets[task.target]
        folder = target.folder
        assert folder is not None
        if isinstance(event, Outcome):
            folder.take(event)
            target.report.refitted += 1
            self._refitted += 1
            if event.problem:
                target.report.problems.append(f"{target.source.path}: {event.problem}")
        elif isinstance(event, (Aside, Unfinished)):
            folder.take_aside(event)
        elif isinstance(event, Problem):
            target.report.problems.append(event.text)
            target.failed = True
        elif isinstance(event, Progress):
            self._progress(target, task, event.fraction)
        else:
            self._progress(target, task, 1.0)
            del target.left[task.number]
            if not target.left:
                self._finish(target, folder)

    def _finish(self, target: _Target, folder: ResultFolder) -> None:
        """Put a source's results in order once all of it is done."""
        report = target.report
        report.unfinished = folder.unfinished
        if not folder.scans and not report.problems:
            why = "; ".join(f"scan {n}: {text}" for n, text in report.unfinished.items())
            report.problems.append(
                f"{target.source.path}: no scan in it is whole" + (f" ({why})" if why else "")
            )
        folder.finish(complete=not target.failed)

    def _progress(self, target: _Target, task: pool.Task, fraction: float) -> None:
        step = max(0.0, fraction - target.left[task.number])
        target.left[task.number] += step
        self._fraction += step * target.share
        self._tell(min(self._fraction, 1.0), f"{self._refitted} scans")
