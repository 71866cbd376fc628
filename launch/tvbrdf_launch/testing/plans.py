"""From a launch file to the graph of a test: some nodes run, the test plays the others."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tvbrdf_messages.run_directory import Graph, Participant

from ..errors import COMMAND_LINE, LaunchError, RunError
from ..find_files import find_launch_file, shipped
from ..launch_file import LaunchFile, NodeEntry, load_declaration, load_launch_file
from ..plan import Plan, make_plan
from ..yaml_items import Item, as_item
from .errors import MisuseError, unknown

WATCHER = "test.watch"
"""The test as a reader: a name that no node can have."""
WATCHED_BYTES = 64 << 20


@dataclass(frozen=True, slots=True)
class RunPlan:
    """What a test runs of a launch file."""

    plan: Plan
    """With only the nodes that run."""
    played: tuple[str, ...]
    ends_run: tuple[str, ...]


def find_file(given: str | Path) -> Path:
    """Return a launch file by name or path."""
    try:
        return find_launch_file(str(given)).resolve()
    except RunError as error:
        raise MisuseError(f"{error}; shipped are: {', '.join(sorted(shipped()))}") from None


def check_arguments(path: Path, arguments: Iterable[str]) -> frozenset[str]:
    """Return the names of the arguments that a launch file takes; refuse others."""
    declared = load_declaration(path).arguments
    for name in arguments:
        if name not in declared:
            raise unknown(f"argument of launch file {path.stem}", name, declared)
    return frozenset(declared)


def make_run_plan(
    file: str,
    arguments: Mapping[str, Any],
    directory: str,
    nodes: Iterable[str] | None = None,
    without: Iterable[str] = (),
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
    real_devices: bool = False,
) -> RunPlan:
    """Return the plan of a launch file of which the test plays a part.

    Parameters
    ----------
    file, arguments
        The launch file and its arguments.
    directory
        The run's; it need not exist.
    nodes
        Those that run; all by default.
    without
        Those that do not.
    parameters
        Changes of nodes' parameters, by node.
    real_devices
        Whether a driver of real hardware may be started.

    Raises
    ------
    MisuseError
        For what is not there, naming what is.
    """
    try:
        launch = load_launch_file(Path(file), arguments, Path(directory))
        names = [entry.name for entry in launch.nodes]
        for name in (*(nodes or ()), *without, *(parameters or {})):
            if name not in names:
                raise unknown(f"node of launch file {launch.path.stem}", name, names)
        plan = make_plan(_changed(launch, parameters or {}), Path(directory))
    except LaunchError as error:
        raise MisuseError(str(error)) from error
    wanted = set(names if nodes is None else nodes) - set(without)
    graph = _played_by_test(plan.graph, wanted)
    if not real_devices:
        _refuse_real(graph)
    running = tuple(node for node in plan.nodes if node.name in wanted)
    if not running:
        raise MisuseError(f"no node runs; launch file {launch.path.stem} has: {', '.join(names)}")
    return RunPlan(
        replace(plan, graph=graph, nodes=running),
        tuple(name for name in names if name not in wanted),
        tuple(node.name for node in running if node.ends_run),
    )


def _changed(launch: LaunchFile, parameters: Mapping[str, Mapping[str, Any]]) -> LaunchFile:
    def change(entry: NodeEntry) -> NodeEntry:
        if entry.name not in parameters:
            return entry
        new = as_item(dict(parameters[entry.name]), COMMAND_LINE)
        merged = Item({**entry.parameters.value, **new.value}, entry.parameters.place)
        return replace(entry, parameters=merged)

    return replace(launch, nodes=tuple(map(change, launch.nodes)))


def _played_by_test(graph: Graph, running: set[str]) -> Graph:
    """Let the test be all that does not run: nobody waits for it, and it has no device."""

    def play() -> Iterable[Participant]:
        for each in graph.participants:
            owner = each.name.partition(".")[0]
            if owner in running:
                yield each
            elif owner == each.name:
                yield replace(each, node="", driver="", live=False, counted_bytes=0)

    return replace(graph, participants=tuple(play()))


def _refuse_real(graph: Graph) -> None:
    for each in graph.participants:
        port = each.parameters.get("driver_parameters", {}).get("port", "")
        twin = isinstance(port, str) and Path(port).parent == Path(graph.directory)
        if each.live and not twin:
            raise MisuseError(
                f"{each.name} drives a real device ({each.driver}); leave it out with "
                "without=, or say real_devices=True"
            )


def watched(graph: Graph, *, keep_frames: bool) -> Graph:
    """Return the graph with the test as a reader of all that is said, for which nobody waits."""
    topics = sorted({topic for p in graph.participants for topic in p.gives})
    takes = tuple(t for t in topics if keep_frames or not t.endswith("/frame"))
    test = Participant(name=WATCHER, takes=takes, counted_bytes=WATCHED_BYTES)
    return replace(graph, participants=(*graph.participants, test))


def plain(value: Any) -> Any:
    """Return a value as YAML has it: paths and bags as texts, tuples as lists."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return {name: plain(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(part) for part in value]
    return value
