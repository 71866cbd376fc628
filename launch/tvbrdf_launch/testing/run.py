"""A run that a test started: it waits for messages, without sleeps, and keeps what was said."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from tvbrdf_messages.bus import Port
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.errors import BusError
from tvbrdf_messages.messages import Log, OperatorReply
from tvbrdf_messages.run_directory import Graph
from tvbrdf_messages.schema import Message
from tvbrdf_messages.topics import find_topic
from tvbrdf_nodes.core.loading import NODES

from .errors import MisuseError, WaitError, unknown
from .tell import describe_wait

Predicate = Callable[[Any], object]
"""Says of a message whether it is the one."""
DEFAULT_TIMEOUT_S = 60.0


class Ended(NamedTuple):
    """How a run ended: the node that ended it, or the launcher, its exit code and its last word."""

    node: str
    code: int
    text: str


class Told(NamedTuple):
    """A message and when it came, on the run's clock."""

    log_time_ns: int
    envelope: Envelope


class Run(ABC):
    """Nodes of a graph that run, and participants that the test plays.

    Time goes on only while the test waits (in process), or at its own pace (real processes).
    Use it as a context manager, or through the fixtures, which stop it at the test's end.
    """

    def __init__(self, graph: Graph, played: Iterable[str], *, keep_frames: bool) -> None:
        self.graph = graph
        self.played = tuple(played)
        """Names of the participants that the test plays: they say what :meth:`send` is given."""
        self.keep_frames = keep_frames
        self.history: list[Told] = []
        """All that was published, in order; frames only with ``keep_frames``."""
        self.counts: defaultdict[str, int] = defaultdict(int)
        """Messages by topic, frames too."""
        self._by_topic: defaultdict[str, list[Envelope]] = defaultdict(list)
        self._ports: dict[str, Port] = {}
        """Of the participants that the test plays."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    # -- what the two kinds of runs do in their own way

    @property
    @abstractmethod
    def now_ns(self) -> int:
        """The run's time, integer nanoseconds."""

    @property
    @abstractmethod
    def ended(self) -> Ended | None:
        """How the run ended; None as long as it goes on."""

    @abstractmethod
    def stop(self) -> None:
        """Stop all nodes; again is harmless. What was published can still be asked for."""

    @abstractmethod
    def ask(self, node: str, verb: str, **arguments: Any) -> OperatorReply:
        """Ask a node what a person may ask it, as ``tvbrdf scan`` does, and return its answer."""

    @abstractmethod
    def _until(self, done: Callable[[], bool], timeout_s: float) -> str:
        """Go on until ``done()``; return why it is not, or nothing if it is."""

    @abstractmethod
    def _node_states(self) -> dict[str, str]:
        """Return how each node is, in words, for who waited in vain."""

    # -- waiting

    def wait_for(
        self,
        topic: str,
        predicate: Predicate | None = None,
        count: int = 1,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> Any:
        """Go on until a message is there, and return it.

        Parameters
        ----------
        topic
            Full name.
        predicate
            Says of a message whether it is meant; all are by default.
        count
            Which of the messages that are meant, counted from the run's beginning: one that has
            come already is returned at once.
        timeout_s
            Real time.

        Raises
        ------
        WaitError
            In vain: with what came instead, and the nodes' logs.
        MisuseError
            If nobody gives the topic, or its frames are not kept.
        """
        said = self._topic(topic)
        if count < 1:
            raise MisuseError(f"count is {count}, expected 1 or more")
        found: list[Any] = []
        looked_at = 0

        def done() -> bool:
            nonlocal looked_at
            while len(found) < count and looked_at < len(said):
                message = said[looked_at].message
                looked_at += 1
                if predicate is None or predicate(message):
                    found.append(message)
            return len(found) >= count

        why = self._until(done, timeout_s)
        if why:
            which = "a message" if count == 1 else f"message {count}"
            name = getattr(predicate, "__qualname__", repr(predicate))
            wanted = f"{which} on {topic}" + (f" with {name}" if predicate is not None else "")
            close = [envelope.message for envelope in said]
            raise self._in_vain(f"{wanted} ({len(found)} of {count} came)", why, close)
        return found[-1]

    def wait_until(
        self,
        done: Callable[[], object],
        what: str = "what the test waits for",
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        """Go on until ``done()`` is true; ``what`` says in words what that means."""
        why = self._until(lambda: bool(done()), timeout_s)
        if why:
            raise self._in_vain(what, why)

    def wait_until_ended(self, timeout_s: float = DEFAULT_TIMEOUT_S) -> Ended:
        """Go on until the run has ended by itself, and return how."""
        self.wait_until(lambda: self.ended is not None, "the end of the run", timeout_s)
        ended = self.ended
        assert ended is not None
        return ended

    def _in_vain(self, wanted: str, why: str, close: Iterable[Any] = ()) -> WaitError:
        text = describe_wait(
            wanted,
            why,
            close=list(close),
            counts=self.counts,
            nodes=self._node_states(),
            logs=self.logs(),
        )
        return WaitError(text)

    # -- what was said

    def published(self, topic: str) -> list[Any]:
        """Return the messages of a topic so far."""
        return [envelope.message for envelope in self._topic(topic)]

    def envelopes(self, topic: str) -> list[Envelope]:
        """Return the messages of a topic so far, with their headers."""
        return list(self._topic(topic))

    def logs(self) -> list[str]:
        """Return what the nodes said to people so far, a line each."""
        messages = [envelope.message for envelope in self._by_topic["/log"]]
        return [f"{m.node} {m.level}: {m.text}" for m in messages if isinstance(m, Log)]

    @property
    def database(self) -> Path:
        """The folder that the database writer writes."""
        for participant in self.graph.participants:
            if participant.node == NODES["database_writer"]:
                return Path(participant.parameters["path"])
        raise MisuseError(f"no database_writer runs; there are: {self._names()}")

    def _names(self) -> str:
        return ", ".join(p.name for p in self.graph.participants if p.node)

    def _topic(self, topic: str) -> list[Envelope]:
        given = {t for p in self.graph.participants for t in p.gives}
        try:
            find_topic(topic)
        except BusError:
            raise unknown("topic", topic, given) from None
        if topic not in given:
            raise MisuseError(
                f"nobody in this run gives {topic}; given are: {', '.join(sorted(given))}"
            )
        if topic.endswith("/frame") and not self.keep_frames:
            raise MisuseError(f"{topic}: frames are not kept; start with keep_frames=True")
        return self._by_topic[topic]

    def _note(self, envelope: Envelope) -> None:
        """Keep a message that was published."""
        self.counts[envelope.topic] += 1
        if self.keep_frames or not envelope.topic.endswith("/frame"):
            self.history.append(Told(self.now_ns, envelope))
            self._by_topic[envelope.topic].append(envelope)

    # -- what the test says

    def send(
        self,
        topic: str,
        message: Message,
        *,
        by: str | None = None,
        stamp_ns: int | None = None,
        **header: Any,
    ) -> None:
        """Publish a message as one of the participants that the test plays.

        Parameters
        ----------
        by
            Which; may be left out where only one of them gives the topic.
        stamp_ns
            When what it tells happened; now by default.
        header
            ``received_ns``, ``hardware_ns``.
        """
        port = self._port(topic, by)
        at_ns = self.now_ns if stamp_ns is None else stamp_ns
        port.publish(topic, message, stamp_ns=at_ns, **header)

    def incarnation(self, played: str) -> str:
        """Return the present life of a participant that the test plays; commands carry it."""
        if played not in self._ports:
            raise unknown("a participant that the test plays,", played, self.played)
        return self._ports[played].incarnation

    def _port(self, topic: str, by: str | None) -> Port:
        try:
            find_topic(topic)
        except BusError as error:
            raise MisuseError(str(error)) from None
        if by is not None and by not in self._ports:
            raise unknown("a participant that the test plays,", by, self.played)
        able = [n for n in self._ports if topic in self.graph.find(n).gives and by in (None, n)]
        if len(able) == 1:
            return self._ports[able[0]]
        if able:
            raise MisuseError(f"{topic} is given by {', '.join(able)}; say which with by=")
        played = "; ".join(
            f"{n} gives {', '.join(self.graph.find(n).gives) or 'nothing'}" for n in self.played
        )
        raise MisuseError(
            f"the test can't send {topic}: it plays {played or 'nobody'} "
            "(play a node with without=, or name inputs=)"
        )
