"""What passes between the processes of a refit; plain values that can be pickled."""

from __future__ import annotations

from dataclasses import dataclass

Parts = tuple[bytes, ...]
"""A message as on the bus: topic, body, arrays."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """One scan that was fitted."""

    scan: int
    line: bytes
    """Its record, JSON on one line."""
    radiance: Parts = ()
    parameters: Parts = ()
    """For the database writer; empty where only fits are written."""
    problem: str = ""
    """Why it could not be fitted."""


@dataclass(frozen=True, slots=True)
class Unfinished:
    """A scan that was begun and of which no radiance came."""

    scan: int
    sample: str
    scan_time_s: float
    reason: str


@dataclass(frozen=True, slots=True)
class Aside:
    """A message that goes to the database as it is: a note, a scan that was missing in the run."""

    parts: Parts


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that can't be refitted; the text names the file and what to do."""

    text: str
    scan: int = 0
    """0: all that was left of the unit."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How much of a unit is done, 0 to 1."""

    fraction: float


Event = Outcome | Unfinished | Aside | Problem | Progress
