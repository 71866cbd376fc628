"""Runs of real processes: a launcher with its nodes, watched over sockets."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import zmq

from tvbrdf_messages.bus import ZmqPort
from tvbrdf_messages.bus.watcher import ServiceClient
from tvbrdf_messages.errors import BusError
from tvbrdf_messages.messages import Clock, Diagnostics, OperatorReply
from tvbrdf_messages.run_directory import Graph

from ..errors import RunError
from ..process_table import ProcessRecord, read_processes, wait_until_gone
from .errors import MisuseError, WaitError, unknown
from .plans import WATCHER, watched
from .run import Ended, Run

START_S = 60.0
"""Processes load numpy and more; busy machines are slow at that."""
STOP_S = 30.0
QUIET_MS = 50
"""Without a message, after the launcher's end: nothing more is on its way."""
DRAIN_LIMIT_S = 5.0
KILL_S = 5.0


class ProcessRun(Run):
    """A launcher in a process of its own, and its nodes in theirs.

    The test is a reader of all topics for which nobody waits: what it has not read within 64 MiB
    is left out, and told when a wait fails. Participants that it plays are read while it waits.

    Parameters
    ----------
    graph
        As the launcher will have it (made by the same function).
    played
        Names of the participants that the test plays.
    spec
        What the launcher's process needs to make the same plan.
    folder
        Private, with a short path; removed by :meth:`stop`.
    """

    def __init__(
        self,
        graph: Graph,
        played: tuple[str, ...],
        spec: Mapping[str, Any],
        folder: Path,
        *,
        keep_frames: bool,
    ) -> None:
        super().__init__(watched(graph, keep_frames=keep_frames), played, keep_frames=keep_frames)
        self._folder = folder
        self._output = folder / "output.txt"
        self._states: dict[str, str] = {}
        self._now_ns = 0
        self._records: dict[str, ProcessRecord] = {}
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._all_ports: dict[str, ZmqPort] = {}
        self._poller = zmq.Poller()
        self._gone = False
        """Whether the launcher has ended, and all that its nodes said has been taken."""
        self._stopped = False
        self._text = ""
        self._pidfd = -1
        self._process = self._launch(spec)
        try:
            self._pidfd = os.pidfd_open(self._process.pid)
            self._poller.register(self._pidfd, zmq.POLLIN)
            self._open_ports()
            self._await_registration()
        except BaseException:
            self.stop()
            raise

    # -- starting

    def _launch(self, spec: Mapping[str, Any]) -> subprocess.Popen[bytes]:
        path = self._folder / "spec.json"
        path.write_text(json.dumps(spec))
        self._made, told = os.pipe()
        environment = {k: v for k, v in os.environ.items() if not k.startswith("TVBRDF_")}
        environment["XDG_RUNTIME_DIR"] = str(self._folder)
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
        command = [sys.executable, "-P", "-m", "tvbrdf_launch.testing.child", str(path), str(told)]
        try:
            with self._output.open("wb") as output:
                return subprocess.Popen(
                    command,
                    env=environment,
                    stdin=subprocess.PIPE,  # its end is the launcher's, whatever ends the test
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    pass_fds=(told,),
                    start_new_session=True,
                )
        except BaseException:
            os.close(self._made)
            raise
        finally:
            os.close(told)

    def _open_ports(self) -> None:
        """Join the run, as soon as its directory is there."""
        try:
            poller = zmq.Poller()
            poller.register(self._made, zmq.POLLIN)
            if not poller.poll(int(1000 * START_S)) or not os.read(self._made, 1):
                raise WaitError(f"the launcher does not start:\n{self.output}")
        finally:
            os.close(self._made)
        for name in (*self.played, WATCHER):
            self._all_ports[name] = ZmqPort(self.graph, name, self._context)
        self._ports = {name: self._all_ports[name] for name in self.played}
        for port in self._all_ports.values():
            for socket in port.sockets():
                self._poller.register(socket, zmq.POLLIN)

    def _await_registration(self) -> None:
        watcher = self._all_ports[WATCHER]
        why = self._until(watcher.subscriber.registered, START_S)
        if why:
            raise self._in_vain("the start of all nodes", f"{why}\n{self.output}")

    # -- how it is

    @property
    def output(self) -> str:
        """What the launcher printed."""
        if self._stopped:
            return self._text
        return self._output.read_text(errors="replace") if self._output.exists() else ""

    @property
    def now_ns(self) -> int:
        """The run's time, integer nanoseconds: as last told, or this host's."""
        return self._now_ns or time.time_ns()

    @property
    def ended(self) -> Ended | None:
        """How the launcher ended."""
        code = self._process.poll()
        return None if code is None else Ended("launcher", code, self.output)

    def processes(self) -> dict[str, ProcessRecord]:
        """Return the processes of the run that are still there, by name."""
        with contextlib.suppress(RunError):
            table = read_processes(Path(self.graph.directory))
            self._records |= {"launcher": table.launcher, **table.nodes}
        return {name: record for name, record in self._records.items() if record.alive()}

    def kill(self, name: str, number: signal.Signals = signal.SIGKILL) -> None:
        """Send a node's process a signal: SIGKILL by default."""
        alive = self.processes()
        if name not in alive:
            raise unknown("process", name, alive)
        alive[name].send(number)

    def ask(self, node: str, verb: str, **arguments: Any) -> OperatorReply:
        """See :meth:`.run.Run.ask`."""
        try:
            with ServiceClient(self.graph, node) as client:
                return client.ask(verb, arguments, START_S)
        except BusError as error:
            raise MisuseError(str(error)) from None

    def send(self, *arguments: Any, **options: Any) -> None:
        """See :meth:`.run.Run.send`."""
        super().send(*arguments, **options)
        for port in self._all_ports.values():
            port.flush()

    def logs(self) -> list[str]:
        """Return what the launcher printed and the nodes wrote, a line each."""
        found = self.output.splitlines()
        for path in sorted(Path(self.graph.directory).glob("*.log")):
            if path.stem != "launch":
                lines = path.read_text(errors="replace").splitlines()[-5:]
                found += [f"{path.stem}: {line}" for line in lines]
        return found

    def _node_states(self) -> dict[str, str]:
        gaps = self._all_ports[WATCHER].counters()["gaps"] if WATCHER in self._all_ports else 0
        states = dict(self._states)
        if gaps:
            states["the test"] = f"read too slowly: {gaps} messages were left out"
        return states | dict.fromkeys(self.played, "played by the test")

    # -- going on

    def _until(self, done: Callable[[], bool], timeout_s: float) -> str:
        deadline = time.monotonic() + timeout_s
        while not done():
            if self._stopped:
                return "the run has been stopped"
            if self._gone:
                return f"the run has ended\n{self.output}"
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                return f"not within {timeout_s:g} s"
            if self._pump(int(1000 * left_s) + 1):
                self._drain()
        return ""

    def _pump(self, timeout_ms: int) -> bool:
        """Take what comes; say whether the launcher has ended."""
        ready = dict(self._poller.poll(timeout_ms))
        for name, port in self._all_ports.items():
            port.service()
            for envelope in port.receive(1000):
                if name == WATCHER:
                    self._take(envelope)
            port.flush()
        return self._pidfd in ready

    def _drain(self) -> None:
        """Take what was sent before the end."""
        self._poller.unregister(self._pidfd)
        deadline = time.monotonic() + DRAIN_LIMIT_S
        while self._poller.poll(QUIET_MS) and time.monotonic() < deadline:
            self._pump(0)
        self._gone = True

    def _take(self, envelope: Any) -> None:
        message = envelope.message
        if isinstance(message, Clock):
            self._now_ns = message.now_ns
        elif isinstance(message, Diagnostics):
            self._states[message.node] = f"{message.state} {message.text}".strip()
        self._note(envelope)

    # -- the end

    def stop(self) -> None:
        """Stop the run in order; end what does not end, close and remove everything."""
        if self._stopped:
            return
        try:
            self._interrupt()
        finally:
            self._text = self.output
            self._stopped = True
            for port in self._all_ports.values():
                port.close()
            self._context.destroy(linger=0)
            if self._pidfd >= 0:
                os.close(self._pidfd)
            shutil.rmtree(self._folder, ignore_errors=True)

    def _interrupt(self) -> None:
        process = self._process
        assert process.stdin is not None
        if self._pidfd >= 0 and process.poll() is None:
            process.send_signal(signal.SIGINT)
            self._until(lambda: process.poll() is not None, STOP_S)
        process.stdin.close()
        if process.poll() is None:
            process.kill()
        process.wait()
        self.processes()  # the last table names them all
        if not wait_until_gone(self._records.values(), KILL_S):
            for record in self._records.values():
                record.send(signal.SIGKILL)
            wait_until_gone(self._records.values(), KILL_S)
