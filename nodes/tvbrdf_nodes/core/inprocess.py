"""The shell that runs nodes of a graph inside one process: for tests and for refitting.

The same node classes, the same contract of the bus, no sockets. The clock moves when nothing is
left to do: to the next timer, or as the world tells it.
"""

from __future__ import annotations

import contextlib
import select
import time
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType

from tvbrdf_messages.bus import InProcessBus
from tvbrdf_messages.clock import ToldClock
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.run_directory import Graph

from .runner import READY, RUNNING, STOPPING, NodeRunner

LONGEST_WAIT_S = 0.05


class InProcessGraph:
    """Runs some or all nodes of a graph in this thread.

    Parameters
    ----------
    graph
        Who is there. Participants that are not in ``run`` are free for the test to play.
    run
        Names of the nodes to run; all by default.
    """

    def __init__(self, graph: Graph, run: Iterable[str] | None = None) -> None:
        self.bus = InProcessBus(graph)
        self.bus.record = True
        self.clock = ToldClock(graph.utc_ns)
        self._stopped = False
        names = [p.name for p in graph.participants if p.node] if run is None else list(run)
        self.runners: dict[str, NodeRunner] = {}
        with self._stopped_on_failure():
            for name in names:
                port = self.bus.port(name)
                self.runners[name] = NodeRunner(
                    graph, name, self.clock, port, self.bus.port, log_to_stderr=False
                )

    @contextlib.contextmanager
    def _stopped_on_failure(self) -> Iterator[None]:
        """Close what was opened if not all of it can be."""
        try:
            yield
        except BaseException:
            with contextlib.suppress(Exception):  # the first error is the one to tell
                self.stop()
            raise

    def __enter__(self) -> InProcessGraph:
        """Start all nodes; none stays open if one can't."""
        with self._stopped_on_failure():
            for runner in self.runners.values():
                runner.set_state(READY)
                runner.node.prepare()
            for runner in self.runners.values():
                runner.port.events()  # of the registrations: nobody was restarted
                runner.put(runner.node.start())
                runner.set_state(RUNNING)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop all nodes."""
        self.stop()

    def stop(self) -> None:
        """Stop all nodes, also when one of them fails to; twice does no harm."""
        if self._stopped:
            return
        self._stopped = True
        with contextlib.ExitStack() as stack:
            for runner in reversed(self.runners.values()):
                stack.callback(_stop, runner)

    def published(self, topic: str) -> list[Envelope]:
        """Return everything published on a topic so far."""
        return [envelope for envelope in self.bus.taps if envelope.topic == topic]

    def step(self) -> bool:
        """Let every node do what it can at this moment; say whether any did something."""
        busy = False
        for runner in self.runners.values():
            if runner.exit is not None:
                continue
            busy |= runner.take_messages()
            before = len(self.bus.taps)
            runner.put(runner.node.poll())
            busy |= runner.node.pending() or len(self.bus.taps) > before
            busy |= runner.fire_timers()
        return busy

    def run_until(self, done: Callable[[], bool], limit_s: float = 60.0) -> None:
        """Go on until ``done()``; the clock jumps to the next timer when all nodes are idle.

        Raises
        ------
        TimeoutError
            After ``limit_s`` of real time.
        RuntimeError
            When nothing is left that could happen.
        """
        deadline = time.monotonic() + limit_s
        while not done():
            if time.monotonic() > deadline:
                raise TimeoutError(f"not done after {limit_s} s")
            if not self.step():
                self._advance()

    def _advance(self) -> None:
        """Nobody has anything to do: go to the next timer, or wait for a device or watchdog."""
        timers = [r.next_timer_ns() for r in self.runners.values() if r.exit is None]
        nearest = min((t for t in timers if t is not None), default=None)
        told = any("/clock" in runner.gives for runner in self.runners.values())
        if nearest is not None and not told:
            self.clock.tell(nearest)
            return
        devices = [w for r in self.runners.values() for w in r.node.waitables()]
        watchdogs = [r.next_watchdog_s() for r in self.runners.values()]
        soonest = min((s for s in watchdogs if s is not None), default=None)
        if not devices and soonest is None:
            raise RuntimeError("nothing is left that could happen")
        select.select(devices, [], [], LONGEST_WAIT_S if soonest is None else soonest)


def _stop(runner: NodeRunner) -> None:
    with contextlib.ExitStack() as last:
        last.callback(runner.port.close)
        last.callback(runner.set_state, STOPPING)
        last.callback(lambda: runner.put(runner.node.stop()))
        last.callback(runner.take_own)
