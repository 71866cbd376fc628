"""Scans of the published database: what each camera saw, a file each.

``tvBrdf-data/scanTT_brdf_cameraV_allexposures.txt``, TT from 01, V from 1 to 4; what such a file
holds is in :mod:`.scan_file`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from numpy.typing import ArrayLike

from .scan_file import CameraScan, read_scan_file
from .text import PublishedFormatError, read_bytes

if TYPE_CHECKING:
    from ..observations import Observations

DATA_FOLDER: Final = "tvBrdf-data"
CAMERAS: Final = (1, 2, 3, 4)

_NAME = re.compile(r"scan(\d{2,})_brdf_camera(\d)_allexposures\.txt")


@dataclass(frozen=True, eq=False)
class PublishedScan:
    """One scan: its number (from 1) and what each camera that has a file saw."""

    scan: int
    exposures_ms: tuple[float, ...]
    cameras: dict[int, CameraScan]

    def observations(self, calibration: ArrayLike | None = None) -> Observations:
        """Return what `fit_scan` takes, with a noise that is estimated from the scan itself.

        Parameters
        ----------
        calibration
            (4, 3) constants of cameras 1-4, B, G, R, that the radiances are divided by, as
            `read_calibration` gives them; by default 1. See :mod:`.observations`.
        """
        from .observations import scan_observations

        return scan_observations(self, calibration)


def scan_file_name(scan: int, camera: int) -> str:
    """Name of a scan file, e.g. ``scan01_brdf_camera1_allexposures.txt``."""
    if scan < 1 or camera not in CAMERAS:
        raise ValueError(f"scan {scan}, camera {camera}: scans count from 1, cameras are {CAMERAS}")
    return f"scan{scan:02d}_brdf_camera{camera}_allexposures.txt"


def parse_scan_file_name(name: str) -> tuple[int, int] | None:
    """(scan, camera) from a file's name; None if it is not the name of a scan file."""
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    scan, camera = int(match[1]), int(match[2])
    if scan < 1 or camera not in CAMERAS or scan_file_name(scan, camera) != name:
        return None
    return scan, camera


def read_scan(
    path: Path | str, scan: int | None = None, *, read: Callable[[Path], bytes] = read_bytes
) -> PublishedScan:
    """Read all cameras' files of one scan.

    Parameters
    ----------
    path
        The sample's folder, which holds ``tvBrdf-data``; or one of the scan's files, which lies
        beside the other cameras'.
    scan
        Its number, from 1; may be left out for a file, and where there is one scan only. A camera
        without a file is left out.
    read
        Gives a file's bytes; see `read_scan_file`.

    Raises
    ------
    PublishedFormatError
        If no camera has a file, the files' exposures differ, or it is not said which scan.
    """
    path = Path(path)
    named = None if path.is_dir() else parse_scan_file_name(path.name)
    if named is not None:
        if scan not in {None, named[0]}:
            raise PublishedFormatError(path, None, f"is a file of scan {named[0]}, not of {scan}")
        if not path.is_file():
            raise PublishedFormatError(path, None, "there is no such file")
        return _read_cameras(path.parent, named[0], read)
    if scan is None:
        numbers = list_scans(path)
        if len(numbers) != 1:
            raise PublishedFormatError(path, None, f"has {len(numbers)} scans: say which to read")
        scan = numbers[0]
    return _read_cameras(path / DATA_FOLDER, scan, read)


def _read_cameras(data_folder: Path, scan: int, read: Callable[[Path], bytes]) -> PublishedScan:
    cameras = {}
    for camera in CAMERAS:
        path = data_folder / scan_file_name(scan, camera)
        if os.path.lexists(path):  # a link to nothing is no camera without a file
            cameras[camera] = read_scan_file(path, read=read)
    if not cameras:
        raise PublishedFormatError(
            data_folder, None, f"has no file of scan {scan:02d}, {scan_file_name(scan, 1)}"
        )
    exposures_ms = next(iter(cameras.values())).exposures_ms
    for camera, camera_scan in cameras.items():
        if camera_scan.exposures_ms != exposures_ms:
            raise PublishedFormatError(
                data_folder / scan_file_name(scan, camera),
                1,
                f"exposures {camera_scan.exposures_ms} differ from the other cameras' "
                f"{exposures_ms} ms; is it a file of another scan?",
            )
    return PublishedScan(scan, exposures_ms, cameras)


def list_scans(folder: Path | str) -> tuple[int, ...]:
    """Numbers of the scans that have a file in a sample's ``tvBrdf-data``, in order.

    Raises
    ------
    PublishedFormatError
        If there is no such folder.
    """
    data_folder = Path(folder) / DATA_FOLDER
    if not data_folder.is_dir():
        raise PublishedFormatError(
            data_folder, None, "is not a folder; give one that holds tvBrdf-data/"
        )
    names = (parse_scan_file_name(path.name) for path in data_folder.iterdir())
    return tuple(sorted({name[0] for name in names if name is not None}))
