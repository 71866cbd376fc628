"""Finds where a clock jumped while a bag was recorded: log time, stamps, devices' own clocks.

By log time alone, a jump forward looks like a pause.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from ..envelope import Header, epoch_of
from .streams import StreamKey

JUMP_S = 1.0
"""A device's own clock and the run's go on together, but for drift; and so do stamps and log time,
but for the time that messages take."""
JUMP_NS = round(JUMP_S * 1e9)
DRIFT = 1e-3
"""Of a device's clock, at most; good ones have a tenth of a thousandth."""
MIN_MESSAGES = 3
"""Before and after a leap of log time, by which it is told whether stamps followed."""
MAX_JUMPS = 1000


class ClockJump(NamedTuple):
    """One jump, at the first message after it."""

    log_time_ns: int
    topic: str
    text: str


class _Last(NamedTuple):
    """The last message of a stream."""

    log_time_ns: int
    header: Header


@dataclass(slots=True)
class _Stretch:
    """Messages since a leap of log time."""

    log_time_ns: int
    topic: str
    least_ns: int
    """By which log time is later than the stamp, of the message where that is least."""
    messages: int = 0
    told: bool = False


class ClockJumps:
    """Follows all messages of a bag in the order in which they were recorded.

    - Log time goes back, or a new epoch says that the replay which was recorded jumped.
    - A device's own clock and the run's do not go on together between two of its stamps.
    - A publisher's stamps go back while log time goes on, or get ahead of log time. (Those that
      are at first are of a node that was not told the run's time yet.)
    - Log time leaps, and of all messages that follow none has a stamp that leapt too. (A recorder
      that stood still for a while has such ones as soon as it has caught up.)
    """

    def __init__(self) -> None:
        self._found: list[ClockJump] = []
        self._last: dict[StreamKey, _Last] = {}
        self._log_time_ns: int | None = None
        self._epoch = 0
        self._level: set[tuple[str, str]] = set()
        self._ahead: set[tuple[str, str]] = set()
        """Publishers' lives whose stamps have been at log time, and whose are ahead of it now."""
        self._stretches: list[_Stretch] = []
        """Each but the first begins with a leap that no stamp has followed so far."""
        self._stretched_ns = 0
        """Log time of the last message in them."""

    def note(self, key: StreamKey, header: Header, log_time_ns: int) -> None:
        """Take the next message."""
        before_ns = self._log_time_ns
        self._log_time_ns = log_time_ns
        epoch = epoch_of(header.incarnation)
        if before_ns is not None and epoch > max(1, self._epoch):
            way = _way(log_time_ns - before_ns)
            self._tell(
                key,
                log_time_ns,
                f"the replay that was recorded jumped (epoch {epoch}), log time {way}",
            )
            self._stretches.clear()
        elif before_ns is not None and log_time_ns < before_ns:
            self._tell(key, log_time_ns, f"log time {_way(log_time_ns - before_ns)}")
        self._epoch = max(epoch, self._epoch)
        last = self._last.get(key)
        again = last is not None and header.sequence <= last.header.sequence
        if again or not header.stamp_ns:
            return  # it tells nothing of now
        self._last[key] = _Last(log_time_ns, header)
        text = self._compared(last, header, log_time_ns)
        if text:
            self._tell(key, log_time_ns, text)
        self._stretch(key, max(0, log_time_ns - header.stamp_ns), log_time_ns)

    def take(self) -> list[ClockJump]:
        """Return what has been found since the last call, in the order of recording.

        Of leaps of log time those that nothing has contradicted so far.
        """
        found, self._found = self._found, []
        for before, after in zip(self._stretches, self._stretches[1:], strict=False):
            if after.told or min(before.messages, after.messages) < MIN_MESSAGES:
                continue
            after.told = True
            by_s = (after.least_ns - before.least_ns) / 1e9
            text = (
                f"log time leaps, and from here on is {by_s:.3f} s later than before against all "
                "stamps: no pause, but a jump of the clock that the recorder lives by"
            )
            found.append(ClockJump(after.log_time_ns, after.topic, text))
        return found

    def _tell(self, key: StreamKey, log_time_ns: int, text: str) -> None:
        if len(self._found) < MAX_JUMPS:
            self._found.append(ClockJump(log_time_ns, key.topic, text))

    def _compared(self, last: _Last | None, header: Header, log_time_ns: int) -> str:
        """Return what is odd about a message's stamps; empty if nothing is."""
        who = header.publisher
        if last is not None:
            run_ns = header.stamp_ns - last.header.stamp_ns
            log_ns = log_time_ns - last.log_time_ns
            if header.hardware_ns and last.header.hardware_ns:
                device_ns = header.hardware_ns - last.header.hardware_ns
                if abs(run_ns - device_ns) > JUMP_NS + DRIFT * abs(device_ns):
                    return (
                        f"since the message before, the run's clock {_way(run_ns)} and the "
                        f"device's own {_way(device_ns)}"
                    )
            was_ahead = last.header.stamp_ns - last.log_time_ns > JUMP_NS
            if run_ns < -JUMP_NS and log_ns >= 0 and not was_ahead:
                return (
                    f"the stamps of {who} go back by {-run_ns / 1e9:.3f} s, log time {_way(log_ns)}"
                )
        ahead_ns = header.stamp_ns - log_time_ns
        life = who, header.incarnation
        if ahead_ns <= JUMP_NS:
            self._level.add(life)
            self._ahead.discard(life)
        elif life not in self._ahead:
            self._ahead.add(life)
            if life in self._level:
                return f"the stamps of {who} get ahead of log time, by {ahead_ns / 1e9:.3f} s"
        return ""

    def _stretch(self, key: StreamKey, late_ns: int, at_ns: int) -> None:
        """Follow by how much log time is later than stamps since each leap of it."""
        stretches = self._stretches
        before_ns, self._stretched_ns = self._stretched_ns, at_ns
        if not stretches or at_ns - before_ns > JUMP_NS:
            stretches.append(_Stretch(at_ns, key.topic, late_ns))
        newest = stretches[-1]
        newest.messages += 1
        newest.least_ns = min(newest.least_ns, late_ns)
        while len(stretches) > 1 and stretches[-1].least_ns - stretches[-2].least_ns <= JUMP_NS:
            joined = stretches.pop()  # a stamp has followed the leap: it was a pause
            stretches[-1].messages += joined.messages
            stretches[-1].least_ns = min(stretches[-1].least_ns, joined.least_ns)


def _way(by_ns: int) -> str:
    if by_ns < 0:
        return f"goes back by {-by_ns / 1e9:.6f} s"
    return f"goes on by {by_ns / 1e9:.3f} s"
