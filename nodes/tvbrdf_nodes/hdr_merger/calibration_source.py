"""Where the merger has its calibration from: a file, or a bag that has one inside."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tvbrdf_fitting.measurement.calibration import Calibration


def check_calibration(path: str) -> None:
    """Refuse with ``ValueError`` what is neither a file nor a bag with a calibration."""
    if is_bag(path):
        from tvbrdf_messages.bag import BagError

        try:
            inside(path)
        except BagError as error:
            raise ValueError(str(error)) from error
    elif not Path(path).is_file():
        raise ValueError(f"calibration {path} is no file; give the rig's own")


def read_calibration(path: str) -> Calibration:
    """Return the calibration; ``CalibrationError`` or ``BagError`` if there is none."""
    from tvbrdf_fitting.measurement.calibration import (
        CalibrationError,
        load_calibration,
        parse_calibration,
    )

    if not is_bag(path):
        return load_calibration(path)
    name, content = inside(path)
    source = f"{path}: {name}"
    try:
        return parse_calibration(content.decode(), source=source)
    except UnicodeDecodeError as error:
        raise CalibrationError(f"{source}: is no text; give a calibration file") from error


def is_bag(path: str) -> bool:
    """Return whether a path is meant as a bag's."""
    return path.endswith(".mcap") or Path(path).is_dir()


def inside(path: str) -> tuple[str, bytes]:
    """Return name and content of a bag's calibration.

    Raises
    ------
    BagError
        If the bag can't be read or has none.
    """
    from tvbrdf_messages.bag import CALIBRATION, BagError, BagReader, attachment_kind

    with BagReader(path) as bag:
        found = {
            n: data for n, data in bag.attachments().items() if attachment_kind(n) == CALIBRATION
        }
    if len(found) != 1:
        has = (
            f"more than one calibration: {', '.join(sorted(found))}" if found else "no calibration"
        )
        raise BagError(path, f"has {has} inside; give the rig's file: calibration:=FILE")
    return found.popitem()
