"""The three sweeps of a scan together, as the fit takes them.

See `.sweep_merge` for a sweep and for what is known of its errors, and `.light_grid` for the common
grid of the published files. The result does not depend on the order in which sweeps are given.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry import BoolArray, FloatArray, IntArray, light_direction
from ..observations import Observations
from .calibration import Calibration
from .sweep_merge import SweepObservations


@dataclass(frozen=True, eq=False)
class ScanObservations:
    """All observations of a scan, ordered by (camera, sweep, stamp); n rows, s sweeps, c cameras.

    Rows are as in `SweepObservations`; light and view directions are unit vectors in the sample's
    frame, (n, 3). Columns named ``sweep_*`` have one value a sweep, in order of sweep number:
    lamp factors (s, c, 3), offsets' deviations (s,) and (s, c). ``gain_relative_std`` (c, 3) is
    the relative standard deviation of the radiometric scale that is left: where lamp factors were
    measured that of the reference's albedo and of the factors' mean, else that of the camera's
    constants.
    """

    camera: IntArray
    sweep: IntArray
    exposure_ms: FloatArray
    stamp_ns: IntArray
    light_angle_deg: FloatArray
    swept_deg: FloatArray
    light_direction: FloatArray
    view_direction: FloatArray
    radiance: FloatArray
    variance: FloatArray
    valid: BoolArray
    sweep_number: IntArray
    sweep_exposure_ms: FloatArray
    sweep_direction: IntArray
    sweep_lamp_factor: FloatArray
    sweep_lamp_factor_std: FloatArray
    sweep_light_offset_std_deg: FloatArray
    sweep_camera_offset_std_deg: FloatArray
    gain_relative_std: FloatArray
    dropped: Mapping[str, int]

    @property
    def light_angle_std_deg(self) -> dict[int, float]:
        """Deviation of the light's angle by sweep: what all cameras share and their own (RMS)."""
        own = np.mean(self.sweep_camera_offset_std_deg**2, axis=1)
        total = np.sqrt(self.sweep_light_offset_std_deg**2 + own)
        return dict(zip(self.sweep_number.tolist(), total.tolist(), strict=True))

    def observations(self, origin_ns: int | None = None) -> Observations:
        """Return the rows as the fit takes them; time 0 is ``origin_ns``, else the first stamp."""
        if origin_ns is None:
            origin_ns = int(np.min(self.stamp_ns))
        return Observations(
            light_direction=self.light_direction,
            view_direction=self.view_direction,
            radiance=self.radiance,
            variance=self.variance,
            valid=self.valid,
            camera=self.camera,
            sweep=self.sweep,
            exposure_ms=self.exposure_ms,
            time_s=(self.stamp_ns - origin_ns) / 1e9,
        )


def assemble_scan(
    sweeps: Iterable[SweepObservations], calibration: Calibration
) -> ScanObservations:
    """Join the sweeps of a scan, in order of (camera, sweep, stamp) however they are given.

    A sweep in which a camera's reference was saturated throughout takes the weighted mean of the
    lamp factors of the scan's other sweeps.

    Raises
    ------
    ValueError
        Without sweeps, or if two have the same number.
    """
    ordered = sorted(sweeps, key=lambda sweep: sweep.sweep)
    numbers = [sweep.sweep for sweep in ordered]
    if not ordered or len(set(numbers)) != len(numbers):
        raise ValueError(f"a scan is made of sweeps {numbers}: give one observation set a sweep")
    factor, std = _lamp_factors(ordered)
    camera = np.concatenate([sweep.camera for sweep in ordered])
    sweep_index = np.repeat(np.arange(len(ordered)), [sweep.camera.size for sweep in ordered])
    stamp_ns = np.concatenate([sweep.stamp_ns for sweep in ordered])
    order = np.lexsort((stamp_ns, sweep_index, camera))
    column = np.searchsorted([c.camera for c in calibration.cameras], camera)
    # sweeps divided by their own factor where they had one, and by 1 where they had none
    borrowed = np.where([sweep.lamp_measured for sweep in ordered], 1.0, factor)
    rest = borrowed[sweep_index, column]
    angle = np.concatenate([sweep.light_angle_deg for sweep in ordered])
    return ScanObservations(
        camera=camera[order],
        sweep=np.array(numbers, dtype=np.int64)[sweep_index][order],
        exposure_ms=np.concatenate([sweep.frame_exposure_ms for sweep in ordered])[order],
        stamp_ns=stamp_ns[order],
        light_angle_deg=angle[order],
        swept_deg=np.concatenate([sweep.swept_deg for sweep in ordered])[order],
        light_direction=light_direction(angle[order], calibration.tilt_deg),
        view_direction=calibration.view_directions[column[order]],
        radiance=(np.concatenate([sweep.radiance for sweep in ordered]) / rest)[order],
        variance=(np.concatenate([sweep.variance for sweep in ordered]) / rest**2)[order],
        valid=np.concatenate([sweep.valid for sweep in ordered])[order],
        sweep_number=np.array(numbers, dtype=np.int64),
        sweep_exposure_ms=np.array([sweep.exposure_ms for sweep in ordered]),
        sweep_direction=np.array([sweep.direction for sweep in ordered], dtype=np.int64),
        sweep_lamp_factor=factor,
        sweep_lamp_factor_std=std,
        sweep_light_offset_std_deg=np.array([sweep.light_offset_std_deg for sweep in ordered]),
        sweep_camera_offset_std_deg=np.stack([sweep.camera_offset_std_deg for sweep in ordered]),
        gain_relative_std=_gain_relative_std(ordered, calibration),
        dropped=dict(sorted(sum((Counter(s.dropped) for s in ordered), Counter()).items())),
    )


def _gain_relative_std(sweeps: Sequence[SweepObservations], calibration: Calibration) -> FloatArray:
    weight = _lamp_weights(sweeps).sum(axis=0)
    of_factors = np.sqrt(1.0 / np.where(weight > 0.0, weight, 1.0))
    constants = np.array([[camera.gain_relative_std] * 3 for camera in calibration.cameras])
    with_reference = np.hypot(of_factors, calibration.reference_relative_std)
    return np.where(weight > 0.0, with_reference, constants)


def _lamp_factors(sweeps: Sequence[SweepObservations]) -> tuple[FloatArray, FloatArray]:
    """Lamp factors and deviations, (s, c, 3), with gaps filled from the scan's other sweeps."""
    factor = np.stack([sweep.lamp_factor for sweep in sweeps])
    std = np.stack([sweep.lamp_factor_std for sweep in sweeps])
    measured = np.stack([sweep.lamp_measured for sweep in sweeps])
    weight = _lamp_weights(sweeps)
    total = weight.sum(axis=0)
    some = total > 0.0
    safe = np.where(some, total, 1.0)
    mean = np.where(some, (weight * factor).sum(axis=0) / safe, 1.0)
    # how much the lamp may differ between sweeps shows in how much the measured ones differ
    spread = np.where(measured, np.abs(factor - mean), 0.0).max(axis=0)
    mean_std = np.where(some, np.maximum(np.sqrt(1.0 / safe), spread), 0.0)
    return np.where(measured, factor, mean), np.where(measured, std, mean_std)


def _lamp_weights(sweeps: Sequence[SweepObservations]) -> FloatArray:
    """Inverse variances of lamp factors, (s, c, 3); 0 where they were not measured."""
    measured = np.stack([sweep.lamp_measured for sweep in sweeps])
    std = np.stack([sweep.lamp_factor_std for sweep in sweeps])
    return np.where(measured, 1.0 / np.maximum(std, 1e-12) ** 2, 0.0)
