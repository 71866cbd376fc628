"""Messages that come before the run's clock was told: a recorder may join a run late."""

from __future__ import annotations

from tvbrdf_messages.clock import RunClock
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.run_directory import Graph

MOST_HELD = 1000


class UntilTold:
    """Holds messages back until the clock has left the moment of launch, where it stands untold.

    Recorded at once, they would stand at the run's beginning in the bag. Its owner releases them
    after a moment in any case: at the beginning of a run the clock stands there rightly.
    """

    def __init__(self, graph: Graph, clock: RunClock) -> None:
        self._clock, self._untold_ns = clock, graph.utc_ns
        self._held: list[Envelope] = []
        self._told = self._holds = graph.simulated
        self._latest_ns = graph.utc_ns

    def log_time_ns(self, envelope: Envelope) -> int:
        """Return the time on the run's clock at which a message is recorded.

        A clock that is told comes some messages late: nothing is recorded before it happened, nor
        before what came earlier.
        """
        now_ns = self._clock.now_ns()
        if not self._told:
            return now_ns
        self._latest_ns = max(self._latest_ns, now_ns, envelope.header.stamp_ns)
        return self._latest_ns

    def take(self, envelope: Envelope) -> list[Envelope]:
        """Return what is to be recorded now."""
        if not self._holds:
            return [envelope]
        self._held.append(envelope)
        if self._clock.now_ns() == self._untold_ns and len(self._held) < MOST_HELD:
            return []
        return self.release()

    def release(self) -> list[Envelope]:
        """Return what was held back, and hold back no more."""
        self._holds = False
        found, self._held = self._held, []
        return found
