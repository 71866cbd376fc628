"""Any nodes together in one process, for tests."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from tvbrdf_messages.errors import BusError
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_messages.topics import find_topic, table
from tvbrdf_nodes.core.loading import NODES, LoadingError, load_class, node_class_path
from tvbrdf_nodes.core.node import Node, TopicUse
from tvbrdf_nodes.core.parameters import ParameterError, build

from .errors import MisuseError, unknown
from .factory import Factory
from .inprocess import InProcessRun
from .plans import plain

START_NS = 1_800_000_000_000_000_000
TEST = "test"
"""The name under which the test gives inputs."""
Kind = str | type[Node[Any]]
Given = Kind | tuple[Kind, Mapping[str, Any]]
"""A node's class or name, alone or with parameters."""


class GraphFactory(Factory):
    """Starts graphs of nodes, and stops them all at its end.

    Parameters
    ----------
    folder
        For what nodes write; a graph's own directory is elsewhere, with a short path.
    """

    def __call__(
        self,
        *nodes: Given,
        inputs: Iterable[str] = (),
        keep_frames: bool = True,
        start_ns: int = START_NS,
        **named: Given,
    ) -> InProcessRun:
        """Start some nodes; who gives a topic is linked with all that take it.

        Parameters
        ----------
        nodes
            Short names (``"fitter"``), ``module:Class`` or classes, or with parameters: a tuple of
            that and a mapping. They are named after themselves.
        inputs
            Topics that the test gives. All that nodes take and none gives are given by the test
            anyway: name those of which nodes are to have a second publisher.
        keep_frames
            Keep frames too.
        start_ns
            When the run's clock begins.
        named
            The same, by the node's name in the graph.

        Raises
        ------
        MisuseError
            For what is not there, naming what is.
        """
        given = [(_own_name(each), each) for each in nodes] + list(named.items())
        names = [name for name, _ in given]
        if not given:
            raise MisuseError(f"no node; there are: {', '.join(NODES)} (or classes)")
        doubled = sorted({name for name in (*names, TEST) if [*names, TEST].count(name) > 1})
        if doubled:
            raise MisuseError(f"two nodes are called {doubled[0]}; name them: other_name=...")
        participants = _link(given, inputs)
        short = Path(tempfile.mkdtemp(prefix="tv"))
        self._last.callback(shutil.rmtree, short, ignore_errors=True)
        graph = Graph(
            directory=str(short),
            utc_ns=start_ns,
            monotonic_ns=0,
            simulated=any("/clock" in p.gives for p in participants),
            participants=tuple(participants),
        )
        try:
            graph.check()
        except BusError as error:
            raise MisuseError(str(error)) from error
        graph.write()
        return self._last.enter_context(InProcessRun(graph, names, keep_frames=keep_frames))


def _link(given: Iterable[tuple[str, Given]], inputs: Iterable[str]) -> list[Participant]:
    """Return all participants; each node with the topics of others that it selects."""
    participants: list[Participant] = []
    selects: dict[str, Callable[[str], bool]] = {}
    for name, node in given:
        mine, select = _participants(name, node)
        participants += mine
        if select is not None:
            selects[name] = select
    participants = _with_inputs(participants, inputs)
    for index, each in enumerate(participants):
        if each.name in selects:
            others = {t for p in participants if p is not each for t in p.gives}
            also = sorted(filter(selects[each.name], others - {*each.takes}))
            participants[index] = replace(each, takes=(*each.takes, *also))
    return participants


def _split(given: Given) -> tuple[Kind, dict[str, Any]]:
    kind, parameters = given if isinstance(given, tuple) else (given, {})
    return kind, plain(parameters)


def _own_name(given: Given) -> str:
    kind, _ = _split(given)
    if isinstance(kind, str) and ":" not in kind:
        return kind
    name = kind.rpartition(":")[2] if isinstance(kind, str) else kind.__name__
    name = name.removesuffix("Node") or name
    words = ("_" + c.lower() if c.isupper() else c for c in name)
    return "".join(words).removeprefix("_")


def _class_path(kind: Kind) -> str:
    """Return ``module:Class`` of a node, and make sure that it leads there."""
    if isinstance(kind, str):
        try:
            path = node_class_path(kind)
            load_class(path)
        except LoadingError as error:
            raise MisuseError(str(error)) from error
        return path
    path = f"{kind.__module__}:{kind.__qualname__}"
    with contextlib.suppress(LoadingError):
        if load_class(path) is kind:
            return path
    raise MisuseError(f"{path} can't be found by that name; define it at the top of its module")


def _participants(name: str, given: Given) -> tuple[list[Participant], Any]:
    """Return a node and its device as the graph has them, and which other topics it selects."""
    kind, parameters = _split(given)
    path = _class_path(kind)
    cls = load_class(path)
    if not issubclass(cls, Node):
        raise MisuseError(f"{path} is no node: it does not derive from Node")
    try:
        checked = build(cls.parameters_type, parameters)
        use = _checked(cls.topics(name, checked))
        found = [
            Participant(
                name=name,
                takes=tuple(use.takes),
                gives=tuple(use.gives),
                node=path,
                parameters=parameters,
                counted_bytes=use.counted_bytes,
            )
        ]
        driver = getattr(checked, "driver", "")
        if isinstance(driver, str) and driver:
            found += _device(found, driver, getattr(checked, "driver_parameters", {}))
    except (ParameterError, LoadingError, BusError) as error:
        raise MisuseError(f"node {name}: {error}") from error
    return found, use.selects


def _device(found: list[Participant], driver: str, raw: Mapping[str, Any]) -> list[Participant]:
    cls = load_class(driver)
    live = bool(getattr(cls, "live", True))
    found[0] = replace(found[0], driver=driver, live=live)
    if not hasattr(cls, "link_topics"):
        return []
    name = found[0].name
    link = _checked(TopicUse(*cls.link_topics(name, build(cls.parameters_type, raw))))
    return [Participant(name=f"{name}.device", takes=tuple(link.takes), gives=tuple(link.gives))]


def _checked(use: TopicUse) -> TopicUse:
    for topic in (*use.takes, *use.gives):
        find_topic(topic)
    return use


def _with_inputs(participants: list[Participant], inputs: Iterable[str]) -> list[Participant]:
    """Add the test, which gives what nobody else does."""
    inputs = [inputs] if isinstance(inputs, str) else list(inputs)
    for topic in inputs:
        try:
            find_topic(topic)
        except BusError:
            raise unknown("topic", topic, (row.name for row in table())) from None
    given = {topic for p in participants for topic in p.gives}
    taken = {topic for p in participants for topic in p.takes} - {"/clock"}
    gives = tuple(sorted((taken - given) | set(inputs)))
    return [*participants, Participant(name=TEST, gives=gives)] if gives else participants
