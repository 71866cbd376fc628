"""A stage for nodes: some run for real, the test plays the others on the in-process bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from tvbrdf_messages.bus import Port
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import (
    Diagnostics,
    OperatorRequest,
)
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_messages.schema import Message
from tvbrdf_nodes.core.inprocess import InProcessGraph
from tvbrdf_nodes.core.loading import load_class, node_class_path
from tvbrdf_nodes.core.node import Reply
from tvbrdf_nodes.core.parameters import build

START_NS = 1_800_000_000_000_000_000
M = TypeVar("M", bound=Message)


class Part(NamedTuple):
    """A node of the graph."""

    name: str
    kind: str
    parameters: Mapping[str, Any] = {}
    run: bool = False
    """Whether it runs for real."""


def participant(part: Part) -> Participant:
    """Return a node as the graph has it, with the topics that its class declares."""
    path = node_class_path(part.kind)
    cls = load_class(path)
    use = cls.topics(part.name, build(cls.parameters_type, part.parameters))
    return Participant(
        name=part.name,
        takes=tuple(use.takes),
        gives=tuple(use.gives),
        node=path,
        parameters=dict(part.parameters),
    )


class Player:
    """A participant that the test plays."""

    def __init__(self, stage: Stage, name: str) -> None:
        self._stage, self.name = stage, name
        self.port: Port = stage.graph.bus.port(name)
        self.seen: list[Envelope] = []

    def say(
        self, topic: str, message: Message, *, stamp_ns: int | None = None, **more: Any
    ) -> None:
        """Publish a message, and let the nodes work on it."""
        at_ns = self._stage.now_ns if stamp_ns is None else stamp_ns
        self.port.publish(topic, message, stamp_ns=at_ns, **more)
        self._stage.settle()

    def state(self, state: str = "running") -> None:
        """Say how this node is."""
        self.say("/diagnostics", Diagnostics(node=self.name, state=state))

    def take(self, kind: type[M]) -> list[M]:
        """Return the messages of a kind that have come since the last call; keep the others."""
        self.seen += self.port.receive(100_000)
        found = [e.message for e in self.seen if isinstance(e.message, kind)]
        self.seen = [e for e in self.seen if not isinstance(e.message, kind)]
        return found

    def die(self) -> None:
        """End this node's life."""
        self.port.close()
        self._stage.settle()

    def return_(self) -> None:
        """Start it again, as a new incarnation."""
        self.port = self._stage.graph.bus.port(self.name)
        self.seen = []
        self._stage.settle()


class Stage:
    """Runs some nodes of a graph; time goes on only when the test says so."""

    def __init__(self, folder: Path, parts: list[Part], utc_ns: int) -> None:
        graph = Graph(
            directory=str(folder),
            utc_ns=utc_ns,
            monotonic_ns=0,
            simulated=False,
            participants=tuple(participant(part) for part in parts),
        )
        graph.check()
        self.graph = InProcessGraph(graph, run=[part.name for part in parts if part.run])
        self.players = {p.name: Player(self, p.name) for p in parts if not p.run}
        self._entered = False

    def begin(self) -> None:
        """Start the nodes."""
        self.graph.__enter__()
        self._entered = True
        self.settle()

    def end(self) -> None:
        """Stop the nodes."""
        if self._entered:
            self._entered = False
            self.graph.__exit__(None, None, None)

    @property
    def now_ns(self) -> int:
        """The run's time."""
        return self.graph.clock.now_ns()

    def settle(self) -> None:
        """Let the nodes do all that they can at this moment."""
        if self._entered:
            while self.graph.step():
                pass

    def advance(self, seconds: float) -> None:
        """Let the run's time go on, from timer to timer."""
        end_ns = self.now_ns + round(1e9 * seconds)
        while True:
            timers = [r.next_timer_ns() for r in self.graph.runners.values()]
            due = min((t for t in timers if t is not None and t <= end_ns), default=None)
            if due is None:
                break
            self.graph.clock.tell(due)
            self.settle()
        self.graph.clock.tell(end_ns)
        self.settle()

    def wait(self, done: Callable[[], bool], limit_s: float = 10.0) -> None:
        """Let the nodes work until ``done()``; for what happens on real (monotonic) time."""
        deadline = time.monotonic() + limit_s
        while not done():
            assert time.monotonic() < deadline, f"not done after {limit_s} s"
            if not self.graph.step():
                waits = [r.next_watchdog_s() for r in self.graph.runners.values()]
                soonest = min((w for w in waits if w is not None), default=0.01)
                threading.Event().wait(min(soonest, 0.01))

    def ask(self, name: str, verb: str, **arguments: Any) -> list[Reply]:
        """Ask a node, and return the answers that it has given at once."""
        runner = self.graph.runners[name]
        runner.put(
            runner.node.on_request(
                OperatorRequest(request_id="person", verb=verb, arguments=arguments)
            )
        )
        self.settle()
        return self.replies(name)

    def replies(self, name: str) -> list[Reply]:
        """Return and clear the answers to people."""
        runner = self.graph.runners[name]
        found, runner.replies = runner.replies, []
        return found

    def said(self, topic: str) -> list[Envelope]:
        """Return everything published on a topic so far."""
        return self.graph.published(topic)

    def log(self, level: str) -> list[str]:
        """Return the texts of a level of the log so far."""
        messages: list[Any] = [e.message for e in self.said("/log")]
        return [m.text for m in messages if m.level == level]


MakeStage = Callable[..., Stage]
