"""Which frames belong to which scan, and where the light was in each.

Stamps and the light's path are solved by the merger's own functions, a sweep at a time; pixels of
lit frames are not kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tvbrdf_fitting.geometry import above_horizon, light_direction
from tvbrdf_fitting.measurement.calibration import Calibration, CameraCalibration
from tvbrdf_fitting.measurement.clock_model import ClockError, frame_stamps
from tvbrdf_fitting.measurement.frame_reduction import FrameReducer, RegionStatistics
from tvbrdf_fitting.measurement.light_path import LightPath
from tvbrdf_fitting.measurement.radiometry import dark_level
from tvbrdf_messages.bag import BagReader
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import ArmState, Frame, ScanCommand, SweepResult
from tvbrdf_messages.topics import frame_topic
from tvbrdf_nodes.hdr_merger.sweep import SweepError, SweepKey, solve_arm, split_states

from .result import Progress
from .rig import Rig, cameras_of, topics_for_light

KEPT_STATES = 20_000
KEPT_SWEEPS = 12
MAX_LIGHT_ANGLE_DEG = 90.0
_SAME_EXPOSURE = 0.05


class Place(NamedTuple):
    """Where a frame is in the bag."""

    log_time_ns: int
    incarnation: str
    sequence: int


class Taken(NamedTuple):
    """What is kept of a frame until its sweep is whole."""

    place: Place
    exposure_ms: float
    hardware_ns: int
    received_ns: int


class LitFrame(NamedTuple):
    """A frame with its time and the light's position in the middle of its exposure."""

    place: Place
    exposure_ms: float
    stamp_ns: int
    light_angle_deg: float


@dataclass(frozen=True, eq=False)
class CameraSweep:
    """One camera's usable frames of one sweep, by the light's angle."""

    sweep: int
    exposure_ms: float
    frames: tuple[LitFrame, ...]
    dark_dn: NDArray[np.float64]
    """Linear dn without light, (3,), of the scan's dark frames, else the calibration's."""


@dataclass(frozen=True)
class Scan:
    """A whole scan: each camera's sweeps in order."""

    sample: str
    scan: int
    time_s: float
    cameras: Mapping[str, tuple[CameraSweep, ...]]


@dataclass
class _Open:
    """A sweep that is not whole yet."""

    frames: dict[str, list[Taken]] = field(default_factory=dict)
    results: dict[str, Envelope] = field(default_factory=dict)


class ScanBook:
    """Reads a bag and hands out its scans, each when its last sweep is whole."""

    def __init__(self, bag: BagReader, rig: Rig, progress: Progress) -> None:
        self._bag, self._rig, self._progress = bag, rig, progress
        self._names = [name for name in cameras_of(bag) if name in rig.cameras]
        import cv2

        cv2.setNumThreads(1)  # see FrameReducer
        self._reducers = {name: FrameReducer(self._camera(name)) for name in self._names}
        self._states: list[Envelope] = []
        self._open: dict[SweepKey, _Open] = {}
        self._commands: dict[SweepKey, ScanCommand] = {}
        self._dark: dict[tuple[int, int, str], list[tuple[float, RegionStatistics]]] = {}
        self._done: dict[int, dict[int, dict[str, CameraSweep]]] = {}
        self._given: set[int] = set()
        self._why: dict[int, str] = {}
        self._refused: dict[tuple[int, int], str] = {}
        """Frames that are not the calibrated camera's, by scan and attempt."""

    def _camera(self, name: str) -> CameraCalibration:
        return self._rig.calibration.camera(self._rig.cameras[name])

    def scans(self) -> Iterator[Scan]:
        """Yield the whole scans in the order in which they ended; a repeated one only once."""
        topics = [*topics_for_light(self._bag)]
        topics += [frame_topic(name) for name in self._names]
        for log_time_ns, envelope in self._bag.messages(topics):
            self._progress.at(log_time_ns)
            message = envelope.message
            if isinstance(message, Frame):
                self._take_frame(log_time_ns, envelope, message)
            elif isinstance(message, ArmState):
                self._states.append(envelope)
                if len(self._states) > KEPT_STATES:
                    del self._states[: KEPT_STATES // 10]
            elif isinstance(message, ScanCommand) and message.action == "prepare":
                key = (message.scan, message.sweep, message.attempt)
                self._commands[key] = message
                yield from self._finish(key)
            elif isinstance(message, SweepResult):
                yield from self._take_result(envelope, message)

    def unfinished(self) -> dict[int, str]:
        """Return the scans that were begun and not handed out, with the reason."""
        begun = {key[0] for key in self._commands if key[0] > 0} | {*self._why}
        why = "the bag does not have all of it"
        return {scan: self._why.get(scan, why) for scan in sorted(begun - self._given)}

    def _take_frame(self, log_time_ns: int, envelope: Envelope, frame: Frame) -> None:
        header = envelope.header
        if frame.kind not in {"dark", "light"}:
            return
        try:  # of lit ones too: so all their codes are known to be within the calibration's table
            region = self._reducers[frame.camera].reduce(frame.image).patch
        except ValueError as error:
            self._refused.setdefault((frame.scan, frame.attempt), str(error))
            return
        if frame.kind == "dark":
            key = (frame.scan, frame.attempt, frame.camera)
            self._dark.setdefault(key, []).append((frame.exposure_ms, region))
        else:
            place = Place(log_time_ns, header.incarnation, header.sequence)
            taken = Taken(place, frame.exposure_ms, header.hardware_ns, header.received_ns)
            sweep = self._sweep((frame.scan, frame.sweep, frame.attempt))
            sweep.frames.setdefault(frame.camera, []).append(taken)

    def _sweep(self, key: SweepKey) -> _Open:
        found = self._open.setdefault(key, _Open())
        while len(self._open) > KEPT_SWEEPS:
            del self._open[min(self._open)]
        return found

    def _take_result(self, envelope: Envelope, result: SweepResult) -> Iterator[Scan]:
        wanted = {self._rig.arm, *self._names}
        if result.action != "sweep" or result.source not in wanted:
            return
        if result.state != "done":
            self._why[result.scan] = f"{result.source}: sweep {result.sweep}: {result.reason}"
            return
        key = (result.scan, result.sweep, result.attempt)
        self._sweep(key).results[result.source] = envelope
        yield from self._finish(key)

    def _finish(self, key: SweepKey) -> Iterator[Scan]:
        """Work through a sweep once its command and everybody's end of it are there."""
        sweep, command = self._open.get(key), self._commands.get(key)
        if sweep is None or command is None or len(sweep.results) <= len(self._names):
            return
        del self._open[key]
        scan, number, attempt = key
        try:
            if (scan, attempt) in self._refused:
                raise SweepError(self._refused[scan, attempt])
            path = self._path(sweep)
            parts = {name: self._located(name, key, sweep, path) for name in self._names}
        except (SweepError, ClockError, ValueError) as error:
            self._why[scan] = f"sweep {number}: {error}"
            return
        if number == 0:
            self._done.pop(scan, None)  # the scan was begun anew
        done = self._done.setdefault(scan, {})
        done[number] = parts
        if len(done) < len(command.exposures_ms) or scan in self._given:
            return
        self._given.add(scan)
        self._forget(scan)
        cameras = {n: tuple(done[k][n] for k in sorted(done)) for n in self._names}
        yield Scan(command.sample, scan, command.scan_time_s, cameras)

    def _forget(self, scan: int) -> None:
        self._done = {key: value for key, value in self._done.items() if key > scan}
        self._dark = {key: value for key, value in self._dark.items() if key[0] > scan}

    def _path(self, sweep: _Open) -> LightPath:
        envelope = sweep.results[self._rig.arm]
        result = envelope.message
        if not isinstance(result, SweepResult):
            raise TypeError(f"{envelope.topic} is no result of a sweep")
        states, self._states = split_states(self._states, result, envelope.header.incarnation)
        path: LightPath = solve_arm(states, result)[0]
        return path

    def _located(self, name: str, key: SweepKey, sweep: _Open, path: LightPath) -> CameraSweep:
        frames = sorted(sweep.frames.get(name, ()), key=lambda taken: taken.place[1:])
        result = sweep.results[name].message
        told = result.frames if isinstance(result, SweepResult) else 0
        if not frames or len(frames) != told:
            raise SweepError(f"{name} sent {told} frames, {len(frames)} are in the bag")
        camera = self._camera(name)
        stamps = frame_stamps(
            [frame.hardware_ns for frame in frames],
            [frame.received_ns for frame in frames],
            [frame.exposure_ms for frame in frames],
            camera,
        ).stamp_ns
        angles = path.angle_at(stamps)
        swept = np.abs(path.speed_at(stamps)) * [frame.exposure_ms / 1e3 for frame in frames]
        usable = usable_light(angles, swept, self._rig.calibration, camera)
        lit = [
            LitFrame(frame.place, frame.exposure_ms, int(stamp), float(angle))
            for frame, stamp, angle, good in zip(frames, stamps, angles, usable, strict=True)
            if good
        ]
        exposure_ms = float(np.median([frame.exposure_ms for frame in frames]))
        return CameraSweep(
            sweep=key[1],
            exposure_ms=exposure_ms,
            frames=tuple(sorted(lit, key=lambda frame: (frame.light_angle_deg, frame.stamp_ns))),
            dark_dn=self._dark_dn(name, key[0], exposure_ms),
        )

    def _dark_dn(self, name: str, scan: int, exposure_ms: float) -> NDArray[np.float64]:
        """Return the dark level that the merger takes: of the scan's last attempt at it."""
        attempts = [key[1] for key in self._dark if key[0] == scan]
        found = self._dark.get((scan, max(attempts), name), []) if attempts else []
        near = [
            region
            for taken_ms, region in found
            if abs(taken_ms - exposure_ms) <= _SAME_EXPOSURE * exposure_ms
        ]
        return dark_level(near, self._camera(name)).mean_dn


def usable_light(
    angle_deg: NDArray[np.float64],
    swept_deg: NDArray[np.float64],
    calibration: Calibration,
    camera: CameraCalibration,
) -> NDArray[np.bool_]:
    """Return where a frame shows the lit sample, as the merger has it.

    The light's position is known, it is above the sample's horizon, and the arm does not hide the
    sample from the camera, during all of the exposure.
    """
    low, high = angle_deg - swept_deg / 2, angle_deg + swept_deg / 2
    good = np.isfinite(angle_deg) & (np.abs(angle_deg) <= MAX_LIGHT_ANGLE_DEG + 1e-9)
    for side in (low, high):
        good &= above_horizon(light_direction(np.nan_to_num(side), calibration.tilt_deg))
    for begin, end in camera.hidden_light_intervals_deg:
        good &= ~((high >= begin) & (low <= end))
    return np.asarray(good)
