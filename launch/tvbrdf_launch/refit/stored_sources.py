"""Databases of a run, and samples in the published text layout, as sources."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tvbrdf_messages.envelope import Envelope, Header
from tvbrdf_messages.messages import Mark, Radiance

from ..errors import RunError
from .events import Aside, Event, Problem, Progress, Unfinished
from .pipeline import Pipeline
from .records import content_facts, file_facts, outcome, parts_of, settings_text
from .settings import RADIANCE, Plan, Settings
from .sources import Unit, input_errors

if TYPE_CHECKING:
    from tvbrdf_fitting.published import PublishedSample, PublishedScan
    from tvbrdf_fitting.published.database import StoredSample

_CHUNK = 16
"""Scans that a process works through before it asks for more."""


def _check(path: Path, settings: Settings) -> None:
    if settings.start not in {None, RADIANCE}:
        raise RunError(f"{path}: has radiances only; leave --from {settings.start} out")


def _chunks(scans: Sequence[int], done: frozenset[int], plan: Plan) -> list[Unit]:
    left = [scan for scan in scans if scan not in done]
    size = len(left) if plan.sequential else _CHUNK
    starts = range(0, len(left), max(1, size))
    units = [Unit(frozenset(left[k : k + size]), with_asides=k == 0) for k in starts]
    return units or [Unit(frozenset())]


def _fit(
    source: str,
    envelopes: Iterable[Envelope],
    plan: Plan,
    count: int,
    facts: dict[int, list[dict[str, Any]]],
    *,
    with_messages: bool,
) -> Iterator[Event]:
    """Fit radiances one by one."""
    settings = settings_text(plan)
    with Pipeline(plan) as pipeline:
        for number, fitted in enumerate(pipeline.run(envelopes), start=1):
            files = facts.pop(getattr(fitted.parameters.message, "scan", 0))
            yield outcome(fitted, source, settings, files, (), with_messages=with_messages)
            yield Progress(number / max(1, count))


@dataclass(frozen=True)
class DatabaseSource:
    """A database that a run has written, with the observations of each scan."""

    path: Path
    keeps_radiance: bool = True

    def plan(self, settings: Settings) -> Plan:
        """See :class:`~.sources.Source`."""
        _check(self.path, settings)
        if settings.calibration is not None:
            raise RunError(
                f"{self.path}: its radiances are calibrated; a calibration is for frames, which "
                "are in the run's bag"
            )
        self._sample()
        return Plan(RADIANCE, settings.fitter({}))

    def _sample(self) -> StoredSample:
        from tvbrdf_fitting.published.database import DatabaseError, read_database

        samples = read_database(self.path).samples
        if not samples or not samples[0].scans:
            raise DatabaseError(f"{self.path}: has no measured scan: there is nothing to refit")
        return samples[0]

    def facts(self) -> dict[str, Any]:
        """See :class:`~.sources.Source`."""
        sample = self._sample()
        return {
            "sample": sample.name,
            "process": sample.process,
            "start_ns": sample.scans[0].start_stamp_ns,
            "run": sample.run_id,
        }

    def hashes(self, scan: int) -> list[dict[str, Any]] | None:
        """See :class:`~.sources.Source`."""
        return next(
            (
                [file_facts(one.observations_path)]
                for one in self._sample().scans
                if one.scan == scan
            ),
            [],
        )

    def units(self, jobs: int, sources: int, done: frozenset[int], plan: Plan) -> list[Unit]:
        """See :class:`~.sources.Source`."""
        return _chunks([scan.scan for scan in self._sample().scans], done, plan)

    def work(self, unit: Unit, plan: Plan) -> Iterator[Event]:
        """See :class:`~.sources.Source`."""
        from tvbrdf_nodes.database_writer.conversion import stored_radiance

        sample = self._sample()
        scans = [scan for scan in sample.scans if unit.wants(scan.scan)]
        facts: dict[int, list[dict[str, Any]]] = {}
        problems: list[Problem] = []

        def read() -> Iterator[Envelope]:
            for scan in scans:
                try:
                    message = stored_radiance(sample.name, scan)
                    facts[scan.scan] = [file_facts(scan.observations_path)]
                except input_errors() as error:
                    problems.append(Problem(str(error), scan.scan))
                    continue
                stamp_ns = int(message.stamp_ns.max(initial=scan.start_stamp_ns))
                yield _envelope(message, scan.scan, stamp_ns)

        name = self.path.resolve().name
        yield from _fit(name, read(), plan, len(scans), facts, with_messages=True)
        yield from problems
        if not unit.with_asides:
            return
        for note in sample.notes:
            mark = Mark(text=note.text, zero=note.zero)
            header = Header("operator", "", "", "", 0, note.stamp_ns)
            yield Aside(parts_of(Envelope("/operator/mark", header, mark)))
        for lost in sample.missing:
            yield Unfinished(lost.scan, sample.name, lost.time_s or 0.0, lost.reason)


@dataclass(frozen=True)
class PublishedSource:
    """A sample in the published text layout; its noise is estimated from the scan itself."""

    path: Path
    keeps_radiance: bool = False

    def plan(self, settings: Settings) -> Plan:
        """See :class:`~.sources.Source`."""
        _check(self.path, settings)
        return Plan(RADIANCE, settings.fitter({}), calibration=settings.calibration)

    def facts(self) -> dict[str, Any]:
        """See :class:`~.sources.Source`."""
        info = _read_companions(self.path, None).info
        return {
            "sample": self.path.resolve().name if info is None else info.sample_name,
            "process": "" if info is None else info.process,
        }

    def hashes(self, scan: int) -> list[dict[str, Any]] | None:
        """See :class:`~.sources.Source`."""
        from tvbrdf_fitting.published.scan import CAMERAS, DATA_FOLDER, scan_file_name

        files = (self.path / DATA_FOLDER / scan_file_name(scan, camera) for camera in CAMERAS)
        return [*(file_facts(file) for file in files if file.exists()), *self._calibration_facts()]

    def _calibration_facts(self) -> list[dict[str, Any]]:
        from tvbrdf_fitting.published.sample import CALIBRATION_FILE

        file = self.path / CALIBRATION_FILE
        return [file_facts(file)] if file.exists() else []

    def units(self, jobs: int, sources: int, done: frozenset[int], plan: Plan) -> list[Unit]:
        """See :class:`~.sources.Source`."""
        from tvbrdf_fitting.published import list_scans

        return _chunks(list_scans(self.path), done, plan)

    def work(self, unit: Unit, plan: Plan) -> Iterator[Event]:
        """See :class:`~.sources.Source`."""
        from tvbrdf_fitting.published import read_scan

        companions, calibration = _read_companions(self.path, plan), self._calibration_facts()
        scans, name = sorted(unit.scans or ()), self.path.resolve().name
        facts: dict[int, list[dict[str, Any]]] = {}
        problems: list[Problem] = []

        def read() -> Iterator[Envelope]:
            for scan in scans:
                files: list[dict[str, Any]] = []
                try:
                    published = read_scan(self.path, scan, read=partial(_read_noting, files))
                except input_errors() as error:
                    problems.append(Problem(str(error), scan))
                    continue
                facts[scan] = [*files, *calibration]
                message = _radiance(published, companions, name)
                yield _envelope(message, scan, message.scan_start_ns)

        yield from _fit(name, read(), plan, len(scans), facts, with_messages=False)
        yield from problems


def _read_noting(files: list[dict[str, Any]], path: Path) -> bytes:
    """Return a file's bytes, and note its facts."""
    from tvbrdf_fitting.published.text import read_bytes

    data = read_bytes(path)
    files.append(content_facts(path, data))
    return data


def _envelope(message: Radiance, scan: int, stamp_ns: int) -> Envelope:
    return Envelope("/scan/radiance", Header("refit", "", "", "", scan, stamp_ns), message)


def _read_companions(folder: Path, plan: Plan | None) -> PublishedSample:
    """Return what lies beside the scans: information and calibration."""
    import tempfile

    from tvbrdf_fitting.published import read_sample

    if plan is None or plan.calibration is None:
        return read_sample(folder, scans=())
    with tempfile.TemporaryDirectory(prefix="tvbrdf-refit-") as place:
        path = Path(place) / plan.calibration.name
        path.write_bytes(plan.calibration.data)
        return read_sample(folder, scans=(), calibration=path)


def _radiance(published: PublishedScan, companions: PublishedSample, folder: str) -> Radiance:
    """Return a published scan as a message: one sweep, one row a light position."""
    from tvbrdf_fitting.geometry import light_world_angle_deg

    seen = published.observations(companions.calibration)
    info = companions.info
    at = next((one for one in info.scans if one.scan == published.scan), None) if info else None
    start_ns = 0 if at is None else at.stamp_ns
    rows, no_grid = len(seen.camera), np.empty((0, 0, 3))
    return Radiance(
        sample=folder if info is None else info.sample_name,
        scan=published.scan,
        attempt=1,
        scan_time_s=0.0 if at is None else at.time_s,
        scan_start_ns=start_ns,
        exposures_ms=published.exposures_ms,
        cameras=tuple(f"camera_{number}" for number in range(1, 5)),
        gain_relative_std=0.0,
        quality={},
        camera=seen.camera,
        sweep=np.zeros(rows, dtype=np.int64),
        exposure_ms=seen.exposure_ms,
        stamp_ns=np.full(rows, start_ns, dtype=np.int64),
        light_angle_deg=light_world_angle_deg(seen.light_direction),
        light_direction=seen.light_direction,
        view_direction=seen.view_direction,
        radiance=seen.radiance,
        variance=seen.variance,
        valid=seen.valid,
        light_angle_std_deg=np.zeros(1),
        grid_angle_deg=np.empty(0),
        grid_radiance=no_grid,
        grid_variance=no_grid,
        grid_valid=np.empty((0, 0, 3), dtype=bool),
        frame_relative_std=(0.0, 0.0, 0.0, 0.0),
    )
