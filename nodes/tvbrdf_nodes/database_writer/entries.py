"""What the store enters in the catalogue's tables, and looks up there."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from sqlalchemy import select
from sqlalchemy.orm import Session

from tvbrdf_fitting.published.database import DatabaseError

from .catalogue import ErrorMeasure, Fit, Note, Parameter, Scan, StoredFile
from .records import FileContent, FitRecord, ScanRecord, plain


def find_scan(session: Session, sample_id: int, number: int) -> Scan | None:
    """Return a scan, measured or missing; None if nothing is known of it."""
    return session.scalar(select(Scan).where(Scan.sample_id == sample_id, Scan.number == number))


def enter_scan(
    session: Session,
    sample_id: int,
    sample_folder: str,
    record: ScanRecord,
    files: list[FileContent],
    digest: str,
) -> None:
    """Enter a measured scan with its files; one that was missing is measured now."""
    scan = find_scan(session, sample_id, record.scan)
    if scan is None:
        scan = Scan(sample_id=sample_id, number=record.scan)
        session.add(scan)
    else:
        text = f"scan {record.scan} came after it was recorded as missing: {scan.reason}"
        add_note(session, sample_id, record.start_stamp_ns, text)
    scan.state, scan.reason, scan.digest = "measured", "", digest
    scan.start_stamp_ns, scan.time_s = int(record.start_stamp_ns), float(record.time_s)
    scan.exposures_ms = [float(exposure_ms) for exposure_ms in record.exposures_ms]
    scan.quality = plain(record.quality)
    scan.files = [file_row(sample_folder, file) for file in files]


def enter_missing(
    session: Session, sample_id: int, number: int, reason: str, time_s: float | None
) -> bool:
    """Enter a scan as missing; False if it is known already, measured or missing."""
    if find_scan(session, sample_id, number) is not None:
        return False
    session.add(
        Scan(sample_id=sample_id, number=number, state="missing", reason=reason, time_s=time_s)
    )
    return True


def add_note(
    session: Session, sample_id: int, stamp_ns: int, text: str, *, zero: bool = False
) -> bool:
    """Enter a note; False if the same is there already."""
    same = select(Note.id).where(
        Note.sample_id == sample_id, Note.stamp_ns == stamp_ns, Note.text == text
    )
    if session.scalar(same) is not None:
        return False
    session.add(Note(sample_id=sample_id, stamp_ns=stamp_ns, text=text, zero=zero))
    return True


def check_model(session: Session, sample_id: int, model: str, *, chosen: bool) -> None:
    """Refuse a fit of another model than the sample's other fits, unless models are chosen."""
    if chosen:
        return
    others = select(Fit.model).join(Scan, Scan.id == Fit.scan_id)
    known = session.scalar(others.where(Scan.sample_id == sample_id).limit(1))
    if known is not None and known != model:
        raise DatabaseError(
            f"parameters of model {model!r} cannot be stored: the sample's other scans were "
            f"fitted with {known!r}; fit all with one model, or write to another folder"
        )


def file_row(sample_folder: str, file: FileContent) -> StoredFile:
    """Row of one file of a scan."""
    return StoredFile(
        path=f"{sample_folder}/{file.path}",
        kind=file.kind,
        size=len(file.data),
        sha256=file.sha256,
    )


def fit_row(record: FitRecord, digest: str) -> Fit:
    """Row of a fit with its parameters and error measures."""
    values, deviations = _nullable(record.values), _nullable(record.standard_deviations)
    return Fit(
        model=record.model,
        solver=record.solver,
        reason=record.reason,
        evaluations=int(record.evaluations),
        solve_time_ms=float(record.solve_time_ms),
        covariance=np.asarray(record.covariance, dtype="<f8").tobytes(),
        at_bound=list(record.at_bound),
        undetermined=list(record.undetermined),
        details=plain(record.details),
        digest=digest,
        parameters=[
            Parameter(
                position=position,
                name=name,
                value=values[position],
                standard_deviation=deviations[position],
            )
            for position, name in enumerate(record.parameter_names)
        ],
        errors=[
            ErrorMeasure(
                name=name,
                value=None if value is None else _nullable([value])[0],
                is_count=isinstance(value, int | np.integer),
            )
            for name, value in record.errors.items()
        ],
    )


def _nullable(values: ArrayLike) -> list[float | None]:
    """Numbers with NULL for NaN, which SQL does not know."""
    numbers = np.asarray(values, dtype=np.float64).tolist()
    return [None if math.isnan(number) else number for number in numbers]
