"""When scans are due: which is next, and where t = 0 is."""

from __future__ import annotations

from tvbrdf_messages.messages import DatabaseState


class Schedule:
    """The scans of a run in time; all times are integer nanoseconds of the run's clock.

    The schedule starts when the first scan of this run may begin. A run that goes on with an
    earlier one keeps the interval from the last scan that this had.

    Parameters
    ----------
    interval_s
        From one scan to the next; 0: they wait for the operator.
    """

    def __init__(self, interval_s: float) -> None:
        self._interval_ns = round(1e9 * interval_s)
        self._first_ns: int | None = None
        """When scan 1 was due, or would have been."""
        self._earliest_ns = 0
        self.next_scan = 1
        self.zero_ns = 0
        """t = 0; 0 until it is known."""

    def go_on_from(self, database: DatabaseState) -> None:
        """Take what a database holds: its scans are done, its t = 0 holds."""
        self.next_scan = max((*database.scans, *database.missing), default=0) + 1
        self.zero_ns = self.zero_ns or database.zero_ns
        if database.last_ns:
            self._earliest_ns = database.last_ns + self._interval_ns

    def due_ns(self, now_ns: int) -> int:
        """Return when the next scan is due; the first that is asked for starts the schedule."""
        if self._interval_ns == 0:
            return now_ns
        offset_ns = self._interval_ns * (self.next_scan - 1)
        if self._first_ns is None:
            self._first_ns = max(now_ns, self._earliest_ns) - offset_ns
        return self._first_ns + offset_ns

    def start_from(self, now_ns: int) -> None:
        """Let the next scan be due now, and those after it from there."""
        self._first_ns, self._earliest_ns = None, now_ns
        self.due_ns(now_ns)

    def has_passed(self, now_ns: int) -> bool:
        """Return whether the next scan can't begin any more without reaching into the one after."""
        return now_ns > self.due_ns(now_ns) + self._interval_ns // 2

    def time_s(self, at_ns: int) -> float:
        """Return the time since t = 0, which is now if it is not known yet."""
        self.zero_ns = self.zero_ns or at_ns
        return (at_ns - self.zero_ns) / 1e9
