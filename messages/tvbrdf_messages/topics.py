"""The one table of topics: name, type, quality, expected rate, recorded or not.

``{camera}`` in a name stands for a camera's name (``camera_1`` …). A topic may have several
publishers. Qualities:

- ``lossless``: credit in bytes for each reader that the graph names; nothing is dropped.
- ``command``: commands and status; never blocks, a full queue is a fault.
- ``latest``: may skip; for people, tools and clocks.

Every topic can also be watched by tools as if it were ``latest``.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import NamedTuple

from . import messages as m
from .errors import BusError
from .schema import Message

LOSSLESS, COMMAND, LATEST = "lossless", "command", "latest"


class Topic(NamedTuple):
    """One row of the table."""

    name: str
    type: type[Message]
    quality: str
    rate_hz: float
    """Expected while a sweep runs, for one publisher; 0: on occasion."""
    recorded: bool
    latched: bool = False
    """A reader that registers late gets the last one."""
    text: str = ""

    @property
    def simulation(self) -> bool:
        """Whether only simulated devices may touch it."""
        return self.name.startswith("/sim/")


_TABLE = (
    Topic("/clock", m.Clock, LATEST, 10, False, text="the run's clock (simulation, replay)"),
    Topic("/scan/command", m.ScanCommand, COMMAND, 0, True, text="what to do next"),
    Topic("/replay/command", m.ScanCommand, COMMAND, 0, True, text="what a bag was told to do"),
    Topic("/scan/sweep_result", m.SweepResult, COMMAND, 0, True, text="a sweep is good or broken"),
    Topic("/arm/state", m.ArmState, LOSSLESS, 50, True, text="where the light was when"),
    Topic("/{camera}/info", m.CameraInfo, COMMAND, 0, True, True, "what a camera is"),
    Topic("/{camera}/frame", m.Frame, LOSSLESS, 30, True, text="what was seen when"),
    Topic("/scan/radiance", m.Radiance, LOSSLESS, 0, True, text="one scan's observations"),
    Topic("/scan/parameters", m.Parameters, LOSSLESS, 0, True, text="one scan's fitted model"),
    Topic("/scan/missing", m.ScanMissing, LOSSLESS, 0, True, text="a scan not measured, and why"),
    Topic("/scan/stored", m.Stored, COMMAND, 0, True, text="it is on disk"),
    Topic("/scan/database", m.DatabaseState, COMMAND, 0, False, True, "what the database holds"),
    Topic("/scan/status", m.ScanStatus, LATEST, 1, True, True, "how far the measurement is"),
    Topic("/operator/mark", m.Mark, LOSSLESS, 0, True, text="an operator's note"),
    Topic("/diagnostics", m.Diagnostics, COMMAND, 1, True, text="how each node is"),
    Topic("/log", m.Log, LATEST, 0, True, text="what nodes say"),
    Topic("/sim/scene", m.SimScene, COMMAND, 0, True, True, "the scene"),
    Topic("/sim/grant", m.SimGrant, COMMAND, 10, False, True, "simulated devices may go on"),
    Topic("/sim/horizon", m.SimHorizon, COMMAND, 10, False, True, "a simulated device is done"),
    Topic("/sim/motion", m.SimMotion, COMMAND, 10, False, True, "the light's true motion"),
)

_PATTERNS = tuple(
    (re.compile(re.escape(row.name).replace(r"\{camera\}", "([a-z][a-z0-9_]*)") + "$"), row)
    for row in _TABLE
)


def table() -> tuple[Topic, ...]:
    """Return all rows, camera topics with ``{camera}`` in the name."""
    return _TABLE


@lru_cache(maxsize=1024)
def find_topic(name: str) -> Topic:
    """Return the row that ``name`` belongs to, under its full name.

    Raises
    ------
    BusError
        If no such topic exists; the text lists those that do.
    """
    for pattern, row in _PATTERNS:
        if pattern.match(name):
            return row if row.name == name else row._replace(name=name)
    known = ", ".join(row.name for row in _TABLE)
    raise BusError(f"no topic {name!r}; there are: {known}")


def frame_topic(camera: str) -> str:
    """Return the topic of a camera's frames."""
    return f"/{camera}/frame"


def info_topic(camera: str) -> str:
    """Return the topic of a camera's description."""
    return f"/{camera}/info"
