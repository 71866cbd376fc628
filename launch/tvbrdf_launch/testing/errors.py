"""What goes wrong in a test: it asked for what is not there, or waited in vain."""

from __future__ import annotations

from collections.abc import Iterable


class MisuseError(ValueError):
    """A test asks for something that does not exist; the text names it and lists what there is."""


class WaitError(AssertionError):
    """What a test waited for did not come; the text says what came instead, with the logs."""


def unknown(what: str, name: object, known: Iterable[object]) -> MisuseError:
    """Return the error for a name that is not among the known ones."""
    names = ", ".join(sorted(map(str, known))) or "none"
    return MisuseError(f"{what} {str(name)!r} does not exist; there are: {names}")
