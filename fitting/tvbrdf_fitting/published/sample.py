"""A sample of the published database: its scans, fitted parameters, information, calibration.

Below the sample's folder ``sampleNN``, beside ``tvBrdf-data/`` (see :mod:`.scan`):

``tvBrdf-fits/brdf-params.txt``
    A line a fitted scan, in the order of the scans, 6 decimals: ``Kd_b Kd_g Kd_r sigma_d Ks
    1/sigma_s`` and, for dust, ``w_b w_g w_r g tau`` after them. A scan without a fit has no line
    (the layout has no way to write "unknown"): ``tvBrdf-info.txt`` says which scans are there.
    Without ``tvBrdf-info.txt`` there must be a line for each scan.
``tvBrdf-info.txt``
    Which scans there are, and when they were made; see :mod:`.info`.
``tvBrdf-calibration.txt``
    Four lines (a camera each) of three numbers (B, G, R) by which the radiances are to be
    divided. Where there is none, all are 1.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..models.torrance_sparrow import SIGMA_S_BOUNDS
from .info import INFO_FILE, SampleInfo, read_info
from .scan import PublishedScan, list_scans, read_scan, scan_file_name
from .text import (
    PublishedFormatError,
    format_numbers,
    parse_number,
    read_lines,
    write_atomically,
)

FITS_FILE: Final = "tvBrdf-fits/brdf-params.txt"
LOST_FILE: Final = "tvBrdf-fits/brdf-params-lost.txt"
"""Our addition: what of a fit ``brdf-params.txt`` has no room for, a line a scan."""
CALIBRATION_FILE: Final = "tvBrdf-calibration.txt"

SURFACE_PARAMETERS: Final = ("kd_b", "kd_g", "kd_r", "sigma_d", "ks", "inverse_sigma_s")
DUST_PARAMETERS: Final = (*SURFACE_PARAMETERS, "w_b", "w_g", "w_r", "g", "tau")
"""Columns of ``brdf-params.txt``, without and with dust."""
_COLOURED: Final = ("ks_b", "ks_g", "ks_r")
PARAMETER_COUNTS: Final = (len(SURFACE_PARAMETERS), len(DUST_PARAMETERS))
_G_COLUMN: Final = 9

_SAMPLE_FOLDER = re.compile(r"sample\d{2,}")


@dataclass(frozen=True, eq=False)
class PublishedSample:
    """One sample of a published database.

    Attributes
    ----------
    folder
        Its folder.
    scans
        Its scans, in order.
    calibration
        (4, 3) constants of cameras 1-4, B, G, R: radiance divided by them is π·BRDF·cosθi.
    parameters
        (k, 6) or (k, 11) fitted parameters, or None if it has no fits.
    parameter_scans
        Numbers of the k scans that the rows of ``parameters`` belong to.
    info
        Its information file, or None if there is none.
    """

    folder: Path
    scans: tuple[PublishedScan, ...]
    calibration: NDArray[np.float64]
    parameters: NDArray[np.float64] | None
    parameter_scans: tuple[int, ...]
    info: SampleInfo | None


def list_samples(folder: Path | str) -> tuple[Path, ...]:
    """Folders ``sampleNN`` of a database, in order."""
    found = (path for path in Path(folder).iterdir() if _SAMPLE_FOLDER.fullmatch(path.name))
    return tuple(sorted(found, key=lambda path: int(path.name[6:])))


def read_sample(
    folder: Path | str,
    *,
    calibration: Path | str | None = None,
    g_positive_is_forward: bool = True,
    scans: Collection[int] | None = None,
) -> PublishedSample:
    """Read a sample: its scans and whatever else its folder holds.

    Parameters
    ----------
    folder
        Holds ``tvBrdf-data/`` and, each if it is there, fits, information and calibration.
    calibration
        File with the constants; by default ``tvBrdf-calibration.txt`` in the folder, if any.
    g_positive_is_forward
        See :func:`read_parameters`.
    scans
        Numbers of the scans to read, by default all; the others' files are only counted.

    Raises
    ------
    PublishedFormatError
        If a file breaks the layout, a scan that is asked for has none, or files disagree about
        which scans there are.
    """
    folder = Path(folder)
    numbers = list_scans(folder)
    if not numbers:
        raise PublishedFormatError(
            folder, None, f"holds no scan file in tvBrdf-data/, such as {scan_file_name(1, 1)}"
        )
    info = read_info(folder / INFO_FILE) if (folder / INFO_FILE).exists() else None
    if info is not None and tuple(scan.scan for scan in info.scans) != numbers:
        raise PublishedFormatError(
            folder / INFO_FILE,
            None,
            f"lists scans {[scan.scan for scan in info.scans]}, but tvBrdf-data/ has files of "
            f"{list(numbers)}; correct the list, or bring the missing files",
        )
    parameters = None
    fitted: tuple[int, ...] = ()
    if (folder / FITS_FILE).exists():
        parameters = read_parameters(
            folder / FITS_FILE, g_positive_is_forward=g_positive_is_forward
        )
        fitted = numbers
    if info is not None:
        fitted = tuple(scan.scan for scan in info.scans if scan.fitted)
    rows = 0 if parameters is None else len(parameters)
    if rows != len(fitted):
        raise PublishedFormatError(
            folder / FITS_FILE,
            None,
            f"has {rows} lines for {len(fitted)} fitted scans; correct the file or remove it",
        )
    if calibration is None and (folder / CALIBRATION_FILE).exists():
        calibration = folder / CALIBRATION_FILE
    return PublishedSample(
        folder=folder,
        scans=tuple(read_scan(folder, scan) for scan in (numbers if scans is None else scans)),
        calibration=np.ones((4, 3)) if calibration is None else read_calibration(calibration),
        parameters=parameters,
        parameter_scans=fitted,
        info=info,
    )


def read_parameters(path: Path | str, *, g_positive_is_forward: bool = True) -> NDArray[np.float64]:
    """Read ``brdf-params.txt``.

    Parameters
    ----------
    path
        The file.
    g_positive_is_forward
        Whether g > 0 means forward scattering in the file, as it does in this project. With
        False the sign of g is turned, for files that take the angle of Φ the other way.

    Returns
    -------
    ndarray
        (k, 6) or (k, 11), one row a fitted scan.

    Raises
    ------
    PublishedFormatError
        With file and line: a line that has not 6 or 11 finite numbers, or not as many as the
        first; a truncated or empty file.
    """
    path = Path(path)
    rows = _read_table(path)
    for index, row in enumerate(rows):
        if len(row) not in PARAMETER_COUNTS or len(row) != len(rows[0]):
            wanted = "6 or 11" if index == 0 else f"{len(rows[0])} as in line 1"
            raise PublishedFormatError(
                path, index + 1, f"has {len(row)} numbers instead of {wanted}"
            )
    parameters = np.array(rows, dtype=np.float64)
    if not g_positive_is_forward and parameters.shape[1] > _G_COLUMN:
        parameters[:, _G_COLUMN] *= -1
    return parameters


def format_parameters(parameters: ArrayLike, path: Path | str = "brdf-params.txt") -> bytes:
    """Bytes of ``brdf-params.txt`` for (k, 6) or (k, 11) finite parameters, k ≥ 1."""
    rows = np.asarray(parameters, dtype=np.float64)
    if rows.ndim != 2 or len(rows) == 0 or rows.shape[1] not in PARAMETER_COUNTS:
        raise PublishedFormatError(path, None, f"parameters {rows.shape} are not (k, 6 or 11)")
    for index, row in enumerate(rows):
        if not np.isfinite(row).all():
            raise PublishedFormatError(path, index + 1, "a parameter is not finite")
    return "".join(f"{format_numbers(row)}\n" for row in rows.tolist()).encode("ascii")


def write_parameters(path: Path | str, parameters: ArrayLike) -> None:
    """Write ``brdf-params.txt``, whole or not at all; see :func:`format_parameters`."""
    write_atomically(Path(path), format_parameters(parameters, path))


@dataclass(frozen=True, eq=False)
class PublishedRow:
    """One scan's parameters as ``brdf-params.txt`` has room for.

    Attributes
    ----------
    values
        (6,) or (11,).
    lost
        What the layout has no room for, in words; empty where nothing is lost.
    """

    values: NDArray[np.float64]
    lost: str = ""


def parameters_row(names: Sequence[str], values: ArrayLike) -> PublishedRow | None:
    """Fitted parameters in the order of ``brdf-params.txt``.

    Amplitudes of the lobe that differ by channel become their mean, and the row says so. What a
    simpler model leaves out is 0: sigma_d (Lambert), Ks (no lobe; sigma_s is then the largest).

    Parameters
    ----------
    names
        What ``values`` are, in any order, e.g. a model's ``parameter_names``.
    values
        (p,) numbers.

    Returns
    -------
    PublishedRow or None
        None where the layout has no place for them: parameters of another model, or a number that
        is not finite.
    """
    by_name = dict(zip(names, np.asarray(values, dtype=np.float64).tolist(), strict=True))
    lost = ""
    if by_name.keys() >= set(_COLOURED):
        each = [by_name.pop(name) for name in _COLOURED]
        by_name["ks"] = float(np.mean(each))
        lost = (
            f"Ks of the channels, {format_numbers(each)} (B, G, R), is written as its mean "
            f"{format_numbers([by_name['ks']])}"
        )
    if by_name.keys() >= set(SURFACE_PARAMETERS[:3]):
        by_name.setdefault("sigma_d", 0.0)
        if not by_name.keys() & {"ks", "inverse_sigma_s"}:
            by_name |= {"ks": 0.0, "inverse_sigma_s": 1 / SIGMA_S_BOUNDS[1]}
    for columns in (SURFACE_PARAMETERS, DUST_PARAMETERS):
        if by_name.keys() == set(columns):
            row = np.array([by_name[name] for name in columns])
            return PublishedRow(row, lost) if np.isfinite(row).all() else None
    return None


def read_calibration(path: Path | str) -> NDArray[np.float64]:
    """Read the constants of the four cameras: (4, 3), B, G, R.

    Raises
    ------
    PublishedFormatError
        With file and line: not four lines of three positive numbers.
    """
    path = Path(path)
    rows = _read_table(path)
    if len(rows) != 4:
        raise PublishedFormatError(
            path, None, f"has {len(rows)} lines instead of 4, one a camera (B, G, R each)"
        )
    for index, row in enumerate(rows):
        if len(row) != 3:
            raise PublishedFormatError(
                path, index + 1, f"has {len(row)} numbers instead of 3 (B, G, R)"
            )
        if min(row) <= 0:
            raise PublishedFormatError(
                path, index + 1, f"{min(row):g} is not positive: radiances are divided by it"
            )
    return np.array(rows, dtype=np.float64)


def write_calibration(path: Path | str, constants: ArrayLike) -> None:
    """Write the (4, 3) constants of the cameras, B, G, R, whole or not at all."""
    rows = np.asarray(constants, dtype=np.float64)
    if rows.shape != (4, 3) or not (np.isfinite(rows) & (rows >= 1e-6)).all():
        raise PublishedFormatError(
            path, None, "calibration constants must be (4, 3), finite and at least 1e-6"
        )
    text = "".join(f"{format_numbers(row)}\n" for row in rows.tolist())
    write_atomically(Path(path), text.encode("ascii"))


def _read_table(path: Path) -> list[list[float]]:
    return [
        [parse_number(token, path, line) for token in text.split()]
        for line, text in enumerate(read_lines(path), start=1)
    ]
