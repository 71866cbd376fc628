"""What runs in the simulated controller: requests, reports, clock and watchdog."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable

from ..world.scene import ArmEffects
from .driver import ArmLimits
from .protocol import VERBS, Answer, Event, Flags, Message, Refusal, Report, Request, number_text
from .simulated_faults import PlannedFault, parse_faults
from .simulated_mechanics import Mechanics
from .simulated_parameters import ControllerParameters, TickClock
from .simulated_wire import Wire

ANSWERS_KEPT = 32
MAX_REPORT_RATE_HZ = 1000.0
_NEVER = 1 << 80

Fields = dict[str, str]


class _RefusedError(Exception):
    """A request is not accepted; its text is the reason's code."""


class Firmware:
    """Carries out requests at its present moment, and moves on when it is granted time.

    Parameters
    ----------
    parameters
        What the controller is.
    effects
        What the scene does to it.
    zero_ns, now_ns
        When the simulation began, and when the controller is switched on.
    wire
        Takes what it says.

    Raises
    ------
    FaultError
        If the effects ask for faults that do not exist.
    """

    def __init__(
        self,
        parameters: ControllerParameters,
        effects: ArmEffects,
        zero_ns: int,
        now_ns: int,
        wire: Wire,
    ) -> None:
        self._parameters, self._wire = parameters, wire
        self._faults = list(parse_faults(effects.faults))
        self._clock = TickClock(zero_ns, effects.clock_offset_s, effects.clock_drift_ppm)
        self._tick_range = 1 << parameters.tick_bits
        offset = effects.angle_offset_deg
        power_up = parameters.power_up_deg - offset
        self.arm = Mechanics(parameters.limits(), now_ns, power_up, offset)
        self._timed: list[tuple[int, PlannedFault | None]] = []
        """Faults, and releases of the emergency stop (None), that come at a known moment."""
        self.emergency_stop = self.stopped_by_watchdog = False
        self.fault = ""
        self._period = 0
        self._next_tick = 0
        self._answers: OrderedDict[int, Message] = OrderedDict()
        self._last_alive_s = -math.inf
        self.requests = self._reports = self._sweeps = 0

    @property
    def now_ns(self) -> int:
        """Up to when everything has happened."""
        return self.arm.now_ns

    def _flags(self) -> Flags:
        arm = self.arm
        return Flags(arm.lamp, arm.moving, arm.homed, bool(self.fault), self.emergency_stop)

    def _tick(self) -> int:
        return self._clock.count(self.now_ns) % self._tick_range

    def _say(self, message: Message) -> None:
        self._wire.report(message, self.now_ns, self._clock.count(self.now_ns))

    def _settle(self) -> None:
        for request_id, code in self.arm.settle():
            outcome = ("BROKEN", code) if code else ("DONE", "-")
            self._say(Event(request_id, self._tick(), *outcome))

    # -- requests

    def execute(self, request: Request, real_s: float) -> None:
        """Carry out a request and answer it; one that comes again is answered again only."""
        self.requests += 1
        answer = self._answers.get(request.request_id)
        if answer is None:
            try:
                fields = self._carry_out(request, real_s)
                answer = Answer(request.request_id, tuple(fields.items()))
            except _RefusedError as refused:
                answer = Refusal(request.request_id, str(refused))
            if request.verb not in ("ALIVE", "TICK", "STATUS"):
                self._answers[request.request_id] = answer
                if len(self._answers) > ANSWERS_KEPT:
                    self._answers.popitem(last=False)
        self._wire.answer(answer, self.now_ns)
        self._settle()

    def _carry_out(self, request: Request, real_s: float) -> Fields:
        if request.verb not in VERBS:
            raise _RefusedError("unknown_verb")
        if len(request.arguments) not in VERBS[request.verb]:
            raise _RefusedError("bad_argument")
        numbers, fields = request.arguments, Fields()
        match request.verb:
            case "IDENTIFY":
                self._answers.clear()
                fields = self._identity()
            case "ALIVE":
                self._last_alive_s = real_s
            case "TICK":
                fields = {"tick": str(self._tick())}
            case "STATUS":
                fields = self._status()
            case "STOP":
                self.arm.stop(request.request_id)
            case "LAMP":
                self._switch(numbers[0], real_s)
            case "REPORTS":
                self._set_reports(numbers[0])
            case "LIMITS":
                if numbers:
                    self._set_limits(*numbers)
                fields = self._tell_limits()
            case _:
                self._start_motion(request, real_s)
        return fields

    def _identity(self) -> Fields:
        p = self._parameters
        return {
            "model": p.model,
            "serial": p.serial,
            "protocol": "1",
            "watchdog_s": number_text(p.watchdog_s) if p.keepalive_watchdog else "0",
            "tick_bits": str(p.tick_bits),
        }

    def _status(self) -> Fields:
        now, (last, outcome) = self.arm.state(), self.arm.last
        return {
            "tick": str(self._tick()),
            "angle": number_text(now.angle_deg),
            "speed": number_text(now.speed_deg_s),
            "flags": self._flags().text(),
            "fault": self.fault or "-",
            "last": str(last),
            "outcome": outcome,
        }

    def _tell_limits(self) -> Fields:
        limits = self.arm.limits
        return {
            "min": number_text(limits.min_angle_deg),
            "max": number_text(limits.max_angle_deg),
            "speed": number_text(limits.max_speed_deg_s),
            "acceleration": number_text(limits.acceleration_deg_s2),
            "settle": number_text(limits.settle_deg),
        }

    def _set_limits(
        self, smallest: float, largest: float, speed: float, acceleration: float
    ) -> None:
        """Take tighter limits; nothing goes beyond the built-in ones."""
        if self.arm.moving:
            raise _RefusedError("busy")
        if not (smallest < largest and speed > 0 and acceleration > 0):
            raise _RefusedError("bad_argument")
        built_in = self._parameters.limits()
        self.arm.limits = ArmLimits(
            min_angle_deg=max(smallest, built_in.min_angle_deg),
            max_angle_deg=min(largest, built_in.max_angle_deg),
            max_speed_deg_s=min(speed, built_in.max_speed_deg_s),
            acceleration_deg_s2=min(acceleration, built_in.acceleration_deg_s2),
            settle_deg=built_in.settle_deg,
        )

    def _set_reports(self, rate_hz: float) -> None:
        if not 0 <= rate_hz <= MAX_REPORT_RATE_HZ:
            raise _RefusedError("bad_argument")
        self._period = round(1e6 / rate_hz) if rate_hz > 0 else 0
        if self._period:
            self._next_tick = (self._clock.count(self.now_ns) // self._period + 1) * self._period

    def _switch(self, on: float, real_s: float) -> None:
        if on not in (0.0, 1.0):
            raise _RefusedError("bad_argument")
        if on:
            self._require_safe(real_s)
        self.arm.switch(bool(on))

    def _require_safe(self, real_s: float) -> None:
        if self.emergency_stop:
            raise _RefusedError("estop")
        if self._unwatched(real_s):
            raise _RefusedError("no_keepalive")

    def _unwatched(self, real_s: float) -> bool:
        p = self._parameters
        return p.keepalive_watchdog and real_s - self._last_alive_s > p.watchdog_s

    # -- motion

    def _start_motion(self, request: Request, real_s: float) -> None:
        self._require_safe(real_s)
        if self.arm.moving:
            raise _RefusedError("busy")
        number, arguments, p = request.request_id, request.arguments, self._parameters
        if request.verb == "HOME":
            self.fault = ""
            self.arm.home(number, p.home_deg, p.homing_speed_deg_s)
            return
        if self.fault:
            raise _RefusedError("fault")
        if not self.arm.homed:
            raise _RefusedError("not_homed")
        limits = self.arm.limits
        if request.verb == "MOVE":
            if limits.refuse_angle(arguments[0]):
                raise _RefusedError("limit")
            self.arm.move(number, arguments[0])
        elif limits.refuse_sweep(*arguments):
            raise _RefusedError("limit")
        else:
            self._start_sweep(number, *arguments)

    def _start_sweep(self, number: int, from_deg: float, to_deg: float, duration_s: float) -> None:
        self._sweeps += 1
        plan = self.arm.sweep(number, from_deg, to_deg, duration_s)
        for fault in [f for f in self._faults if f.at_sweep == self._sweeps]:
            self._faults.remove(fault)
            at_ns = plan.first_ns + round(fault.fraction * (plan.last_ns - plan.first_ns))
            self._timed.append((at_ns, fault))

    # -- what happens by itself

    def check_watchdog(self, real_s: float) -> None:
        """Stop and switch the lamp off if no keepalive has come for too long (real time)."""
        safe = self.arm.still_or_braking and not self.arm.lamp
        if not safe and self._unwatched(real_s):
            self.stopped_by_watchdog = True
            self.arm.switch(False)
            self.arm.brake("watchdog")
            self._say(Event(0, self._tick(), "NOTICE", "watchdog"))
            self._settle()

    def make_safe(self) -> None:
        """Lamp off, and brake to a stand: what is left when nobody grants time any more."""
        self.arm.switch(False)
        self.arm.brake("stopped")
        self.arm.run_down()
        self._settle()

    def _strike(self, fault: PlannedFault) -> None:
        if fault.kind not in ("stall", "emergency_stop"):
            self._wire.take_fault(fault)
            return
        if fault.kind == "stall":
            self.fault = code = "stall"
            self.arm.brake(code, at_once=True)
        else:
            self.emergency_stop, code = True, "estop"
            self.arm.switch(False)
            self.arm.brake(code)
            if fault.for_s > 0:
                self._timed.append((self.now_ns + round(1e9 * fault.for_s), None))
        self._say(Event(0, self._tick(), "NOTICE", code))
        self._settle()

    def advance(self, until_ns: int, has_room: Callable[[], bool]) -> bool:
        """Move on to ``until_ns``; return False where the wire's queue is full before that."""
        while has_room():
            self._timed.sort(key=lambda item: item[0])
            timed_ns = self._timed[0][0] if self._timed else _NEVER
            end_ns = self.arm.next_end_ns or _NEVER
            report_ns = self._clock.when(self._next_tick) if self._period else _NEVER
            next_ns = min(timed_ns, end_ns, report_ns)
            self.arm.now_ns = max(self.now_ns, min(next_ns, until_ns))
            if next_ns > until_ns:
                return True
            if timed_ns == next_ns:
                self._take_timed()
            elif end_ns == next_ns:
                self._settle()
            else:
                self._report()
        return False

    def _take_timed(self) -> None:
        fault = self._timed.pop(0)[1]
        if fault is None:
            self.emergency_stop = False
        else:
            self._strike(fault)

    def _report(self) -> None:
        self._reports += 1
        for fault in [f for f in self._faults if f.at_report == self._reports]:
            self._faults.remove(fault)
            self._strike(fault)
        now, tick = self.arm.state(), self._next_tick
        self._next_tick += self._period
        report = Report(tick % self._tick_range, now.angle_deg, now.speed_deg_s, self._flags())
        self._wire.report(report, self.now_ns, tick)
