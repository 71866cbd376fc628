"""Opening a database for writing: whose folder it is, the lock, the catalogue, the sample."""

from __future__ import annotations

import fcntl
import io
import os
from pathlib import Path
from typing import Final

from sqlalchemy import func, insert, inspect, select
from sqlalchemy.engine import Engine
from sqlalchemy.orm import Session

from tvbrdf_fitting.published import PublishedFormatError, SampleInfo, format_info
from tvbrdf_fitting.published.database import CATALOGUE_FILE, SCHEMA_VERSION, DatabaseError
from tvbrdf_fitting.published.text import sync_folder

from .catalogue import Base, Note, Sample, Scan, SchemaVersion, open_engine

LOCK_FILE: Final = "catalogue.lock"
TRUTH_FILE: Final = "truth.json"
"""What a simulation knows of its sample; may be there before anything is stored."""

_OURS: Final = {
    LOCK_FILE,
    TRUTH_FILE,
    CATALOGUE_FILE,
    *(f"{CATALOGUE_FILE}-{end}" for end in ("wal", "shm", "journal")),
}


def check_names(sample_name: str, process: str) -> None:
    """Refuse a name or process that ``tvBrdf-info.txt`` could not hold."""
    try:
        format_info(SampleInfo(sample_name, process, (1.0,), ()))
    except PublishedFormatError as error:
        raise DatabaseError(f"the sample cannot be stored: {error.problem}") from None


def lock_folder(path: Path) -> io.FileIO:
    """Make the folder if need be, and hold it for this process until the result is closed.

    Raises
    ------
    DatabaseError
        If it is no folder, holds other people's files, or another process writes to it.
    """
    if path.exists() and not path.is_dir():
        raise DatabaseError(f"{path}: is a file; give a folder for the database")
    path.mkdir(parents=True, exist_ok=True)
    if not (path / CATALOGUE_FILE).exists():
        strangers = sorted(entry.name for entry in path.iterdir() if entry.name not in _OURS)
        if strangers:
            raise DatabaseError(
                f"{path}: is not empty and no database of this project (it holds {strangers[0]!r}"
                f" and {len(strangers) - 1} more); give an empty or a new folder"
            )
    descriptor = os.open(path / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    lock = io.FileIO(descriptor, "r+")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.ftruncate(descriptor, 0)
        lock.write(f"{os.getpid()}\n".encode("ascii"))
    except BlockingIOError:
        holder = lock.read().decode("ascii", "replace").strip()
        lock.close()
        raise DatabaseError(
            f"{path}: process {holder or '?'} is writing to it; stop that one first, or give "
            "another folder"
        ) from None
    except BaseException:
        lock.close()
        raise
    return lock


def open_catalogue(path: Path) -> Engine:
    """Open the catalogue of a locked folder, making its tables in one transaction if it has none.

    Raises
    ------
    DatabaseError
        If it was written by another version of this project.
    """
    engine = open_engine(path / CATALOGUE_FILE)
    try:
        if not inspect(engine).has_table(SchemaVersion.__tablename__):
            with engine.begin() as connection:
                connection.exec_driver_sql("BEGIN IMMEDIATE")  # or each table commits on its own
                Base.metadata.create_all(connection)
                connection.execute(insert(SchemaVersion).values(version=SCHEMA_VERSION))
            sync_folder(path)
        with Session(engine) as session:
            version = session.scalar(select(SchemaVersion.version))
        if version != SCHEMA_VERSION:
            raise DatabaseError(
                f"{path}: its catalogue has version {version}, this program writes "
                f"{SCHEMA_VERSION}; give another folder"
            )
    except BaseException:
        engine.dispose()
        raise
    return engine


def adopt_sample(
    engine: Engine, path: Path, name: str, process: str, run_id: str, *, number: int, resume: bool
) -> int:
    """Return the id of the sample in the catalogue, entered if the database is empty.

    Raises
    ------
    DatabaseError
        If it has another sample, or may not be gone on with.
    """
    with Session(engine) as session, session.begin():
        sample = session.scalar(select(Sample).where(Sample.number == number))
        if sample is None:
            sample = Sample(number=number, name=name, process=process, run_id=run_id)
            session.add(sample)
            session.flush()
            return sample.id
        scans = _count(session, Scan, sample.id)
        if scans + _count(session, Note, sample.id) == 0:
            sample.name, sample.process, sample.run_id = name, process, run_id
        elif sample.name != name:
            raise DatabaseError(
                f"{path}: is the database of sample {sample.name!r}, not of {name!r}; "
                "give another folder for it"
            )
        elif not (resume or (run_id and sample.run_id == run_id)):
            raise DatabaseError(
                f"{path}: is not empty: it holds {scans} scans of sample {name!r}; say "
                "resume:=true to go on with them, or give another folder"
            )
        return sample.id


def _count(session: Session, table: type[Scan] | type[Note], sample_id: int) -> int:
    counted = select(func.count()).select_from(table).where(table.sample_id == sample_id)
    return session.scalar(counted) or 0
