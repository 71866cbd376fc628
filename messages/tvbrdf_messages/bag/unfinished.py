"""Where an output is made before it gets its name: a hidden folder beside it.

A process that is killed can't remove its own. The next one that makes the same output does, when
nobody holds the folder's lock any more; the system takes the lock from who has ended in any way.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import tempfile
from pathlib import Path
from types import TracebackType

_RANDOM = "[a-z0-9_]{8}"
"""What ``tempfile`` adds to a name."""


class Unfinished:
    """A place to make an output in; use as a context manager, after which it is gone.

    Parameters
    ----------
    path
        Of the output, which is not there yet; its folder is made.

    Raises
    ------
    OSError
        If nothing can be written there.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.removed = remove_unfinished(path)
        """What others had left of the same output."""
        self.folder = Path(tempfile.mkdtemp(prefix=_prefix(path), dir=path.parent))
        self.path = self.folder / path.name
        """Where the output is to be made, as a file or folder; rename it from there."""
        try:
            self._lock = os.open(self.folder, os.O_RDONLY)
        except OSError:
            self.folder.rmdir()
            raise
        with contextlib.suppress(OSError):  # where there are no locks, nobody removes it either
            fcntl.flock(self._lock, fcntl.LOCK_EX)

    def __enter__(self) -> Unfinished:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Remove what is left of it."""
        shutil.rmtree(self.folder, ignore_errors=True)
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


def remove_unfinished(path: Path) -> tuple[Path, ...]:
    """Remove what processes that are gone have left of an output; return the folders."""
    pattern = re.compile(re.escape(_prefix(path)) + _RANDOM)
    with os.scandir(path.parent) as entries:
        found = [
            Path(e)
            for e in entries
            if pattern.fullmatch(e.name) and e.is_dir(follow_symlinks=False)
        ]
    return tuple(each for each in sorted(found) if _remove(each))


def _remove(folder: Path) -> bool:
    """Remove a folder unless somebody is at work in it; return whether it is gone."""
    try:
        lock = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(lock).st_uid != os.getuid() or not any(folder.iterdir()):
            return False  # an empty one may be of somebody who is just about to lock it
        shutil.rmtree(folder)
    except OSError:
        return False
    finally:
        os.close(lock)
    return True


def _prefix(path: Path) -> str:
    return f".{path.name}.tvbrdf-"
