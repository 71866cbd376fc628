"""What the merger has of one sweep, until every device has said that its part has ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import ArmState, SweepResult

if TYPE_CHECKING:
    from tvbrdf_fitting.measurement.calibration import Calibration
    from tvbrdf_fitting.measurement.frame_reduction import PatchStatistics
    from tvbrdf_fitting.measurement.sweep_merge import FrameRecord, SweepObservations

SweepKey = tuple[int, int, int]
"""Scan, sweep, attempt."""


class ReducedFrame(NamedTuple):
    """A frame after its pixels were reduced; sorts by sequence, whenever it came."""

    incarnation: str
    sequence: int
    exposure_ms: float
    hardware_ns: int
    received_ns: int
    statistics: PatchStatistics


@dataclass(slots=True)
class Sweep:
    """Frames by camera number, and who has ended its part how."""

    frames: dict[int, list[ReducedFrame]] = field(default_factory=dict)
    results: dict[str, SweepResult] = field(default_factory=dict)
    arm_incarnation: str = ""
    """Of the arm's node that told its result: sequence numbers are this life's."""


class SweepError(ValueError):
    """A sweep that can't be used; the text says why, and it is taken again."""

    def __init__(self, text: str, lost: int = 0) -> None:
        super().__init__(text)
        self.lost = lost
        """Frames that were sent and have not arrived."""


def check_complete(sweep: Sweep, cameras: Mapping[str, int]) -> None:
    """Refuse a sweep of which frames are missing here."""
    for name in cameras:
        if sweep.results[name].frames == 0:
            raise SweepError(f"{name} saw no frame")
    sent = {name: sweep.results[name].frames for name in cameras}
    got = {name: len(sweep.frames.get(number, ())) for name, number in cameras.items()}
    check_arrived(sent, got, "frames")


def check_arrived(sent: Mapping[str, int], got: Mapping[str, int], what: str) -> None:
    """Refuse a sweep for which another number of frames has arrived than cameras have sent."""
    wrong = [name for name in sent if got.get(name, 0) != sent[name]]
    if wrong:
        texts = (f"{name} sent {sent[name]} {what}, {got.get(name, 0)} arrived" for name in wrong)
        lost = sum(max(0, sent[name] - got.get(name, 0)) for name in wrong)
        raise SweepError("; ".join(texts), lost)


def split_states(
    states: list[Envelope], result: SweepResult, incarnation: str
) -> tuple[list[Envelope], list[Envelope]]:
    """Return the states that the arm counted to a sweep, by number, and those sent after them.

    ``states`` are in the order in which the arm's node, or its successor, sent them.
    """
    chosen = {
        envelope.header.sequence: (index, envelope)
        for index, envelope in enumerate(states)
        if envelope.header.incarnation == incarnation
        and result.first_sequence <= envelope.header.sequence <= result.last_sequence
    }
    last = max((index for index, _ in chosen.values()), default=-1)
    return [chosen[number][1] for number in sorted(chosen)], states[last + 1 :]


def solve_arm(states: list[Envelope], result: SweepResult) -> tuple[Any, float, dict[str, float]]:
    """Return the light's path in a sweep, the deviation of its stamps (ns), and its clock."""
    from tvbrdf_fitting.measurement.clock_model import ClockError, fit_clock
    from tvbrdf_fitting.measurement.light_path import LightPath

    if len(states) != result.last_sequence - result.first_sequence + 1:
        raise SweepError(f"{result.source}: states of the sweep are missing")
    headers = [envelope.header for envelope in states]
    arms = [m for e in states if isinstance(m := e.message, ArmState)]
    delay_ns = arms[-1].one_way_delay_ns if arms else 0
    try:
        clock = fit_clock(
            [header.hardware_ns for header in headers],
            [header.received_ns - delay_ns for header in headers],
        )
        stamps = clock.to_run_ns([header.hardware_ns for header in headers])
        path = LightPath.from_reports(
            stamps,
            [state.angle_deg for state in arms],
            [state.speed_deg_s for state in arms],
        )
    except (ClockError, ValueError) as error:
        raise SweepError(f"{result.source}: {error}") from error
    middle = [headers[len(headers) // 2].hardware_ns]
    # the two ways of a round trip may share it in any proportion: uniform, so 1/sqrt(3) of a half
    std_ns = float((clock.std_ns(middle)[0] ** 2 + delay_ns**2 / 3.0) ** 0.5)
    facts = {"drift_ppm": 1e6 * clock.drift, "jitter_ms": clock.jitter_ns / 1e6}
    return path, std_ns, {**facts, "delay_ms": delay_ns / 1e6}


def solve_sweep(
    sweep: Sweep,
    key: SweepKey,
    dark: list[FrameRecord],
    states: list[Envelope],
    calibration: Calibration,
    arm: str,
    *,
    correct_motion_blur: bool = True,
) -> tuple[SweepObservations, dict[str, Any]]:
    """Return a sweep's calibrated observations, and what was found about its clocks."""
    from tvbrdf_fitting.measurement.clock_model import ClockError, frame_stamps
    from tvbrdf_fitting.measurement.motion_blur import without_motion_blur
    from tvbrdf_fitting.measurement.sweep_merge import FrameRecord, sweep_observations

    path, arm_std_ns, arm_facts = solve_arm(states, sweep.results[arm])
    records: list[FrameRecord] = []
    stds_ns: dict[int, float] = {}
    facts: dict[str, Any] = {"arm": arm_facts}
    for number, frames in sorted(sweep.frames.items()):
        frames.sort(key=lambda frame: frame[:2])
        try:
            stamps = frame_stamps(
                [frame.hardware_ns for frame in frames],
                [frame.received_ns for frame in frames],
                [frame.exposure_ms for frame in frames],
                calibration.camera(number),
            )
        except ClockError as error:
            raise SweepError(str(error)) from error
        stds_ns[number] = float(stamps.std_ns[len(frames) // 2])
        facts[f"camera {number}"] = {
            "frames": len(frames),
            "drift_ppm": 1e6 * stamps.clock.drift,
            "jitter_ms": stamps.clock.jitter_ns / 1e6,
        }
        records += [
            FrameRecord(number, key[1], frame.exposure_ms, int(stamp), frame.statistics)
            for frame, stamp in zip(frames, stamps.stamp_ns.tolist(), strict=True)
        ]
    try:
        observations = sweep_observations(
            records,
            dark,
            path,
            calibration,
            camera_stamp_std_ns=stds_ns,
            arm_stamp_std_ns=arm_std_ns,
        )
    except ValueError as error:
        raise SweepError(str(error)) from error
    if correct_motion_blur:
        observations = without_motion_blur(observations)
    return observations, {**facts, "dropped": dict(observations.dropped)}
