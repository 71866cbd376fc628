"""What can go wrong with messages and the bus."""

from __future__ import annotations


class MessageError(ValueError):
    """A message is malformed: what was wrong is in the text; it was not delivered."""


class BusError(RuntimeError):
    """The bus can't do what was asked: a wrong name, address or graph."""


class QueueFullError(BusError):
    """A command or status could not be queued: its reader is stuck, which is a fault."""


class StoppedError(BusError):
    """A wait for credit ended because the node was told to stop."""
