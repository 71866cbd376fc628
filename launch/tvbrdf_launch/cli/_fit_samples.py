"""What ``tvbrdf fit`` finds below a path, reads and fits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from tvbrdf_fitting.choice.choose import ModelChoice
    from tvbrdf_fitting.inference.nuisances import CommonErrors
    from tvbrdf_fitting.observations import Observations
    from tvbrdf_fitting.published import PublishedSample, PublishedScan
    from tvbrdf_fitting.published.database import StoredScan
    from tvbrdf_fitting.result import FitResult
    from tvbrdf_rendering.fit_report import DataSource, FittedSample, FittedScan

AUTO = "auto"
_ROWS_IN_VAIN = 16
"""Every 16th."""


@dataclass(frozen=True)
class Request:
    """How to fit.

    ``model`` is a name or ``auto``, ``options`` are those of ``fit_scan``; ``calibration`` is a
    file; ``grid`` means the published grid even where frames are kept.
    """

    model: str
    options: Mapping[str, Any] = field(default_factory=dict)
    scan_by_scan: bool = False
    calibration: Path | None = None
    grid: bool = False


@dataclass(frozen=True)
class Target:
    """A sample's folder, and which of its scans; or a scan file that lies outside of a sample."""

    folder: Path
    scans: tuple[int, ...]
    file: Path | None = None

    @property
    def label(self) -> str:
        """Name for a folder of pictures."""
        if self.file is not None:
            return f"{self.folder.name}_scan{self.scans[0]:02d}"
        return self.folder.name

    def path_of(self, scan: int) -> Path:
        """Where a scan is, for messages."""
        from tvbrdf_fitting.published.scan import DATA_FOLDER, scan_file_name

        folder = self.folder if self.file is not None else self.folder / DATA_FOLDER
        return folder / scan_file_name(scan, 1).replace("camera1", "camera*")


def find_targets(path: Path, scan: int | None) -> list[Target]:
    """Return the samples that a path means; raise :class:`RunError` if it means none."""
    from tvbrdf_fitting.published.scan import DATA_FOLDER, parse_scan_file_name

    from ..errors import RunError

    if not path.exists():
        raise RunError(f"{path}: there is no such file or folder")
    if not path.is_dir():
        parsed = parse_scan_file_name(path.name)
        if parsed is None:
            raise RunError(
                f"{path}: is not a scan file (scanTT_brdf_cameraV_allexposures.txt); give one, a "
                f"sample's folder (with {DATA_FOLDER}/), or a folder of samples"
            )
        if scan not in {None, parsed[0]}:
            raise RunError(f"{path}: is a file of scan {parsed[0]}, not of {scan}")
        if path.parent.name != DATA_FOLDER:
            return [Target(path.parent, parsed[:1], path)]
        return [Target(path.parent.parent, parsed[:1])]
    folder = path.parent if path.name == DATA_FOLDER else path
    folders = [folder] if (folder / DATA_FOLDER).is_dir() else _samples_below(folder)
    if not folders:
        raise RunError(
            f"{path}: holds neither {DATA_FOLDER}/ nor folders with it; give a sample, a folder of "
            "samples, or a scan file"
        )
    return [Target(one, () if scan is None else (scan,)) for one in folders]


def _samples_below(folder: Path) -> list[Path]:
    from tvbrdf_fitting.published import list_samples
    from tvbrdf_fitting.published.scan import DATA_FOLDER

    numbered = list_samples(folder)
    others = sorted(path for path in folder.iterdir() if path not in numbered)
    return [path for path in [*numbered, *others] if (path / DATA_FOLDER).is_dir()]


@dataclass(frozen=True, eq=False)
class _Read:
    """A scan that was read."""

    published: PublishedScan
    observations: Observations
    common: CommonErrors | None
    source: DataSource
    time_s: float | None
    remarks: tuple[str, ...]


def fit_sample(target: Target, request: Request) -> FittedSample:
    """Read and fit a sample's scans; those that can't be are in its ``failures``.

    Raises
    ------
    RunError
        What concerns the sample as a whole: nothing to fit, files that disagree, a request that
        no scan can fulfil.
    """
    from tvbrdf_fitting.problem import FitError
    from tvbrdf_fitting.published import PublishedFormatError
    from tvbrdf_rendering.fit_report import FittedSample

    from ..errors import RunError

    try:
        sample, numbers = _companions(target, request)
    except PublishedFormatError as error:
        raise RunError(str(error)) from error
    stored, remarks = _stored_scans(target, request)
    read: dict[int, _Read] = {}
    failures: list[str] = []
    for number in numbers:
        try:
            read[number] = _read(target, number, sample, stored.get(number))
        except _data_errors() as error:
            failures.append(str(error))
    if not read:
        return FittedSample(target.folder.name, "", target.folder, (), (), tuple(failures))
    remarks += _suspicions(target, sample, read)
    try:
        fits = dict(_fits(target, read, request, failures))
    except (FitError, ValueError) as error:
        raise RunError(f"{target.folder}: {error}") from error
    info = None if sample is None else sample.info
    return FittedSample(
        name=target.label if info is None else info.sample_name,
        process="" if info is None else info.process,
        folder=target.folder,
        scans=tuple(_fitted(number, read[number], *fits[number]) for number in fits),
        remarks=remarks,
        failures=tuple(failures),
    )


def _data_errors() -> tuple[type[Exception], ...]:
    from tvbrdf_fitting.published import PublishedFormatError
    from tvbrdf_fitting.published.database import DatabaseError

    return PublishedFormatError, DatabaseError


def _companions(target: Target, request: Request) -> tuple[PublishedSample | None, tuple[int, ...]]:
    """What lies beside the scans, and which scans are asked for."""
    from tvbrdf_fitting.published import PublishedFormatError, list_scans, read_sample

    if target.file is not None:
        if request.calibration is not None:
            raise PublishedFormatError(
                target.file, None, "a calibration needs a sample's folder around the file"
            )
        return None, target.scans
    sample = read_sample(target.folder, calibration=request.calibration, scans=())
    known = list_scans(target.folder)
    lost = [number for number in target.scans if number not in known]
    if lost:
        raise PublishedFormatError(
            target.folder, None, f"has no scan {lost[0]}; it has {_ranges(known)}"
        )
    return sample, target.scans or known


def _ranges(numbers: Sequence[int]) -> str:
    if len(numbers) > 6 and numbers[-1] - numbers[0] == len(numbers) - 1:
        return f"{numbers[0]} to {numbers[-1]}"
    return ", ".join(map(str, numbers))


def _stored_scans(
    target: Target, request: Request
) -> tuple[dict[int, StoredScan], tuple[str, ...]]:
    """Scans of which the database around the sample has kept the frames, and what is amiss."""
    from tvbrdf_fitting.published.database import (
        CATALOGUE_FILE,
        OBSERVATIONS_FOLDER,
        DatabaseError,
        read_database,
    )

    kept = target.folder / OBSERVATIONS_FOLDER
    if request.grid or target.file is not None or not kept.is_dir():
        return {}, ()
    database = target.folder.parent
    if not (database / CATALOGUE_FILE).is_file():
        return {}, (f"{kept} is not used: {database} has no {CATALOGUE_FILE}",)
    try:
        samples = read_database(database).samples
    except DatabaseError as error:
        return {}, (f"the frames in {kept} are not used: {error}",)
    own = [sample for sample in samples if sample.folder.resolve() == target.folder.resolve()]
    return {scan.scan: scan for sample in own for scan in sample.scans}, ()


def _read(
    target: Target, number: int, sample: PublishedSample | None, stored: StoredScan | None
) -> _Read:
    from tvbrdf_fitting.published import read_scan
    from tvbrdf_fitting.published.checks import check_cameras, check_scan
    from tvbrdf_fitting.published.database import DatabaseError
    from tvbrdf_fitting.published.observations import stored_observations

    published = read_scan(target.file or target.folder, number)
    grid = published.observations(None if sample is None else sample.calibration)
    remarks = check_scan(published) + check_cameras(grid)
    info = None if sample is None or sample.info is None else sample.info.scans
    time_s = next((scan.time_s for scan in info or () if scan.scan == number), None)
    if stored is None:
        return _Read(published, grid, None, "grid", time_s, remarks)
    try:
        frames, common = stored_observations(stored)
    except DatabaseError as error:
        raise DatabaseError(f"{error}, or fit the published grid with --grid") from error
    return _Read(published, frames, common, "frames", stored.time_s, remarks)


def _suspicions(
    target: Target, sample: PublishedSample | None, read: Mapping[int, _Read]
) -> tuple[str, ...]:
    """What is suspicious in the sample as a whole."""
    from tvbrdf_fitting.published.checks import (
        check_files,
        check_name,
        check_parameters,
        check_series,
        diffuse_colour,
    )

    colours = {number: diffuse_colour(one.observations) for number, one in read.items()}
    first = next(iter(colours))
    remarks = check_series(colours)
    if sample is None:
        return remarks
    missing = () if sample.info is None else tuple(scan for scan, _ in sample.info.missing)
    remarks = check_files(target.folder, missing) + remarks
    if sample.parameters is not None and first in sample.parameter_scans:
        row = sample.parameters[sample.parameter_scans.index(first)]
        remarks += check_parameters(colours[first], row[:3])
    name = target.folder.name if sample.info is None else sample.info.sample_name
    return remarks + check_name(name, colours[first])


def _fits(
    target: Target, read: Mapping[int, _Read], request: Request, failures: list[str]
) -> Iterable[tuple[int, tuple[FitResult, ModelChoice | None]]]:
    from tvbrdf_fitting.fit import fit_scan
    from tvbrdf_fitting.problem import FitError

    _load_solver(next(iter(read.values())).observations, request)
    if request.model == AUTO:
        choices = _choices(list(read.values()), request)
        for number, choice in zip(read, choices, strict=True):
            yield number, (choice.result, choice)
        return
    reasons: dict[int, str] = {}
    for number, one in read.items():
        try:
            fit = fit_scan(
                one.observations, request.model, common_errors=one.common, **request.options
            )
        except (FitError, ValueError) as error:
            reasons[number] = str(error)
        else:
            yield number, (fit, None)
    if len(reasons) == len(read) > 1 and len(set(reasons.values())) == 1:
        raise FitError(f"no scan can be fitted: {reasons.popitem()[1]}")
    failures += [
        f"{target.path_of(number)}: scan {number} can't be fitted: {reason}"
        for number, reason in reasons.items()
    ]


def _load_solver(observations: Observations, request: Request) -> None:
    """Fit a few rows in vain: the first fit loads compiled code, which is no time of solving."""
    from tvbrdf_fitting.fit import fit_scan
    from tvbrdf_fitting.models import SURFACE

    model = SURFACE if request.model == AUTO else request.model
    with suppress(ValueError):
        fit_scan(observations.select(slice(None, None, _ROWS_IN_VAIN)), model, **request.options)


def _choices(read: Sequence[_Read], request: Request) -> Sequence[ModelChoice]:
    """Choose a model for one scan, or one for all; each scan has errors that its frames share."""
    from tvbrdf_fitting.choice.choose import choose_for_series, choose_model

    scans, common = [one.observations for one in read], [one.common for one in read]
    if len(read) == 1:
        return [choose_model(scans[0], common_errors=common[0], **request.options)]
    mode: Literal["joint", "per_scan"] = "per_scan" if request.scan_by_scan else "joint"
    return choose_for_series(scans, mode=mode, common_errors=common, **request.options)


def _fitted(number: int, read: _Read, fit: FitResult, choice: ModelChoice | None) -> FittedScan:
    from tvbrdf_rendering.fit_report import FittedScan

    return FittedScan(
        scan=number,
        time_s=read.time_s,
        exposures_ms=read.published.exposures_ms,
        observations=read.observations,
        source=read.source,
        fit=fit,
        choice=choice,
        remarks=read.remarks,
    )
