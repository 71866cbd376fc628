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
    Stored,
    SweepResult,
)

from ..core.node import Exit, Node, NodeContext, Output, Outputs, Reply, Send, TopicUse
from .plan import Scan, SequencerParameters, progress
from .requests import FORWARDED, VERBS, RequestError, Requests, as_command, note_text
from .schedule import Schedule
from .storage import Storage

FITTER = "fitter"
MERGER = "hdr_merger"
WRITER = "database_writer"
_IDLE = ("interval", "waiting for the operator")
_RUNNING = ("sweeping", "ending")
_OF_SCANS = ("sweep", "prepare", "dark", "end_sweep")


class SequencerNode(Node[SequencerParameters]):
    """Tells arm and cameras what to do next, and waits until it is on disk."""

    parameters_type = SequencerParameters
    has_service = True

    def __init__(self, context: NodeContext, parameters: SequencerParameters) -> None:
        super().__init__(context, parameters)
        self._state = "waiting for nodes"
        self._nodes = {
            p.name
            for p in context.graph.participants
            if p.node and "/diagnostics" in p.gives and not p.counted_bytes
        } - {context.name}
        """Those that it can't do without: for one that is only counted nobody waits."""
        self._states: dict[str, str] = {}
        """Of each node, as it last told."""
        self._lost: set[str] = set()
        self._database: DatabaseState | None = None
        self._schedule = Schedule(parameters.interval_s)
        self._command_id = 0
        self._pending: dict[str, int] = {}
        """Devices that have not yet answered, with the id of the command they should answer."""
        self._scan: Scan | None = None
        self._sweep_count = 0
        self._homed = self._lamp = self._hold = False
        self._storage = Storage(parameters.sample, context.log)
        self._requests = Requests()

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
            yield from self._take_database(message)
        elif isinstance(message, Diagnostics):
            self._states[message.node] = message.state
            if message.state == "running":
                yield from self._take_running(message.node)
            yield from self._begin_when_ready()

    def on_lost(self, publisher: str) -> Outputs:
        """A node's process is gone: whatever sweep it took part in is broken."""
        node = publisher.removesuffix(".device")
        self._states.pop(node, None)
        if node not in self._nodes or node in self._lost:
            return
        self._lost.add(node)
        self.context.set_watchdog(f"lost {node}", self.parameters.restart_limit_s)
        self.context.log.warning(f"{node} is gone; waiting for it to be restarted")
        yield from self._requests.lose(node)
        if node == self.parameters.arm:
            self._homed = self._lamp = False
        if node == MERGER and self._storage.unsaved(self._scan):
            self.context.set_watchdog("radiance", self.parameters.restart_limit_s)
        if node in (*self.parameters.cameras, self.parameters.arm, MERGER):
            yield from self._break(f"{node} was lost", from_first=node == MERGER)

    def _take_running(self, node: str) -> Outputs:
        if node in self._lost:
            self._lost.discard(node)
            self.context.cancel(f"lost {node}")
            self.context.log.info(f"{node} is back")
            if not self._lost and self._state == "waiting for a restart":
                yield from self._resume()

    def on_timer(self, name: str) -> Outputs:
        """Begin the scan that is due, go on after a wait, or give up on a device."""
        if name.startswith("lost "):
            yield from self._give_up(f"{name.removeprefix('lost ')} did not come back")
        elif name == "answer":
            silent = ", ".join(sorted(self._pending)) or "nobody"
            yield from self._break(f"no answer from {silent}")
        elif name == "due" and self._state == "interval":
            yield from self._begin_scan(self._schedule.due_ns(self._now_ns()))
        elif name == "warm" and self._state == "warming up":
            yield from self._wait_for_slot()
        elif name == "settled" and self._state == "lamp settling":
            yield from self._prepare_sweep()
        elif name == "radiance":
            yield from self._miss_unsaved()

    # -- from start to the first scan

    def _take_database(self, database: DatabaseState) -> Outputs:
        """Take what the database holds; only what it held at first is news."""
        unfitted = sorted({*database.scans} - {*database.fitted})
        if self._database is None and unfitted:
            self.context.log.info(f"scans {unfitted} are stored, not fitted; they are fitted now")
            self._storage.expect_parameters(unfitted)
        self._database = database
        yield from self._begin_when_ready()

    def _begin_when_ready(self) -> Outputs:
        """Begin when all nodes run; the fitter may still load, what is sent to it waits."""
        database = self._database
        if self._state != "waiting for nodes" or database is None:
            return
        states = {node: self._states.get(node) for node in self._nodes}
        if states.get(FITTER) == "ready":
            del states[FITTER]
        if set(states.values()) - {"running"}:
            return
        self._schedule.go_on_from(database)
        if self._hold or self._schedule.next_scan > self.parameters.scans:
            yield from self._wait_for_slot()
        else:
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

    def _wait_for_slot(self) -> Outputs:
        """Wait until the next scan is due; record those whose time has passed as missing."""
        self._scan = None
        schedule, now_ns = self._schedule, self._now_ns()
        while schedule.next_scan <= self.parameters.scans:
            if self._hold or self.parameters.interval_s <= 0:
                self._state = "waiting for the operator"
                yield self._status("waiting for the operator: tvbrdf scan")
                return
            due_ns = schedule.due_ns(now_ns)
            if not schedule.has_passed(now_ns):
                self._state = "interval"
                yield self._status(f"scan {schedule.next_scan} is due")
                self.context.set_timer("due", due_ns)
                return
            scan = Scan(schedule.next_scan, due_ns, due_ns, schedule.time_s(due_ns))
            yield from self._miss(scan, "its time slot had passed")
        self._state = "finishing"
        yield self._status("waiting until everything is stored and fitted")
        yield from self._command("lamp", [], target="arm", lamp=False)
        yield from self._finish_when_stored()

    # -- one scan

    def _begin_scan(self, due_ns: int) -> Outputs:
        now_ns = self._now_ns()
        self._scan = Scan(
            number=self._schedule.next_scan,
            due_ns=due_ns,
            start_ns=now_ns,
            scan_time_s=self._schedule.time_s(now_ns),
        )
        self._storage.expect(self._scan)
        yield from self._begin_dark() if self._homed else self._home()

    def _begin_dark(self) -> Outputs:
        if self.parameters.dark_frames:
            self._state = "dark"
            yield self._status("dark frames")
            yield from self._command("lamp", [self.parameters.arm], target="arm", lamp=False)
        elif self._lamp:
            yield from self._prepare_sweep()
        else:
            yield from self._light()

    def _light(self) -> Outputs:
        self._state = "lamp settling"
        yield from self._command("lamp", [], target="arm", lamp=True)
        self.context.set_timer("settled", self._in(self.parameters.lamp_settle_s))

    def _prepare_sweep(self) -> Outputs:
        self._state = "preparing"
        yield self._status("preparing")
        yield from self._command("prepare", [self.parameters.arm, *self.parameters.cameras])

    def _take_result(self, result: SweepResult) -> Outputs:
        if result.command_id in self._requests:
            yield from self._requests.take(result)
            return
        scan = self._scan
        key = (result.scan, result.sweep, result.attempt)
        if result.action in _OF_SCANS and (scan is None or key != scan.key):
            return  # of an attempt that was given up
        expected = self._pending.get(result.source)
        answers = expected is not None and (
            result.command_id == expected or (result.action == "sweep" and self._state in _RUNNING)
        )
        if result.state != "done":
            if answers or result.action == "sweep":
                yield from self._break(f"{result.source}: {result.reason or result.state}")
        elif answers:
            del self._pending[result.source]
            if not self._pending:
                self.context.cancel("answer")
                yield from self._go_on(result)

    def _go_on(self, last: SweepResult) -> Outputs:
        """Take the next step: all have answered the last command."""
        scan, cameras = self._scan, list(self.parameters.cameras)
        if self._state == "homing":
            self._homed = True
            yield from self._resume() if scan else self._warm_up()
        elif scan is None:
            return
        elif self._state == "dark" and last.action == "lamp":
            frames = self.parameters.dark_frames
            yield from self._command("dark", cameras, target="cameras", frames=frames)
        elif self._state == "dark":
            yield from self._light()
        elif self._state == "preparing":
            self._state = "sweeping"
            yield self._status("sweeping")
            yield from self._command("sweep", [self.parameters.arm])
        elif self._state == "sweeping":
            self._state = "ending"
            yield from self._command("end_sweep", [*cameras, MERGER])
        elif self._state == "ending":
            yield from self._end_sweep(scan)

    def _end_sweep(self, scan: Scan) -> Outputs:
        self._sweep_count += 1
        scan.sweep += 1
        if scan.sweep < len(self.parameters.exposures_ms):
            yield from self._prepare_sweep()
        else:
            self._schedule.next_scan = scan.number + 1
            yield from self._wait_for_slot()

    # -- when something breaks

    def _break(self, reason: str, *, from_first: bool = False) -> Outputs:
        """The sweep is broken: stop, and take it again if its slot and tries allow."""
        if self._state == "waiting for nodes":
            return
        self._pending.clear()
        for timer in ("answer", "settled", "warm"):
            self.context.cancel(timer)
        scan = self._scan
        if self._state in ("homing", "warming up") and not (self._lost or self._hold):
            yield from self._give_up(reason)
            return
        if scan is None:
            if self._lost and self._state != "finishing":
                self._state = "waiting for a restart"
            return
        self.context.log.warning(f"scan {scan.number} sweep {scan.sweep + 1}: {reason}")
        yield from self._command("stop", [])
        scan.begin_again(from_first=from_first)
        if self._hold:
            yield from self._miss(scan, reason)
        elif scan.most_tries >= self.parameters.attempts:
            yield from self._miss(scan, f"{reason} ({scan.most_tries} attempts)")
        elif self._is_late(scan):
            yield from self._miss(scan, f"{reason} (its time slot had passed)")
        if self._lost:
            self._state = "waiting for a restart"
            yield self._status(f"waiting for {', '.join(sorted(self._lost))}")
        else:
            yield from self._resume()

    def _resume(self) -> Outputs:
        """Go on after a break: home if the arm was restarted, then where the scan stood."""
        scan = self._scan
        if scan is not None and self._is_late(scan):
            yield from self._miss(scan, "its time slot had passed while a node was restarted")
        if self._hold:
            yield from self._wait_for_slot()
        elif not self._homed:
            yield from self._home()
        elif self._scan is None:
            yield from self._wait_for_slot()
        elif self._scan.sweep == 0:
            yield from self._begin_dark()
        else:
            yield from self._light()

    def _is_late(self, scan: Scan) -> bool:
        return self._now_ns() > self.parameters.slot_end_ns(scan.due_ns)

    def _miss(self, scan: Scan, reason: str) -> Outputs:
        """Record a scan as missing, and go to the next."""
        self._scan = None
        self._schedule.next_scan = scan.number + 1
        yield from self._storage.missing(scan, reason)

    def _miss_unsaved(self) -> Outputs:
        """Give up the scans that a merger had measured but that no database has seen."""
        if WRITER in self._lost:
            self.context.set_watchdog("radiance", self.parameters.restart_limit_s)
            return
        for scan in self._storage.unsaved(self._scan):
            yield from self._storage.missing(scan, f"it was lost with {MERGER}")

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
        yield from self._storage.take(stored)
        scan = self._scan
        if scan is not None and self._storage.has(scan) and self._state == "waiting for a restart":
            # its merger died before it could say so
            self._scan = None
            self._schedule.next_scan = scan.number + 1
        yield from self._finish_when_stored()

    def _finish_when_stored(self) -> Outputs:
        end = self._storage.end()
        if self._state == "finishing" and end is not None:
            self._state = "finished"
            yield self._status("all scans are stored" if end.code == 0 else end.text)
            yield end

    # -- helpers

    def _now_ns(self) -> int:
        return self.context.clock.now_ns()

    def _in(self, seconds: float) -> int:
        return self._now_ns() + int(1e9 * seconds)

    def _command(
        self, action: str, answers: list[str], *, target: str = "all", **fields: Any
    ) -> Outputs:
        """Send a command, and wait for the answers of those named."""
        self._command_id += 1
        self._pending = dict.fromkeys(answers, self._command_id)
        if answers:
            limit_s = self.parameters.answer_limit_s + self.parameters.sweep_s
            self.context.set_watchdog("answer", limit_s)
        if action in ("lamp", "stop"):
            self._lamp = bool(fields.get("lamp", False))
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
        next_scan = self._schedule.next_scan
        status = progress(self.parameters, self._state, self._scan, next_scan, text)
        return Send(topic="/scan/status", message=status)

    # -- people

    def on_request(self, request: OperatorRequest) -> Outputs:
        """Carry out what a person asks, when the rig is free for it."""
        verb = request.verb
        try:
            if verb == "mark":
                yield from self._mark(request)
            elif verb == "stop":
                yield from self._stop_for_operator()
                yield Reply(request.request_id, True, "stopped; go on with: tvbrdf scan")
            elif verb not in VERBS:
                raise RequestError(f"unknown request {verb!r}; known: {', '.join(VERBS)}")
            elif self._state not in _IDLE:
                raise RequestError(
                    f"the rig is busy ({self._state}); wait for the end of the scan, or stop it"
                )
            elif verb in FORWARDED:
                forwarded = as_command(request, self.parameters)
                target, fields = forwarded.target, forwarded.fields
                yield from self._command(verb, [], target=target, **fields)
                self._requests.add(self._command_id, forwarded)
            else:
                yield from self._scan_for_operator(request)
        except RequestError as error:
            yield Reply(request.request_id, False, str(error))

    def _stop_for_operator(self) -> Outputs:
        """Stop, and begin no scan before the operator says so."""
        self._hold = True
        self.context.cancel("due")
        if self._scan is not None:
            yield from self._break("stopped by the operator")
            return
        yield from self._command("stop", [])
        if self._state in ("homing", "warming up", *_IDLE):
            self.context.cancel("warm")
            self.context.cancel("answer")
            yield from self._wait_for_slot()

    def _scan_for_operator(self, request: OperatorRequest) -> Outputs:
        now_ns = self._now_ns()
        self._hold = False
        self.context.cancel("due")
        self._schedule.start_from(now_ns)
        yield Reply(request.request_id, True, f"scan {self._schedule.next_scan} begins")
        yield from self._begin_scan(now_ns)

    def _mark(self, request: OperatorRequest) -> Outputs:
        text, zero = note_text(request), bool(request.arguments.get("zero", False))
        now_ns = self._now_ns()
        if zero and self._scan is None and self._schedule.next_scan == 1:
            self._schedule.zero_ns = now_ns
        elif zero:
            zero = False
            self.context.log.warning(
                "t = 0 can't move: scans refer to it already; noted without it"
            )
        keep = str(self.context.next_sequence("/operator/mark"))
        yield Send(
            topic="/operator/mark", message=Mark(text=text, zero=zero), stamp_ns=now_ns, keep=keep
        )
        yield Reply(request.request_id, True, "noted", {"stamp_ns": now_ns, "zero": zero})
