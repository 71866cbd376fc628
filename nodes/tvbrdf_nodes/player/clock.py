"""All time logic of playback: which moment of a bag is due at which moment of real time.

Nothing here reads a clock: ``real_ns`` is always given, on a monotonic clock.
"""

from __future__ import annotations

import math

MAX_RATE = 1e6


class PlaybackError(ValueError):
    """What was asked of the clock makes no sense; the text says what would."""


class PlaybackClock:
    """Maps real time to a bag's, through rate, pause, steps, loops and seeks.

    It stands at its beginning until :meth:`start`.

    Parameters
    ----------
    first_ns, last_ns
        Log times of the bag's first and last message.
    rate
        Bag time over real time; 0: as fast as messages are taken, and the bag's time is that of
        the last one (:meth:`reach`).
    start_offset_s
        Where it begins, after the first message.
    until_s
        Where it ends, after the first message; None: with the last one.
    loop
        Begin anew at the end.
    paused
        Stand still until :meth:`resume`.

    Raises
    ------
    PlaybackError
        For a rate below 0, or where nothing is left to play.
    """

    def __init__(
        self,
        first_ns: int,
        last_ns: int,
        *,
        rate: float = 1.0,
        start_offset_s: float = 0.0,
        until_s: float | None = None,
        loop: bool = False,
        paused: bool = False,
    ) -> None:
        self.rate = _checked_rate(rate)
        self.first_ns, self.last_ns = first_ns, last_ns
        length_s = (last_ns - first_ns) / 1e9
        if not 0 <= start_offset_s <= length_s:
            raise PlaybackError(
                f"start offset {start_offset_s:g} s: the bag lasts {length_s:.3f} s; give 0 to that"
            )
        if until_s is not None and not (math.isfinite(until_s) and until_s >= start_offset_s):
            raise PlaybackError(
                f"until {until_s:g} s: nothing lies between it and the start offset of "
                f"{start_offset_s:g} s; give more"
            )
        self.begin_ns = first_ns + round(start_offset_s * 1e9)
        """Where it begins, and begins anew."""
        if until_s is not None:
            self.last_ns = min(last_ns, first_ns + round(until_s * 1e9))
        self.loop = loop
        self.paused = paused
        self.epoch = 1
        """Goes up by one with each jump. The first is 1: a clock that shows 0 takes no time that
        lies before the launch."""
        self._bag_ns = self.begin_ns
        self._real_ns: int | None = None
        """When the bag's time was ``_bag_ns``; None: it stands."""

    def start(self, real_ns: int) -> None:
        """Begin to run, unless paused."""
        if not self.paused:
            self._real_ns = real_ns

    def now_ns(self, real_ns: int) -> int:
        """Return the bag's time; it never passes the end."""
        if self._real_ns is None or self.rate == 0:
            return self._bag_ns
        now_ns = self._bag_ns + int((real_ns - self._real_ns) * self.rate)
        return max(self._bag_ns, min(now_ns, self.last_ns))

    def due_ns(self, bag_ns: int) -> int | None:
        """Return when a moment of the bag is due, in real time; None while the clock stands.

        What the clock has passed was due in the past; at rate 0 all is due.
        """
        if self._real_ns is None:
            return None
        if self.rate == 0:
            return self._real_ns
        return self._real_ns + math.ceil((bag_ns - self._bag_ns) / self.rate)

    def reach(self, bag_ns: int) -> None:
        """Take note that a message was played: at rate 0 and in steps this is what moves time."""
        if self._real_ns is None or self.rate == 0:
            self._bag_ns = max(self._bag_ns, bag_ns)

    def pause(self, real_ns: int) -> None:
        """Stand still."""
        self._bag_ns = self.now_ns(real_ns)
        self._real_ns = None
        self.paused = True

    def resume(self, real_ns: int) -> None:
        """Go on where it stands."""
        if self.paused:
            self.paused = False
            self._real_ns = real_ns

    def set_rate(self, rate: float, real_ns: int) -> None:
        """Go on from here at another rate."""
        rate = _checked_rate(rate)
        self._bag_ns = self.now_ns(real_ns)
        if self._real_ns is not None:
            self._real_ns = real_ns
        self.rate = rate

    def seek(self, offset_s: float, real_ns: int) -> None:
        """Jump to a moment after the bag's first message; a new epoch."""
        last_s = (self.last_ns - self.first_ns) / 1e9
        if not 0 <= offset_s <= last_s:
            raise PlaybackError(f"can't seek to {offset_s:g} s; give 0 to {last_s:.3f}")
        self._jump(self.first_ns + round(offset_s * 1e9), real_ns)

    def end(self, real_ns: int) -> bool:
        """Take note that all was played; return whether it begins anew, in a new epoch."""
        if self.loop:
            self._jump(self.begin_ns, real_ns)
        return self.loop

    def _jump(self, bag_ns: int, real_ns: int) -> None:
        self.epoch += 1
        self._bag_ns = bag_ns
        if self._real_ns is not None:
            self._real_ns = real_ns


def _checked_rate(rate: float) -> float:
    if not 0 <= rate <= MAX_RATE:
        raise PlaybackError(f"rate {rate:g}: give 0 (as fast as it is taken) to {MAX_RATE:g}")
    return float(rate)
