"""What both shells share: a node's context, its timers, and the way of its outputs."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tvbrdf_messages.bus import Port
from tvbrdf_messages.clock import RunClock, ToldClock
from tvbrdf_messages.envelope import Envelope, Header, boot_id, epoch_of, host_name, in_epoch
from tvbrdf_messages.errors import BusError
from tvbrdf_messages.messages import Clock, Diagnostics, Log
from tvbrdf_messages.run_directory import Graph
from tvbrdf_messages.schema import Message
from tvbrdf_messages.topics import LOSSLESS, find_topic

from .loading import load_class
from .node import Exit, Forward, Logger, Node, Outputs, Release, Reply, Send
from .parameters import ParameterError, build

WAITING, READY, RUNNING, FAULT, STOPPING = "waiting", "ready", "running", "fault", "stopping"


class _Log:
    """A node's log: a line on standard error, and a message on ``/log``."""

    def __init__(self, runner: NodeRunner) -> None:
        self._runner = runner

    def info(self, text: str) -> None:
        self._say("info", text)

    def warning(self, text: str) -> None:
        self._say("warning", text)

    def error(self, text: str) -> None:
        self._say("error", text)

    def _say(self, level: str, text: str) -> None:
        runner = self._runner
        if runner.log_to_stderr:
            stamp = time.strftime("%H:%M:%S", time.gmtime(runner.clock.now_ns() // 1_000_000_000))
            sys.stderr.write(f"{stamp} {level:7} {runner.name}: {text}\n")
        if "/log" in runner.gives:
            runner.publish("/log", Log(node=runner.name, level=level, text=text))


class NodeRunner:
    """Owns one node and its port; implements the node's context.

    Parameters
    ----------
    graph, name
        The run's graph and the node's name in it.
    clock
        The run's clock.
    port
        The node's place on the bus.
    open_link
        Opens a further port of this process by its name in the graph.
    """

    def __init__(
        self,
        graph: Graph,
        name: str,
        clock: RunClock,
        port: Port,
        open_link: Callable[[str], Port],
        *,
        log_to_stderr: bool = True,
    ) -> None:
        self.graph, self.name, self.clock, self.port = graph, name, clock, port
        self.incarnation = port.incarnation
        self.run_directory = Path(graph.directory)
        self.open_link = open_link
        self.log_to_stderr = log_to_stderr
        me = graph.find(name)
        self.gives, self.live = frozenset(me.gives), me.live
        self._own: list[Envelope] = []
        """What the node has said itself and is yet to hear."""
        self.log: Logger = _Log(self)
        self.state, self.state_text = WAITING, ""
        self.exit: Exit | None = None
        self.replies: list[Reply] = []
        self._epoch = 0
        """Of the last message that a player sent after a jump."""
        self._timers: dict[str, int] = {}
        self._watchdogs: dict[str, float] = {}
        node_class: type[Node[Any]] = load_class(me.node)
        self._heard = frozenset(me.takes) & self.gives if node_class.hears_itself else frozenset()
        try:
            parameters = build(node_class.parameters_type, me.parameters)
        except ParameterError as error:
            raise BusError(f"node {name}: {error}") from error
        self.node = node_class(self, parameters)

    # -- the node's context

    def set_timer(self, name: str, at_ns: int) -> None:
        """See :class:`.node.NodeContext`."""
        self._timers[name] = at_ns

    def set_watchdog(self, name: str, after_s: float) -> None:
        """See :class:`.node.NodeContext`."""
        self._watchdogs[name] = time.monotonic() + after_s

    def cancel(self, name: str) -> None:
        """See :class:`.node.NodeContext`."""
        self._timers.pop(name, None)
        self._watchdogs.pop(name, None)

    def next_sequence(self, topic: str) -> int:
        """See :class:`.node.NodeContext`."""
        return self.port.next_sequence(topic)

    # -- running it

    def next_timer_ns(self) -> int | None:
        """Return the run-clock time of the next timer."""
        return min(self._timers.values(), default=None)

    def next_watchdog_s(self) -> float | None:
        """Return in how many seconds the next watchdog runs out."""
        if not self._watchdogs:
            return None
        return max(0.0, min(self._watchdogs.values()) - time.monotonic())

    def fire_timers(self) -> bool:
        """Call the node for every timer and watchdog that has run out; say whether any had."""
        now_ns, now_s = self.clock.now_ns(), time.monotonic()
        due = [(at, name) for name, at in self._timers.items() if at <= now_ns]
        late = [(at, name) for name, at in self._watchdogs.items() if at <= now_s]
        for _, name in sorted(due):
            if self._timers.get(name, now_ns + 1) <= now_ns:
                del self._timers[name]
                self.put(self.node.on_timer(name))
        for _, name in sorted(late):
            if self._watchdogs.pop(name, None) is not None:
                self.put(self.node.on_timer(name))
        return bool(due or late)

    def take_messages(self, limit: int = 64) -> bool:
        """Hand arrived messages and events to the node; say whether there were any."""
        own = self.take_own()
        found = self.port.receive(limit)
        events = self.port.events()  # first: what a restarted node sends comes after its return
        for event in events:
            if event.kind == "refused":
                self.log.warning(f"refused from {event.name}: {event.text}")
            elif self.state == RUNNING:
                handler = {
                    "reader": self.node.on_reader,
                    "lost": self.node.on_lost,
                    "found": self.node.on_found,
                }[event.kind]
                self.put(handler(event.name))
        for envelope in found:
            if envelope.topic == "/clock" and isinstance(envelope.message, Clock):
                if isinstance(self.clock, ToldClock):
                    self.clock.tell(envelope.message.now_ns, envelope.message.epoch)
                continue
            self._note_epoch(epoch_of(envelope.header.incarnation))
            self.put(self.node.handle(envelope))
        return bool(own or found or events)

    def pending(self) -> bool:
        """Return whether the node has something to do at once."""
        return bool(self._own) or self.node.pending()

    def take_own(self) -> bool:
        """Hand the node what it has said itself, if it hears that; say whether there was any.

        Not while it speaks: so what it says about that comes behind, and can't go round in it.
        """
        own, self._own = self._own, []
        for envelope in own:
            self.put(self.node.handle(envelope))
        return bool(own)

    def _note_epoch(self, epoch: int) -> None:
        """Tell the node of a replay's jump before the first message that was sent after it.

        What the node says from then on tells it to the nodes behind it.
        """
        if epoch > self._epoch:
            self._epoch = epoch
            self.port.begin_epoch(epoch)
            self.put(self.node.on_epoch(epoch))

    def put(self, outputs: Outputs) -> None:
        """Carry out what a handler returned."""
        for output in outputs:
            if isinstance(output, Send):
                self._publish(output)
            elif isinstance(output, Forward):
                self.port.forward(output.parts)
            elif isinstance(output, Release):
                self.port.release(output.topic, output.key)
            elif isinstance(output, Reply):
                self.replies.append(output)
            else:
                self.exit = output

    def _publish(self, send: Send) -> None:
        if isinstance(send.message, Clock) and isinstance(self.clock, ToldClock):
            self.clock.tell(send.message.now_ns, send.message.epoch)  # its owner lives by it too
        stamp_ns = self.clock.now_ns() if send.stamp_ns is None else send.stamp_ns
        stamps = (stamp_ns, send.received_ns, send.hardware_ns)
        delivered = self.publish(send.topic, send.message, stamps, send.keep)
        if not delivered and self.live and find_topic(send.topic).quality == LOSSLESS:
            self.put(self.node.on_overflow(send.topic))

    def publish(
        self,
        topic: str,
        message: Message,
        stamps: tuple[int, int, int] | None = None,
        keep: str = "",
    ) -> bool:
        """Publish a message; the bus brings nobody what he says himself, so that is kept here.

        ``stamps``: stamp, received and hardware, ns; the first is now when they are not given.
        """
        stamps = stamps or (self.clock.now_ns(), 0, 0)
        sequence = self.port.next_sequence(topic)
        stamp_ns, received_ns, hardware_ns = stamps
        delivered = self.port.publish(
            topic,
            message,
            stamp_ns=stamp_ns,
            received_ns=received_ns,
            hardware_ns=hardware_ns,
            keep=keep,
        )
        if topic in self._heard:
            life = in_epoch(self.incarnation, self._epoch) if self._epoch else self.incarnation
            header = Header(self.name, life, host_name(), boot_id(), sequence, *stamps)
            self._own.append(Envelope(topic, header, message))
        return delivered

    def set_state(self, state: str, text: str = "") -> None:
        """Change the node's state and tell it."""
        self.state, self.state_text = state, text
        self.tell_diagnostics()

    def tell_diagnostics(self) -> None:
        """Publish how the node is."""
        if "/diagnostics" not in self.gives:
            return
        self.publish(
            "/diagnostics",
            Diagnostics(
                node=self.name,
                state=self.state,
                text=self.state_text,
                missing_readers=self.port.missing_readers(),
                counters={**self.port.counters(), **self.node.diagnostics()},
                resident_mb=resident_mb(),
            ),
        )


def resident_mb() -> float:
    """Return this process's resident memory in MB."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * resource.getpagesize() / 1e6
    except (OSError, ValueError, IndexError):
        return 0.0
