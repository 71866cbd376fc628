"""What a participant sees of the bus, whichever bus it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from ..envelope import Envelope
from ..schema import Message


class PortEvent(NamedTuple):
    """Something that happened to a connection.

    ``kind``: ``reader`` (one registered, also after a restart), ``lost`` (a publisher's process is
    gone), ``found`` (it is there, ``incarnation`` tells whether it is a new one), ``refused``
    (bytes that were no message of ours; ``text`` says what was wrong).
    """

    kind: str
    name: str
    incarnation: str = ""
    text: str = ""


class Port(Protocol):
    """One participant's place on the bus. Used by one thread."""

    name: str
    incarnation: str

    def publish(
        self,
        topic: str,
        message: Message,
        *,
        stamp_ns: int,
        received_ns: int = 0,
        hardware_ns: int = 0,
        keep: str = "",
    ) -> bool:
        """Send a message to every reader that the graph names.

        With ``keep``, it is kept under that key and sent again to a restarted reader until
        :meth:`release`. Small lossless messages may wait to travel together until the port is
        serviced, which its owner does before it waits for anything. Waits for credit on a lossless
        topic; a live source does not wait: then ``False`` says that a reader did not get it.
        """
        ...

    def forward(self, parts: Sequence[Any]) -> bool:
        """Send a recorded message as it is, header and all, to every reader that the graph names.

        ``parts`` are those of a multipart message, its topic one that this port gives. Waits as
        :meth:`publish` does.
        """
        ...

    def begin_epoch(self, epoch: int) -> None:
        """Let what is published from now on tell the epoch of a replay, in its incarnation."""
        ...

    def release(self, topic: str, key: str) -> None:
        """Forget a kept message."""
        ...

    def next_sequence(self, topic: str) -> int:
        """Return the sequence number that the next message on ``topic`` will carry."""
        ...

    def receive(self, limit: int = 64) -> list[Envelope]:
        """Return messages that have arrived, at most ``limit``; each counts as handled at the
        next call, which gives its credit back."""
        ...

    def events(self) -> list[PortEvent]:
        """Return and clear what happened to the connections."""
        ...

    def missing_readers(self) -> tuple[str, ...]:
        """Return the readers that have not registered, as ``reader:topic``."""
        ...

    def counters(self) -> dict[str, Any]:
        """Return messages and bytes sent and received, gaps, repeats and refusals."""
        ...

    def close(self) -> None:
        """Close all connections; what was sent is still delivered for a moment."""
        ...
