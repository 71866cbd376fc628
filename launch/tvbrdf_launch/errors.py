"""What can go wrong before and while a run goes on, told in one line for people."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple


class Place(NamedTuple):
    """A line of a launch file; line 0 is the command line."""

    file: Path
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}" if self.line else str(self.file)


COMMAND_LINE = Place(Path("command line"), 0)


class LaunchError(ValueError):
    """A launch file or its arguments can't be used; ``place`` says where."""

    def __init__(self, text: str, place: Place | None = None) -> None:
        super().__init__(f"{place}: {text}" if place is not None else text)
        self.place = place


class RunError(RuntimeError):
    """A run can't start, be found or be reached; the text says what to do."""


def did_you_mean(given: str, known: Iterable[str], what: str = "known") -> str:
    """Return a hint for a name that is not among the known ones."""
    names = sorted(known)
    close = difflib.get_close_matches(given, names, 1)
    return f"did you mean {close[0]!r}?" if close else f"{what}: {', '.join(names) or 'none'}"
