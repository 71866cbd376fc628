"""Read a database that a measurement has left: published text, raw observations, catalogue.

``DATABASE/catalogue.sqlite`` says what there is and holds the parameters with their uncertainty;
``DATABASE/sampleNN/`` has the published text files (see :mod:`.published`) and
``observations/scanTT.npz`` with what the cameras saw, frame by frame, for refits. The catalogue
is read as it is on disk, also while a measurement is still writing to it.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from .scan import PublishedScan, read_scan

CATALOGUE_FILE: Final = "catalogue.sqlite"
OBSERVATIONS_FOLDER: Final = "observations"
SCHEMA_VERSION: Final = 2
"""Version of the catalogue's tables that this reader and the writer know."""


class DatabaseError(Exception):
    """A database cannot be used as asked; the message says what to do."""


class DiskFullError(DatabaseError):
    """There is no space left; nothing stored before is lost, and storing can be tried again."""


@dataclass(frozen=True, eq=False)
class StoredFit:
    """Fitted parameters of one scan, as the catalogue has them.

    Attributes
    ----------
    model
        Full name of the model.
    parameter_names, values, standard_deviations
        (p,) in the model's order and published units; NaN where a deviation is not known.
    covariance
        (p, p), published units.
    errors
        Error measures by name; None where nothing was left to measure.
    reason
        Why the solver stopped.
    at_bound, undetermined
        Names of parameters that ended at a bound, or that the data do not determine.
    details
        Metric and loss of the fit, errors that frames share as it found them, and, where the model
        was chosen, why this one.
    """

    model: str
    parameter_names: tuple[str, ...]
    values: NDArray[np.float64]
    standard_deviations: NDArray[np.float64]
    covariance: NDArray[np.float64]
    errors: dict[str, float | int | None]
    solver: str
    reason: str
    evaluations: int
    solve_time_ms: float
    at_bound: tuple[str, ...]
    undetermined: tuple[str, ...]
    details: dict[str, Any]


@dataclass(frozen=True, eq=False)
class StoredScan:
    """One measured scan of a sample.

    Attributes
    ----------
    folder
        The sample's folder, from which radiance and observations are read when asked for.
    start_stamp_ns
        Start on the run's clock (UTC), nanoseconds.
    time_s
        Seconds since t = 0.
    quality
        What the merger noted: gaps, retaken sweeps, missing frames, lamp drift, dark level.
    fit
        Its fitted parameters, or None.
    """

    folder: Path
    scan: int
    start_stamp_ns: int
    time_s: float
    exposures_ms: tuple[float, ...]
    quality: dict[str, Any]
    fit: StoredFit | None

    @property
    def observations_path(self) -> Path:
        """File with the raw observations."""
        return self.folder / OBSERVATIONS_FOLDER / observations_file_name(self.scan)

    def radiance(self) -> PublishedScan:
        """Radiance on the grid of light positions, from the text files."""
        return read_scan(self.folder, self.scan)

    def observations(self) -> dict[str, NDArray[Any]]:
        """Raw observations by name, bit for bit as they were stored."""
        try:
            with (
                self.observations_path.open("rb") as file,
                np.load(file, allow_pickle=False) as arrays,
            ):
                return {name: arrays[name] for name in arrays.files}
        except (OSError, ValueError, EOFError, BadZipFile) as error:
            raise DatabaseError(
                f"{self.observations_path}: observations of scan {self.scan} cannot be read: "
                f"{error}; restore the file from a copy"
            ) from error


@dataclass(frozen=True)
class StoredNote:
    """A note of the operator or of the writer itself."""

    stamp_ns: int
    text: str
    zero: bool
    """Whether this moment is t = 0."""


@dataclass(frozen=True)
class MissingScan:
    """A scan that could not be measured, why, and when it was due (None if that is not known)."""

    scan: int
    reason: str
    time_s: float | None


@dataclass(frozen=True, eq=False)
class StoredSample:
    """One sample with its measured and its missing scans in order, and the notes."""

    name: str
    process: str
    run_id: str
    folder: Path
    scans: tuple[StoredScan, ...]
    missing: tuple[MissingScan, ...]
    notes: tuple[StoredNote, ...]


@dataclass(frozen=True, eq=False)
class StoredDatabase:
    """Everything in a database."""

    path: Path
    samples: tuple[StoredSample, ...]


def sample_folder_name(number: int) -> str:
    """Folder of a sample, e.g. ``sample01``."""
    return f"sample{number:02d}"


def observations_file_name(scan: int) -> str:
    """File of a scan's raw observations, e.g. ``scan01.npz``."""
    return f"scan{scan:02d}.npz"


def read_database(path: Path | str) -> StoredDatabase:
    """Read a database: samples, scans, parameters, notes.

    Radiance and observations stay in their files until a :class:`StoredScan` is asked for them.

    Raises
    ------
    DatabaseError
        If there is none, it is damaged, or it was written by a newer version.
    """
    path = Path(path)
    catalogue = path / CATALOGUE_FILE
    if not catalogue.is_file():
        raise DatabaseError(
            f"{path}: is no database of this project (no {CATALOGUE_FILE}); give the folder that "
            "the measurement wrote"
        )
    try:
        with closing(_open_read_only(catalogue)) as connection:
            connection.row_factory = sqlite3.Row
            connection.execute("BEGIN")  # one consistent moment, also while a run writes
            _check_version(connection, path)
            samples = connection.execute("SELECT * FROM samples ORDER BY number").fetchall()
            return StoredDatabase(
                path, tuple(_read_sample(connection, path, row) for row in samples)
            )
    except sqlite3.Error as error:
        raise DatabaseError(
            f"{catalogue}: cannot be read: {error}; if a measurement was killed, open the database "
            "once for writing (resume) so that it can repair itself"
        ) from error


def _open_read_only(catalogue: Path) -> sqlite3.Connection:
    uri = catalogue.absolute().as_uri()
    return sqlite3.connect(f"{uri}?mode=ro", uri=True, timeout=5.0, isolation_level=None)


def _check_version(connection: sqlite3.Connection, path: Path) -> None:
    row = connection.execute("SELECT version FROM schema_version").fetchone()
    version = None if row is None else row[0]
    if version != SCHEMA_VERSION:
        raise DatabaseError(
            f"{path}: its catalogue has version {version}, this program knows {SCHEMA_VERSION}; "
            "use the program version that wrote it"
        )


def _read_sample(connection: sqlite3.Connection, path: Path, row: sqlite3.Row) -> StoredSample:
    folder = path / sample_folder_name(row["number"])
    fits = _read_fits(connection, row["id"])
    scans = []
    missing = []
    for scan in connection.execute(
        "SELECT * FROM scans WHERE sample_id = ? ORDER BY number", (row["id"],)
    ):
        if scan["state"] == "missing":
            missing.append(MissingScan(scan["number"], scan["reason"], scan["time_s"]))
            continue
        scans.append(
            StoredScan(
                folder=folder,
                scan=scan["number"],
                start_stamp_ns=scan["start_stamp_ns"],
                time_s=scan["time_s"],
                exposures_ms=tuple(json.loads(scan["exposures_ms"])),
                quality=json.loads(scan["quality"]),
                fit=fits.get(scan["id"]),
            )
        )
    notes = connection.execute(
        "SELECT stamp_ns, text, zero FROM notes WHERE sample_id = ? ORDER BY stamp_ns, id",
        (row["id"],),
    )
    return StoredSample(
        name=row["name"],
        process=row["process"],
        run_id=row["run_id"],
        folder=folder,
        scans=tuple(scans),
        missing=tuple(missing),
        notes=tuple(StoredNote(stamp, text, bool(zero)) for stamp, text, zero in notes),
    )


def _read_fits(connection: sqlite3.Connection, sample_id: int) -> dict[int, StoredFit]:
    of_sample = "WHERE scan_id IN (SELECT id FROM scans WHERE sample_id = ?)"
    parameters: dict[int, list[sqlite3.Row]] = {}
    for row in connection.execute(
        f"SELECT * FROM parameters {of_sample} ORDER BY scan_id, position",
        (sample_id,),
    ):
        parameters.setdefault(row["scan_id"], []).append(row)
    errors: dict[int, dict[str, float | int | None]] = {}
    for row in connection.execute(
        f"SELECT * FROM errors {of_sample} ORDER BY id",
        (sample_id,),
    ):
        value = row["value"]
        is_count = value is not None and row["is_count"]
        errors.setdefault(row["scan_id"], {})[row["name"]] = int(value) if is_count else value
    fits = {}
    for row in connection.execute(f"SELECT * FROM fits {of_sample}", (sample_id,)):
        rows = parameters.get(row["scan_id"], [])
        count = len(rows)
        fits[row["scan_id"]] = StoredFit(
            model=row["model"],
            parameter_names=tuple(parameter["name"] for parameter in rows),
            values=_doubles(parameter["value"] for parameter in rows),
            standard_deviations=_doubles(parameter["standard_deviation"] for parameter in rows),
            covariance=np.frombuffer(row["covariance"], "<f8").reshape(count, count).copy(),
            errors=errors.get(row["scan_id"], {}),
            solver=row["solver"],
            reason=row["reason"],
            evaluations=row["evaluations"],
            solve_time_ms=row["solve_time_ms"],
            at_bound=tuple(json.loads(row["at_bound"])),
            undetermined=tuple(json.loads(row["undetermined"])),
            details=json.loads(row["details"]),
        )
    return fits


def _doubles(values: Iterable[float | None]) -> NDArray[np.float64]:
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)
