"""The player: publishes what a bag holds, as it was sent, and tells the bag's time on ``/clock``.

It never publishes commands: nothing moves. A jump (loop, seek) begins a new epoch: the clock tells
it, and so does each message that is played in it, in its header's incarnation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from tvbrdf_messages.bag import BagError
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Clock, OperatorRequest
from tvbrdf_messages.run_directory import Graph

from ..core.device import DeviceError
from ..core.node import Exit, Forward, Node, NodeContext, Outputs, Reply, Send, TopicUse
from ..core.parameters import build
from ..hdr_merger.node import HdrMergerParameters
from .alarm import Alarm
from .clock import PlaybackClock, PlaybackError
from .lateness import Lateness
from .ledger import Ledger
from .parameters import PlayerParameters
from .read_ahead import Item, ReadAhead
from .selection import FRAMES, RADIANCE, TOLD_COMMAND
from .source import BagSource

BATCH = 64
"""Messages that are sent before people are heard."""
TICK_NS = 100_000_000
"""The clock is told at least so often, of real time and of the bag's."""
PATIENCE_S = 10.0
"""After that it is told what is waited for at the end."""


class PlayerNode(Node[PlayerParameters]):
    """Publishes the messages of a bag in its own time; never commands.

    People may ask it to ``pause``, ``resume``, ``toggle``, ``step``, ``seek`` (``seconds``),
    change the ``rate``, and for its ``status``.
    """

    parameters_type = PlayerParameters
    has_service = True

    def __init__(self, context: NodeContext, parameters: PlayerParameters) -> None:
        super().__init__(context, parameters)
        try:
            _refuse_devices(context.graph, context.name)
            self._source: BagSource = parameters.open()
            self._clock: PlaybackClock = parameters.clock(self._source)
        except (BagError, ValueError) as error:
            raise DeviceError(str(error)) from error
        self._ledger = Ledger(*_merged(context.graph)) if parameters.until_stored else None
        self._ahead: ReadAhead | None = None
        self._alarm: Alarm | None = None
        self._next_tick_ns = self._told_ns = 0
        self._steps = self._played = 0
        self._lateness = Lateness()
        self._started = self._at_end = False

    @classmethod
    def topics(cls, name: str, parameters: PlayerParameters) -> TopicUse:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        takes = {
            "": (),
            FRAMES: ("/scan/sweep_result", "/scan/stored"),
            RADIANCE: ("/scan/stored",),
        }
        return TopicUse(
            takes=takes[parameters.what] if parameters.until_stored else (),
            gives=("/clock", *parameters.names(), "/diagnostics", "/log"),
        )

    @classmethod
    def notices(cls, name: str, parameters: PlayerParameters, graph: Graph) -> Iterable[str]:
        """Refuse to play beside real devices, or where somebody else tells the time."""
        _refuse_devices(graph, name)
        return ()

    def prepare(self) -> None:
        """Begin to read."""
        self._alarm = Alarm()
        self._read_from(self._clock.begin_ns)

    def start(self) -> Outputs:
        """Tell the time and what was last told before it; the clock runs from the first poll on."""
        for topic in self._source.lacking:
            if not self.parameters.what:
                self.context.log.warning(f"{self.parameters.bag} has nothing on {topic}")
        yield from self._begin_epoch(self._clock.begin_ns)

    def _read_from(self, time_ns: int) -> None:
        if self._ahead is not None:
            self._ahead.close()
        self._ahead = self._source.read_ahead(time_ns, self._clock.last_ns, self._clock.epoch)
        self._at_end = False

    def _begin_epoch(self, time_ns: int) -> Outputs:
        yield self._tell(time_ns)
        for item in self._source.latched_before(time_ns, self._clock.epoch):
            yield Forward(item.parts)

    def _tell(self, now_ns: int) -> Send:
        self._told_ns = now_ns
        self._next_tick_ns = self._real_ns() + TICK_NS
        clock = Clock(now_ns=now_ns, epoch=self._clock.epoch, speedup=self._clock.rate)
        return Send(topic="/clock", message=clock, stamp_ns=now_ns)

    def _real_ns(self) -> int:
        return Alarm.now_ns()

    # -- playing

    def waitables(self) -> tuple[Any, ...]:
        """Return what becomes readable when something is due, or was read."""
        if self._alarm is None or self._ahead is None or self._at_end:
            return ()
        return (self._alarm.fileno(), self._ahead.fileno())

    def pending(self) -> bool:
        """Return whether a message is due."""
        item = None if self._ahead is None else self._next(self._ahead)
        return item is not None and self._is_due(item)

    def _next(self, ahead: ReadAhead) -> Item | None:
        try:
            return ahead.peek()
        except BagError as error:
            raise DeviceError(str(error)) from error

    def _is_due(self, item: Item) -> bool:
        due_ns = self._clock.due_ns(item.log_time_ns)
        return self._steps > 0 if due_ns is None else due_ns <= self._real_ns()

    def poll(self) -> Outputs:
        """Send what is due."""
        if self._ahead is None or self._alarm is None or self._at_end:
            return
        if not self._started:  # only now: between start and this the shell takes its time
            self._started = True
            self._clock.start(self._real_ns())
        self._ahead.clear()
        self._alarm.clear()
        for _ in range(BATCH):
            item = self._next(self._ahead)
            if item is None or not self._is_due(item):
                break
            yield from self._play(self._ahead.take())
        if self._ahead.ended():
            yield from self._end()
        yield from self._tick()

    def _play(self, item: Item) -> Outputs:
        clock = self._clock
        due_ns = clock.due_ns(item.log_time_ns)
        if due_ns is None:
            self._steps -= 1
        clock.reach(item.log_time_ns)
        if due_ns is None or item.log_time_ns - self._told_ns >= TICK_NS * max(1.0, clock.rate):
            yield self._tell(item.log_time_ns)
        if self._ledger is not None and item.envelope is not None:
            self._ledger.played(item.envelope)
        yield Forward(item.parts)
        self._played += 1
        if due_ns is not None and clock.rate > 0:
            self._lateness.add(self._real_ns() - due_ns)

    def _tick(self) -> Outputs:
        """Tell the time when it is time for that, and set the alarm for what comes next."""
        if self._alarm is None or self._ahead is None or self._clock.rate == 0 or self._at_end:
            return
        if self._clock.due_ns(0) is None:  # it stands
            return
        now_ns = self._real_ns()
        if now_ns >= self._next_tick_ns:
            yield self._tell(self._clock.now_ns(now_ns))
        item = self._next(self._ahead)
        due_ns = None if item is None else self._clock.due_ns(item.log_time_ns)
        self._alarm.set(min(self._next_tick_ns, due_ns or self._next_tick_ns))

    # -- the end

    def _end(self) -> Outputs:
        """All was played: begin anew, or end when what came of it is stored."""
        if self._clock.paused:
            return
        last_ns = self._clock.last_ns
        if self._clock.rate > 0:
            end_ns = self._clock.due_ns(last_ns)
            if end_ns is not None and end_ns > self._real_ns():
                return  # until lies after the last message
        if self._clock.end(self._real_ns()):
            self._read_from(self._clock.begin_ns)
            yield from self._begin_epoch(self._clock.begin_ns)
            return
        self._at_end = True
        self.context.log.info(f"{self.parameters.bag}: {self._played} messages were played")
        yield self._tell(last_ns)
        yield from self._end_when_stored()

    def _end_when_stored(self) -> Outputs:
        ledger = self._ledger
        if ledger is None:
            yield Exit()
        elif ledger.open():
            self.context.set_watchdog("stored", PATIENCE_S)
        elif ledger.refused:
            yield Exit(1, "the database refused " + "; ".join(ledger.refused[:3]))
        elif not ledger.stored:
            yield Exit(1, f"{self.parameters.bag}: no scan came out of it: none is whole in it")
        else:
            yield Exit()

    def on_timer(self, name: str) -> Outputs:
        """Say what is waited for."""
        if self._ledger is not None and (left := self._ledger.open()):
            self.context.log.warning(f"waits for {', '.join(left[:5])}")
            self.context.set_watchdog("stored", PATIENCE_S)
        return ()

    def handle(self, envelope: Envelope) -> Outputs:
        """Take what merger and database say of what was played."""
        if self._ledger is not None:
            self._ledger.heard(envelope.message)
            if self._at_end:
                yield from self._end_when_stored()

    # -- people

    def on_request(self, request: OperatorRequest) -> Outputs:
        """Pause, go on, step, seek, change the rate, or tell how it is."""
        try:
            text = yield from self._do(request.verb, request.arguments)
        except (PlaybackError, BagError) as error:
            yield Reply(request.request_id, False, str(error))
        else:
            yield Reply(request.request_id, True, text, self._status())

    def _do(self, verb: str, arguments: Mapping[str, Any]) -> Any:
        """Do what was asked; return what is said of it."""
        clock, real_ns = self._clock, self._real_ns()
        if verb == "toggle":
            verb = "resume" if clock.paused else "pause"
        if verb != "status" and self._at_end:
            raise PlaybackError("all was played")
        if verb == "pause":
            clock.pause(real_ns)
            yield self._tell(clock.now_ns(real_ns))
        elif verb == "resume":
            clock.resume(real_ns)
            self._steps = 0
        elif verb == "step":
            if not clock.paused:
                raise PlaybackError("it is playing; pause it first, then step")
            self._steps += 1
        elif verb == "seek":
            clock.seek(_number(arguments, "seconds"), real_ns)
            if self._ledger is not None:
                self._ledger.jumped()
            self._read_from(clock.now_ns(real_ns))
            yield from self._begin_epoch(clock.now_ns(real_ns))
        elif verb == "rate":
            clock.set_rate(_number(arguments, "rate"), real_ns)
        elif verb != "status":
            raise PlaybackError(
                f"no request {verb!r}; there are pause, resume, toggle, step, seek, rate, status"
            )
        if self._alarm is not None:
            self._alarm.set(real_ns)  # what is due now is another thing than it was
        return self._in_words()

    def _in_words(self) -> str:
        clock = self._clock
        at_s = (clock.now_ns(self._real_ns()) - clock.first_ns) / 1e9
        how = "paused" if clock.paused else f"playing at rate {clock.rate:g}"
        return f"{how} at {at_s:.3f} s of {(clock.last_ns - clock.first_ns) / 1e9:.3f} s"

    def _status(self) -> dict[str, Any]:
        clock, real_ns = self._clock, self._real_ns()
        return {
            "paused": clock.paused,
            "rate": clock.rate,
            "epoch": clock.epoch,
            "offset_s": (clock.now_ns(real_ns) - clock.first_ns) / 1e9,
            "now_ns": clock.now_ns(real_ns),
            "played": self._played,
        }

    def stop(self) -> Outputs:
        """Stop reading."""
        if self._ahead is not None:
            self._ahead.close()
            self._ahead = None
        if self._alarm is not None:
            self._alarm.close()
            self._alarm = None
        return ()

    def diagnostics(self) -> dict[str, Any]:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        open_ = 0 if self._ledger is None else len(self._ledger.open())
        found = {"played": self._played, "epoch": self._clock.epoch, "unstored": open_}
        return {**found, **self._lateness.as_dict()}


def _merged(graph: Graph) -> tuple[tuple[str, ...], str]:
    """Return the cameras and the arm for whose ends of sweeps the run's merger waits."""
    for other in graph.participants:
        if TOLD_COMMAND in other.takes:
            given = build(HdrMergerParameters, other.parameters)
            return given.cameras, given.arm
    return (), ""


def _number(arguments: Mapping[str, Any], name: str) -> float:
    value = arguments.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise PlaybackError(f"{name} is {value!r}, expected a number")
    return float(value)


def _refuse_devices(graph: Graph, name: str) -> None:
    """Refuse a run with real devices, or with another clock."""
    for other in graph.participants:
        if other.name == name:
            continue
        if other.live:
            raise ValueError(
                f"{other.name} is a real device, and a bag's time is not its: play the bag in a "
                "run of its own"
            )
        if "/clock" in other.gives:
            raise ValueError(f"{other.name} tells the time already; a run has one clock")
