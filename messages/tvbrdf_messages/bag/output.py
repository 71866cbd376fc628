"""A bag that is made of others: written beside, read back, then renamed."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path

from .about import About
from .errors import BagDamagedError, BagError, BagWriteError
from .reader import BagReader
from .stored import RawMessage
from .unfinished import Unfinished
from .writer import BagWriter


class _Digest:
    """Tells whether two sets of messages are the same, in whatever order."""

    def __init__(self) -> None:
        self.messages, self.total = 0, 0

    def add(self, message: RawMessage) -> None:
        """Take one message."""
        head = f"{message.topic} {message.log_time_ns} {message.publish_time_ns}".encode()
        self.messages += 1
        self.total += zlib.crc32(message.data, zlib.crc32(head))


class NewBag:
    """A bag in the making; it gets its name when everything in it has been read back.

    Use as a context manager; after an error nothing is left.
    """

    def __init__(self, path: Path, about: About, attachments: Mapping[str, bytes]) -> None:
        if path.exists():
            raise BagError(path, "exists already; choose another name or remove it")
        self.path = path
        self._digest = _Digest()
        try:
            self._place = Unfinished(path)
        except OSError as error:
            raise BagWriteError(path, f"can't be made: {error.strerror}") from error
        self.removed = self._place.removed
        """What processes that were killed had left of the same bag."""
        try:
            self.writer = BagWriter(
                self._place.path, about=about, attachments=attachments, floor_free_bytes=0
            )
        except BaseException:
            self._place.close()
            raise

    def __enter__(self) -> NewBag:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._complete()
            else:
                self.writer.abandon()
        finally:
            self._place.close()

    def add(self, message: RawMessage) -> None:
        """Write a message."""
        self._digest.add(message)
        self.writer.write_raw(message)

    def _complete(self) -> None:
        self.writer.close()
        found = _Digest()
        with BagReader(self.writer.path) as reader:
            for message in reader.messages(raw=True):
                found.add(message)
        if (found.messages, found.total) != (self._digest.messages, self._digest.total):
            raise BagDamagedError(
                self.path,
                f"{self._digest.messages} messages were written and {found.messages} read back, "
                "not the same ones: the disk or the memory is faulty",
            )
        if self.path.exists():
            raise BagError(self.path, "exists by now; choose another name")
        self.writer.path.rename(self.path)
