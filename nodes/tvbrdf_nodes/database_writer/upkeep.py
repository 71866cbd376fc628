"""Brings the files of a database in line with its catalogue, which is the truth."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from tvbrdf_fitting.published import (
    PublishedRow,
    SampleInfo,
    ScanInfo,
    format_info,
    format_parameters,
    parameters_row,
)
from tvbrdf_fitting.published.database import OBSERVATIONS_FOLDER, DatabaseError
from tvbrdf_fitting.published.info import INFO_FILE
from tvbrdf_fitting.published.sample import FITS_FILE, LOST_FILE
from tvbrdf_fitting.published.scan import DATA_FOLDER
from tvbrdf_fitting.published.text import (
    TEMPORARY_PREFIX,
    sync_folder,
    temporary_path,
    write_atomically,
)

from .catalogue import Fit, Sample, Scan, StoredFile


def make_folders(folder: Path) -> None:
    """Make a sample's folders."""
    for place in (DATA_FOLDER, OBSERVATIONS_FOLDER, str(Path(FITS_FILE).parent)):
        (folder / place).mkdir(parents=True, exist_ok=True)
    sync_folder(folder)
    sync_folder(folder.parent)


def put_in_place(paths: Iterable[Path]) -> None:
    """Give files that were written beside their names."""
    paths = list(paths)
    for path in paths:
        os.replace(temporary_path(path), path)  # noqa: PTH105  (one place for fault injection)
    for place in sorted({path.parent for path in paths}):
        sync_folder(place)


def repair_files(session: Session, sample_id: int, folder: Path) -> None:
    """Finish renames that a committed scan still needs, and remove what was never committed.

    Raises
    ------
    DatabaseError
        If a file that the catalogue has is missing or has another size.
    """
    unfinished = []
    rows = session.execute(
        select(StoredFile, Scan.number).join(Scan).where(Scan.sample_id == sample_id)
    )
    for file, scan in rows:
        path = folder.parent / file.path
        if path.exists():
            size = path.stat().st_size
            if size != file.size:
                raise DatabaseError(
                    f"{path}: has {size} bytes instead of the {file.size} that were stored for "
                    f"scan {scan}; restore it from a copy, or go on in another folder"
                )
        elif _sha256(temporary_path(path)) == file.sha256:
            unfinished.append(path)
        else:
            raise DatabaseError(
                f"{path}: is missing, but scan {scan} was stored with it; restore it from a copy, "
                "or go on in another folder"
            )
    put_in_place(unfinished)
    for leftover in sorted(folder.rglob(f"{TEMPORARY_PREFIX}*")):
        leftover.unlink()


def write_derived(session: Session, sample_id: int, folder: Path) -> None:
    """Write ``brdf-params.txt`` and ``tvBrdf-info.txt`` from the catalogue where they changed.

    A fit that the layout has no place for (another model's parameters, a value that is not
    finite) has no line, and its scan is ``unfitted`` there; the catalogue has it. Where the layout
    has place for a part only, ``brdf-params-lost.txt`` says what is missing.
    """
    sample = session.get_one(Sample, sample_id)
    rows = _fitted_rows(session, sample_id)
    if rows:
        values = [row.values for row in rows.values()]
        _write_if_changed(folder / FITS_FILE, format_parameters(values))
        lost = [f"scan {number}: {row.lost}\n" for number, row in rows.items() if row.lost]
        if lost or (folder / LOST_FILE).exists():
            _write_if_changed(folder / LOST_FILE, "".join(lost).encode())
    scans = session.scalars(
        select(Scan).where(Scan.sample_id == sample_id).order_by(Scan.number)
    ).all()
    measured = [scan for scan in scans if scan.state == "measured"]
    if not measured:
        return  # without a scan there are no exposures to state
    info = SampleInfo(
        sample_name=sample.name,
        process=sample.process,
        exposures_ms=tuple(measured[0].exposures_ms),
        scans=tuple(
            ScanInfo(scan.number, scan.start_stamp_ns or 0, scan.time_s or 0.0, scan.number in rows)
            for scan in measured
        ),
        missing=tuple((scan.number, scan.reason) for scan in scans if scan.state == "missing"),
    )
    _write_if_changed(folder / INFO_FILE, format_info(info))


def _fitted_rows(session: Session, sample_id: int) -> dict[int, PublishedRow]:
    fits = session.execute(
        select(Scan.number, Fit)
        .join(Fit, Fit.scan_id == Scan.id)
        .where(Scan.sample_id == sample_id)
        .order_by(Scan.number)
    )
    rows = {}
    for number, fit in fits:
        values = [np.nan if p.value is None else p.value for p in fit.parameters]
        row = parameters_row([p.name for p in fit.parameters], values)
        if row is not None:
            rows[number] = row
    return rows


def _write_if_changed(path: Path, data: bytes) -> None:
    if not path.exists() or path.read_bytes() != data:
        write_atomically(path, data)


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else ""
