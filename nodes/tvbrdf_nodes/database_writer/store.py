"""The database on disk: each scan, fit and note exactly once, whatever happens in between.

Storing a scan: its files are written beside under temporary names and synced; one transaction of
the catalogue makes them part of the database; then they get their names. Killed before the commit,
nothing was stored and the next opening removes the leftovers; killed after it, the next opening
finishes the renaming. ``brdf-params.txt`` and ``tvBrdf-info.txt`` are derived from the catalogue
and written again, whole, whenever it changes.

Layout: ``catalogue.sqlite``, ``catalogue.lock`` and ``sample01/`` (see
:mod:`tvbrdf_fitting.published.database`). A store is used from one thread.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, Self

from tvbrdf_fitting.published.database import (
    DatabaseError,
    DiskFullError,
    StoredDatabase,
    StoredScan,
    read_database,
    sample_folder_name,
)
from tvbrdf_fitting.published.text import sync_folder, write_beside

from .faults import explained
from .records import (
    FileContent,
    FitRecord,
    ScanRecord,
    check_fit,
    fit_digest,
    scan_digest,
    scan_files,
)

if TYPE_CHECKING:  # SQLAlchemy takes 0.4 s to import: it is loaded when a database is opened
    from sqlalchemy.orm import Session

__all__ = [
    "DatabaseError",
    "DatabaseStore",
    "DiskFullError",
    "FitRecord",
    "Outcome",
    "ScanRecord",
    "StoredDatabase",
    "read_database",
]

Outcome = Literal["stored", "already_stored"]

_SAMPLE_NUMBER = 1

_logger = logging.getLogger(__name__)


class Contents(NamedTuple):
    """What a database holds; times on the run's clock."""

    scans: tuple[int, ...]
    """Numbers of the measured scans, in order."""
    fitted: tuple[int, ...]
    """Of those whose parameters are stored."""
    missing: dict[int, str]
    """Of those that could not be measured, and why."""
    zero_ns: int
    """t = 0: the last zero note, else from the first scan, else 0."""
    last_ns: int
    """The latest scan, measured or missing; 0 if none is known."""


class DatabaseStore:
    """A database of one sample, open for writing.

    Parameters
    ----------
    path
        Its folder; made if it is not there.
    sample_name
        The sample; becomes ``sample01``.
    resume
        Go on in a database that is not empty; it must be of the same sample.
    process
        What the sample does ("drying paint"), for ``tvBrdf-info.txt``; no parentheses.
    run_id
        The run that writes. A database that the same run made is gone on with, also without
        ``resume``: so a writer that was restarted finds its own.

    Raises
    ------
    DatabaseError
        If the folder is not empty and may not be gone on with, cannot be written, is in use by
        another process, or lacks files that its catalogue says it has.
    """

    def __init__(
        self,
        path: Path | str,
        sample_name: str,
        *,
        resume: bool = False,
        process: str = "",
        run_id: str = "",
    ) -> None:
        from . import opening

        self.path = Path(path)
        self.sample_name = sample_name
        self.folder = self.path / sample_folder_name(_SAMPLE_NUMBER)
        with explained(self.path, "opening it"):
            opening.check_names(sample_name, process)
            self._lock = opening.lock_folder(self.path)
            try:
                self._engine = opening.open_catalogue(self.path)
                self._sample_id = opening.adopt_sample(
                    self._engine,
                    self.path,
                    sample_name,
                    process,
                    run_id,
                    number=_SAMPLE_NUMBER,
                    resume=resume,
                )
                self._needs_repair = True
                self._repair()
            except BaseException:
                self.close()
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close it; everything stored is on disk already. Closing twice does nothing."""
        from .catalogue import close_engine

        engine = self.__dict__.pop("_engine", None)
        if engine is not None:
            close_engine(engine)
        lock = self.__dict__.pop("_lock", None)
        if lock is not None:
            lock.close()

    def store_scan(self, record: ScanRecord) -> Outcome:
        """Store one measured scan with its files.

        Returns
        -------
        "stored" or "already_stored"
            The latter also if another content came before: the first is kept, and the
            contradiction is logged and noted.

        Raises
        ------
        DatabaseError
            If the record is of another sample or not valid.
        DiskFullError
            If there is no space; send it again when there is.
        """
        from .entries import enter_scan

        self.check_sample(record.sample)
        files = scan_files(record)
        digest = scan_digest(record, files)
        with explained(self.path, f"storing scan {record.scan}"):
            self._repair()
            known = self._measured_digest(record.scan)
            if known is not None:
                if known != digest:
                    self._contradiction(f"scan {record.scan}", digest, record.start_stamp_ns)
                return "already_stored"
            with self._written_beside(files), self._transaction() as session:
                enter_scan(session, self._sample_id, self.folder.name, record, files, digest)
            self._settle([self.folder / file.path for file in files])
        return "stored"

    def store_parameters(self, record: FitRecord) -> Outcome:
        """Store what was fitted to a scan that is stored already.

        Returns
        -------
        "stored" or "already_stored"
            As for :meth:`store_scan`.

        Raises
        ------
        DatabaseError
            If the scan is not stored, the record is not valid, or it is of another model than the
            sample's other fits.
        DiskFullError
            If there is no space; send it again when there is.
        """
        from .entries import check_model, find_scan, fit_row

        self.check_sample(record.sample)
        check_fit(record)
        digest = fit_digest(record)
        with explained(self.path, f"storing the parameters of scan {record.scan}"):
            self._repair()
            with self._transaction() as session:
                scan = find_scan(session, self._sample_id, record.scan)
                if scan is None or scan.state != "measured":
                    raise DatabaseError(
                        f"{self.path}: parameters of scan {record.scan} came before the scan "
                        "itself; store the scan, then send them again"
                    )
                known = None if scan.fit is None else scan.fit.digest
                stamp_ns = scan.start_stamp_ns or 0
                if known is None:
                    chosen = "choice" in record.details
                    check_model(session, self._sample_id, record.model, chosen=chosen)
                    scan.fit = fit_row(record, digest)
            if known is not None:
                if known != digest:
                    self._contradiction(f"parameters of scan {record.scan}", digest, stamp_ns)
                return "already_stored"
            self._settle()
        return "stored"

    def store_missing(self, scan: int, reason: str, *, time_s: float | None = None) -> Outcome:
        """Record that a scan could not be measured, and why; a measured one stays as it is."""
        from .entries import enter_missing

        if scan < 1:
            raise DatabaseError(f"missing scan {scan}: scans count from 1")
        text = " ".join(reason.split()) or "no reason given"
        with explained(self.path, f"recording scan {scan} as missing"):
            self._repair()
            with self._transaction() as session:
                added = enter_missing(session, self._sample_id, scan, text, time_s)
            if not added:
                return "already_stored"
            self._settle()
        return "stored"

    def store_note(self, stamp_ns: int, text: str, *, zero: bool = False) -> Outcome:
        """Store a note; ``zero`` says that its moment is t = 0."""
        from .entries import add_note

        with explained(self.path, "storing a note"):
            self._repair()
            with self._transaction() as session:
                added = add_note(session, self._sample_id, stamp_ns, text, zero=zero)
        return "stored" if added else "already_stored"

    def contents(self) -> Contents:
        """Return which scans there are, and when."""
        from sqlalchemy import select

        from .catalogue import Fit, Note, Scan

        numbers = (Scan.number, Scan.state, Scan.reason, Scan.start_stamp_ns, Scan.time_s)
        scans = select(*numbers, Fit.scan_id).outerjoin(Fit, Fit.scan_id == Scan.id)
        scans = scans.where(Scan.sample_id == self._sample_id).order_by(Scan.number)
        zero = select(Note.stamp_ns).where(Note.sample_id == self._sample_id, Note.zero)
        with explained(self.path, "reading it"), self._session() as session:
            marked = session.scalar(zero.order_by(Note.stamp_ns.desc()).limit(1))
            rows = session.execute(scans).all()
        first = (
            row.start_stamp_ns - round(1e9 * row.time_s)
            for row in rows
            if row.start_stamp_ns is not None and row.time_s is not None
        )
        zero_ns = next(first, 0) if marked is None else marked
        last_s = max((row.time_s for row in rows if row.time_s is not None), default=None)
        return Contents(
            scans=tuple(row.number for row in rows if row.state == "measured"),
            fitted=tuple(row.number for row in rows if row.scan_id is not None),
            missing={row.number: row.reason for row in rows if row.state == "missing"},
            zero_ns=zero_ns,
            last_ns=0 if last_s is None or not zero_ns else zero_ns + round(1e9 * last_s),
        )

    def unfitted(self) -> tuple[StoredScan, ...]:
        """Measured scans without parameters, in order."""
        contents = self.contents()
        if contents.scans == contents.fitted:
            return ()
        (sample,) = read_database(self.path).samples
        return tuple(scan for scan in sample.scans if scan.fit is None)

    def check_sample(self, sample: str) -> None:
        """Refuse what is of another sample."""
        if sample != self.sample_name:
            raise DatabaseError(
                f"{self.path}: is the database of sample {self.sample_name!r}; what was sent is "
                f"of {sample!r}"
            )

    @contextmanager
    def _session(self) -> Iterator[Session]:
        from sqlalchemy.orm import Session

        if "_engine" not in self.__dict__:
            raise DatabaseError(f"{self.path}: the database is closed")
        with Session(self._engine) as session:
            yield session

    @contextmanager
    def _transaction(self) -> Iterator[Session]:
        with self._session() as session, session.begin():
            yield session

    def _measured_digest(self, number: int) -> str | None:
        from .entries import find_scan

        with self._session() as session:
            scan = find_scan(session, self._sample_id, number)
            return scan.digest if scan is not None and scan.state == "measured" else None

    def _contradiction(self, what: str, digest: str, stamp_ns: int) -> None:
        from .entries import add_note

        text = f"{what} came again with another content ({digest[:12]}); the first was kept"
        with self._transaction() as session:
            added = add_note(session, self._sample_id, stamp_ns, text)
        if added:
            _logger.warning("%s: %s", self.path, text)

    @contextmanager
    def _written_beside(self, files: list[FileContent]) -> Iterator[None]:
        """Hold files under temporary names while they are entered in the catalogue."""
        try:
            paths = [write_beside(self.folder / file.path, file.data) for file in files]
            for place in sorted({path.parent for path in paths}):
                sync_folder(place)
            yield
        except BaseException:
            # only the catalogue knows whether the commit went through
            self._needs_repair = True
            with suppress(Exception):
                self._repair()
            raise

    def _settle(self, paths: list[Path] | None = None) -> None:
        """After a commit: files get their names, derived files are written again."""
        from . import upkeep

        self._needs_repair = True
        upkeep.put_in_place(paths or [])
        with self._session() as session:
            upkeep.write_derived(session, self._sample_id, self.folder)
        self._needs_repair = False

    def _repair(self) -> None:
        from . import upkeep

        if not self._needs_repair:
            return
        upkeep.make_folders(self.folder)
        with self._session() as session:
            upkeep.repair_files(session, self._sample_id, self.folder)
            upkeep.write_derived(session, self._sample_id, self.folder)
        self._needs_repair = False
