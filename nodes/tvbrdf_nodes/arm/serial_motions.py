"""Motions that a controller has accepted, until they have ended, even if that line is lost."""

from __future__ import annotations

from typing import NamedTuple

from .protocol import REASONS, Answer, Event, flags_from_text

STILL_REPORTS = 3


class Ended(NamedTuple):
    """A motion or stop that has ended; ``reason`` is empty when it did what was asked."""

    token: int
    verb: str
    reason: str = ""


class MotionTable:
    """Accepted motions and stops that have not ended, by the numbers of their requests."""

    def __init__(self) -> None:
        self._verbs: dict[int, str] = {}
        self._still_reports = 0

    def accept(self, token: int, verb: str) -> None:
        """Take note that a motion has begun."""
        self._verbs[token] = verb
        self._still_reports = 0

    def take_event(self, event: Event) -> list[Ended]:
        """Return what an event has ended."""
        verb = self._verbs.pop(event.request_id, None)
        if verb is None:
            return []
        reason = "" if event.outcome == "DONE" else REASONS.get(event.code, event.code)
        return [Ended(event.request_id, verb, reason)]

    def missed_end(self, moving: bool) -> bool:
        """Take a report; return whether the line that told of a motion's end must be lost."""
        if moving or not self._verbs:
            self._still_reports = 0
            return False
        self._still_reports += 1
        return self._still_reports % STILL_REPORTS == 0

    def take_status(self, answer: Answer) -> list[Ended]:
        """Return what has ended according to the controller's status."""
        if flags_from_text(answer.text("flags")).moving:
            return []
        last, outcome = answer.count("last"), answer.text("outcome")
        verbs, self._verbs = self._verbs, {}
        ended = []
        for token, verb in verbs.items():
            reason = "" if verb == "STOP" or outcome == "done" else outcome
            if verb != "STOP" and token != last:
                reason = "the controller does not remember it (was it switched off?)"
            ended.append(Ended(token, verb, REASONS.get(reason, reason)))
        return ended
