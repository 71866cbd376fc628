"""What people ask of devices through the sequencer, until these have answered."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from tvbrdf_messages.messages import OperatorRequest, SweepResult

from ..core.node import Reply
from .plan import SequencerParameters

FORWARDED = ("home", "jog", "lamp", "still")
VERBS = (*FORWARDED, "stop", "mark", "scan")
MAX_TEXT = 10_000
"""Characters of a note."""


class RequestError(ValueError):
    """A request can't be carried out; the text says why."""


@dataclass(slots=True)
class Forwarded:
    """A request as a command: to whom, with what, and who has still to answer."""

    request_id: str
    verb: str
    target: str
    answers: set[str]
    fields: dict[str, Any] = field(default_factory=dict)


def as_command(request: OperatorRequest, parameters: SequencerParameters) -> Forwarded:
    """Return a request for devices as a command.

    Raises
    ------
    RequestError
        If an argument is missing or wrong.
    """
    verb, given = request.verb, request.arguments
    if verb == "still":
        return Forwarded(request.request_id, verb, "cameras", set(parameters.cameras))
    command = Forwarded(request.request_id, verb, parameters.arm, {parameters.arm})
    try:
        if verb == "jog":
            command.fields["to_deg"] = float(given["angle_deg"])
        elif verb == "lamp":
            command.fields["lamp"] = bool(given["on"])
    except (KeyError, TypeError, ValueError) as error:
        raise RequestError(f"{verb}: argument missing or wrong: {error}") from error
    return command


def note_text(request: OperatorRequest) -> str:
    """Return a note's text.

    Raises
    ------
    RequestError
        If there is none, or it is too long.
    """
    text = request.arguments.get("text", "")
    if not isinstance(text, str) or not text.strip():
        raise RequestError("a mark needs a text")
    if len(text) > MAX_TEXT:
        raise RequestError(f"a mark has at most {MAX_TEXT} characters, this one {len(text)}")
    return text


class Requests:
    """Requests that were passed on, by the id of their command."""

    def __init__(self) -> None:
        self._waiting: dict[int, Forwarded] = {}

    def add(self, command_id: int, forwarded: Forwarded) -> None:
        """Wait for the answers to a command."""
        self._waiting[command_id] = forwarded

    def __contains__(self, command_id: int) -> bool:
        """Return whether a command was a person's request."""
        return command_id in self._waiting

    def take(self, result: SweepResult) -> Iterator[Reply]:
        """Take a device's answer; reply when all have answered, or one could not do it."""
        forwarded = self._waiting[result.command_id]
        if result.state != "done":
            yield self._fail(result.command_id, f"{result.source}: {result.reason or result.state}")
            return
        forwarded.answers.discard(result.source)
        if not forwarded.answers:
            del self._waiting[result.command_id]
            yield Reply(forwarded.request_id, True, f"{forwarded.verb}: done")

    def lose(self, node: str) -> Iterator[Reply]:
        """Answer for a node that is gone."""
        for command_id, forwarded in list(self._waiting.items()):
            if node in forwarded.answers:
                yield self._fail(command_id, f"{node} was lost")

    def _fail(self, command_id: int, text: str) -> Reply:
        return Reply(self._waiting.pop(command_id).request_id, False, text)
