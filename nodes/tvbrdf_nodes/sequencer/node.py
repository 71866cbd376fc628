"""The sequencer: repeats scans at the preset interval or when the operator asks, and keeps order.

A scan: dark frames with the lamp off, then one sweep an exposure. A sweep: the arm goes to its
start and the cameras take their exposure (``prepare``), all run (``sweep``), the arm arrives, the
cameras stop (``end_sweep``), the merger says whether it is good. A broken sweep is taken again
within the scan's time slot; after that the scan is recorded as missing, with the reason.
"""

from __future__ import annotations

from typing import Any

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import (
    DatabaseState,
    Diagnostics,
    Mark,
    OperatorRequest,
    ScanCommand,
    ScanMissing,
    Stored,
    SweepResult,
)

from ..core.node import Exit, Node, NodeContext, Output, Outputs, Release, Reply, Send, TopicUse
from .plan import Scan, SequencerParameters, progress

MERGER = "hdr_merger"
WRITER = "database_writer"
_IDLE = ("interval", "waiting for the operator")
_RUNNING = ("sweeping", "ending")


class SequencerNode(Node[SequencerParameters]):
    """Tells arm and cameras what to do next, and waits until it is on disk."""

    parameters_type = SequencerParameters
    has_service = True

    def __init__(self, context: NodeContext, parameters: SequencerParameters) -> None:
        super().__init__(context, parameters)
        self._state = "waiting for nodes"
        self._nodes = {
            p.name for p in context.graph.participants if p.node and "/diagnostics" in p.gives
        } - {context.name}
        self._running: set[str] = set()
        self._database: DatabaseState | None = None
        self._command_id = 0
        self._pending: dict[str, int] = {}
        """Devices that have not yet answered, with the id of the command they should answer."""
        self._next_scan = 1
        self._zero_ns = 0
        self._schedule_ns = 0
        self._scan: Scan | None = None
        self._sweep_count = 0
        self._homed = False
        self._wanted: set[int] = set()
        """Scans that are measured or missing but not yet known to be stored and fitted."""
        self._lost: set[str] = set()
        self._hold = False
        self._requests: dict[int, tuple[str, str, set[str]]] = {}

    @classmethod
    def topics(cls, name: str, parameters: SequencerParameters) -> TopicUse:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return TopicUse(
            takes=(
                "/clock",
                "/diagnostics",
                "/scan/sweep_result",
                "/scan/stored",
                "/scan/database",
            ),
            gives=(
                "/scan/command",
                "/scan/status",
                "/scan/missing",
                "/operator/mark",
                "/diagnostics",
                "/log",
            ),
        )

    # -- what comes in

    def start(self) -> Outputs:
        """Wait for the others."""
        yield self._status("waiting for all nodes")

    def handle(self, envelope: Envelope) -> Outputs:
        """Take results, what is stored, and how the nodes are."""
        message = envelope.message
        if isinstance(message, SweepResult):
            yield from self._take_result(message)
        elif isinstance(message, Stored):
            yield from self._take_stored(message)
        elif isinstance(message, DatabaseState):
            self._database = message
            yield from self._begin_when_ready()
        elif isinstance(message, Diagnostics):
            if message.state == "running":
                self._running.add(message.node)
                yield from self._take_running(message.node)
            else:
                self._running.discard(message.node)

    def on_lost(self, publisher: str) -> Outputs:
        """A node's process is gone: whatever sweep it took part in is broken."""
        node = publisher.removesuffix(".device")
        self._running.discard(node)
        if node not in self._nodes or node in self._lost:
            return
        self._lost.add(node)
        self.context.set_watchdog(f"lost {node}", self.parameters.restart_limit_s)
        self.context.log.warning(f"{node} is gone; waiting for it to be restarted")
        if node in (*self.parameters.cameras, self.parameters.arm, MERGER):
            self._homed = self._homed and node != self.parameters.arm
            yield from self._break(f"{node} was lost")

    def _take_running(self, node: str) -> Outputs:
        if node in self._lost:
            self._lost.discard(node)
            self.context.cancel(f"lost {node}")
            self.context.log.info(f"{node} is back")
            if not self._lost and self._state == "waiting for a restart":
                yield from self._resume()
        yield from self._begin_when_ready()

    def on_timer(self, name: str) -> Outputs:
        """Begin the scan that is due, go on after a wait, or give up on a device."""
        if name.startswith("lost "):
            yield from self._give_up(f"{name.removeprefix('lost ')} did not come back")
        elif name == "answer":
            silent = ", ".join(sorted(self._pending)) or "nobody"
            yield from self._break(f"no answer from {silent}")
        elif name == "due" and self._state == "interval":
            yield from self._begin_scan(self._due_ns(self._next_scan))
        elif name == "warm" and self._state == "warming up":
            yield from self._wait_for_slot()
        elif name == "settled" and self._state == "lamp settling":
            yield from self._prepare_sweep()

    # -- from start to the first scan

    def _begin_when_ready(self) -> Outputs:
        if self._state != "waiting for nodes" or self._database is None:
            return
        if not self._nodes <= self._running:
            return
        stored = {*self._database.scans, *self._database.missing}
        self._next_scan = max(stored, default=0) + 1
        self._zero_ns = self._zero_ns or self._database.zero_ns
        yield from self._home()

    def _home(self) -> Outputs:
        self._state = "homing"
        yield self._status("arm homing")
        yield from self._command("home", [self.parameters.arm], target="arm")

    def _warm_up(self) -> Outputs:
        self._state = "warming up"
        yield self._status(f"lamp warming up for {self.parameters.warm_up_s:g} s")
        yield from self._command("lamp", [], target="arm", lamp=True)
        self.context.set_timer("warm", self._in(self.parameters.warm_up_s))

    def _due_ns(self, number: int) -> int:
        """Return when a scan is due; the schedule starts with the first scan of this run."""
        now_ns = self.context.clock.now_ns()
        if self.parameters.interval_s <= 0:
            return now_ns
        if not self._schedule_ns:
            self._schedule_ns = now_ns - int(1e9 * self.parameters.interval_s * (number - 1))
        return self._schedule_ns + int(1e9 * self.parameters.interval_s * (number - 1))

    def _wait_for_slot(self) -> Outputs:
        """Wait until the next scan is due; record those whose time has passed as missing."""
        self._scan = None
        if self._next_scan > self.parameters.scans:
            self._state = "finishing"
            yield self._status("waiting until everything is stored and fitted")
            yield from self._command("lamp", [], target="arm", lamp=False)
            yield from self._finish_when_stored()
            return
        if self._hold or self.parameters.interval_s <= 0:
            self._state = "waiting for the operator"
            yield self._status("waiting for the operator: tvbrdf scan")
            return
        due_ns = self._due_ns(self._next_scan)
        if self.context.clock.now_ns() > due_ns + int(5e8 * self.parameters.interval_s):
            yield from self._miss(self._next_scan, due_ns, "its time slot had passed")
            yield from self._wait_for_slot()
            return
        self._state = "interval"
        yield self._status(f"scan {self._next_scan} is due")
        self.context.set_timer("due", due_ns)

    # -- one scan

    def _begin_scan(self, due_ns: int) -> Outputs:
        now_ns = self.context.clock.now_ns()
        if not self._zero_ns:
            self._zero_ns = now_ns
        self._scan = Scan(
            number=self._next_scan,
            due_ns=due_ns,
            start_ns=now_ns,
            scan_time_s=(now_ns - self._zero_ns) / 1e9,
        )
        self._wanted.add(self._next_scan)
        yield from self._begin_dark() if self._homed else self._home()

    def _begin_dark(self) -> Outputs:
        if not self.parameters.dark_frames:
            yield from self._prepare_sweep()
            return
        self._state = "dark"
        yield self._status("dark frames")
        yield from self._command("lamp", [self.parameters.arm], target="arm", lamp=False)

    def _prepare_sweep(self) -> Outputs:
        self._state = "preparing"
        yield self._status("preparing")
        yield from self._command("prepare", [self.parameters.arm, *self.parameters.cameras])

    def _run_sweep(self) -> Outputs:
        self._state = "sweeping"
        yield self._status("sweeping")
        yield from self._command("sweep", [self.parameters.arm])

    def _end_sweep(self) -> Outputs:
        self._state = "ending"
        yield from self._command("end_sweep", [*self.parameters.cameras, MERGER])

    def _take_result(self, result: SweepResult) -> Outputs:
        scan = self._scan
        if result.command_id in self._requests:
            yield from self._answer_person(result)
            return
        of_scan = scan is not None and result.action in ("sweep", "prepare", "dark", "end_sweep")
        if of_scan and (result.scan, result.sweep, result.attempt) != self._key():
            return  # of an attempt that was given up
        expected = self._pending.get(result.source)
        answers = expected is not None and (
            result.command_id == expected or (result.action == "sweep" and self._state in _RUNNING)
        )
        if result.state != "done":
            if answers or result.action == "sweep":
                yield from self._break(f"{result.source}: {result.reason or result.state}")
            return
        if not answers:
            return
        del self._pending[result.source]
        if not self._pending:
            self.context.cancel("answer")
            yield from self._go_on(result)

    def _go_on(self, last: SweepResult) -> Outputs:
        """Take the next step: all have answered the last command."""
        scan = self._scan
        if self._state == "homing":
            self._homed = True
            yield from self._resume() if scan else self._warm_up()
        elif scan is None:
            return
        elif self._state == "dark" and last.action == "lamp":
            yield from self._command(
                "dark",
                list(self.parameters.cameras),
                target="cameras",
                frames=self.parameters.dark_frames,
            )
        elif self._state == "dark":
            self._state = "lamp settling"
            yield from self._command("lamp", [], target="arm", lamp=True)
            self.context.set_timer("settled", self._in(self.parameters.lamp_settle_s))
        elif self._state == "preparing":
            yield from self._run_sweep()
        elif self._state == "sweeping":
            yield from self._end_sweep()
        elif self._state == "ending":
            self._sweep_count += 1
            scan.sweep += 1
            scan.attempt = 1
            if scan.sweep < len(self.parameters.exposures_ms):
                yield from self._prepare_sweep()
            else:
                self._next_scan += 1
                yield from self._wait_for_slot()

    # -- when something breaks

    def _break(self, reason: str) -> Outputs:
        """The sweep is broken: stop, and take it again if its slot and tries allow."""
        self._pending.clear()
        for timer in ("answer", "settled", "warm"):
            self.context.cancel(timer)
        scan = self._scan
        if self._state in ("homing", "warming up") and not self._lost:
            yield from self._give_up(reason)
            return
        if scan is None:
            if self._lost and self._state != "finishing":
                self._state = "waiting for a restart"
            return
        self.context.log.warning(f"scan {scan.number} sweep {scan.sweep + 1}: {reason}")
        yield from self._command("stop", [])
        scan.attempt += 1
        late = self.context.clock.now_ns() > self.parameters.slot_end_ns(scan.due_ns)
        if self._hold or scan.attempt > self.parameters.attempts or late:
            why = "its time slot had passed" if late else f"{scan.attempt - 1} attempts"
            yield from self._miss(scan.number, scan.start_ns, f"{reason} ({why})")
            self._scan = None
        if self._lost:
            self._state = "waiting for a restart"
            yield self._status(f"waiting for {', '.join(sorted(self._lost))}")
        else:
            yield from self._resume()

    def _resume(self) -> Outputs:
        """Go on after a break: home if the arm was restarted, then where the scan stood."""
        if not self._homed:
            yield from self._home()
        elif self._scan is None:
            yield from self._wait_for_slot()
        elif self._scan.sweep == 0 and self.parameters.dark_frames:
            yield from self._begin_dark()
        else:
            self._state = "lamp settling"
            yield from self._command("lamp", [], target="arm", lamp=True)
            self.context.set_timer("settled", self._in(self.parameters.lamp_settle_s))

    def _miss(self, number: int, start_ns: int, reason: str) -> Outputs:
        self.context.log.warning(f"scan {number} is missing: {reason}")
        self._wanted.add(number)
        self._next_scan = number + 1
        yield Send(
            topic="/scan/missing",
            message=ScanMissing(
                sample=self.parameters.sample,
                scan=number,
                scan_time_s=(start_ns - (self._zero_ns or start_ns)) / 1e9,
                reason=reason,
            ),
            keep=str(number),
        )

    def _give_up(self, reason: str) -> Outputs:
        """Stop everything safely and end the run."""
        yield from self._command("stop", [])
        self._state = "failed"
        yield self._status(f"failed: {reason}")
        self.context.log.error(f"the measurement can't go on: {reason}")
        yield Exit(1, reason)

    def stop(self) -> Outputs:
        """Leave the rig still and dark."""
        if self._homed:
            yield from self._command("stop", [])

    # -- the end

    def _take_stored(self, stored: Stored) -> Outputs:
        if stored.what == "missing":
            yield Release("/scan/missing", str(stored.scan))
        elif stored.what == "mark":
            yield Release("/operator/mark", str(stored.scan))
        if stored.what in ("parameters", "missing"):
            self._wanted.discard(stored.scan)
        yield from self._finish_when_stored()

    def _finish_when_stored(self) -> Outputs:
        if self._state == "finishing" and not self._wanted:
            self._state = "finished"
            yield self._status("all scans are stored")
            yield Exit(0)

    # -- helpers

    def _key(self) -> tuple[int, int, int]:
        scan = self._scan
        return (scan.number, scan.sweep, scan.attempt) if scan else (0, 0, 0)

    def _in(self, seconds: float) -> int:
        return self.context.clock.now_ns() + int(1e9 * seconds)

    def _command(
        self, action: str, answers: list[str], *, target: str = "all", **fields: Any
    ) -> Outputs:
        """Send a command, and wait for the answers of those named."""
        self._command_id += 1
        self._pending = dict.fromkeys(answers, self._command_id)
        if answers:
            limit_s = self.parameters.answer_limit_s + self.parameters.sweep_s
            self.context.set_watchdog("answer", limit_s)
        if self._scan is not None:
            fields = self._scan.command_fields(self.parameters, self._sweep_count) | fields
        command = ScanCommand(
            command_id=self._command_id,
            incarnation=self.context.incarnation,
            not_after_ns=self._in(self.parameters.command_life_s),
            action=action,
            target=target,
            sample=self.parameters.sample,
            exposures_ms=self.parameters.exposures_ms,
            **fields,
        )
        yield Send(topic="/scan/command", message=command)

    def _status(self, text: str) -> Output:
        status = progress(self.parameters, self._state, self._scan, self._next_scan, text)
        return Send(topic="/scan/status", message=status)

    # -- people

    def on_request(self, request: OperatorRequest) -> Outputs:
        """Carry out what a person asks, when the rig is free for it."""
        verb, arguments = request.verb, request.arguments
        if verb == "mark":
            yield from self._mark(request)
        elif verb == "stop":
            self._hold = True
            yield from self._command("stop", [])
            if self._scan is not None:
                yield from self._break("stopped by the operator")
            else:
                yield from self._wait_for_slot()
            yield Reply(request.request_id, True, "stopped; go on with: tvbrdf scan")
        elif self._state not in _IDLE:
            text = f"the rig is busy ({self._state}); wait for the end of the scan, or stop it"
            yield Reply(request.request_id, False, text)
        elif verb == "scan":
            self._hold = False
            self._schedule_ns = 0
            self.context.cancel("due")
            yield Reply(request.request_id, True, f"scan {self._next_scan} begins")
            yield from self._begin_scan(self.context.clock.now_ns())
        elif verb in ("home", "jog", "lamp", "still"):
            yield from self._forward(request.request_id, verb, arguments)
        else:
            known = "home, jog, stop, lamp, still, mark, scan"
            yield Reply(request.request_id, False, f"unknown request {verb!r}; known: {known}")

    def _mark(self, request: OperatorRequest) -> Outputs:
        text, zero = request.arguments.get("text", ""), bool(request.arguments.get("zero", False))
        now_ns = self.context.clock.now_ns()
        if not isinstance(text, str) or not text:
            yield Reply(request.request_id, False, "a mark needs a text")
            return
        if zero and self._scan is None and self._next_scan == 1:
            self._zero_ns = now_ns
        elif zero:
            text_error = "t = 0 can't move: scans refer to it already; noted without it"
            zero = False
            self.context.log.warning(text_error)
        keep = str(self.context.next_sequence("/operator/mark"))
        yield Send(
            topic="/operator/mark", message=Mark(text=text, zero=zero), stamp_ns=now_ns, keep=keep
        )
        yield Reply(request.request_id, True, "noted", {"stamp_ns": now_ns, "zero": zero})

    def _forward(self, request_id: str, verb: str, arguments: dict[str, Any]) -> Outputs:
        """Pass a request on as a command; the devices' answers are the reply."""
        fields: dict[str, Any] = {}
        answers = [self.parameters.arm]
        target = "arm"
        try:
            if verb == "jog":
                fields["to_deg"] = float(arguments["angle_deg"])
            elif verb == "lamp":
                fields["lamp"] = bool(arguments["on"])
            elif verb == "still":
                answers, target = list(self.parameters.cameras), "cameras"
        except (KeyError, TypeError, ValueError) as error:
            yield Reply(request_id, False, f"{verb}: argument missing or wrong: {error}")
            return
        yield from self._command(verb, [], target=target, **fields)
        self._requests[self._command_id] = (request_id, verb, set(answers))

    def _answer_person(self, result: SweepResult) -> Outputs:
        request_id, verb, waiting = self._requests[result.command_id]
        if result.state != "done":
            del self._requests[result.command_id]
            yield Reply(request_id, False, f"{result.source}: {result.reason or result.state}")
            return
        waiting.discard(result.source)
        if not waiting:
            del self._requests[result.command_id]
            yield Reply(request_id, True, f"{verb}: done")
