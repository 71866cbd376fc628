"""Where a bag's files are: one ``NAME.mcap``, or ``NAME_0.mcap`` … in a folder ``NAME``."""

from __future__ import annotations

import contextlib
import mimetypes
from pathlib import Path

from .errors import BagError, BagWriteError

SUFFIX = ".mcap"


class Layout:
    """The files of a bag that is being written.

    Parameters
    ----------
    path
        A new file with the suffix, or a new folder without it, which is made.
    in_parts
        Whether there will be more than one file.

    Raises
    ------
    BagError
        If the path exists, can't be made, or is a file for a bag in parts.
    """

    def __init__(self, path: Path, *, in_parts: bool) -> None:
        self.path = path
        self.files: list[Path] = []
        self._folder = path.suffix != SUFFIX
        if in_parts:
            self.require_folder()
        if path.exists():
            raise BagError(path, "exists already; choose another name or remove it")
        if self._folder:
            try:
                path.mkdir(parents=True)
            except OSError as error:
                raise BagWriteError(path, f"can't be made: {error.strerror}") from error

    def require_folder(self) -> None:
        """Raise if the bag can't have a second file."""
        if not self._folder:
            raise BagError(self.path, f"a bag in parts is a folder: leave out {SUFFIX}")

    def next_file(self) -> Path:
        """Return the path of the next file."""
        name = f"{self.path.name}_{len(self.files)}{SUFFIX}"
        self.files.append(self.path / name if self._folder else self.path)
        return self.files[-1]

    def remove(self) -> None:
        """Leave nothing of a bag that could not be begun."""
        for file in self.files:
            file.unlink(missing_ok=True)
        if self._folder:
            with contextlib.suppress(OSError):
                self.path.rmdir()


def bag_files(path: Path) -> list[Path]:
    """Return the files of a bag: itself, or those in its folder.

    Raises
    ------
    BagError
        If there are none.
    """
    if path.is_dir():
        found = sorted(path.glob(f"*{SUFFIX}"))
        if not found:
            raise BagError(path, f"a folder without *{SUFFIX} files is no bag")
        return found
    if not path.exists():
        raise BagError(path, "there is no such bag")
    return [path]


def media_type(name: str) -> str:
    """Return the media type of an attachment by its name."""
    if name.endswith((".yaml", ".yml")):
        return "application/yaml"
    return mimetypes.guess_type(name)[0] or "application/octet-stream"
