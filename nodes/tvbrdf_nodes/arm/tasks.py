"""Commands that the arm is carrying out, and what became of them."""

from __future__ import annotations

from dataclasses import dataclass

from tvbrdf_messages.messages import ScanCommand, SweepResult

MOTION, ANSWER = "motion", "answer"


@dataclass(slots=True, eq=False)
class Task:
    """Commands that are being carried out together, and what of the driver they wait for."""

    commands: list[ScanCommand]
    waiting: dict[int, str]
    """Tokens, and whether the end of a motion or an answer is awaited."""
    first_sequence: int = -1
    """Of the states sent for it; -1 when none was."""

    @property
    def sweeps(self) -> bool:
        """Whether it is a sweep."""
        return any(command.action == "sweep" for command in self.commands)


def result(
    source: str,
    command: ScanCommand,
    state: str,
    reason: str = "",
    sequences: tuple[int, int] = (-1, -1),
) -> SweepResult:
    """Return what is said about a command; ``sequences``: of the first and last state sent."""
    first, last = sequences
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
        frames=last - first + 1 if first >= 0 else 0,
        first_sequence=first,
        last_sequence=last,
    )
