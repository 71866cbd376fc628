"""Merger and fitter inside one process, fed with messages from a file."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from tvbrdf_messages.envelope import Envelope, Header
from tvbrdf_messages.messages import Log, Parameters, Radiance, Stored, SweepResult
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_nodes.core.inprocess import InProcessGraph
from tvbrdf_nodes.core.loading import load_class, node_class_path
from tvbrdf_nodes.core.parameters import build

from .settings import FRAMES

if TYPE_CHECKING:
    from .settings import Plan

MERGER, FITTER, WRITER = "hdr_merger", "fitter", "database_writer"
_HEADER = Header(WRITER, "", "", "", 0, 0)
_BATCH = 32


class Fitted(NamedTuple):
    """A scan's radiance, and what was fitted to it."""

    radiance: Envelope
    parameters: Envelope


def graph_of(nodes: Mapping[str, Mapping[str, Any]], start_ns: int, directory: str = "") -> Graph:
    """Return a graph of some of our nodes with their parameters, by short name."""
    participants = []
    for name, given in nodes.items():
        path = node_class_path(name)
        cls = load_class(path)
        use = cls.topics(name, build(cls.parameters_type, given))
        participants.append(
            Participant(
                name=name,
                takes=tuple(use.takes),
                gives=tuple(use.gives),
                node=path,
                parameters=dict(given),
            )
        )
    return Graph(
        directory=directory,
        utc_ns=start_ns,
        monotonic_ns=0,
        simulated=False,
        participants=tuple(participants),
    )


class NodesInProcess:
    """Some nodes that are fed and emptied by hand; what they publish is handed out at once."""

    def __init__(self, graph: Graph) -> None:
        self._graph = InProcessGraph(graph)
        self._takes = {p.name: frozenset(p.takes) for p in graph.participants}

    def __enter__(self) -> Self:
        self._graph.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._graph.__exit__(kind, error, trace)

    def feed(self, envelope: Envelope) -> None:
        """Put a message before all nodes that take its topic; :meth:`work` lets them work."""
        for name, takes in self._takes.items():
            if envelope.topic in takes and envelope.header.publisher != name:
                self._graph.bus.ports[name].take(envelope)

    def work(self) -> list[Envelope]:
        """Let the nodes do all they can; return what they published, in order."""
        while self._graph.step():
            pass
        taps = self._graph.bus.taps
        found = list(taps)
        taps.clear()
        return found

    def counter(self, name: str, counter: str) -> int:
        """Return a counter of a node's own."""
        return int(self._graph.runners[name].node.diagnostics()[counter])


class Pipeline:
    """Turns a run's messages, or its radiances, into radiances with their parameters.

    Parameters
    ----------
    plan
        Parameters of the nodes.
    start_ns
        Where the run's clock stands; neither node has a timer.
    """

    def __init__(self, plan: Plan, start_ns: int = 0) -> None:
        self._plan, self._start_ns = plan, start_ns
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._nodes: NodesInProcess | None = None
        self._radiance: dict[tuple[int, int], Envelope] = {}
        self._published: set[int] = set()
        self._broken: dict[tuple[int, int], str] = {}

    def __enter__(self) -> Self:
        nodes: dict[str, dict[str, Any]] = {}
        if self._plan.start == FRAMES and self._plan.calibration is not None:
            self._folder = tempfile.TemporaryDirectory(prefix="tvbrdf-refit-")
            path = Path(self._folder.name) / Path(self._plan.calibration.name).name
            path.write_bytes(self._plan.calibration.data)
            nodes[MERGER] = {**self._plan.merger, "calibration": str(path)}
        nodes[FITTER] = self._plan.fitter
        try:
            self._nodes = NodesInProcess(graph_of(nodes, self._start_ns)).__enter__()
        except BaseException:
            self._clean()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._nodes is not None:
            self._nodes.__exit__(kind, error, trace)
        self._clean()

    def _clean(self) -> None:
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def run(self, envelopes: Iterable[Envelope]) -> Iterator[Fitted]:
        """Yield what comes of messages, each scan once, as soon as it is fitted."""
        waiting = 0
        for envelope in envelopes:
            if isinstance(envelope.message, Radiance):
                self._keep(envelope)
            self.nodes.feed(envelope)
            waiting += 1
            if waiting == _BATCH or isinstance(envelope.message, (Radiance, SweepResult)):
                waiting = 0
                yield from self._work()
        yield from self._work()

    def _keep(self, envelope: Envelope) -> None:
        if isinstance(radiance := envelope.message, Radiance):
            self._radiance[radiance.scan, radiance.attempt] = envelope

    def _work(self) -> Iterator[Fitted]:
        for envelope in self.nodes.work():
            message = envelope.message
            if isinstance(message, Radiance):
                self._keep(envelope)
            elif isinstance(message, SweepResult):
                self._judge(message)
            elif isinstance(message, Log) and message.level == "error":
                continue  # its reason is in the parameters
            elif isinstance(message, Parameters):
                yield from self._finished(envelope, message)

    def _judge(self, result: SweepResult) -> None:
        key = result.scan, result.sweep
        self._broken.pop(key, None)
        if result.state != "done":
            self._broken[key] = result.reason

    def broken(self, scan: int) -> str:
        """Return why the merger refused a scan's first broken sweep; empty if it refused none."""
        reasons = [reason for key, reason in sorted(self._broken.items()) if key[0] == scan]
        return reasons[0] if reasons else ""

    def _finished(self, envelope: Envelope, parameters: Parameters) -> Iterator[Fitted]:
        scan = parameters.scan
        keys = sorted(key for key in self._radiance if key[0] == scan)
        radiance = [self._radiance.pop(key) for key in keys]
        for what in ("radiance", "parameters"):  # nobody here needs to keep it
            stored = Stored(sample=parameters.sample, scan=scan, what=what)
            self.nodes.feed(Envelope("/scan/stored", _HEADER, stored))
        if scan not in self._published and radiance:
            self._published.add(scan)
            yield Fitted(radiance[0], envelope)

    @property
    def nodes(self) -> NodesInProcess:
        """Merger and fitter, once it is open."""
        if self._nodes is None:
            raise RuntimeError("the pipeline is not open")
        return self._nodes
