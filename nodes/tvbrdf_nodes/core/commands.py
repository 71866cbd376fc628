"""Which commands a device's node carries out, and how it says what came of them.

None is carried out that is late, repeated or of an earlier run.
"""

from __future__ import annotations

from typing import Any

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import ScanCommand, SweepResult


class CommandGate:
    """Remembers the sequencer that commands now, and its last command.

    Parameters
    ----------
    targets
        What a command may be addressed to for it to concern this node.
    """

    def __init__(self, *targets: str) -> None:
        self._targets = frozenset(targets)
        self._incarnation = ""
        self._earlier: set[str] = set()
        self._last_id = -1
        self.refused = 0

    def concerns(self, command: ScanCommand) -> bool:
        """Return whether a command is addressed to this node."""
        return command.target in self._targets

    def refusal(self, envelope: Envelope, command: ScanCommand, now_ns: int) -> str:
        """Return why a command is refused; empty if it is to be carried out.

        Parameters
        ----------
        envelope
            In which the command came: its publisher must be the sequencer that signed it.
        command
            The command.
        now_ns
            The run's time.
        """
        reason = self._refusal(envelope, command, now_ns)
        if reason:
            self.refused += 1
        return reason

    def _refusal(self, envelope: Envelope, command: ScanCommand, now_ns: int) -> str:
        theirs = command.incarnation
        if theirs != envelope.header.incarnation:
            return f"command {command.command_id} is not its publisher's own ({theirs})"
        if theirs in self._earlier:
            return f"command {command.command_id} is of an earlier sequencer ({theirs})"
        if theirs == self._incarnation and command.command_id <= self._last_id:
            return f"command {command.command_id} came again"
        late_ms = (now_ns - command.not_after_ns) / 1e6
        if late_ms > 0:
            return f"command {command.command_id} is {late_ms:.0f} ms late"
        if theirs != self._incarnation:
            if self._incarnation:
                self._earlier.add(self._incarnation)
            self._incarnation = theirs
        self._last_id = command.command_id
        return ""


def result_of(
    command: ScanCommand, source: str, state: str, reason: str = "", **measured: Any
) -> SweepResult:
    """Return what came of a command; ``measured``: further fields of the message."""
    return SweepResult(
        source=source,
        command_id=command.command_id,
        action=command.action,
        state=state,
        reason=reason,
        sample=command.sample,
        scan=command.scan,
        sweep=command.sweep,
        attempt=command.attempt,
        **measured,
    )
