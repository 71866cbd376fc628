"""From a launch file to the graph of a run: every class is loaded and every parameter checked."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tvbrdf_messages.errors import BusError
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_messages.topics import find_topic, table
from tvbrdf_nodes.core.loading import NODES, LoadingError, load_class, node_class_path
from tvbrdf_nodes.core.node import Node, TopicUse
from tvbrdf_nodes.core.parameters import ParameterError, build

from .errors import LaunchError, Place, did_you_mean
from .launch_file import LaunchFile, NodeEntry, RestartPolicy
from .yaml_items import Item


@dataclass(frozen=True, slots=True)
class PlannedNode:
    """What the launcher must know of a node."""

    name: str
    restart: RestartPolicy
    ends_run: bool


@dataclass(frozen=True, slots=True)
class Plan:
    """A launch file made ready: nothing in it is left unchecked."""

    launch: LaunchFile
    graph: Graph
    nodes: tuple[PlannedNode, ...]
    notices: tuple[str, ...] = ()
    """What people should know before it is carried out."""


@dataclass(frozen=True, slots=True)
class _Checked:
    entry: NodeEntry
    cls: type[Node[Any]]
    parameters: Any
    participants: tuple[Participant, ...]
    drives_real_device: bool
    speedup: float | None
    selects: Callable[[str], bool] | None
    """Says which topics that others give the node takes besides."""


def make_plan(launch: LaunchFile, run: Path) -> Plan:
    """Return the graph and the nodes of a resolved launch file.

    Raises
    ------
    LaunchError
        With file and line, for unknown nodes, drivers, topics and parameters, for wrong types, and
        for ``speedup`` where a device is real.
    """
    if not launch.nodes:
        raise LaunchError("it starts no node", Place(launch.path, 0))
    checked = [_check_node(entry) for entry in launch.nodes]
    participants = tuple(_with_selected(checked))
    topics = {topic for p in participants for topic in p.gives}
    simulated = "/clock" in topics and not any(
        each.drives_real_device and not _reaches_twin(each, topics, run) for each in checked
    )
    _check_speedup(checked, topics, simulated, run)
    graph = Graph(
        directory=str(run),
        utc_ns=time.time_ns(),
        monotonic_ns=time.monotonic_ns(),
        simulated="/clock" in topics,
        participants=participants,
        working_directory=str(Path.cwd()),
    )
    _check_graph(graph, checked)
    nodes = tuple(PlannedNode(e.name, e.restart, e.ends_run) for e in launch.nodes)
    return Plan(launch, graph, nodes, tuple(_notices(graph, checked)))


def _with_selected(checked: list[_Checked]) -> Iterator[Participant]:
    """Yield all participants, each with the topics of others that its node selects."""
    given = [(p.name, topic) for each in checked for p in each.participants for topic in p.gives]
    for each in checked:
        for participant in each.participants:
            if each.selects is None or not participant.node:
                yield participant
                continue
            others = {topic for name, topic in given if name != participant.name}
            also = sorted(filter(each.selects, others - set(participant.takes)))
            yield replace(participant, takes=(*participant.takes, *also))


def _notices(graph: Graph, checked: list[_Checked]) -> Iterator[str]:
    for each in checked:
        name = each.entry.name
        try:
            for text in each.cls.notices(name, each.parameters, graph):
                yield f"{name}: {text}"
        except ValueError as error:
            raise LaunchError(f"node {name}: {error}", each.entry.place) from error


def _check_node(entry: NodeEntry) -> _Checked:
    if ":" not in entry.kind and entry.kind not in NODES:
        hint = did_you_mean(entry.kind, NODES, "there are")
        text = f"unknown node {entry.kind!r}; {hint} (or package.module:Class)"
        raise LaunchError(text, entry.kind_place)
    path = node_class_path(entry.kind)
    cls = _load(path, entry.kind_place, "node")
    if not issubclass(cls, Node):
        raise LaunchError(f"{path} is no node: it does not derive from Node", entry.kind_place)
    parameters = _build(cls.parameters_type, entry.parameters, f"node {entry.name}")
    driver_path = getattr(parameters, "driver", "")
    driver, link = None, None
    if isinstance(driver_path, str) and driver_path:
        driver, link = _check_driver(entry, driver_path, parameters)
    live = driver is not None and bool(getattr(driver, "live", True))
    use = _topics(cls.topics, entry, parameters)
    me = Participant(
        name=entry.name,
        takes=use.takes,
        gives=use.gives,
        node=path,
        driver=driver_path if driver else "",
        parameters=entry.parameters.plain(),
        live=live,
        counted_bytes=use.counted_bytes,
    )
    found = [me]
    if link is not None:
        found.append(Participant(name=f"{entry.name}.device", takes=link.takes, gives=link.gives))
    speedup = getattr(parameters, "speedup", None)
    return _Checked(entry, cls, parameters, tuple(found), live, speedup, use.selects)


def _load(path: str, place: Place, what: str) -> type[Any]:
    try:
        return load_class(path)
    except LoadingError as error:
        hint = "; is its folder on PYTHONPATH?" if "No module named" in str(error) else ""
        raise LaunchError(f"unknown {what}: {error}{hint}", place) from error
    except Exception as error:
        text = f"{what} {path} can't be imported: {type(error).__name__}: {error}"
        raise LaunchError(text, place) from error


def _build(cls: type[Any], item: Item, what: str) -> Any:
    try:
        return build(cls, item.plain())
    except ParameterError as error:
        found = item.find(error.key) if error.key else None
        raise LaunchError(f"{what}: {error}", (found or item).place) from error


def _check_driver(
    entry: NodeEntry, path: str, parameters: Any
) -> tuple[type[Any], TopicUse | None]:
    at = entry.parameters.find("driver") or entry.parameters
    cls = _load(path, at.place, "driver")
    kind = getattr(cls, "parameters_type", None)
    raw = getattr(parameters, "driver_parameters", {})
    item = entry.parameters.find("driver_parameters") or Item({}, at.place)
    if kind is None:
        if raw:
            raise LaunchError(f"driver {path} takes no parameters", item.place)
        checked = None
    else:
        checked = _build(kind, item, f"driver of {entry.name}")
    if not hasattr(cls, "link_topics"):
        return cls, None
    return cls, _topics(cls.link_topics, entry, checked)


def _topics(declare: Any, entry: NodeEntry, parameters: Any) -> TopicUse:
    """Return what a class says that it takes and gives; refuse topics that do not exist."""
    try:
        use = TopicUse(*declare(entry.name, parameters))
    except Exception as error:
        text = f"node {entry.name}: its topics: {type(error).__name__}: {error}"
        raise LaunchError(text, entry.place) from error
    for topic in (*use.takes, *use.gives):
        try:
            find_topic(topic)
        except BusError as error:
            hint = did_you_mean(topic, (row.name for row in table()))
            text = f"node {entry.name}: unknown topic {topic!r}; {hint}"
            raise LaunchError(text, entry.place) from error
    return use


def _reaches_twin(checked: _Checked, topics: set[str], run: Path) -> bool:
    """Return whether a real driver talks to a simulated controller: its port is in the run."""
    driver = checked.entry.parameters.find("driver_parameters")
    port = driver.find("port") if driver is not None else None
    return (
        "/sim/motion" in topics
        and port is not None
        and isinstance(port.value, str)
        and Path(port.value).parent == run
    )


def _check_speedup(checked: list[_Checked], topics: set[str], simulated: bool, run: Path) -> None:
    for each in checked:
        if each.speedup is None or each.speedup == 1 or simulated:
            continue
        real = [
            c.entry.name
            for c in checked
            if c.drives_real_device and not _reaches_twin(c, topics, run)
        ]
        found = each.entry.parameters.find("speedup") or each.entry.parameters
        raise LaunchError(
            f"speedup {each.speedup:g} is refused: {', '.join(real) or 'the rig'} is real, and "
            "real devices take real time; leave speedup at 1",
            found.place,
        )


def _check_graph(graph: Graph, checked: list[_Checked]) -> None:
    try:
        graph.check()
        for participant in graph.participants:
            graph.endpoint(participant.name, "lossless")
    except BusError as error:
        at: Mapping[str, Place] = {
            p.name: each.entry.place for each in checked for p in each.participants
        }
        words = str(error).split()
        place = next((at[word] for word in words if word in at), checked[0].entry.place)
        raise LaunchError(str(error), place) from error
