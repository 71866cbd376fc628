"""What is given to the database store, checked, and turned into files and digests."""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tvbrdf_fitting.published import CameraScan, format_scan_file, scan_file_name
from tvbrdf_fitting.published.database import (
    OBSERVATIONS_FOLDER,
    DatabaseError,
    observations_file_name,
)
from tvbrdf_fitting.published.scan import DATA_FOLDER


@dataclass(frozen=True, kw_only=True, eq=False)
class ScanRecord:
    """One measured scan.

    Attributes
    ----------
    sample, scan
        Name of the sample and number of the scan, from 1.
    start_stamp_ns
        Start of the scan on the run's clock (UTC), nanoseconds.
    time_s
        Seconds since t = 0.
    exposures_ms
        Exposure times of its sweeps, ms.
    grid
        Radiance of each camera (1 to 4) on the common grid of light positions, for the published
        text files. Positions with an invalid (not finite) channel are left out there; a camera
        with no valid position gets no file.
    observations
        Raw observations by name, of numeric or boolean type; kept bit for bit.
    quality
        Gaps, retaken sweeps, missing frames, lamp drift, dark level: anything JSON can hold.
    """

    sample: str
    scan: int
    start_stamp_ns: int
    time_s: float
    exposures_ms: tuple[float, ...]
    grid: Mapping[int, CameraScan]
    observations: Mapping[str, NDArray[Any]]
    quality: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, eq=False)
class FitRecord:
    """A model fitted to one scan; fields as in :class:`StoredFit`, values in published units."""

    sample: str
    scan: int
    model: str
    parameter_names: tuple[str, ...]
    values: ArrayLike
    standard_deviations: ArrayLike
    covariance: ArrayLike
    errors: Mapping[str, float | int | None]
    solver: str
    reason: str
    evaluations: int = 0
    solve_time_ms: float = 0.0
    at_bound: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class FileContent:
    """A file to be: its path below the sample's folder, its kind and bytes."""

    path: str
    kind: str
    data: bytes

    @property
    def sha256(self) -> str:
        """SHA-256 of its bytes."""
        return hashlib.sha256(self.data).hexdigest()


def scan_files(record: ScanRecord) -> list[FileContent]:
    """All files of a scan: the cameras' text and the raw observations.

    Raises
    ------
    DatabaseError
        If the record is not one that can be stored; says what is wrong with it.
    """
    if record.scan < 1 or record.start_stamp_ns < 0 or not math.isfinite(record.time_s):
        raise DatabaseError(
            f"scan {record.scan} (start {record.start_stamp_ns} ns, {record.time_s} s) cannot be "
            "stored: scans count from 1, stamps are not negative, times are finite"
        )
    files = []
    for camera, camera_scan in sorted(record.grid.items()):
        if tuple(camera_scan.exposures_ms) != tuple(record.exposures_ms):
            raise DatabaseError(
                f"scan {record.scan}, camera {camera}: exposures {camera_scan.exposures_ms} are "
                f"not the scan's {record.exposures_ms} ms"
            )
        if not np.isfinite(camera_scan.radiance).all(axis=1).any():
            continue
        try:
            name = scan_file_name(record.scan, camera)
            files.append(
                FileContent(f"{DATA_FOLDER}/{name}", "text", format_scan_file(camera_scan, name))
            )
        except ValueError as error:
            raise DatabaseError(f"scan {record.scan} cannot be stored: {error}") from error
    if not files:
        raise DatabaseError(
            f"scan {record.scan}: no camera has a single valid radiance; store it as missing"
        )
    files.append(
        FileContent(
            f"{OBSERVATIONS_FOLDER}/{observations_file_name(record.scan)}",
            "observations",
            _observations_bytes(record),
        )
    )
    return files


def _observations_bytes(record: ScanRecord) -> bytes:
    for name, array in record.observations.items():
        if not name.isidentifier() or name == "file" or array.dtype.kind not in "biuf":
            raise DatabaseError(
                f"scan {record.scan}: observations {name!r} ({array.dtype}) cannot be stored; "
                "give plain numeric arrays with names that are identifiers"
            )
    buffer = io.BytesIO()
    np.savez(buffer, **record.observations)  # type: ignore[arg-type]  # names are checked above
    return buffer.getvalue()


def scan_digest(record: ScanRecord, files: list[FileContent]) -> str:
    """Digest of everything that a scan record says."""
    facts = [record.start_stamp_ns, record.time_s, record.exposures_ms, plain(record.quality)]
    return _digest([facts, [(file.path, file.sha256) for file in files]])


def fit_digest(record: FitRecord) -> str:
    """Digest of what a fit found; how long it took, and how, is no part of it."""
    arrays = (record.values, record.standard_deviations, record.covariance)
    return _digest(
        [
            record.model,
            record.parameter_names,
            [np.asarray(array, dtype="<f8").tobytes().hex() for array in arrays],
        ]
    )


def check_fit(record: FitRecord) -> None:
    """Refuse a fit whose parts do not go together, before any of it is stored."""
    count = len(record.parameter_names)
    where = f"parameters of scan {record.scan} cannot be stored"
    for name, value, shape in (
        ("values", record.values, (count,)),
        ("standard deviations", record.standard_deviations, (count,)),
        ("covariance", record.covariance, (count, count)),
    ):
        if np.shape(value) != shape:
            raise DatabaseError(f"{where}: {name} have shape {np.shape(value)}, not {shape}")
    if count == 0 or len(set(record.parameter_names)) != count:
        raise DatabaseError(f"{where}: their names {record.parameter_names} are not unique")
    for name, measure in record.errors.items():
        if measure is not None and not isinstance(measure, int | float | np.number):
            raise DatabaseError(f"{where}: error measure {name!r} is {measure!r}, not a number")


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it: plain types, numbers that are not finite as null.

    Raises
    ------
    DatabaseError
        If it holds anything else.
    """
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    raise DatabaseError(f"{value!r} ({type(value).__name__}) cannot be stored as JSON")


def _digest(facts: Any) -> str:
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
