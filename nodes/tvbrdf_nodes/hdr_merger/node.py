"""The HDR merger: turns frames and arm states into each scan's calibrated radiance.

A frame's pixels are reduced as soon as it arrives; everything else waits until arm and cameras
have sent their end-of-sweep marks, and is then worked through in an order that does not depend on
how it arrived. So a refit of what was recorded equals the live run.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import ArmState, Frame, Radiance, ScanCommand, Stored, SweepResult
from tvbrdf_messages.topics import frame_topic

from ..core.device import DeviceError
from ..core.node import Node, NodeContext, Outputs, Release, Send, TopicUse
from .calibration_source import check_calibration, read_calibration
from .sweep import (
    ReducedFrame,
    Sweep,
    SweepError,
    SweepKey,
    check_arrived,
    check_complete,
    solve_sweep,
    split_states,
)

if TYPE_CHECKING:
    from tvbrdf_fitting.measurement.calibration import Calibration
    from tvbrdf_fitting.measurement.frame_reduction import FrameReducer
    from tvbrdf_fitting.measurement.scan_merge import ScanObservations
    from tvbrdf_fitting.measurement.sweep_merge import FrameRecord, SweepObservations

KEPT_STATES = 20_000
"""Of the arm since its last sweep: those of a sweep of six minutes."""
KEPT_SWEEPS, KEPT_COMMANDS = 12, 1000
"""Sweeps that were given up stay until their scan or a later one is published, or these are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HdrMergerParameters:
    """Whose frames are merged, and how their codes become radiance."""

    calibration: str
    """Path of the calibration file, or of a bag that has one inside."""
    cameras: tuple[str, ...] = ("camera_1", "camera_2", "camera_3", "camera_4")
    """In the calibration's order: the first is its camera 1."""
    arm: str = "arm"
    bit_depth: int | None = None
    """Of the frames, where it is not the calibration's."""
    correct_motion_blur: bool = True
    """Frames average over the light's way during their exposure; only a simulation may not."""
    replayed: bool = False
    """A player tells what was commanded, where it moves nothing (``/replay/command``)."""

    def __post_init__(self) -> None:
        """Refuse a calibration that is not there, before anything starts."""
        check_calibration(self.calibration)


class HdrMergerNode(Node[HdrMergerParameters]):
    """Turns ``/<camera>/frame`` and ``/arm/state`` into ``/scan/radiance``."""

    parameters_type = HdrMergerParameters

    def __init__(self, context: NodeContext, parameters: HdrMergerParameters) -> None:
        super().__init__(context, parameters)
        self._numbers = {name: index + 1 for index, name in enumerate(parameters.cameras)}
        self._calibration: Calibration | None = None
        self._reducers: dict[int, FrameReducer] = {}
        self._sweeps: dict[SweepKey, Sweep] = {}
        self._states: list[Envelope] = []
        self._commands: dict[SweepKey, ScanCommand] = {}
        self._dark: dict[tuple[int, int], list[tuple[tuple[Any, ...], FrameRecord]]] = {}
        self._dark_sent: dict[tuple[int, int], dict[str, int]] = {}
        """How many each camera has sent, as it says when it has."""
        self._done: dict[int, dict[int, tuple[SweepObservations, dict[str, Any]]]] = {}
        """Good sweeps of each scan that is under way."""
        self._unstored: dict[int, set[str]] = {}
        self._frames = self._lost = 0
        self._refused: SweepKey | None = None

    @classmethod
    def topics(cls, name: str, parameters: HdrMergerParameters) -> TopicUse:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return TopicUse(
            takes=(
                "/clock",
                "/replay/command" if parameters.replayed else "/scan/command",
                "/scan/sweep_result",
                "/scan/stored",
                "/arm/state",
                *(frame_topic(camera) for camera in parameters.cameras),
            ),
            gives=("/scan/radiance", "/scan/sweep_result", "/diagnostics", "/log"),
        )

    def prepare(self) -> None:
        """Read the calibration and make the tables that frames are reduced with."""
        import cv2

        import tvbrdf_fitting.measurement.light_grid  # noqa: F401 - loaded now rather than in the first scan
        from tvbrdf_fitting.measurement.calibration import CalibrationError
        from tvbrdf_fitting.measurement.frame_reduction import FrameReducer

        cv2.setNumThreads(1)
        try:
            calibration = read_calibration(self.parameters.calibration)
            bit_depth = self.parameters.bit_depth
            if bit_depth is not None:
                cameras = tuple(c.with_bit_depth(bit_depth) for c in calibration.cameras)
                calibration = replace(calibration, cameras=cameras)
            for number in self._numbers.values():
                self._reducers[number] = FrameReducer(calibration.camera(number))
        except CalibrationError as error:
            raise DeviceError(str(error)) from error
        self._calibration = calibration

    # -- what comes in

    def on_epoch(self, epoch: int) -> Outputs:
        """Empty all buffers: a replay has jumped."""
        buffers = (self._sweeps, self._commands, self._dark, self._dark_sent, self._done)
        for buffer in (self._states, *buffers):
            buffer.clear()
        self._refused = None
        return ()

    def handle(self, envelope: Envelope) -> Outputs:
        """Take frames, states, commands and end-of-sweep marks."""
        message = envelope.message
        if isinstance(message, Frame):
            yield from self._take_frame(envelope, message)
        elif isinstance(message, ArmState):
            self._states.append(envelope)
            if len(self._states) > KEPT_STATES:
                del self._states[: KEPT_STATES // 10]
        elif isinstance(message, ScanCommand):
            yield from self._take_command(message)
        elif isinstance(message, SweepResult):
            yield from self._take_result(envelope, message)
        elif isinstance(message, Stored):
            yield from self._take_stored(message)

    def _take_command(self, command: ScanCommand) -> Outputs:
        if command.action == "prepare":
            key = (command.scan, command.sweep, command.attempt)
            self._commands[key] = command
            _keep_last(self._commands, KEPT_COMMANDS)
            yield from self._finish_when_whole(key)

    def _take_frame(self, envelope: Envelope, frame: Frame) -> Outputs:
        number = self._numbers.get(frame.camera)
        if number is None or frame.kind == "still":
            return
        header = envelope.header
        try:
            statistics = self._reducers[number].reduce(frame.image)
        except ValueError as error:
            key = (frame.scan, frame.sweep, frame.attempt)
            if key != self._refused:  # say it once, not for every frame
                self._refused = key
                yield self._result(key, "broken", str(error))
            return
        self._frames += 1
        if frame.kind == "dark":
            from tvbrdf_fitting.measurement.sweep_merge import FrameRecord

            record = FrameRecord(
                number, -1, frame.exposure_ms, header.stamp_ns, statistics, lamp_on=False
            )
            order = (number, header.incarnation, header.sequence)
            self._dark.setdefault((frame.scan, frame.attempt), []).append((order, record))
            _keep_last(self._dark, KEPT_SWEEPS)
            return
        sweep = self._sweep((frame.scan, frame.sweep, frame.attempt))
        sweep.frames.setdefault(number, []).append(
            ReducedFrame(
                header.incarnation,
                header.sequence,
                frame.exposure_ms,
                header.hardware_ns,
                header.received_ns,
                statistics,
            )
        )

    def _sweep(self, key: SweepKey) -> Sweep:
        sweep = self._sweeps.setdefault(key, Sweep())
        _keep_last(self._sweeps, KEPT_SWEEPS)
        return sweep

    def _take_result(self, envelope: Envelope, result: SweepResult) -> Outputs:
        if result.state != "done" or result.action not in ("sweep", "dark"):
            return
        if result.action == "dark":
            if result.source in self._numbers:
                sent = self._dark_sent.setdefault((result.scan, result.attempt), {})
                sent[result.source] = result.frames
                _keep_last(self._dark_sent, KEPT_SWEEPS)
            return
        if result.source != self.parameters.arm and result.source not in self._numbers:
            return
        key = (result.scan, result.sweep, result.attempt)
        sweep = self._sweep(key)
        sweep.results[result.source] = result
        if result.source == self.parameters.arm:
            sweep.arm_incarnation = envelope.header.incarnation
        yield from self._finish_when_whole(key)

    # -- a sweep is whole

    def _finish_when_whole(self, key: SweepKey) -> Outputs:
        """Work through a sweep once its command and everybody's end of it are there."""
        sweep, command = self._sweeps.get(key), self._commands.get(key)
        if sweep is None or command is None or len(sweep.results) <= len(self._numbers):
            return
        yield from self._finish(key, sweep, command)

    def _finish(self, key: SweepKey, sweep: Sweep, command: ScanCommand) -> Outputs:
        del self._sweeps[key]
        scan, number, _ = key
        states, self._states = split_states(
            self._states, sweep.results[self.parameters.arm], sweep.arm_incarnation
        )
        try:
            check_complete(sweep, self._numbers)
            if number == 0:
                self._check_dark(scan)  # they are taken before it, and with it again
            found = solve_sweep(
                sweep,
                key,
                self._dark_frames(scan),
                states,
                self._calibrated(),
                self.parameters.arm,
                correct_motion_blur=self.parameters.correct_motion_blur,
            )
        except SweepError as error:
            self._lost += error.lost
            yield self._result(key, "broken", str(error))
            return
        done = self._done.setdefault(scan, {})
        _keep_last(self._done, KEPT_SWEEPS)
        if number == 0:
            done.clear()  # the scan was begun anew
        done[number] = found
        if len(done) == len(command.exposures_ms):
            yield from self._publish(command)
        elif number + 1 == len(command.exposures_ms):
            missing = sorted(set(range(number)) - set(done))
            yield self._result(key, "broken", f"sweeps {missing} of the scan were lost here")
            return
        yield self._result(key, "done")

    def _check_dark(self, scan: int) -> None:
        """Refuse a scan's first sweep if dark frames of the last attempt at them are missing."""
        attempts = [key for key in self._dark_sent if key[0] == scan]
        if attempts:
            last = max(attempts)
            arrived = Counter(order[0] for order, _ in self._dark.get(last, ()))
            got = {name: arrived[number] for name, number in self._numbers.items()}
            check_arrived(self._dark_sent[last], got, "dark frames")

    def _dark_frames(self, scan: int) -> list[FrameRecord]:
        """Return the dark frames of the scan's last attempt at them, in a fixed order."""
        attempts = sorted(key for key in self._dark if key[0] == scan)
        if not attempts:
            return []
        found = sorted(self._dark[attempts[-1]], key=lambda pair: pair[0])
        return [record for _, record in found]

    def _publish(self, command: ScanCommand) -> Outputs:
        from tvbrdf_fitting.measurement.light_grid import merge_on_grid
        from tvbrdf_fitting.measurement.scan_merge import assemble_scan

        calibration = self._calibrated()
        done = self._done[command.scan]
        self._forget(command.scan)
        scan = assemble_scan([observations for observations, _ in done.values()], calibration)
        grid = merge_on_grid(scan, calibration)
        radiance = Radiance(
            sample=command.sample,
            scan=command.scan,
            attempt=command.attempt,
            scan_time_s=command.scan_time_s,
            scan_start_ns=command.scan_start_ns,
            exposures_ms=command.exposures_ms,
            cameras=self.parameters.cameras,
            gain_relative_std=_gain_std(scan),
            quality=_quality(scan, {number: facts for number, (_, facts) in done.items()}),
            camera=scan.camera,
            sweep=scan.sweep,
            exposure_ms=scan.exposure_ms,
            stamp_ns=scan.stamp_ns,
            light_angle_deg=scan.light_angle_deg,
            light_direction=scan.light_direction,
            view_direction=scan.view_direction,
            radiance=scan.radiance,
            variance=scan.variance,
            valid=scan.valid,
            light_angle_std_deg=_light_std_deg(scan),
            grid_angle_deg=grid.light_angle_deg,
            grid_radiance=grid.radiance,
            grid_variance=grid.variance,
            grid_valid=grid.valid,
            frame_relative_std=tuple(
                calibration.camera(number).relative_noise_std for number in self._numbers.values()
            ),
        )
        self._unstored[command.scan] = {"radiance", "parameters"}
        yield Send(
            topic="/scan/radiance",
            message=radiance,
            stamp_ns=int(scan.stamp_ns[-1]),
            keep=str(command.scan),
        )

    def _forget(self, scan: int) -> None:
        """Drop what is left of a scan that was published, and of those before it."""
        self._sweeps = {key: value for key, value in self._sweeps.items() if key[0] > scan}
        self._commands = {key: value for key, value in self._commands.items() if key[0] > scan}
        self._dark = {key: value for key, value in self._dark.items() if key[0] > scan}
        self._dark_sent = {key: n for key, n in self._dark_sent.items() if key[0] > scan}
        self._done = {key: value for key, value in self._done.items() if key > scan}

    def _take_stored(self, stored: Stored) -> Outputs:
        left = self._unstored.get(stored.scan)
        if left is not None:
            left.discard(stored.what)
            if not left or (stored.what == "radiance" and stored.refused):
                del self._unstored[stored.scan]
                yield Release("/scan/radiance", str(stored.scan))

    def _result(self, key: SweepKey, state: str, reason: str = "") -> Send:
        scan, sweep, attempt = key
        message = SweepResult(
            source=self.context.name,
            command_id=0,
            action="sweep",
            state=state,
            reason=reason,
            scan=scan,
            sweep=sweep,
            attempt=attempt,
        )
        return Send(topic="/scan/sweep_result", message=message)

    def _calibrated(self) -> Calibration:
        if self._calibration is None:
            raise DeviceError("the calibration is not loaded")
        return self._calibration

    def diagnostics(self) -> dict[str, Any]:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return {
            "frames": self._frames,
            "frames_lost": self._lost,
            "unstored": len(self._unstored),
            "open_sweeps": len(self._sweeps),
            "kept_states": len(self._states),
        }


def _keep_last(kept: dict[Any, Any], count: int) -> None:
    """Drop the entries with the smallest keys beyond so many."""
    while len(kept) > count:
        del kept[min(kept)]


def _gain_std(scan: ScanObservations) -> float:
    """Return one deviation that stands for the scale's and the lamp factor's, the largest."""
    import numpy as np

    lamp = (scan.sweep_lamp_factor_std / scan.sweep_lamp_factor).max(axis=0)
    return float(np.hypot(scan.gain_relative_std, lamp).max())


def _light_std_deg(scan: ScanObservations) -> Any:
    import numpy as np

    return np.hypot(
        scan.sweep_light_offset_std_deg, scan.sweep_camera_offset_std_deg.max(axis=1)
    ).astype(np.float64)


def _quality(scan: ScanObservations, facts: dict[int, dict[str, Any]]) -> dict[str, Any]:
    return {
        "lamp_factor": scan.sweep_lamp_factor.tolist(),
        "dropped": dict(scan.dropped),
        "sweep_direction": scan.sweep_direction.tolist(),
        "sweeps": {str(number): fact for number, fact in sorted(facts.items())},
    }
