"""The arm's node: carries out the sequencer's commands within the arm's limits, or says why not."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import ArmState, ScanCommand

from ..core.commands import CommandGate, result_of
from ..core.device import DeviceError, make_driver
from ..core.node import Node, NodeContext, Output, Outputs, Send, TopicUse
from .driver import (
    Acknowledged,
    ArmDriver,
    ArmFault,
    ArmReading,
    MotionDone,
    Reading,
    Ready,
    Refused,
    RoundTrip,
)
from .parameters import ArmParameters
from .rules import NOT_OURS, refuse_command, time_limit_s
from .tasks import ANSWER, MOTION, Task

SERVICE_S = 0.05
STOP_LIMIT_S = 60.0
"""On the run's clock: within that the arm must be at rest after a stop."""
ROUND_TRIPS = 200


class ArmNode(Node[ArmParameters]):
    """Drives the light, and tells where it is.

    On a start it stops the arm, switches the lamp off, reads the state, and moves only on a new
    command. A command of an earlier sequencer, a late or a repeated one is refused; ``stop`` is
    always obeyed, and switches the lamp off unless it says ``lamp``.
    """

    parameters_type = ArmParameters

    def __init__(self, context: NodeContext, parameters: ArmParameters) -> None:
        super().__init__(context, parameters)
        self._driver: ArmDriver = make_driver(
            context, parameters.driver, parameters.driver_parameters
        )
        self._gate = CommandGate("all", "arm", context.name)
        self._ready = self._open = False
        self._state: ArmReading | None = None
        self._tasks: list[Task] = []
        self._motion: Task | None = None
        self._stop: Task | None = None
        self._deferred: list[ScanCommand] = []
        """Commands that wait until the driver is ready, or a stop has ended."""
        self._delays: deque[int] = deque(maxlen=ROUND_TRIPS)
        self._commander = ""
        self._refused = 0

    @classmethod
    def topics(cls, name: str, parameters: ArmParameters) -> TopicUse:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return TopicUse(
            takes=("/scan/command", "/clock"),
            gives=("/arm/state", "/scan/sweep_result", "/diagnostics", "/log"),
        )

    # -- what comes in

    def start(self) -> Outputs:
        """Open the driver, which makes the arm still and dark."""
        self._open = True
        self._driver.open()
        self.context.set_watchdog("service", SERVICE_S)
        return ()

    def handle(self, envelope: Envelope) -> Outputs:
        """Take a command."""
        command = envelope.message
        if not isinstance(command, ScanCommand) or not self._gate.concerns(command):
            return ()
        if command.action in NOT_OURS:
            return ()
        return self._guarded(self._take_command(envelope, command))

    def poll(self) -> Outputs:
        """Send a keepalive if it is time to, and read the driver.

        Only the main loop does so: if it hangs, keepalives cease and the controller stops.
        """
        return self._guarded(self._poll())

    def on_timer(self, name: str) -> Outputs:
        """Keep things going; give up what lasts too long."""
        return self._guarded(self._on_timer(name))

    def on_signal(self) -> Outputs:
        """Stop and switch the lamp off: somebody asked for it without the bus."""
        self.context.log.warning("stopped by a signal")
        return self._guarded(self._halt("stopped by a signal")) if self._ready else ()

    def on_overflow(self, topic: str) -> Outputs:
        """A state is lost to a reader: what is measured now can't be used."""
        if topic == "/arm/state" and self._motion is not None and self._motion.sweeps:
            return self._guarded(self._halt("states were lost: a reader of /arm/state is too slow"))
        return ()

    def on_lost(self, publisher: str) -> Outputs:
        """Nobody commands any more: the lamp must not stay on for long."""
        if publisher == self._commander:
            self.context.set_watchdog("commander", self.parameters.commander_lost_s)
        return ()

    def on_found(self, publisher: str) -> Outputs:
        """The sequencer is back."""
        if publisher == self._commander:
            self.context.cancel("commander")
        return ()

    def waitables(self) -> Sequence[Any]:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return self._driver.waitables() if self._open else ()

    def pending(self) -> bool:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return self._open and self._driver.pending()

    def _guarded(self, outputs: Iterable[Output]) -> Outputs:
        """Break what is under way when the driver fails, then let its error end the node."""
        try:
            yield from outputs
        except DeviceError as error:
            self._open = False
            yield from self._break_all(str(error))
            raise

    def _on_timer(self, name: str) -> Outputs:
        if name == "service":
            self.context.set_watchdog("service", SERVICE_S)
            yield from self._poll()
        elif not self._ready:
            return
        elif name == "tick":
            self._ask_tick()
        elif name == "commander":
            reason = f"its sequencer has been gone for {self.parameters.commander_lost_s:g} s"
            self.context.log.warning(f"stop and lamp off: {reason}")
            yield from self._halt(reason)
        elif name == "motion" and self._motion is not None:
            yield from self._halt(f"{self._motion.commands[0].action} did not end in time")
        elif name == "stop" and self._stop is not None:
            yield from self._finish(self._stop, "broken", "the arm did not come to rest in time")

    def _ask_tick(self) -> None:
        p = self.parameters
        sweeping = self._motion is not None and self._motion.sweeps
        rate_hz = p.sweep_tick_rate_hz if sweeping else p.idle_tick_rate_hz
        self._driver.ask_tick()
        self.context.set_timer("tick", self._in(1.0 / rate_hz))

    # -- what the driver reads

    def _poll(self) -> Outputs:
        if not self._open:
            return
        self._driver.keepalive()
        for reading in self._driver.read():
            yield from self._take_reading(reading)

    def _take_reading(self, reading: Reading) -> Outputs:
        match reading:
            case ArmReading():
                yield from self._take_state(reading)
            case RoundTrip():
                self._delays.append(reading.one_way_ns)
            case Acknowledged():
                yield from self._resolve(reading.token, ANSWER, "")
            case MotionDone():
                yield from self._resolve(reading.token, MOTION, reading.reason)
            case Refused():
                for task in [t for t in self._tasks if reading.token in t.waiting]:
                    yield from self._finish(task, "refused", reading.reason)
            case ArmFault():
                self.context.log.warning(f"controller: {reading.text}")
            case Ready():
                self._ready = True
                limits, identity = reading.limits, reading.identity
                self.context.log.info(
                    f"{identity.model} {identity.serial}: {limits.min_angle_deg:g}° to "
                    f"{limits.max_angle_deg:g}°, up to {limits.max_speed_deg_s:g}°/s"
                )
                self._ask_tick()
                yield from self._take_deferred()

    def _take_state(self, reading: ArmReading) -> Outputs:
        self._state = reading
        delay_ns = min(self._delays, default=0)
        if self._motion is not None and self._motion.first_sequence < 0:
            self._motion.first_sequence = self.context.next_sequence("/arm/state")
        yield Send(
            topic="/arm/state",
            message=ArmState(
                angle_deg=reading.angle_deg,
                speed_deg_s=reading.speed_deg_s,
                lamp=reading.lamp,
                moving=reading.moving,
                homed=reading.homed,
                fault=reading.fault,
                emergency_stop=reading.emergency_stop,
                one_way_delay_ns=delay_ns,
            ),
            stamp_ns=reading.received_ns - delay_ns,
            received_ns=reading.received_ns,
            hardware_ns=reading.tick_ns,
        )

    def _resolve(self, token: int, kind: str, reason: str) -> Outputs:
        for task in [t for t in self._tasks if t.waiting.get(token) == kind]:
            if reason:
                yield from self._finish(task, "broken", reason)
                continue
            del task.waiting[token]
            if not task.waiting:
                homed = any(command.action == "home" for command in task.commands)
                if homed and self._state is not None:  # known before the next report tells it
                    self._state = replace(self._state, homed=True, fault="")
                yield from self._finish(task, "done")

    # -- carrying out commands

    def _take_command(self, envelope: Envelope, command: ScanCommand) -> Outputs:
        reason = self._gate.refusal(envelope, command, self.context.clock.now_ns())
        if command.action == "stop":  # never too late to be safe
            yield from self._take_stop(command)
        elif reason:
            yield from self._refuse(command, reason)
        else:
            self._commander = envelope.header.publisher
            if self._ready and self._stop is None:
                yield from self._begin(command)
            else:
                self._deferred.append(command)

    def _take_stop(self, command: ScanCommand) -> Outputs:
        reason = f"stopped by command {command.command_id}"
        if self._ready:
            yield from self._halt(reason, [command], keep_lamp=command.lamp)
        else:
            yield from self._refuse_deferred(reason)
            self._deferred.append(command)

    def _take_deferred(self) -> Outputs:
        if not self._ready:
            return
        deferred, self._deferred = self._deferred, []
        for command in deferred:
            late_ms = (self.context.clock.now_ns() - command.not_after_ns) / 1e6
            if command.action == "stop":
                yield from self._take_stop(command)
            elif late_ms > 0:
                text = f"command {command.command_id} waited until it was {late_ms:.0f} ms late"
                yield from self._refuse(command, text)
            elif self._stop is not None:
                self._deferred.append(command)
            else:
                yield from self._begin(command)

    def _refuse_deferred(self, reason: str) -> Outputs:
        refused = [command for command in self._deferred if command.action != "stop"]
        self._deferred = [command for command in self._deferred if command.action == "stop"]
        for command in refused:
            yield from self._refuse(command, reason)

    def _halt(
        self, reason: str, commands: Sequence[ScanCommand] = (), *, keep_lamp: bool = False
    ) -> Outputs:
        """Stop, and switch the lamp off; a motion under way is broken."""
        waiting = {self._driver.stop(): MOTION}
        if not keep_lamp:
            waiting[self._driver.lamp(False)] = ANSWER
        if self._motion is not None:
            yield from self._finish(self._motion, "broken", reason)
        yield from self._refuse_deferred(reason)
        if self._stop is None:
            self._stop = Task([], {})
            self._tasks.append(self._stop)
        self._stop.commands.extend(commands)
        self._stop.waiting = waiting
        self.context.set_timer("stop", self._in(STOP_LIMIT_S))

    def _begin(self, command: ScanCommand) -> Outputs:
        driver, limits = self._driver, self._driver.limits
        current = self._motion.commands[0] if self._motion is not None else None
        reason = refuse_command(command, self._state, limits, current)
        if reason:
            yield from self._refuse(command, reason)
            return
        if command.action == "lamp":
            self._tasks.append(Task([command], {driver.lamp(command.lamp): ANSWER}))
            return
        limit_s = time_limit_s(command, limits)
        way = (command.from_deg, command.to_deg, command.duration_s)
        match command.action:
            case "home":
                token, limit_s = driver.home(), self.parameters.home_limit_s
            case "jog":
                token = driver.move(command.to_deg)
            case "prepare":
                token = driver.move(limits.sweep_ends_deg(*way)[0])
            case _:
                token = driver.sweep(*way)
        self._motion = Task([command], {token: MOTION})
        self._tasks.append(self._motion)
        self.context.set_timer("motion", self._in(limit_s))
        if command.action == "sweep":
            self._ask_tick()

    # -- results

    def _refuse(self, command: ScanCommand, reason: str) -> Outputs:
        self._refused += 1
        self.context.log.warning(f"refused {command.action}: {reason}")
        yield self._result(command, "refused", reason)

    def _finish(self, task: Task, state: str, reason: str = "") -> Outputs:
        self._tasks.remove(task)
        if task is self._motion:
            self._motion = None
            self.context.cancel("motion")
        for command in task.commands:
            yield self._result(command, state, reason, task.first_sequence)
        if task is self._stop:
            self._stop = None
            self.context.cancel("stop")
            yield from self._take_deferred()

    def _break_all(self, reason: str) -> Outputs:
        self._ready = False
        deferred, self._deferred = self._deferred, []
        for task in list(self._tasks):
            yield from self._finish(task, "broken", reason)
        for command in deferred:
            yield self._result(command, "broken", reason)

    def _result(
        self, command: ScanCommand, state: str, reason: str, first_sequence: int = -1
    ) -> Send:
        states = {}
        if first_sequence >= 0:
            last = self.context.next_sequence("/arm/state") - 1
            states = {
                "frames": last - first_sequence + 1,
                "first_sequence": first_sequence,
                "last_sequence": last,
            }
        message = result_of(command, self.context.name, state, reason, **states)
        return Send(topic="/scan/sweep_result", message=message)

    def _in(self, seconds: float) -> int:
        return self.context.clock.now_ns() + round(1e9 * seconds)

    # -- the end

    def stop(self) -> Outputs:
        """Leave the arm still and the lamp off; wait a little for the controller to confirm it."""
        halted = self._driver.halt(self.parameters.stop_limit_s)
        if not halted and self._ready:
            self.context.log.error(
                "the controller did not confirm stop and lamp off; its own watchdog must do it"
            )
        self._driver.close()
        self._open = self._ready = False
        if halted and self._stop is not None:
            yield from self._finish(self._stop, "done")
        yield from self._break_all("the arm's node ends")

    def diagnostics(self) -> dict[str, Any]:
        """Return how the line is, and what was refused."""
        return {
            **self._driver.counters(),
            "commands_refused": self._refused,
            "round_trips": len(self._delays),
            "one_way_delay_us": min(self._delays, default=0) / 1e3,
        }
