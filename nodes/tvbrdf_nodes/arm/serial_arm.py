"""The arm behind a serial line, with any controller that speaks docs/serial_protocol.md."""

from __future__ import annotations

import contextlib
import select
import time
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

from ..core.awake_time import AwakeTime
from ..core.device import DeviceError, DriverContext
from .driver import (
    Acknowledged,
    ArmFault,
    ArmIdentity,
    ArmLimits,
    ArmReading,
    MotionDone,
    Reading,
    Ready,
    Refused,
    RoundTrip,
)
from .protocol import (
    REASONS,
    Answer,
    Event,
    Line,
    ProtocolError,
    Refusal,
    Report,
)
from .serial_handshake import Handshake
from .serial_line import SerialLine, byte_time_ns, is_path
from .serial_motions import Ended, MotionTable
from .serial_parameters import SerialArmParameters
from .serial_quality import WatchedParser
from .serial_requests import Pending, PendingRequests

RETRY_OPEN_S = 0.1
_MOTIONS = ("HOME", "MOVE", "SWEEP")


class SerialArm:
    """Implements :class:`.driver.ArmDriver` with pyserial.

    Parameters
    ----------
    parameters
        Port and limits.
    context
        Clock, log and names.
    """

    live: ClassVar[bool] = True
    parameters_type: ClassVar[type[Any]] = SerialArmParameters

    def __init__(self, parameters: SerialArmParameters, context: DriverContext) -> None:
        self._parameters, self._context = parameters, context
        self._port: SerialLine | None = None
        self._awake = AwakeTime()
        self._parser = WatchedParser()
        self._requests = PendingRequests(
            self._write, context.clock, parameters.answer_timeout_s, parameters.attempts
        )
        self._handshake = Handshake(parameters, self._requests)
        self._ready = False
        self._found: list[Reading] = []
        self._connect_limit_s, self._next_try_s = 0.0, 0.0
        self._next_alive_s = 0.0
        self._unanswered_since_s: float | None = None
        self._motions = MotionTable()
        self._sweep: tuple[int, tuple[float, ...]] | None = None
        """A sweep that waits until reports come at its rate."""
        self._fault = ""
        self._byte_ns, self._report_bytes = 0.0, 48
        self._unstamped, self._unasked, self._alive_sent = 0, 0, 0

    # -- opening

    def open(self) -> None:
        """Open the port; the controller is identified, stopped and made dark while reading."""
        self._connect_limit_s = self._awake.now_s() + self._parameters.connect_timeout_s
        self._try_open()

    def _try_open(self) -> None:
        parameters, now_s = self._parameters, self._awake.now_s()
        if now_s < self._next_try_s:
            return
        self._next_try_s = now_s + RETRY_OPEN_S
        try:
            self._port = SerialLine(parameters.port, parameters.baud_rate, self._context.clock)
        except DeviceError as error:
            # an adapter may need a moment to appear; an address that refuses won't change its mind
            if now_s >= self._connect_limit_s or not is_path(parameters.port):
                hint = "; is the controller on, and parameter 'port' right?"
                raise DeviceError(f"{error}{hint}") from error
            return
        if parameters.arrival_stamps == "host":
            self._byte_ns = byte_time_ns(parameters.port, parameters.baud_rate)
        self._write(b"\n")  # ends whatever the controller may have read before
        self._handshake.begin()

    @property
    def identity(self) -> ArmIdentity:
        """See :class:`.driver.ArmDriver`."""
        if self._handshake.identity is None:
            raise self._error("its controller has not been identified yet")
        return self._handshake.identity

    @property
    def limits(self) -> ArmLimits:
        """See :class:`.driver.ArmDriver`."""
        if self._handshake.limits is None:
            raise self._error("its limits are not known yet")
        return self._handshake.limits

    # -- requests

    def home(self) -> int:
        """See :class:`.driver.ArmDriver`."""
        return self._move("HOME")

    def move(self, angle_deg: float) -> int:
        """See :class:`.driver.ArmDriver`."""
        return self._move("MOVE", angle_deg)

    def _move(self, verb: str, *arguments: float, request_id: int | None = None) -> int:
        def accepted(answer: Answer) -> None:
            self._motions.accept(answer.request_id, verb)
            self._found.append(Acknowledged(token=answer.request_id))

        return self._requests.ask(verb, *arguments, handler=accepted, request_id=request_id)

    def sweep(self, from_deg: float, to_deg: float, duration_s: float) -> int:
        """See :class:`.driver.ArmDriver`; position reports come at the sweep's rate first."""
        token = self._requests.new_id()
        self._sweep = (token, (from_deg, to_deg, duration_s))
        self._requests.ask(
            "REPORTS", self._parameters.report_rate_hz, handler=lambda _: self._start_sweep()
        )
        return token

    def _start_sweep(self) -> None:
        if self._sweep is not None:
            (token, arguments), self._sweep = self._sweep, None
            self._move("SWEEP", *arguments, request_id=token)

    def _idle_reports(self) -> None:
        self._requests.ask("REPORTS", self._parameters.idle_report_rate_hz)

    def stop(self) -> int:
        """See :class:`.driver.ArmDriver`; a motion that was not yet answered is not repeated."""
        tokens = [p.request.request_id for p in self._requests.drop(*_MOTIONS)]
        if self._sweep is not None:
            tokens.append(self._sweep[0])
            self._sweep = None
        self._found.extend(MotionDone(token=t, reason=REASONS["stopped"]) for t in tokens)
        return self._move("STOP")

    def lamp(self, on: bool) -> int:
        """See :class:`.driver.ArmDriver`; an earlier request that was not answered is dropped."""
        for pending in self._requests.drop("LAMP"):
            reason = "a later request to the lamp came before it was answered"
            self._found.append(Refused(token=pending.request.request_id, reason=reason))
        return self._requests.ask(
            "LAMP",
            float(on),
            handler=lambda answer: self._found.append(Acknowledged(token=answer.request_id)),
        )

    def keepalive(self) -> None:
        """See :class:`.driver.ArmDriver`."""
        now_s = self._awake.now_s()
        known = self._port is not None and self._handshake.identity is not None
        if not known or now_s < self._next_alive_s:
            return
        self._next_alive_s = now_s + self._parameters.keepalive_s
        self._alive_sent += 1
        if self._unanswered_since_s is None:
            self._unanswered_since_s = now_s
        self._requests.ask("ALIVE", once=True)

    def ask_tick(self) -> None:
        """See :class:`.driver.ArmDriver`."""
        if self._ready and not self._requests.waiting("TICK"):
            self._requests.ask("TICK", once=True)

    def _write(self, data: bytes) -> None:
        if self._port is None:
            raise self._error("the arm's port is not open")
        self._port.write(data)

    # -- reading

    def waitables(self) -> Sequence[Any]:
        """See :class:`~tvbrdf_nodes.core.device.Driver`."""
        return () if self._port is None else (self._port.fileno(),)

    def pending(self) -> bool:
        """See :class:`~tvbrdf_nodes.core.device.Driver`."""
        return bool(self._found)

    def read(self) -> list[Reading]:
        """See :class:`.driver.ArmDriver`."""
        if self._port is None:
            self._try_open()
        else:
            self._receive()
            self._handshake.service()
            self._check_time()  # only after everything that has come was taken
            self._check_quality()
        found, self._found = self._found, []
        return found

    def _receive(self) -> None:
        for chunk in () if self._port is None else self._port.read():
            for line in self._parser.feed(chunk.data):
                if self._parameters.arrival_stamps == "host":
                    self._take(line, chunk.received_ns)
                elif line.stamps:
                    self._take(line, line.stamps[-1])
                else:
                    self._unstamped += 1

    def _take(self, line: Line, received_ns: int) -> None:
        match line.message:
            case Report() as report:
                self._report_bytes = line.size
                self._take_report(report, received_ns)
            case Answer() as answer:
                self._unanswered_since_s = None
                self._take_answer(answer, line, received_ns)
            case Refusal() as refusal:
                self._unanswered_since_s = None
                self._take_refusal(refusal)
            case Event() as event:
                self._take_event(event)
            case _:
                self._unasked += 1  # a request: something on the line sends back what we send

    def _take_report(self, report: Report, received_ns: int) -> None:
        if self._handshake.identity is None:
            return
        flags = report.flags
        if not flags.fault:
            self._fault = ""
        self._found.append(
            ArmReading(
                tick_ns=1000 * self._handshake.ticks.unwrap(report.tick),
                received_ns=received_ns,
                angle_deg=report.angle_deg,
                speed_deg_s=report.speed_deg_s,
                lamp=flags.lamp,
                moving=flags.moving,
                homed=flags.homed,
                fault=(self._fault or "fault") if flags.fault else "",
                emergency_stop=flags.emergency_stop,
            )
        )
        if self._motions.missed_end(flags.moving):
            self._requests.ask("STATUS", handler=self._take_status)

    def _take_status(self, answer: Answer) -> None:
        self._end(self._motions.take_status(answer))

    def _take_answer(self, answer: Answer, line: Line, received_ns: int) -> None:
        pending = self._requests.take(answer.request_id)
        if pending is None:
            self._unasked += 1
            return
        try:
            if pending.request.verb == "TICK":
                self._take_tick(answer, line, pending, received_ns)
            elif pending.handler is not None:
                pending.handler(answer)
        except ProtocolError as error:
            raise self._error(f"answer to {pending.request.verb}: {error}") from error
        if self._handshake.ready and not self._ready:
            self._ready = True
            self._fault = self._handshake.fault
            self._found.append(Ready(identity=self.identity, limits=self.limits))

    def _take_tick(self, answer: Answer, line: Line, pending: Pending, received_ns: int) -> None:
        sent_ns = pending.sent_ns
        if self._parameters.arrival_stamps == "line":
            if len(line.stamps) != 2:
                return
            sent_ns = line.stamps[0]
        wire_ns = self._byte_ns * (len(pending.line) + line.size)
        one_way_ns = (received_ns - sent_ns - wire_ns) / 2 + self._byte_ns * self._report_bytes
        self._found.append(
            RoundTrip(
                sent_ns=sent_ns,
                tick_ns=1000 * self._handshake.ticks.unwrap(answer.count("tick")),
                received_ns=received_ns,
                one_way_ns=max(0, round(one_way_ns)),
            )
        )

    def _take_refusal(self, refusal: Refusal) -> None:
        pending = self._requests.take(refusal.request_id)
        if pending is None:
            self._unasked += 1
            return
        verb = pending.request.verb
        reason = REASONS.get(refusal.code, refusal.code)
        if verb in ("ALIVE", "TICK"):
            return
        if verb not in (*_MOTIONS, "STOP", "LAMP") or not self._ready:
            raise self._error(f"its controller refuses {verb}: {reason}")
        self._found.append(Refused(token=refusal.request_id, reason=reason))
        if verb == "SWEEP":
            self._idle_reports()

    def _take_event(self, event: Event) -> None:
        if event.outcome == "NOTICE":
            text = REASONS.get(event.code, event.code)
            self._found.append(ArmFault(code=event.code, text=text))
        if event.code == "stall":
            self._fault = event.code
        pending = self._requests.take(event.request_id)
        if pending is not None and pending.handler is not None:  # its answer was lost
            pending.handler(Answer(event.request_id))
        self._end(self._motions.take_event(event))

    def _end(self, ended: Iterable[Ended]) -> None:
        for token, verb, reason in ended:
            self._found.append(MotionDone(token=token, reason=reason))
            if verb == "SWEEP":
                self._idle_reports()

    # -- what goes wrong

    def _check_time(self) -> None:
        now_s = self._awake.now_s()
        lost = [
            pending.request.verb
            for pending in self._requests.expire()
            if pending.request.verb not in ("ALIVE", "TICK")
        ]
        if self._handshake.identity is None:
            if now_s >= self._connect_limit_s:
                raise self._error(f"no arm controller answers{self._what_came()}")
            if lost:
                self._handshake.begin()
            return
        limit_s = self._parameters.answer_timeout_s * self._parameters.attempts
        silent = self._unanswered_since_s is not None and now_s - self._unanswered_since_s > limit_s
        if lost or silent:
            raise self._error(
                f"its controller has stopped answering ({lost[0] if lost else 'ALIVE'}, for "
                f"{limit_s:g} s); check its power and the cable"
            )

    def _what_came(self) -> str:
        if self._unstamped:
            return (
                f"; {self._unstamped} lines carried no arrival stamp: without a line monitor set "
                "arrival_stamps: host"
            )
        if self._parser.unreadable:
            return f" but {self._parser.unreadable} unreadable lines came: is baud_rate right?"
        return " and nothing came: is it switched on, and is this its port?"

    def _check_quality(self) -> None:
        trouble = self._parser.trouble(self._parameters.max_unreadable_fraction)
        if trouble:
            raise self._error(trouble)

    def _error(self, text: str) -> DeviceError:
        return DeviceError(f"{self._parameters.port}: {text}")

    # -- the end

    def halt(self, timeout_s: float) -> bool:
        """See :class:`.driver.ArmDriver`."""
        deadline_s = time.monotonic() + timeout_s
        try:
            waiting = {self.stop(), self.lamp(False)}
            while waiting and time.monotonic() < deadline_s:
                select.select(self.waitables(), [], [], 0.02)
                self._receive()
                self._requests.expire()
                waiting -= {r.token for r in self._found if isinstance(r, Acknowledged)}
                self._found.clear()
        except (DeviceError, OSError, ValueError):
            return False
        return not waiting

    def close(self) -> None:
        """See :class:`~tvbrdf_nodes.core.device.Driver`."""
        if self._port is not None:
            with contextlib.suppress(OSError):
                self._port.close()
            self._port = None

    def counters(self) -> dict[str, float]:
        """See :class:`.driver.ArmDriver`."""
        return {
            **self._parser.counters(),
            "unstamped_lines": self._unstamped,
            "answers_unasked": self._unasked,
            "requests_repeated": self._requests.repeated,
            "keepalives": self._alive_sent,
        }
