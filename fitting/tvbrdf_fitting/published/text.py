"""Text in the published layout: numbers with 6 decimals, errors with file and line, whole files.

Shared by the readers and writers of the published database's files, see :mod:`.published`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

TEMPORARY_PREFIX = ".writing-"
"""Beginning of the name of a file that is not whole yet."""

COPY_AGAIN = "copy it again from where it came"
"""What to do about a damaged file."""
_LONGEST_SHOWN = 40


class PublishedFormatError(ValueError):
    """A file, or what is to be written as one, breaks the published layout."""

    def __init__(self, path: Path | str, line: int | None, problem: str) -> None:
        self.path = Path(path)
        self.line = line
        self.problem = problem
        super().__init__(f"{path}: {problem}" if line is None else f"{path}:{line}: {problem}")


def shown(text: str) -> str:
    """Return a piece of a file as an error quotes it: damaged ones have no line ends for long."""
    return repr(text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}…")


def format_numbers(values: Iterable[float]) -> str:
    """Numbers with 6 decimals and single spaces between them, as in the published files."""
    return " ".join(f"{value:.6f}" for value in values)


def parse_number(token: str, path: Path | str, line: int) -> float:
    """One finite decimal number.

    Raises
    ------
    PublishedFormatError
        If it is none; names file and line.
    """
    try:
        value = float(token)
    except ValueError:
        hint = "; decimals follow a point" if "," in token else ""
        raise PublishedFormatError(path, line, f"{shown(token)} is not a number{hint}") from None
    if not math.isfinite(value):
        raise PublishedFormatError(
            path,
            line,
            f"{shown(token)} is not a finite number; leave out what was not measured",
        )
    return value


def parse_exposures(text: str, path: Path | str, line: int) -> tuple[float, ...]:
    """Exposure times in milliseconds from a line ``Exposure a b c``.

    Raises
    ------
    PublishedFormatError
        If the line does not start with ``Exposure``, has no number, or one that is not positive.
    """
    tokens = text.split()
    if not tokens or tokens[0] != "Exposure":
        found = tokens[0] if tokens else ""
        raise PublishedFormatError(
            path,
            line,
            f"starts with {shown(found)}; the line 'Exposure a b c' is missing: "
            "is it a file of the published layout?",
        )
    exposures_ms = tuple(parse_number(token, path, line) for token in tokens[1:])
    if not exposures_ms:
        raise PublishedFormatError(path, line, "the exposure times are missing after 'Exposure'")
    for exposure_ms in exposures_ms:
        if exposure_ms <= 0:
            raise PublishedFormatError(
                path, line, f"exposure time {exposure_ms:g} ms is not positive"
            )
    return exposures_ms


def format_exposures(exposures_ms: Iterable[float], path: Path | str) -> str:
    """The line ``Exposure a b c`` (ms), without its end.

    Raises
    ------
    PublishedFormatError
        If there is no exposure time, or one that does not show as positive with 6 decimals.
    """
    line = f"Exposure {format_numbers(exposures_ms)}".rstrip()
    parse_exposures(line, path, 1)
    return line


def read_bytes(path: Path) -> bytes:
    """Contents of a file that must be there.

    Raises
    ------
    PublishedFormatError
        If it is missing, empty or cannot be read.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise PublishedFormatError(path, None, "there is no such file") from None
    except OSError as error:
        raise PublishedFormatError(path, None, f"cannot be read: {error.strerror}") from error
    if not data:
        raise PublishedFormatError(path, None, f"is empty; {COPY_AGAIN}")
    return data


def read_lines(path: Path) -> list[str]:
    """Lines of an ASCII or UTF-8 file that must end with a line end (else it is truncated)."""
    data = read_bytes(path)
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise PublishedFormatError(path, line, "is not text (UTF-8)") from None
    lines = text.split("\n")
    if lines[-1]:
        raise PublishedFormatError(
            path,
            len(lines),
            f"the file is truncated: its last line has no end; {COPY_AGAIN}",
        )
    return lines[:-1]


def write_all(descriptor: int, data: bytes) -> None:
    """Write every byte to an open file descriptor."""
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]


def write_beside(path: Path, data: bytes) -> Path:
    """Write a temporary file next to ``path``, on disk when this returns; ``path`` is untouched.

    Returns
    -------
    Path
        The temporary file, to be renamed to ``path``. After an error there is none.
    """
    beside = temporary_path(path)
    descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
    try:
        try:
            write_all(descriptor, data)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except BaseException:
        with suppress(OSError):
            beside.unlink()
        raise
    return beside


def temporary_path(path: Path) -> Path:
    """Where :func:`write_beside` puts what will be ``path``."""
    return path.with_name(f"{TEMPORARY_PREFIX}{path.name}")


def sync_folder(folder: Path) -> None:
    """Make new names in a folder survive a power failure."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_atomically(path: Path, data: bytes) -> None:
    """Write a whole file or none: beside, to disk, then renamed over ``path``.

    Raises
    ------
    OSError
        If the disk is full or the folder is missing or not writable; ``path`` is as before.
    """
    beside = write_beside(path, data)
    try:
        os.replace(beside, path)  # noqa: PTH105  (one place for fault injection with os.write)
    except BaseException:
        with suppress(OSError):
            beside.unlink()
        raise
    sync_folder(path.parent)
