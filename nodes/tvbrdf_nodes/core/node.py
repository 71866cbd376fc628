"""What a node is: a class that declares what it takes and gives, with handlers.

Handlers map a message to messages. They hold no sockets, threads, sleeps or wall clocks: time
enters as timers on the run's clock, device readings through :meth:`Node.poll`. One shell runs any
node as a process over ZeroMQ (:mod:`.process`), another runs the same classes inside one process
(:mod:`.inprocess`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import OperatorRequest
from tvbrdf_messages.schema import Message

if TYPE_CHECKING:
    from pathlib import Path

    from tvbrdf_messages.bus import Port
    from tvbrdf_messages.clock import RunClock
    from tvbrdf_messages.run_directory import Graph


@dataclass(frozen=True, slots=True, kw_only=True)
class Send:
    """Publish a message; ``stamp_ns`` is now on the run's clock when not given.

    With ``keep``, it is kept under that key for restarted readers until :class:`Release`.
    """

    topic: str
    message: Message
    stamp_ns: int | None = None
    received_ns: int = 0
    hardware_ns: int = 0
    keep: str = ""


@dataclass(frozen=True, slots=True)
class Forward:
    """Publish a recorded message as it is: the parts of a multipart message, header and all."""

    parts: Sequence[bytes]


@dataclass(frozen=True, slots=True)
class Release:
    """Forget a message that was sent with ``keep``."""

    topic: str
    key: str


@dataclass(frozen=True, slots=True)
class Reply:
    """Answer a person's request."""

    request_id: str
    ok: bool
    text: str
    data: dict[str, Any] = field(default_factory=dict)


GIVE_UP = 3
"""Exit code of a node without which the run can't go on, and which it won't help to start again."""


@dataclass(frozen=True, slots=True)
class Exit:
    """End this node's process; ``code`` 0 says that its work is done."""

    code: int = 0
    text: str = ""


Output = Send | Forward | Release | Reply | Exit
Outputs = Iterable[Output]


class TopicUse(NamedTuple):
    """The topics that a node takes and gives."""

    takes: tuple[str, ...] = ()
    gives: tuple[str, ...] = ()
    selects: Callable[[str], bool] | None = None
    """Says which topics it takes besides, of those that other nodes of the run give."""
    counted_bytes: int = 0
    """Above 0: nobody waits for it. Each publisher has so many bytes on the way to it at most;
    what does not fit is left out, and counted as a gap."""


class Logger(Protocol):
    """A node's log: lines go to its log file and to ``/log``."""

    def info(self, text: str) -> None:
        """Say what happened."""
        ...

    def warning(self, text: str) -> None:
        """Say what is not as it should be, but can go on."""
        ...

    def error(self, text: str) -> None:
        """Say what failed, and what to do."""
        ...


class NodeContext(Protocol):
    """What the shell gives a node."""

    name: str
    incarnation: str
    clock: RunClock
    log: Logger
    graph: Graph
    run_directory: Path

    def set_timer(self, name: str, at_ns: int) -> None:
        """Call :meth:`Node.on_timer` once the run's clock has reached ``at_ns``."""
        ...

    def set_watchdog(self, name: str, after_s: float) -> None:
        """Call :meth:`Node.on_timer` after that much real (monotonic) time."""
        ...

    def cancel(self, name: str) -> None:
        """Forget a timer or watchdog."""
        ...

    def next_sequence(self, topic: str) -> int:
        """Return the sequence number that the next message on ``topic`` will carry."""
        ...

    def open_link(self, name: str) -> Port:
        """Open the port of a simulated device that this process owns (see the graph)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class NoParameters:
    """For nodes that have none."""


P = TypeVar("P")


class Node(Generic[P]):
    """Base of all nodes. ``parameters_type`` is a frozen dataclass: names, types, defaults."""

    parameters_type: ClassVar[type[Any]] = NoParameters
    has_service: ClassVar[bool] = False
    """Whether people may ask it things (:meth:`on_request`)."""
    drains: ClassVar[bool] = False
    """Whether it takes what has arrived before it stops; nothing that moves hardware may."""
    hears_itself: ClassVar[bool] = False
    """Whether it takes what it says itself too, on topics that it takes from others."""

    def __init__(self, context: NodeContext, parameters: P) -> None:
        self.context = context
        self.parameters = parameters

    @classmethod
    def topics(cls, name: str, parameters: P) -> TopicUse:
        """Return what a node of that name takes and gives."""
        raise NotImplementedError

    @classmethod
    def notices(cls, name: str, parameters: P, graph: Graph) -> Iterable[str]:
        """Return what people should know before the run starts; ``ValueError`` refuses it."""
        return ()

    def prepare(self) -> None:
        """Do what takes long (imports, tables) while the arm homes; all readers are there."""

    def start(self) -> Outputs:
        """Begin; called once, after :meth:`prepare`."""
        return ()

    def handle(self, envelope: Envelope) -> Outputs:
        """Take one message."""
        return ()

    def on_timer(self, name: str) -> Outputs:
        """Take note that a timer or watchdog has run out."""
        return ()

    def on_reader(self, reader: str) -> Outputs:
        """Take note that a reader registered after the start: it was restarted."""
        return ()

    def on_lost(self, publisher: str) -> Outputs:
        """Take note that a publisher's process is gone."""
        return ()

    def on_found(self, publisher: str) -> Outputs:
        """Take note that a publisher is back, as a new incarnation."""
        return ()

    def on_epoch(self, epoch: int) -> Outputs:
        """Empty what was joined so far: a replay has jumped, and what follows is of its new epoch.

        The first epoch of a replay is not told.
        """
        return ()

    def on_request(self, request: OperatorRequest) -> Outputs:
        """Answer a person (only with ``has_service``)."""
        return ()

    def on_overflow(self, topic: str) -> Outputs:
        """Take note that a live source's message did not fit a reader's queue."""
        return ()

    def poll(self) -> Outputs:
        """Read the device, without blocking."""
        return ()

    def waitables(self) -> Sequence[Any]:
        """Return what becomes readable when :meth:`poll` has work: file numbers, sockets."""
        return ()

    def pending(self) -> bool:
        """Return whether :meth:`poll` has more to give at once."""
        return False

    def stop(self) -> Outputs:
        """End: make the hardware safe, close the device."""
        return ()

    def diagnostics(self) -> dict[str, Any]:
        """Return counters of its own for ``/diagnostics``."""
        return {}
