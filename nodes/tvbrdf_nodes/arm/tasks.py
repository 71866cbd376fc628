"""Commands that the arm is carrying out."""

from __future__ import annotations

from dataclasses import dataclass

from tvbrdf_messages.messages import ScanCommand

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
