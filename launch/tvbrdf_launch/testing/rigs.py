"""Rigs from launch files, for tests."""

from __future__ import annotations

import contextlib
import itertools
import shutil
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, overload

from ..launch_file import load_declaration
from .errors import MisuseError
from .factory import Factory
from .inprocess import InProcessRun
from .plans import check_arguments, find_file, make_run_plan, plain
from .processes import ProcessRun
from .scenes import Faults, write_scene


class RigFactory(Factory):
    """Starts rigs, and stops them all at its end.

    Parameters
    ----------
    folder
        For databases and scenes, which stay; a run's own directory is elsewhere, with a short path.
    """

    @overload
    def __call__(
        self, launch_file: str | Path = ..., /, *, processes: Literal[True], **options: Any
    ) -> ProcessRun: ...

    @overload
    def __call__(
        self, launch_file: str | Path = ..., /, *, processes: Literal[False] = ..., **options: Any
    ) -> InProcessRun: ...

    @overload
    def __call__(
        self, launch_file: str | Path = ..., /, *, processes: bool, **options: Any
    ) -> InProcessRun | ProcessRun: ...

    def __call__(
        self,
        launch_file: str | Path = "simulated_rig",
        /,
        *,
        processes: bool = False,
        nodes: Iterable[str] | None = None,
        without: Iterable[str] = (),
        faults: Faults | None = None,
        parameters: Mapping[str, Mapping[str, Any]] | None = None,
        keep_frames: bool = False,
        real_devices: bool = False,
        **arguments: Any,
    ) -> InProcessRun | ProcessRun:
        """Start a rig.

        Parameters
        ----------
        launch_file
            Name of a shipped one, or a path.
        processes
            A launcher and real processes; else all nodes run in this one.
        nodes, without
            Which nodes run, or do not; the test plays the others.
        faults
            Of simulated devices: lists of entries as in a scene's ``faults``, by device: ``arm``,
            ``camera`` (all), ``camera_1`` ...
        parameters
            Changes of nodes' parameters, by node.
        keep_frames
            Keep the frames too: they are most of all bytes.
        real_devices
            Whether drivers of real hardware may be started.
        arguments
            Of the launch file. ``sample`` and ``effects`` may be mappings, as in their files. The
            database is a new folder where none is given.

        Raises
        ------
        MisuseError
            For what is not there, naming what is.
        """
        path = find_file(launch_file)
        declared = check_arguments(path, arguments)
        place = self._new_folder()
        if "database" in declared:
            arguments.setdefault("database", place / "db")
        if "effects" in declared:
            default = load_declaration(path).arguments["effects"].default
            write_scene(place, arguments, str(default.value if default else ""), faults or {})
        elif faults:
            raise MisuseError(f"launch file {path.stem} has no effects, so no faults: {faults}")
        # the path of a Unix socket has at most 107 characters
        short = Path(tempfile.mkdtemp(prefix="tv"))
        self._last.callback(shutil.rmtree, short, ignore_errors=True)
        spec: dict[str, Any] = {
            "file": str(path),
            "arguments": {name: plain(value) for name, value in arguments.items()},
            "directory": str(short / "r"),
            "nodes": None if nodes is None else _names(nodes),
            "without": _names(without),
            "parameters": {name: plain(dict(each)) for name, each in (parameters or {}).items()},
            "real_devices": real_devices,
        }
        planned = make_run_plan(**spec)
        if processes:
            spec["keep_frames"] = keep_frames
            return self._last.enter_context(
                ProcessRun(planned.plan.graph, planned.played, spec, short, keep_frames=keep_frames)
            )
        (short / "r").mkdir(mode=0o700)
        planned.plan.graph.write()
        return self._last.enter_context(
            InProcessRun(
                planned.plan.graph,
                [node.name for node in planned.plan.nodes],
                ends_run=planned.ends_run,
                keep_frames=keep_frames,
            )
        )

    def _new_folder(self) -> Path:
        """Make the next free folder: tests may share the one above."""
        for number in itertools.count(1):
            with contextlib.suppress(FileExistsError):
                place = self._folder / f"rig_{number}"
                place.mkdir(parents=True)
                return place
        raise AssertionError


def _names(given: Iterable[str]) -> list[str]:
    return [given] if isinstance(given, str) else list(given)
