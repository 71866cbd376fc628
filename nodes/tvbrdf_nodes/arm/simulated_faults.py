"""Faults on demand of the simulated controller: what breaks, and when."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from ..core.parameters import ParameterError, build

KINDS: dict[str, tuple[str, ...]] = {
    "garbage": ("count", "bytes"),
    "wrong_checksum": ("count",),
    "lost_bytes": ("count", "bytes"),
    "silent": (),
    "late_answers": ("count", "delay_s"),
    "unplug": ("for_s",),
    "stall": (),
    "emergency_stop": ("for_s",),
}
"""Every kind of fault, with the details that it may have."""


class FaultError(ValueError):
    """A scene asks for a fault that does not exist."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedFault:
    """One fault: ``at_report`` or ``at_sweep`` (both count from 1) says when it begins.

    Kinds: ``garbage`` (random bytes instead of a report), ``wrong_checksum``, ``lost_bytes``,
    ``silent`` (nothing is sent any more), ``late_answers``, ``unplug`` (the cable is pulled),
    ``stall`` (the motor stops, with a fault), ``emergency_stop``.
    """

    kind: str
    at_report: int = 0
    at_sweep: int = 0
    fraction: float = 0.5
    """Of the way between the sweep's ends."""
    count: int = 1
    """Lines that it spoils."""
    bytes: int = 3
    """Random bytes, or bytes lost, in each line."""
    delay_s: float = 1.0
    """Real time by which answers are late."""
    for_s: float = 0.0
    """How long it lasts (``unplug``: real time, ``emergency_stop``: the run's); 0: for good."""

    def __post_init__(self) -> None:
        """Refuse what makes no sense."""
        if self.kind not in KINDS:
            raise ValueError(f"unknown arm fault {self.kind!r}; there are: {', '.join(KINDS)}")
        if (self.at_report > 0) == (self.at_sweep > 0):
            raise ValueError(f"fault {self.kind}: give one of at_report and at_sweep, from 1 on")
        if not 0 <= self.fraction <= 1 or min(self.count, self.bytes) < 1:
            raise ValueError(f"fault {self.kind}: fraction is 0 to 1; count, bytes are 1 or more")
        if self.delay_s < 0 or self.for_s < 0:
            raise ValueError(f"fault {self.kind}: delay_s and for_s are 0 or more")


def parse_faults(raw: Iterable[Mapping[str, Any]]) -> tuple[PlannedFault, ...]:
    """Return the faults of a scene's ``arm.faults``.

    Raises
    ------
    FaultError
        Naming the fault, what is wrong with it and what is known.
    """
    found = []
    for number, entry in enumerate(raw, start=1):
        try:
            fault = build(PlannedFault, entry)
        except ParameterError as error:
            raise FaultError(f"arm.faults, number {number}: {error}") from error
        known = {"kind", "at_report", "at_sweep", "fraction", *KINDS[fault.kind]}
        for key in entry:
            if key not in known:
                raise FaultError(
                    f"arm.faults, number {number}: {fault.kind} has no {key!r}; "
                    f"it has: {', '.join(sorted(known))}"
                )
        found.append(fault)
    return tuple(found)
