"""What can go wrong with a bag; every text names the file, what is wrong, and what to do."""

from __future__ import annotations

from pathlib import Path


class BagError(RuntimeError):
    """A bag can't be read or written.

    Parameters
    ----------
    path
        The file or folder that is meant; the text begins with it.
    text
        What is wrong, and what to do.
    """

    def __init__(self, path: str | Path, text: str) -> None:
        super().__init__(f"{path}: {text}")
        self.path = Path(path)
        self.text = text


class BagEmptyError(BagError):
    """The file has no bytes: nothing was ever recorded into it."""


class BagForeignError(BagError):
    """It is no bag of ours: another program's MCAP file, or no MCAP file at all."""


class BagVersionError(BagError):
    """It was recorded by another version, whose messages this one can't read."""


class BagIncompleteError(BagError):
    """It has no end: its recorder was killed, still records, or the file was cut."""


class BagDamagedError(BagError):
    """A checksum or length does not fit: bytes have changed since they were written."""


class BagTopicError(BagError):
    """A topic was asked for that the bag does not have."""


class BagWriteError(BagError):
    """The system refused to write; whole chunks written before are kept."""


class BagFloorError(BagWriteError):
    """So little disk is free that recording stopped; the bag is complete up to here."""
