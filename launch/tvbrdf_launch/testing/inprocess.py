"""Runs inside the test's process: no sockets, and time goes on only while the test waits."""

from __future__ import annotations

import contextlib
import uuid
from collections.abc import Callable, Iterable
from typing import Any

from tvbrdf_messages.bus import InProcessPort
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import OperatorReply, OperatorRequest
from tvbrdf_messages.run_directory import Graph
from tvbrdf_nodes.core.inprocess import InProcessGraph
from tvbrdf_nodes.core.node import Node

from .errors import MisuseError, unknown
from .run import Ended, Run

LAST_STEPS = 1000
"""With which the others may finish their work when the run has ended."""
_NOTHING_LEFT = "nothing is left that could happen"
"""As the in-process graph says it."""


class InProcessRun(Run):
    """Nodes of a graph in this thread.

    Parameters
    ----------
    graph
        Who is there.
    run
        Names of the nodes that run; the test plays the others.
    ends_run
        Names of those whose end is the run's.
    """

    def __init__(
        self,
        graph: Graph,
        run: Iterable[str],
        *,
        ends_run: Iterable[str] = (),
        keep_frames: bool = False,
    ) -> None:
        names = tuple(run)
        owned = {f"{name}.device" for name in names}
        played = [p.name for p in graph.participants if p.name not in {*names, *owned}]
        super().__init__(graph, played, keep_frames=keep_frames)
        self._ends_run = frozenset(ends_run)
        self._graph = InProcessGraph(graph, run=names)
        self._ports = {name: self._graph.bus.port(name) for name in played}
        self._stopped = False
        self._graph.__enter__()
        self._collect()

    @property
    def now_ns(self) -> int:
        """The run's time, integer nanoseconds."""
        return self._graph.clock.now_ns()

    @property
    def ended(self) -> Ended | None:
        """How the run ended: by the node that ends it, or by the first that failed."""
        for name, runner in self._graph.runners.items():
            if runner.exit is not None and (name in self._ends_run or runner.exit.code != 0):
                return Ended(name, runner.exit.code, runner.exit.text)
        return None

    def node(self, name: str) -> Node[Any]:
        """Return a node that runs."""
        if name not in self._graph.runners:
            raise unknown("node", name, self._graph.runners)
        return self._graph.runners[name].node

    # -- going on

    def settle(self) -> None:
        """Let the nodes do all that they can at this moment of the run's clock."""
        while self._graph.step():
            self._collect()
        self._collect()

    def advance(self, seconds: float) -> None:
        """Let the run's clock go on by so much, from timer to timer.

        Not where a node tells the time (simulation, replay): wait for a message instead.
        """
        tellers = [name for name, runner in self._graph.runners.items() if "/clock" in runner.gives]
        if tellers:
            raise MisuseError(f"{tellers[0]} tells the time in this run; wait for a message")
        end_ns = self.now_ns + round(1e9 * seconds)
        self.settle()
        while True:
            timers = [r.next_timer_ns() for r in self._graph.runners.values() if r.exit is None]
            due = min((t for t in timers if t is not None and t <= end_ns), default=None)
            if due is None:
                break
            self._graph.clock.tell(due)
            self.settle()
        self._graph.clock.tell(end_ns)
        self.settle()

    def feed(self, recorded: Iterable[Envelope]) -> None:
        """Hand recorded messages to the nodes that take them, headers and all, one at a time.

        A :class:`~tvbrdf_launch.testing.bags.Bag` may be given as it is. What a node said that
        runs here itself is left out, and the recorded clock too.
        """
        takes = {name: set(self.graph.find(name).takes) for name in self._graph.runners}
        for envelope in recorded:
            if envelope.header.publisher in takes or envelope.topic == "/clock":
                continue
            for name, topics in takes.items():
                port = self._graph.bus.ports.get(name)
                if envelope.topic in topics and port is not None:
                    port.take(envelope)
            self.settle()

    def ask(self, node: str, verb: str, **arguments: Any) -> OperatorReply:
        """See :meth:`.run.Run.ask`."""
        if not self.node(node).has_service:
            able = [n for n, runner in self._graph.runners.items() if runner.node.has_service]
            raise MisuseError(f"{node} takes no requests; who does: {', '.join(able) or 'nobody'}")
        runner = self._graph.runners[node]
        request = OperatorRequest(request_id=uuid.uuid4().hex, verb=verb, arguments=arguments)
        runner.put(runner.node.on_request(request))

        def answers() -> list[Any]:
            return [each for each in runner.replies if each.request_id == request.request_id]

        self.wait_until(answers, f"the answer of {node} to {verb!r}")
        (reply,) = answers()
        runner.replies.remove(reply)
        return OperatorReply(
            request_id=reply.request_id, ok=reply.ok, text=reply.text, data=reply.data
        )

    def _until(self, done: Callable[[], bool], timeout_s: float) -> str:
        def there() -> bool:
            self._collect()
            return done() or self.ended is not None

        if there() and done():
            return ""
        if self._stopped:
            return "the run has been stopped"
        try:
            self._graph.run_until(there, timeout_s)
        except TimeoutError:
            return f"not within {timeout_s:g} s"
        except RuntimeError as error:
            if str(error) != _NOTHING_LEFT:
                raise
            return _NOTHING_LEFT
        for _ in range(LAST_STEPS):
            if done():
                return ""
            busy = self._graph.step()
            self._collect()
            if not busy:
                break
        return "" if done() else "the run has ended"

    def _collect(self) -> None:
        taps = self._graph.bus.taps
        for envelope in taps:
            self._note(envelope)
        taps.clear()
        for port in self._ports.values():
            while port.receive(1000):
                pass  # all of it is in the history

    # -- the end

    def stop(self) -> None:
        """Stop all nodes, also when one of them fails to."""
        if self._stopped:
            return
        self._stopped = True
        with contextlib.ExitStack() as last:
            last.callback(self._collect)
            last.callback(self._graph.stop)

    def kill(self, name: str) -> None:
        """Let a participant that the test plays vanish, as one whose process was killed."""
        self._played(name).close()
        self.settle()

    def return_(self, name: str) -> None:
        """Start a participant that the test plays again, as a new incarnation."""
        self._played(name)
        self._ports[name] = self._graph.bus.port(name)
        self.settle()

    def _played(self, name: str) -> InProcessPort:
        if name not in self._ports:
            raise unknown("a participant that the test plays,", name, self.played)
        port = self._ports[name]
        assert isinstance(port, InProcessPort)
        return port

    def _node_states(self) -> dict[str, str]:
        states = {}
        for name, runner in self._graph.runners.items():
            end = runner.exit
            states[name] = (
                runner.state if end is None else f"has ended (code {end.code}: {end.text})"
            )
        return states | dict.fromkeys(self.played, "played by the test")
