"""Faults of disk and catalogue, told so that an operator knows what to do."""

from __future__ import annotations

import errno
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tvbrdf_fitting.published.database import CATALOGUE_FILE, DatabaseError, DiskFullError

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_DENIED = {errno.EACCES, errno.EPERM, errno.EROFS}
_DAMAGED = {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}
_LITTLE_SPACE_BYTES = 1_000_000
"""Below this, an I/O error of the catalogue is put down to the full disk."""


@contextmanager
def explained(path: Path, action: str) -> Iterator[None]:
    """Turn errors of the operating system and of the catalogue into a :class:`DatabaseError`.

    Parameters
    ----------
    path
        The database.
    action
        What was being done, "storing scan 3".
    """
    from sqlalchemy.exc import DBAPIError

    try:
        yield
    except OSError as error:
        raise _os_fault(path, action, error) from error
    except DBAPIError as error:
        raise _catalogue_fault(path, action, error.orig) from error


def _os_fault(path: Path, action: str, error: OSError) -> DatabaseError:
    if error.errno in _FULL:
        return _disk_full(path, action, error.strerror or "no space left")
    place = error.filename or path
    if error.errno in _DENIED:
        return DatabaseError(
            f"{path}: {action} failed: {place} is not writable ({error.strerror}); "
            "give a folder that you may write to"
        )
    return DatabaseError(f"{path}: {action} failed: {place}: {error.strerror or error}")


def _catalogue_fault(path: Path, action: str, error: BaseException | None) -> DatabaseError:
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF  # without the extended part
    catalogue = path / CATALOGUE_FILE
    little_space = _free_bytes(path) < _LITTLE_SPACE_BYTES
    if code == sqlite3.SQLITE_FULL or (code == sqlite3.SQLITE_IOERR and little_space):
        return _disk_full(path, action, str(error))
    if code == sqlite3.SQLITE_READONLY:
        return DatabaseError(
            f"{path}: {action} failed: {catalogue} is not writable; give a folder that you may "
            "write to"
        )
    if code in _DAMAGED:
        return DatabaseError(
            f"{path}: {action} failed: {catalogue} is damaged ({error}); restore it from a copy, "
            "or go on in another folder"
        )
    return DatabaseError(f"{path}: {action} failed: {catalogue}: {error}")


def _disk_full(path: Path, action: str, reason: str) -> DiskFullError:
    return DiskFullError(
        f"{path}: {action} failed: the disk is full ({reason}; {_free_bytes(path) / 1e6:.1f} MB "
        "free); free some space and send it again; everything stored before is safe"
    )


def _free_bytes(path: Path) -> int:
    for place in (path, *path.parents):
        if place.exists():
            return shutil.disk_usage(place).free
    return 0
