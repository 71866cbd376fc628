"""From the reduced frames of one sweep to calibrated observations of all cameras.

A frame's stamp and the arm's path give the light's position; its patch's mean gives the radiance
(`.radiometry`). Observations stay as they are, one a frame, for the fit.

Errors are kept apart. ``variance`` is the random part, new in each frame. What all frames of a
sweep or a camera share (position of the light, lamp, radiometric constants) is carried as standard
deviations of their own and is not part of ``variance``. The dark level's variance is small and,
though shared by a sweep, counted with the random part.

The result does not depend on the order in which frames are given.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry import BoolArray, FloatArray, IntArray, above_horizon, light_direction
from .calibration import Calibration, CameraCalibration
from .frame_reduction import PatchStatistics, RegionStatistics
from .light_path import LightPath
from .radiometry import LampFactor, RegionRadiance, dark_level, lamp_factor, region_radiance

MAX_LIGHT_ANGLE_DEG = 90.0
_SAME_EXPOSURE = 0.05


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """What is kept of one frame.

    Parameters
    ----------
    camera, sweep : int
    exposure_ms : float
        As read back from the camera.
    stamp_ns : int
        Middle of the exposure on the run's clock.
    statistics : PatchStatistics
    lamp_on : bool
        False for dark frames.
    """

    camera: int
    sweep: int
    exposure_ms: float
    stamp_ns: int
    statistics: PatchStatistics
    lamp_on: bool = True


@dataclass(frozen=True, eq=False)
class SweepObservations:
    """Calibrated observations of all cameras in one sweep, ordered by (camera, stamp).

    Parameters
    ----------
    sweep : int
    exposure_ms : float
        Median of the frames'.
    direction : int
        +1 if the light went to larger world angles, -1 if to smaller.
    camera, stamp_ns : ndarray of int64, (n,)
    light_angle_deg, swept_deg, frame_exposure_ms : ndarray, (n,)
        World angle of the light in the middle of the exposure, and how far it went during it.
    radiance, variance : ndarray, (n, 3)
        Divided by the lamp factor.
    valid : ndarray of bool, (n, 3)
        False where light was clipped.
    lamp_factor, lamp_factor_std, lamp_measured : ndarray, (cameras, 3)
        See `tvbrdf_fitting.measurement.radiometry.LampFactor`.
    light_offset_std_deg : float
        Of the light's angle, shared by all cameras: from the arm's clock.
    camera_offset_std_deg : ndarray, (cameras,)
        Of the light's angle, shared by a camera's frames: from the camera's clock.
    dropped : mapping of str to int
        Frames left out, by reason: ``light_unknown``, ``out_of_range``, ``below_horizon``,
        ``hidden``, ``repeated``, ``other_exposure``.
    """

    sweep: int
    exposure_ms: float
    direction: int
    camera: IntArray
    stamp_ns: IntArray
    light_angle_deg: FloatArray
    swept_deg: FloatArray
    frame_exposure_ms: FloatArray
    radiance: FloatArray
    variance: FloatArray
    valid: BoolArray
    lamp_factor: FloatArray
    lamp_factor_std: FloatArray
    lamp_measured: BoolArray
    light_offset_std_deg: float
    camera_offset_std_deg: FloatArray
    dropped: Mapping[str, int]


@dataclass(frozen=True, eq=False)
class _CameraSweep:
    """One camera's part of a sweep."""

    frames: Sequence[FrameRecord]
    light_angle_deg: FloatArray
    swept_deg: FloatArray
    sample: RegionRadiance
    lamp: LampFactor


def sweep_observations(
    frames: Iterable[FrameRecord],
    dark_frames: Iterable[FrameRecord],
    path: LightPath,
    calibration: Calibration,
    *,
    camera_stamp_std_ns: Mapping[int, float],
    arm_stamp_std_ns: float,
) -> SweepObservations:
    """Calibrate the frames of one sweep, of all cameras.

    Left out are frames taken where the light's position is not known or was further than 90
    degrees from the vertical; where the light was below the sample's horizon (cosine below 1e-3)
    or hidden by the arm during any part of the exposure; frames whose exposure is not the sweep's;
    and repeated ones. A channel with clipped light stays as a row that is not valid.

    Parameters
    ----------
    frames : iterable of FrameRecord
        Lamp-on frames, in any order. Records with ``lamp_on`` False are passed over.
    dark_frames : iterable of FrameRecord
        Lamp-off frames of the scan; those of the same camera and exposure are used.
    path : LightPath
        The arm's in this sweep.
    camera_stamp_std_ns : mapping of int to float
        Standard deviation shared by a camera's stamps (clock model and frame delay).
    arm_stamp_std_ns : float
        The same for the arm's reports.

    Raises
    ------
    ValueError
        If there are no frames, frames of several sweeps or of a camera that is not calibrated, or
        dark frames or reference cannot be true.
    """
    lit = [frame for frame in frames if frame.lamp_on]
    numbers = sorted({frame.sweep for frame in lit})
    if len(numbers) != 1:
        raise ValueError(
            f"a sweep's frames carry the sweep numbers {numbers}; give the lamp-on frames of "
            "exactly one sweep"
        )
    for frame in lit:
        calibration.camera(frame.camera)
    exposure_ms = float(np.median([frame.exposure_ms for frame in lit]))
    dark = [
        frame
        for frame in dark_frames
        if not frame.lamp_on and _same_exposure(frame.exposure_ms, exposure_ms)
    ]
    velocity_deg_s = _typical_velocity_deg_s(path, lit)
    speed_deg_s = abs(velocity_deg_s)
    light_offset_std_deg = speed_deg_s * arm_stamp_std_ns / 1e9
    dropped: Counter[str] = Counter()
    parts: list[_CameraSweep] = []
    camera_offsets = []
    for camera in calibration.cameras:
        number = camera.camera
        camera_offset = speed_deg_s * camera_stamp_std_ns.get(number, 0.0) / 1e9
        camera_offsets.append(camera_offset)
        parts.append(
            _camera_sweep(
                [frame for frame in lit if frame.camera == number],
                [frame for frame in dark if frame.camera == number],
                path,
                exposure_ms,
                float(np.hypot(camera_offset, light_offset_std_deg)),
                calibration,
                camera,
                dropped,
            )
        )
    kept = [frame for part in parts for frame in part.frames]
    return SweepObservations(
        sweep=numbers[0],
        exposure_ms=exposure_ms,
        direction=int(np.sign(velocity_deg_s)),
        camera=np.array([frame.camera for frame in kept], dtype=np.int64),
        stamp_ns=np.array([frame.stamp_ns for frame in kept], dtype=np.int64),
        light_angle_deg=np.concatenate([part.light_angle_deg for part in parts]),
        swept_deg=np.concatenate([part.swept_deg for part in parts]),
        frame_exposure_ms=np.array([frame.exposure_ms for frame in kept], dtype=np.float64),
        radiance=np.concatenate([part.sample.radiance / part.lamp.factor for part in parts]),
        variance=np.concatenate([part.sample.variance / part.lamp.factor**2 for part in parts]),
        valid=np.concatenate([part.sample.valid for part in parts]),
        lamp_factor=np.stack([part.lamp.factor for part in parts]),
        lamp_factor_std=np.stack([part.lamp.std for part in parts]),
        lamp_measured=np.stack([part.lamp.measured for part in parts]),
        light_offset_std_deg=light_offset_std_deg,
        camera_offset_std_deg=np.array(camera_offsets),
        dropped={reason: count for reason, count in sorted(dropped.items()) if count},
    )


def _camera_sweep(
    frames: Sequence[FrameRecord],
    dark_frames: Sequence[FrameRecord],
    path: LightPath,
    exposure_ms: float,
    offset_std_deg: float,
    calibration: Calibration,
    camera: CameraCalibration,
    dropped: Counter[str],
) -> _CameraSweep:
    frames = _in_order(frames, exposure_ms, dropped)
    stamps = np.array([frame.stamp_ns for frame in frames], dtype=np.int64)
    exposures = np.array([frame.exposure_ms for frame in frames], dtype=np.float64)
    angle = path.angle_at(stamps)
    swept = np.abs(path.speed_at(stamps)) * exposures / 1e3
    kept = _usable(angle, swept, calibration.tilt_deg, camera, dropped)
    frames = [frame for frame, keep in zip(frames, kept, strict=True) if keep]
    angle, swept, exposures = angle[kept], swept[kept], exposures[kept]
    dark = dark_level([frame.statistics.patch for frame in dark_frames], camera)
    sample = region_radiance([f.statistics.patch for f in frames], exposures, dark, camera)
    references = _references(frames)
    if references and len(references) == len(frames):
        reference_dark = dark_level(_references(dark_frames), camera)
        shown = region_radiance(references, exposures, reference_dark, camera)
        light = light_direction(angle, calibration.tilt_deg)
        lamp = lamp_factor(shown, light, offset_std_deg, calibration, camera)
    else:
        lamp = LampFactor(np.ones(3), np.zeros(3), np.zeros(3, dtype=np.bool_))
    return _CameraSweep(frames, angle, swept, sample, lamp)


def _references(frames: Sequence[FrameRecord]) -> list[RegionStatistics]:
    found = [frame.statistics.reference for frame in frames]
    return [reference for reference in found if reference is not None]


def _same_exposure(exposure_ms: float, other_ms: float) -> bool:
    return abs(exposure_ms - other_ms) <= _SAME_EXPOSURE * other_ms


def _in_order(
    frames: Sequence[FrameRecord], exposure_ms: float, dropped: Counter[str]
) -> list[FrameRecord]:
    """Frames by stamp, each stamp once, of the sweep's exposure only."""
    right = [frame for frame in frames if _same_exposure(frame.exposure_ms, exposure_ms)]
    dropped["other_exposure"] += len(frames) - len(right)
    # the means break ties, so that the choice among repeated frames never depends on arrival
    right.sort(key=lambda frame: (frame.stamp_ns, *frame.statistics.patch.mean_dn.tolist()))
    stamps = [frame.stamp_ns for frame in right]
    first = [i == 0 or stamps[i] != stamps[i - 1] for i in range(len(right))]
    dropped["repeated"] += len(right) - sum(first)
    return [frame for frame, keep in zip(right, first, strict=True) if keep]


def _usable(
    angle_deg: FloatArray,
    swept_deg: FloatArray,
    tilt_deg: float,
    camera: CameraCalibration,
    dropped: Counter[str],
) -> BoolArray:
    hidden = np.zeros(angle_deg.shape, dtype=np.bool_)
    for low, high in camera.hidden_light_intervals_deg:
        hidden |= (angle_deg + swept_deg / 2 >= low) & (angle_deg - swept_deg / 2 <= high)
    reasons = {
        "light_unknown": ~np.isfinite(angle_deg),
        "out_of_range": np.abs(angle_deg) > MAX_LIGHT_ANGLE_DEG + 1e-9,
        # a mean over light that partly shines from below is no radiance of any direction
        "below_horizon": ~(
            above_horizon(light_direction(angle_deg - swept_deg / 2, tilt_deg))
            & above_horizon(light_direction(angle_deg + swept_deg / 2, tilt_deg))
        ),
        "hidden": hidden,
    }
    kept = np.ones(angle_deg.shape, dtype=np.bool_)
    for reason, applies in reasons.items():
        dropped[reason] += int(np.count_nonzero(kept & applies))
        kept &= ~applies
    return kept


def _typical_velocity_deg_s(path: LightPath, frames: Sequence[FrameRecord]) -> float:
    """Median over the frames, with the sweep's direction as sign."""
    velocity = path.speed_at(np.array([frame.stamp_ns for frame in frames], dtype=np.int64))
    known = velocity[np.isfinite(velocity)]
    return float(np.median(known)) if known.size else 0.0
