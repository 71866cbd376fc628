"""A bag that is made of others: written beside, read back, then renamed."""

from __future__ import annotations

import shutil
import tempfile
import zlib
from collections.abc import Mapping
from pathlib import Path

from .about import About
from .errors import BagDamagedError, BagError, BagWriteError
from .reader import BagReader
from .stored import RawMessage
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
            path.parent.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(prefix=f".{path.stem}.", dir=path.parent))
        except OSError as error:
            raise BagWriteError(path, f"can't be made: {error.strerror}") from error
        try:
            self.writer = BagWriter(
                self._folder / path.name, about=about, attachments=attachments, floor_free_bytes=0
            )
        except BaseException:
            shutil.rmtree(self._folder)
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
            shutil.rmtree(self._folder, ignore_errors=True)

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
