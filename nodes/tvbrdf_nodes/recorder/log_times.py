"""At which time on the run's clock a message is recorded; a recorder may join a run late."""

from __future__ import annotations

from typing import NamedTuple

from tvbrdf_messages.clock import RunClock, ToldClock
from tvbrdf_messages.envelope import Envelope, Header, epoch_of
from tvbrdf_messages.run_directory import Graph

MOST_HELD = 1000


class Timed(NamedTuple):
    """A message, and the log time under which it is recorded."""

    log_time_ns: int
    envelope: Envelope


class LogTimes:
    """Gives each message its log time; holds it back while the run's clock is not known yet.

    A clock that is told stands at the moment of launch until then: recorded at once, messages
    would stand at the run's beginning in the bag. The owner releases them after a moment in any
    case: at the beginning of a run the clock stands there rightly.
    """

    def __init__(self, graph: Graph, clock: RunClock) -> None:
        self._clock, self._untold_ns = clock, graph.utc_ns
        self._held: list[Envelope] = []
        self._told = self._holds = graph.simulated
        self._latest_ns = self._epoch = 0

    def take(self, envelope: Envelope) -> list[Timed]:
        """Return what is to be recorded now."""
        if not self._holds:
            return [self._timed(envelope)]
        self._held.append(envelope)
        if self._clock.now_ns() == self._untold_ns and len(self._held) < MOST_HELD:
            return []
        return self.release()

    def release(self) -> list[Timed]:
        """Return what was held back, and hold back no more."""
        self._holds = False
        found, self._held = self._held, []
        return [self._timed(envelope) for envelope in found]

    def _timed(self, envelope: Envelope) -> Timed:
        """Add the time on the run's clock.

        A clock that is told comes some messages late: nothing is recorded before it happened, nor
        before what came earlier, unless a replay has jumped.
        """
        now_ns = self._clock.now_ns()
        if not self._told:
            return Timed(now_ns, envelope)
        epoch = self._clock.epoch if isinstance(self._clock, ToldClock) else 0
        if epoch != self._epoch:
            self._epoch, self._latest_ns = epoch, 0
        happened_ns = envelope.header.stamp_ns if self._is_of_now(envelope.header) else 0
        self._latest_ns = max(self._latest_ns, now_ns, happened_ns)
        return Timed(self._latest_ns, envelope)

    def _is_of_now(self, header: Header) -> bool:
        """Return whether who sent a message knew the time, and that of the present epoch."""
        if header.stamp_ns == self._untold_ns:
            return False
        return self._epoch <= 1 or epoch_of(header.incarnation) == self._epoch
