"""The launcher: starts, watches, restarts and stops one process a node.

It waits for everything in one place: ends of processes (as file numbers), signals (through a pipe),
messages for people, and the next moment at which something is due.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import time
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

from tvbrdf_nodes.core.node import GIVE_UP

from .display import Display
from .errors import RunError
from .node_process import NodeProcess, describe_exit
from .plan import Plan
from .process_table import ProcessRecord, ProcessTable, start_ticks
from .run_folder import RunFolder, remove_old_runs
from .stop_order import stop_stages

if TYPE_CHECKING:
    from tvbrdf_messages.bus.watcher import Watcher

STOP_S = 5.0
"""What a node has from SIGINT to SIGTERM."""
TERMINATE_S = 3.0
"""What it then has until SIGKILL."""
HURRY_S = 1.0
"""Both, after a second Ctrl-C."""
WORKED_S = 60.0
"""A node that worked that long has all its restarts again."""
RUNNING_S = 15.0
"""After that it is told which nodes do not run."""
OK, FAILED = 0, 1
POLLIN = 1
"""``zmq.POLLIN``, without loading zmq."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
TOPICS = ("/scan/status", "/scan/parameters", "/log", "/diagnostics")


class Launcher:
    """Carries out a plan.

    Parameters
    ----------
    plan
        Checked: see :func:`~tvbrdf_launch.plan.make_plan`.
    folder
        The run's directory, not made yet.
    make_display
        Gives what shows the run; called when all nodes have been started.
    """

    def __init__(self, plan: Plan, folder: RunFolder, make_display: Callable[[], Display]) -> None:
        self._plan, self._folder, self._make_display = plan, folder, make_display
        self._run = folder.path
        self._nodes = {n.name: NodeProcess(n, self._run) for n in plan.nodes}
        self._silent = {n for n in self._nodes if "/diagnostics" not in plan.graph.find(n).gives}
        """Nodes that can't say how they are."""
        self._counted = {p.name for p in plan.graph.participants if p.counted_bytes}
        """Nodes for which nobody waits: once they have run, the run goes on without them."""
        self._table = ProcessTable(ProcessRecord(os.getpid(), start_ticks(os.getpid())))
        self._code = OK
        self._interrupts = 0
        self._restarts_due: dict[str, float] = {}
        self._running_due = math.inf
        self._tick_due = math.inf
        self._stages: list[tuple[str, ...]] | None = None
        """Groups of nodes that are still to be stopped; None: the run goes on."""
        self._stopping: tuple[str, ...] = ()
        self._terminate_due = math.inf
        self._kill_due = math.inf
        self._killed: set[str] = set()
        self._watcher: Watcher | None = None
        self._poller: Any = None

    def run(self) -> int:
        """Run the plan to its end.

        Returns
        -------
        int
            0 when it ended as it should, 1 when something failed, 128 + signal when interrupted.

        Raises
        ------
        RunError
            If the run's directory can't be used.
        """
        with _SignalPipe() as signals:
            self._folder.make(self._plan)
            try:
                self._write_first_table()
                remove_old_runs()
                self._start_all()
                self._open_poller(signals.fileno())
                self._display.say(f"run {self._run}: {len(self._nodes)} nodes")
                while self._busy():
                    self._wait(signals)
            finally:
                for node in self._nodes.values():
                    node.kill_and_reap()  # none is left unless something above went wrong
                if self._watcher is not None:
                    self._watcher.close()
                self._write_table("ended")
                self._say_end()
                self._display.close()
                self._folder.release()
        return self._code

    def _write_first_table(self) -> None:
        try:
            self._table.write(self._run)
        except OSError as error:
            raise RunError(f"can't write into {self._run}: {error.strerror}") from error

    @cached_property
    def _display(self) -> Display:
        display = self._make_display()
        with contextlib.suppress(OSError):
            display.open_log(self._run)
        return display

    def _busy(self) -> bool:
        return any(node.alive for node in self._nodes.values()) or bool(self._restarts_due)

    def _start_all(self) -> None:
        for node in self._nodes.values():
            if not self._start(node):
                break
        self._running_due = time.monotonic() + RUNNING_S
        self._write_table("running" if self._stages is None else "stopping")

    def _start(self, node: NodeProcess) -> bool:
        try:
            node.start()
        except OSError as error:
            self._fail(f"node {node.name} can't be started: {error.strerror}")
            return False
        if self._poller is not None:
            self._poller.register(node.pidfd, POLLIN)
        self._table.nodes[node.name] = node.record
        return True

    def _open_poller(self, signals: int) -> None:
        import zmq  # only now: the nodes load their own meanwhile

        from tvbrdf_messages.bus.watcher import Watcher

        self._poller = zmq.Poller()
        self._poller.register(signals, POLLIN)
        for node in self._nodes.values():
            if node.alive:
                self._poller.register(node.pidfd, POLLIN)
        given = {topic for p in self._plan.graph.participants for topic in p.gives}
        topics = [topic for topic in TOPICS if topic in given]
        if topics:
            self._watcher = Watcher(self._plan.graph, topics)
            self._poller.register(self._watcher.socket, POLLIN)
        if self._display.tick_s is not None:
            self._tick_due = time.monotonic()

    # -- waiting

    def _wait(self, signals: _SignalPipe) -> None:
        """Wait until something happens or is due, and deal with it."""
        due = (self._running_due, self._tick_due, self._terminate_due, self._kill_due)
        next_s = min((*due, *self._restarts_due.values()))
        wait_s = next_s - time.monotonic()
        wait_ms = None if math.isinf(wait_s) else max(0, math.ceil(1000 * wait_s))
        events = dict(self._poller.poll(wait_ms))
        for number in signals.take():
            self._interrupt(number)
        self._take_messages()
        for node in self._nodes.values():
            if node.alive and node.pidfd in events:
                self._take_exit(node)
        self._do_what_is_due()

    def _do_what_is_due(self) -> None:
        now = time.monotonic()
        for name in [name for name, due in self._restarts_due.items() if due <= now]:
            del self._restarts_due[name]
            if self._start(self._nodes[name]):
                self._write_table("running")
        if now >= self._running_due:
            self._running_due = math.inf
            late = [
                name
                for name, node in self._nodes.items()
                if node.alive and not node.reports and name not in self._silent
            ]
            if late and self._stages is None:
                self._display.say(f"these do not run yet: {', '.join(late)}")
        if now >= self._tick_due:
            self._tick_due = now + (self._display.tick_s or math.inf)
            self._display.tick()
        if now >= self._terminate_due:
            self._terminate_due = math.inf
            for node in self._still_stopping():
                self._display.say(f"{node.name} does not stop; SIGTERM")
                node.terminate()
        if now >= self._kill_due:
            self._kill_due = math.inf
            self._kill(self._still_stopping())

    def _take_messages(self) -> None:
        if self._watcher is None:
            return
        for _ in range(256):  # people's messages never hold up the rest
            arrival = self._watcher.receive(0)
            if arrival is None:
                return
            message: Any = arrival.envelope.message
            node = self._nodes.get(arrival.envelope.header.publisher)
            told = arrival.envelope.topic == "/diagnostics" and message.state == "running"
            if told and node is not None:
                node.report()
            with contextlib.suppress(ValueError, TypeError, ArithmeticError):
                self._display.take(arrival.envelope)  # a strange message never ends the run

    # -- ends of nodes

    def _take_exit(self, node: NodeProcess) -> None:
        self._poller.unregister(node.pidfd)
        code = node.reap()
        self._table.nodes[node.name] = node.record
        if self._stages is not None:
            self._take_end(node, code)
        elif code == 0:
            self._take_success(node)
        else:
            self._take_failure(node, code)
        self._write_table("running" if self._stages is None else "stopping")

    def _take_success(self, node: NodeProcess) -> None:
        if node.plan.ends_run:
            self._display.say(f"{node.name} has finished")
            self._stop(OK)
        elif node.plan.restart.policy == "always":
            self._restart(node, "has ended")
        else:
            self._display.say(f"{node.name} has ended")

    def _take_failure(self, node: NodeProcess, code: int) -> None:
        what = f"node {node.name} failed ({describe_exit(code)})"
        by_itself = code > 0
        if by_itself and not node.has_run and node.name not in self._silent:
            self._fail(f"node {node.name} failed at start ({describe_exit(code)})", node)
        elif node.plan.restart.policy == "never" and node.name in self._counted:
            self._go_on_without(node, what)
        elif (
            node.plan.restart.policy == "never"
            or code == GIVE_UP
            or (by_itself and node.plan.ends_run)
        ):
            self._fail(what, node)
        else:
            self._restart(node, f"failed ({describe_exit(code)})")

    def _restart(self, node: NodeProcess, what: str) -> None:
        policy = node.plan.restart
        now = time.monotonic()
        if now - node.started_s > WORKED_S:
            node.restarts = 0
        if node.restarts >= policy.max_restarts:
            times = f"{node.restarts} restarts" if node.restarts != 1 else "1 restart"
            text = f"node {node.name} {what} after {times}"
            if node.name in self._counted:
                self._go_on_without(node, text)
            else:
                self._fail(text, node)
            return
        node.restarts += 1
        self._display.say(
            f"node {node.name} {what}; restart {node.restarts} of {policy.max_restarts}"
        )
        self._restarts_due[node.name] = now + policy.delay_s

    def _go_on_without(self, node: NodeProcess, text: str) -> None:
        self._report(f"{text}; the run goes on without it", node)

    def _take_end(self, node: NodeProcess, code: int) -> None:
        """Take note of the end of a node while the run is being stopped."""
        if code != 0 and node.name not in self._killed:
            when = "while it stopped" if node.stop_sent else "before it was asked to stop"
            text = f"node {node.name} failed {when} ({describe_exit(code)})"
            if self._code == OK:
                self._report(text, node)
                self._code = FAILED
            else:  # most likely a consequence; the cause has been told
                self._display.say(f"{text}; see {node.log_path}")
        if not self._still_stopping():
            self._stop_next()

    # -- stopping

    def _interrupt(self, number: int) -> None:
        self._interrupts += 1
        if self._interrupts == 1 and self._stages is None:
            name = signal.Signals(number).name
            self._display.say(f"{name}: stopping in order (once more: hurry)")
            self._stop(128 + number)
        elif self._interrupts <= 2:
            self._display.say("stopping at once (once more: kill)")
            self._stages = []
            self._begin_to_stop(tuple(self._nodes), HURRY_S, HURRY_S)
        else:
            self._kill([node for node in self._nodes.values() if node.alive])

    def _fail(self, text: str, node: NodeProcess | None = None) -> None:
        self._report(text, node)
        self._stop(FAILED)

    def _report(self, text: str, node: NodeProcess | None) -> None:
        lines = node.last_lines() if node is not None else []
        if node is not None and lines:
            text = "\n  | ".join([f"{text}; the end of {node.log_path}:", *lines])
        self._display.fail(text)

    def _stop(self, code: int) -> None:
        """Begin to stop everything in order."""
        if self._stages is not None:
            return
        self._code = code
        self._restarts_due.clear()
        self._stages = list(stop_stages(self._plan.graph))
        self._stop_next()

    def _stop_next(self) -> None:
        self._terminate_due = self._kill_due = math.inf
        while self._stages:
            stage = tuple(name for name in self._stages.pop(0) if self._nodes[name].alive)
            if stage:
                self._begin_to_stop(stage, STOP_S, TERMINATE_S)
                return

    def _begin_to_stop(self, names: tuple[str, ...], stop_s: float, terminate_s: float) -> None:
        self._stopping = names
        self._terminate_due = time.monotonic() + stop_s
        self._kill_due = self._terminate_due + terminate_s
        for node in self._still_stopping():
            node.ask_to_stop()

    def _still_stopping(self) -> list[NodeProcess]:
        return [self._nodes[name] for name in self._stopping if self._nodes[name].alive]

    def _kill(self, nodes: list[NodeProcess]) -> None:
        for node in nodes:
            self._display.say(f"{node.name} does not stop; SIGKILL")
            self._killed.add(node.name)
            if not self._interrupts:
                self._code = self._code or FAILED
            node.signal(signal.SIGKILL)

    # -- the end

    def _write_table(self, state: str) -> None:
        self._table.state = state
        self._table.exit_code = self._code if state == "ended" else None
        with contextlib.suppress(OSError):  # a full disk must not keep nodes from being stopped
            self._table.write(self._run)

    def _say_end(self) -> None:
        how = {OK: "ended", FAILED: "failed"}.get(self._code, "was interrupted")
        self._display.say(f"the run {how}; its logs are in {self._run}")


class _SignalPipe:
    """Makes signals readable, in place of their handlers, for as long as it is entered."""

    def __enter__(self) -> _SignalPipe:
        self._read, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._old_descriptor = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        self._old = {number: signal.signal(number, lambda *_: None) for number in SIGNALS}
        return self

    def fileno(self) -> int:
        return self._read

    def take(self) -> list[int]:
        """Return the numbers of the signals that came since the last call."""
        try:
            return [n for n in os.read(self._read, 64) if n in SIGNALS]
        except BlockingIOError:
            return []

    def __exit__(self, *_: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._old_descriptor)
        os.close(self._read)
        os.close(self._write)
