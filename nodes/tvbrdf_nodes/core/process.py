"""The shell that runs one node as a process over ZeroMQ.

``python -m tvbrdf_nodes.core.process --run DIR --name NAME``: started by the launcher, which holds
the other end of standard input: its EOF means that the launcher is gone, and ends the node.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import signal
import sys
import threading
import time
import traceback
from dataclasses import asdict
from typing import Any

import msgpack
import zmq

from tvbrdf_messages.bus import Port, ZmqPort
from tvbrdf_messages.bus.zmq_publisher import readable
from tvbrdf_messages.clock import RunClock, SystemClock, ToldClock
from tvbrdf_messages.errors import BusError, StoppedError
from tvbrdf_messages.messages import OperatorRequest
from tvbrdf_messages.run_directory import Graph, read_graph

from .device import DeviceError
from .runner import FAULT, READY, RUNNING, STOPPING, NodeRunner

DIAGNOSTICS_S = 1.0
DRAIN_LIMIT_S, DRAIN_QUIET_MS = 2.0, 50
"""At most, and after how long without a message."""
STOP_LIMIT_S = 5.0
"""A node that has not ended by then after its launcher is gone is ended."""


class NodeProcess:
    """Runs one node until it is done, told to stop, or its launcher is gone."""

    def __init__(self, graph: Graph, name: str, lifeline: int | None) -> None:
        self._stopping = threading.Event()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK)
        self._signalled = False
        self._graph = graph
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._links: list[ZmqPort] = []
        clock: RunClock = (
            ToldClock(graph.utc_ns)
            if graph.simulated
            else SystemClock(graph.utc_ns, graph.monotonic_ns)
        )
        self.port = ZmqPort(graph, name, self._context, stopping=self._stopping.is_set)
        self.runner = NodeRunner(graph, name, clock, self.port, self._open_link)
        self._service: zmq.Socket[bytes] | None = None
        if self.runner.node.has_service:
            self._service = self._context.socket(zmq.ROUTER)
            self._service.linger = 500
            self._service.bind(graph.endpoint(name, "service"))
        self._askers: dict[str, bytes] = {}
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: self.stop())
        signal.signal(signal.SIGUSR1, lambda *_: self._signal())
        if lifeline is not None:
            threading.Thread(
                target=self._watch_lifeline, args=(lifeline,), name="lifeline", daemon=True
            ).start()

    def _open_link(self, name: str) -> Port:
        link = ZmqPort(self._graph, name, self._context, stopping=self._stopping.is_set)
        self._links.append(link)
        return link

    def stop(self) -> None:
        """End soon; may be called from a signal handler or another thread."""
        self._stopping.set()
        os.eventfd_write(self._wake, 1)

    def _signal(self) -> None:
        self._signalled = True
        os.eventfd_write(self._wake, 1)

    def _watch_lifeline(self, lifeline: int) -> None:
        with contextlib.suppress(OSError):
            while os.read(lifeline, 64):
                pass
        self.stop()
        if threading.Event().wait(STOP_LIMIT_S):  # pragma: no cover - never set
            return
        os._exit(4)  # the main thread hangs, and nobody else is left to end it

    # -- the loop

    def run(self) -> int:
        """Run the node; return the process's exit code."""
        runner = self.runner
        code = 0
        try:
            if self._wait_for_readers():
                runner.set_state(READY)
                runner.node.prepare()
                self.port.events()  # of the registrations that were waited for
                runner.put(runner.node.start())
                runner.set_state(RUNNING)
                gc.collect()
                gc.freeze()  # what was made at the start is never garbage
                self._loop()
                if runner.node.drains and runner.exit is None:
                    self._drain()
        except StoppedError:
            pass
        except (DeviceError, BusError, OSError) as error:
            code = self._fail(str(error))
        except Exception as error:  # noqa: BLE001 - the log must tell, and the device be made safe
            traceback.print_exc()
            code = self._fail(f"{type(error).__name__}: {error}")
        return self._end(code)

    def _wait_for_readers(self) -> bool:
        poller = zmq.Poller()
        for socket in (*self.port.sockets(), self._wake):
            poller.register(socket, zmq.POLLIN)
        while not self._stopping.is_set():
            self.port.service()
            if self.port.ready():
                return True
            poller.poll(1000)
        return False

    def _loop(self) -> None:
        runner, node, port = self.runner, self.runner.node, self.port
        poller = zmq.Poller()
        polled: list[Any] = []
        next_diagnostics = time.monotonic() + DIAGNOSTICS_S
        while not self._stopping.is_set() and runner.exit is None:
            wanted = [*port.sockets(), self._wake, *node.waitables()]
            if self._service is not None:
                wanted.append(self._service)
            if wanted != polled:
                poller, polled = _poller(wanted), wanted
            busy = runner.pending()
            ready = dict(poller.poll(0 if busy else self._timeout_ms(next_diagnostics)))
            if self._wake in ready:
                with contextlib.suppress(BlockingIOError):
                    os.eventfd_read(self._wake)
            if self._signalled:
                self._signalled = False
                runner.put(getattr(node, "on_signal", tuple)())
            port.service(ready)
            runner.take_messages()
            runner.put(node.poll())
            runner.fire_timers()
            self._serve()
            now = time.monotonic()
            if now >= next_diagnostics:
                next_diagnostics = now + DIAGNOSTICS_S
                runner.tell_diagnostics()
            port.flush()

    def _drain(self) -> None:
        """Take what was sent before the stop: nodes stop along the data, so nothing follows."""
        poller = _poller(self.port.sockets())
        deadline = time.monotonic() + DRAIN_LIMIT_S
        while time.monotonic() < deadline and poller.poll(DRAIN_QUIET_MS):
            self.port.service()
            self.runner.take_messages()
            self.port.flush()

    def _timeout_ms(self, next_diagnostics: float) -> int:
        runner = self.runner
        timeout_s = next_diagnostics - time.monotonic()
        watchdog_s = runner.next_watchdog_s()
        if watchdog_s is not None:
            timeout_s = min(timeout_s, watchdog_s)
        timer_ns = runner.next_timer_ns()
        if timer_ns is not None:
            left_s = (timer_ns - runner.clock.now_ns()) / 1e9
            if left_s <= 0 or not isinstance(runner.clock, ToldClock):
                timeout_s = min(timeout_s, left_s)
        return max(0, int(timeout_s * 1000) + 1) if timeout_s > 0 else 0

    # -- people's requests

    def _serve(self) -> None:
        if self._service is None:
            return
        while readable(self._service):
            parts = self._service.recv_multipart(zmq.DONTWAIT)
            try:
                identity, body = parts
                raw = msgpack.unpackb(body)
                request = OperatorRequest(
                    request_id=str(raw["request_id"]),
                    verb=str(raw["verb"]),
                    arguments=dict(raw["arguments"]),
                )
            except Exception as error:  # noqa: BLE001 - anything may come in from outside
                self.runner.log.warning(f"refused a request: {error!s:.200}")
                continue
            self._askers[request.request_id] = identity
            self.runner.put(self.runner.node.on_request(request))
        for reply in self.runner.replies:
            identity = self._askers.pop(reply.request_id, b"")
            answer = msgpack.packb(asdict(reply))
            self._service.send_multipart([identity, answer], zmq.DONTWAIT)
        self.runner.replies.clear()

    # -- the end

    def _fail(self, text: str) -> int:
        with contextlib.suppress(Exception):
            self.runner.log.error(text)
            self.runner.set_state(FAULT, text)
        return 1

    def _end(self, code: int) -> int:
        runner = self.runner
        for last in (runner.take_own, lambda: runner.put(runner.node.stop())):
            try:
                with contextlib.suppress(StoppedError):
                    last()
            except Exception as error:  # noqa: BLE001 - the rest must still be closed
                traceback.print_exc()
                code = code or 1
                sys.stderr.write(f"{runner.name}: while stopping: {error}\n")
        with contextlib.suppress(Exception):
            runner.set_state(STOPPING)
            self._serve()
        for port in (*self._links, self.port):
            port.close()
        if self._service is not None:
            self._service.close()
        self._context.term()
        if runner.exit is not None and code == 0:
            code = runner.exit.code
            if runner.exit.text:
                sys.stderr.write(f"{runner.name}: {runner.exit.text}\n")
        return code


def _poller(wanted: list[Any]) -> zmq.Poller:
    poller = zmq.Poller()
    for item in wanted:
        poller.register(item, zmq.POLLIN)
    return poller


def main(argv: list[str] | None = None) -> int:
    """Run the node that the command line names."""
    parser = argparse.ArgumentParser(description="Runs one node of a launched graph.")
    parser.add_argument("--run", required=True, help="the run's directory")
    parser.add_argument("--name", required=True, help="the node's name in its graph")
    parser.add_argument("--no-lifeline", action="store_true", help="do not end on EOF of stdin")
    arguments = parser.parse_args(argv)
    try:
        process = NodeProcess(
            read_graph(arguments.run), arguments.name, None if arguments.no_lifeline else 0
        )
    except (BusError, DeviceError, ValueError, zmq.ZMQError) as error:
        sys.stderr.write(f"{arguments.name}: {error}\n")
        return 2
    return process.run()


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    os._exit(code)  # the lifeline's thread still reads; nothing is left to clean up
