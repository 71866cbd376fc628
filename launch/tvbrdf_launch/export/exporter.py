"""Exports a bag: checks what is asked, makes all of it beside, and gives it its name at the end."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tvbrdf_messages.bag import BagReader
from tvbrdf_messages.bag.about import software_version
from tvbrdf_messages.bag.errors import BagError
from tvbrdf_messages.bag.unfinished import Unfinished

from ..errors import RunError
from ..refit.bag_source import recorded_parameters
from ..refit.pipeline import WRITER
from . import foxglove, protobuf, published
from .exr import ExrOptions, write_exr_images
from .result import Tell, Written
from .rig import lacks_frames, rig_for_frames, rig_for_geometry

if TYPE_CHECKING:
    from ..refit.settings import CalibrationFile
    from .rig import Rig

TEXT, EXR, FOXGLOVE = "text", "exr", "foxglove"
FORMATS = (TEXT, EXR, FOXGLOVE)
RECORD_FILE = "export.json"
TellMore = Callable[[float, str], None]
"""Told how much of the whole is done, 0 to 1, and what is being made."""


@dataclass(frozen=True)
class Report:
    """What an export has made."""

    out: Path
    written: tuple[Written, ...]
    left_out: dict[str, str]
    """Formats that were not asked for by name and could not be made, and why."""
    removed: tuple[Path, ...] = ()
    """What exports that were killed had left of the same folder."""

    def plain(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "out": str(self.out),
            "written": [each.plain() for each in self.written],
            "left_out": self.left_out,
            "removed": [str(each) for each in self.removed],
        }


def export_bag(
    path: Path,
    out: Path,
    formats: Sequence[str] | None = None,
    *,
    calibration: CalibrationFile | None = None,
    options: ExrOptions | None = None,
    tell: TellMore = lambda fraction, text: None,
) -> Report:
    """Write what a bag holds into a new folder, in other tools' forms.

    Parameters
    ----------
    out
        A new folder; it is there when all of it is whole, else not at all.
    formats
        Of :data:`FORMATS`; None: each that the bag has the messages for.
    calibration
        In place of the one in the bag.

    Raises
    ------
    BagError
        If the bag can't be read or lacks what a format needs.
    RunError
        If ``out`` exists, a package is missing, or writing fails.
    """
    if out.exists() or out.is_symlink():
        raise RunError(f"{out}: exists already; choose another folder or remove it")
    with BagReader(path) as bag:
        job = _Job(bag, calibration, options or ExrOptions())
        chosen, left_out = job.choose(formats)
        return _beside(out, lambda folder: _export(job, folder, out, chosen, left_out, tell))


def _beside(out: Path, make: Callable[[Path], Report]) -> Report:
    """Make a folder under another name and rename it; after an error nothing is left."""
    try:
        with Unfinished(out) as place:
            place.path.mkdir()
            try:
                report = make(place.path)
            except RunError as error:
                raise RunError(str(error).replace(str(place.path), str(out))) from error
            if out.exists():
                raise RunError(f"{out}: exists by now; choose another folder")
            place.path.rename(out)
            return replace(report, removed=place.removed)
    except OSError as error:
        raise RunError(_explained(error, out)) from error


def _explained(error: OSError, out: Path) -> str:
    """Return why a folder can't be written, and what to do."""
    text = f"{out}: can't be written: {error.strerror or error}"
    if error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}:
        return f"{text}; nothing is left of it: free some space, or give another place with --out"
    return f"{text}; give another place with --out"


def _export(
    job: _Job, folder: Path, out: Path, chosen: Sequence[str], left_out: dict[str, str], tell: Any
) -> Report:
    written = []
    for number, name in enumerate(chosen):

        def tell_part(fraction: float, number: int = number, name: str = name) -> None:
            tell((number + min(1.0, fraction)) / len(chosen), name)

        tell_part(0.0)
        written.append(job.write(name, folder, tell_part))
    report = Report(out, tuple(written), left_out)
    (folder / RECORD_FILE).write_text(json.dumps(job.record(report), indent=1) + "\n")
    return report


class _Job:
    """One bag, and how it is exported."""

    def __init__(
        self, bag: BagReader, calibration: CalibrationFile | None, options: ExrOptions
    ) -> None:
        self._bag, self._calibration, self._options = bag, calibration, options
        self._rig: Rig | None = None

    def choose(self, formats: Sequence[str] | None) -> tuple[list[str], dict[str, str]]:
        """Return which formats are made, and those that can't be with the reason."""
        wanted = FORMATS if formats is None else tuple(dict.fromkeys(formats))
        checked = {name: self._check(name) for name in wanted}
        wrong = {name: error for name, error in checked.items() if error is not None}
        if wrong and (formats is not None or len(wrong) == len(FORMATS)):
            raise next(iter(wrong.values()))
        texts = {
            name: error.text if isinstance(error, BagError) else str(error)
            for name, error in wrong.items()
        }
        return [name for name in wanted if name not in wrong], texts

    def _check(self, name: str) -> BagError | RunError | None:
        """Return what is wrong with making one format, before anything is written."""
        lacks = {TEXT: published.lacks, EXR: lacks_frames, FOXGLOVE: foxglove.lacks}[name]
        why = lacks(self._bag)
        if why:
            return BagError(self._bag.path, why)
        if name == FOXGLOVE and (why := protobuf.lacks_packages()):
            return RunError(f"a bag for Foxglove can't be written: {why}")
        if name == EXR:
            try:
                self._rig = rig_for_frames(self._bag, self._calibration)
            except (BagError, RunError) as error:
                return error
        return None

    def write(self, name: str, folder: Path, tell: Tell) -> Written:
        """Make one format."""
        bag = self._bag
        if name == TEXT:
            recorded = recorded_parameters(bag).get(WRITER, {})
            return published.write_text(bag, folder / TEXT, recorded, tell)
        if name == EXR and self._rig is not None:
            return write_exr_images(bag, folder / EXR, self._rig, self._options, tell)
        return self._write_protobuf(folder / f"{FOXGLOVE}.mcap", tell)

    def _write_protobuf(self, path: Path, tell: Tell) -> Written:
        try:
            rig = self._rig or rig_for_geometry(self._bag, self._calibration)
        except (BagError, RunError) as error:
            if self._calibration is not None:
                raise
            written = foxglove.write_protobuf(self._bag, path, None, tell)
            written.remarks.append(
                f"the rig's geometry: {error}"
                if isinstance(error, RunError)
                else "the rig's geometry: the bag has no calibration; give it with --calibration"
            )
            return written
        return foxglove.write_protobuf(self._bag, path, rig, tell)

    def record(self, report: Report) -> dict[str, Any]:
        """Return what an export was made from and with."""
        about = self._bag.about
        calibration = self._rig and {
            "name": self._rig.calibration_name,
            "sha256": self._rig.calibration_sha256,
        }
        return {
            "version": software_version(),
            "bag": self._bag.path.resolve().name,
            "run": about.run,
            "recorded_with": about.version,
            "calibration": calibration,
            "each_exposure": self._options.each_exposure,
            "whole_frames": self._options.whole_frames,
            "written": [each.plain() for each in report.written],
            "left_out": report.left_out,
        }
