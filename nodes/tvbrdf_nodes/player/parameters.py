"""Parameters of the player."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from tvbrdf_messages.bag import BagError

from .clock import PlaybackClock
from .selection import PRESETS, select
from .source import BagSource


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayerParameters:
    """What is played, and how."""

    bag: str
    """A file, or the folder of a bag in parts."""
    what: str = ""
    """``frames`` or ``radiance``: what the pipeline is fed with; empty: ``topics``."""
    topics: tuple[str, ...] = ()
    """Full names; none: all but ``/sim/`` and what nodes say of themselves. Never a command."""
    remap: dict[str, Any] = field(default_factory=dict)
    """Other names, by name; both must carry the same type."""
    rate: float = 1.0
    """Bag time over real time; 0: as fast as the slowest lossless reader takes it."""
    start_offset_s: float = 0.0
    until_s: float | None = None
    """Both after the bag's first message."""
    loop: bool = False
    paused: bool = False
    until_stored: bool = False
    """End when the database has what came of it, not when it was played."""

    def __post_init__(self) -> None:
        """Refuse what can't be played, before anything starts."""
        if self.what and self.what not in PRESETS:
            raise ValueError(f"what is {self.what!r}, expected {' or '.join(PRESETS)}")
        if self.what and (self.topics or self.remap):
            raise ValueError("what: not with topics or remap; give one or the other")
        if self.until_stored and self.loop:
            raise ValueError("loop: not with until_stored, which never comes")
        if self.topics or self.remap:
            select(self.topics, self.topics, self.remap)
        self._clock(0, math.inf)
        if not self.topics:
            try:
                source = self.open()
            except BagError as error:
                raise ValueError(str(error)) from error
            self.clock(source)

    def open(self) -> BagSource:
        """Return the bag, opened."""
        return BagSource(self.bag, what=self.what, topics=self.topics, remap=self.remap)

    def clock(self, source: BagSource) -> PlaybackClock:
        """Return the clock of its playback."""
        return self._clock(source.first_ns, source.last_ns)

    def names(self) -> tuple[str, ...]:
        """Return the topics that are given, by the names under which they are played."""
        if self.topics:
            return tuple(select(self.topics, self.topics, self.remap).values())
        return tuple(self.open().topics.values())

    def _clock(self, first_ns: int, last_ns: float) -> PlaybackClock:
        return PlaybackClock(
            first_ns,
            int(last_ns) if math.isfinite(last_ns) else 1 << 62,
            rate=self.rate,
            start_offset_s=self.start_offset_s,
            until_s=self.until_s,
            loop=self.loop,
            paused=self.paused,
        )
