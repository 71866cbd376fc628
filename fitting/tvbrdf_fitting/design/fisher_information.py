"""What a rig would learn of a material: Fisher information before anything is measured.

A frame of one camera at one light and exposure gives three values with a known variance (photons,
read noise, flicker of the lamp), so that the information of any set of frames is the sum of theirs
(S. M. Kay, "Fundamentals of Statistical Signal Processing: Estimation Theory", 1993, section 3.7):
with D the weighted derivatives by nuisances (in prior deviations) and parameters, ``M = sum D D^T +
diag(1, 0)``. Its inverse bounds every unbiased estimate's covariance from below (Cramér and Rao),
and the fit reaches it. Noise that the channels of a frame share adds ``M^-1 B M^-1`` for a fit that
weighs channels as if it were their own, B as in `uncertainty`; so what is stated here is what
`fit_scan` states of the same frames.

Derivatives, weights and nuisances are the fit's own. A camera's and an exposure's part is made once
for each set of lights; any choice among them is then a sum of small matrices. These Gram matrices
lose half of the digits, of which a design needs few.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import CAMERA_ANGLES_DEG, TILT_DEG, BoolArray, FloatArray, IntArray
from ..geometry import light_direction as light_at
from ..geometry import view_direction as view_of
from ..inference.nuisances import CommonErrors, make_nuisances
from ..inference.uncertainty import Uncertainty, published_scale
from ..models import ReflectanceModel, get_model
from ..observations import Observations
from ..problem import FitError, Problem, make_problem

_RANK = 1e-13
_NULL_SHARE = 1e-3
_NOTHING = 1e-12
"""A deviation of more than its inverse, in internal coordinates, is none at all."""
_SATURATION_SIGMAS = 4.0
"""As `frame_reduction.is_saturated` has it."""


@dataclass(frozen=True)
class NoiseModel:
    """Noise of the mean over a sample's patch in one frame; defaults are the simulated rig's.

    Attributes
    ----------
    electrons_per_radiance_ms
        Photo-electrons in a pixel for each unit of radiance (a white diffuser facing the light)
        and millisecond.
    read_noise_e
        Standard deviation of a pixel without light, with that of rounding to whole codes.
    pixels
        That are averaged.
    frame_relative_std
        Flicker of the lamp: a part of the signal, common to the channels of a frame.
    saturation_radiance_ms
        Radiance times exposure at which a pixel saturates.
    """

    electrons_per_radiance_ms: float = 1500.0
    read_noise_e: float = 5.05
    pixels: float = 14336
    frame_relative_std: float = 0.001
    saturation_radiance_ms: float = 6.667

    def __post_init__(self) -> None:
        for part in fields(self):
            value = getattr(self, part.name)
            may_vanish = part.name == "frame_relative_std"
            if not (math.isfinite(value) and (value >= 0 if may_vanish else value > 0)):
                least = "at least" if may_vanish else "above"
                raise ValueError(f"noise: {part.name} = {value} must be finite and {least} 0")

    def own_variance(self, radiance: FloatArray, exposure_ms: FloatArray) -> FloatArray:
        """Variance of photons and read noise (n, 3), of a radiance (n, 3) at exposures (n,)."""
        scale = self.electrons_per_radiance_ms * exposure_ms[:, None]
        return np.asarray(self._pixel_variance(radiance * scale) / (self.pixels * scale**2))

    def variance(self, radiance: FloatArray, exposure_ms: FloatArray) -> FloatArray:
        """Whole variance (n, 3), with the flicker."""
        shared = np.square(self.frame_relative_std * radiance)
        return self.own_variance(radiance, exposure_ms) + shared

    def unsaturated(self, radiance: FloatArray, exposure_ms: FloatArray) -> BoolArray:
        """(n, 3) True where no pixel is likely to saturate."""
        scale = self.electrons_per_radiance_ms * exposure_ms[:, None]
        electrons = radiance * scale
        margin = _SATURATION_SIGMAS * np.sqrt(self._pixel_variance(electrons))
        full = self.saturation_radiance_ms * self.electrons_per_radiance_ms
        return np.asarray(electrons + margin < full)

    def _pixel_variance(self, electrons: FloatArray) -> FloatArray:
        return np.asarray(np.maximum(electrons, 0.0) + self.read_noise_e**2)


@dataclass(frozen=True)
class Rig:
    """Cameras, and a light on an arm; defaults are those of the paper's rig.

    Attributes
    ----------
    camera_angles_deg
        From the vertical, in the cameras' plane; cameras are numbered from 1.
    tilt_deg
        Of the plate, in the light's plane.
    sweep_deg
        World angles of the light at the ends of a sweep.
    arm_half_width_deg
        The arm hides the sample from a camera that lies within this angle of the light.
    sweep_s, frame_rate_hz
        Shortest time of one sweep, and the cameras' rate.
    noise
        Of each frame.
    """

    camera_angles_deg: tuple[float, ...] = CAMERA_ANGLES_DEG
    tilt_deg: float = TILT_DEG
    sweep_deg: tuple[float, float] = (-90.0, 90.0)
    arm_half_width_deg: float = 1.75
    sweep_s: float = 12.0
    frame_rate_hz: float = 30.0
    noise: NoiseModel = field(default_factory=NoiseModel)

    def __post_init__(self) -> None:
        angles = {"tilt_deg": (self.tilt_deg,), "camera_angles_deg": self.camera_angles_deg}
        for name, values in angles.items():
            if not all(abs(value) < 90 for value in values):
                raise ValueError(f"rig: {name} = {[*values]}, expected angles between -90 and 90")
        low, high = self.sweep_deg
        if not -math.inf < low < high < math.inf:
            raise ValueError(f"rig: sweep_deg from {low:g} to {high:g}, expected a rising order")

    @property
    def cameras(self) -> tuple[int, ...]:
        """Numbers of the cameras."""
        return tuple(range(1, len(self.camera_angles_deg) + 1))

    def lights_deg(self, count: int, phase: float = 0.5) -> FloatArray:
        """World angles (count,) of evenly spaced lights, all above the sample's horizon.

        Each has an equal part of the sweep, and lies at `phase` (0 to 1) in it.
        """
        low = max(self.sweep_deg[0], self.tilt_deg - 90.0)
        high = min(self.sweep_deg[1], self.tilt_deg + 90.0)
        if not low < high or count < 1:
            raise ValueError(
                f"no light: sweep {self.sweep_deg} with a tilt of {self.tilt_deg:g} degrees, "
                f"{count} lights"
            )
        return np.asarray(low + (np.arange(count) + phase) * ((high - low) / count))

    def time_s(self, lights: int, exposures_ms: Sequence[float]) -> float:
        """Time of one sweep an exposure, with a frame at each light."""
        period_s = [max(1 / self.frame_rate_hz, exposure / 1e3) for exposure in exposures_ms]
        return sum(max(self.sweep_s, lights * period) for period in period_s)

    def observe(
        self,
        model: ReflectanceModel,
        values: FloatArray,
        *,
        cameras: Sequence[int],
        exposures_ms: Sequence[float],
        lights: int,
        phase: float = 0.5,
    ) -> Observations:
        """Return what would be seen of a material without noise, with the variances it would have.

        One sweep an exposure; rows of one camera and sweep are together.

        Raises
        ------
        ValueError
            No such camera, no light.
        """
        angle = self.lights_deg(lights, phase)
        every_light = light_at(angle, self.tilt_deg)
        arm = 2 * math.sin(math.radians(self.arm_half_width_deg) / 2)
        parts = []
        for sweep, exposure in enumerate(exposures_ms, start=1):
            for camera in cameras:
                if camera not in self.cameras:
                    raise ValueError(f"there is no camera {camera}; there are {self.cameras}")
                towards = view_of(self.camera_angles_deg[camera - 1], self.tilt_deg)
                kept = np.linalg.norm(every_light - towards, axis=1) > arm
                seen, light = angle[kept], every_light[kept]
                view = np.broadcast_to(towards, light.shape)
                radiance = np.pi * light[:, 2:] * model.evaluate(light, view, values)
                exposures = np.full(len(seen), float(exposure))
                share = (seen - self.sweep_deg[0]) / (self.sweep_deg[1] - self.sweep_deg[0])
                parts.append(
                    Observations(
                        light_direction=light,
                        view_direction=view,
                        radiance=radiance,
                        variance=self.noise.variance(radiance, exposures),
                        valid=self.noise.unsaturated(radiance, exposures),
                        camera=np.full(len(seen), camera),
                        sweep=np.full(len(seen), sweep),
                        exposure_ms=exposures,
                        time_s=self.sweep_s * (sweep - 1 + share),
                    )
                )
        return Observations.concatenate(parts)


@dataclass(frozen=True, eq=False)
class Deviations:
    """Standard deviations of a fit, in the order of the model's parameters; infinite where none.

    Attributes
    ----------
    published, internal
        (p,) in the two sets of coordinates; 0 where fixed.
    common_share
        (p,) part of the variance that comes from errors that frames share: 0 to 1.
    """

    published: FloatArray
    internal: FloatArray
    common_share: FloatArray


class Information:
    """Fisher information of a material for every camera and exposure of a rig.

    Parameters
    ----------
    rig
        Geometry and noise.
    model, values
        The material: a model, or its name, and its published values (p,).
    exposures_ms
        One sweep each.
    fixed
        Names of parameters that are known.
    common_errors
        Errors that frames share; the flicker is the noise model's.

    Raises
    ------
    FitError
        The rig's directions cannot determine the model, or values lie outside its bounds.
    """

    def __init__(
        self,
        rig: Rig,
        model: str | ReflectanceModel,
        values: ArrayLike,
        exposures_ms: Sequence[float],
        *,
        fixed: Sequence[str] = (),
        common_errors: CommonErrors | None = None,
    ) -> None:
        self.rig = rig
        self.model = get_model(model) if isinstance(model, str) else model
        self.values = np.asarray(values, dtype=np.float64)
        self.exposures_ms = tuple(float(e) for e in exposures_ms)
        self.internal = self.model.to_internal(self.values)
        everything = dict(self.model.as_mapping(self.values))
        self.fixed = {name: everything[name] for name in fixed}
        flicker = rig.noise.frame_relative_std
        self.common_errors = replace(common_errors or CommonErrors(), frame_relative_std=flicker)
        whole = rig.observe(
            self.model, self.values, cameras=rig.cameras, exposures_ms=exposures_ms, lights=361
        )
        # what saturates is lost, but belongs to the model
        whole = replace(whole, valid=np.ones(whole.valid.shape, dtype=bool))
        reference = make_problem(whole, self.model, self.fixed, everything)
        self._reference = reference
        self.free = reference.free
        self._names = make_nuisances(reference, whole, self.common_errors).names
        self._known: dict[tuple[int, float], tuple[FloatArray, FloatArray, IntArray]] = {}

    @property
    def nuisances(self) -> int:
        """Number of nuisances."""
        return len(self._names)

    def deviations(
        self, cameras: Sequence[int], exposures_ms: Sequence[float], lights: int, phase: float = 0.5
    ) -> Deviations:
        """Return the standard deviations that a fit of these frames would have."""
        blocks, excess, values = self.blocks(lights, phase)
        rows = [self.rig.cameras.index(camera) for camera in cameras]
        columns = [self.exposures_ms.index(exposure) for exposure in exposures_ms]
        chosen = np.ix_(rows, columns)
        information, more = blocks[chosen].sum(axis=(0, 1)), excess[chosen].sum(axis=(0, 1))
        random, common, lost = _covariances(information, more, self.nuisances)
        count, free = len(self.internal), list(self.free)
        whole = [np.zeros((count, count)) for _ in range(2)]
        for matrix, part in zip(whole, (random, common), strict=True):
            matrix[np.ix_(free, free)] = part
        # a fit refuses fewer values than parameters, whatever they tell of one of them
        gone = free if values[chosen].sum() < len(free) else [free[i] for i in lost]
        variance = np.diag(whole[0] + whole[1]).copy()
        share = np.diag(whole[1]) / np.where(variance > 0, variance, 1.0)
        variance[gone] = np.inf
        uncertainty = Uncertainty(whole[0], whole[1], (), np.zeros(0))
        scale = published_scale(self._reference, self.internal, uncertainty)
        internal = np.sqrt(variance)
        published = internal.copy()
        known = np.isfinite(internal)
        published[known] *= scale[known]
        return Deviations(published, internal, share)

    def blocks(self, lights: int, phase: float = 0.5) -> tuple[FloatArray, FloatArray, IntArray]:
        """Information, excess from shared noise, and number of values of each camera and exposure.

        The first two are (cameras, exposures, m + q, m + q), the m nuisances before the q free
        parameters, the last (cameras, exposures).
        """
        key = (lights, phase)
        if key not in self._known:
            self._known[key] = self._blocks(lights, phase)
        return self._known[key]

    def _blocks(self, lights: int, phase: float) -> tuple[FloatArray, FloatArray, IntArray]:
        m, q = self.nuisances, len(self.free)
        shape = (len(self.rig.cameras), len(self.exposures_ms), m + q, m + q)
        blocks, excess, values = np.zeros(shape), np.zeros(shape), np.zeros(shape[:2], dtype=int)
        whole = self.rig.observe(
            self.model,
            self.values,
            cameras=self.rig.cameras,
            exposures_ms=self.exposures_ms,
            lights=lights,
            phase=phase,
        )
        try:
            problem = make_problem(whole, self.model, self.fixed, {})
        except FitError:
            return blocks, excess, values  # fewer values than parameters
        derivatives = self._derivatives(problem, whole)
        relative = self.rig.noise.frame_relative_std
        part = np.minimum(relative * np.abs(problem.radiance) * problem.weight, 1.0)
        rows = np.flatnonzero(whole.usable.any(axis=1))
        camera, sweep = whole.camera[rows], whole.sweep[rows]
        for c, number in enumerate(self.rig.cameras):
            for e in range(len(self.exposures_ms)):
                own = np.flatnonzero((camera == number) & (sweep == e + 1))
                each = derivatives[:, :, own]
                flat = each.reshape(m + q, -1)
                blocks[c, e], values[c, e] = flat @ flat.T, np.count_nonzero(problem.weight[:, own])
                if relative:
                    shared = each * part[:, own]
                    together, alone = shared.sum(axis=1), shared.reshape(m + q, -1)
                    excess[c, e] = together @ together.T - alone @ alone.T
        return blocks, excess, values

    def _derivatives(self, problem: Problem, observations: Observations) -> FloatArray:
        """Weighted derivatives (m + q, 3, n) by nuisances and free parameters."""
        m, size = self.nuisances, problem.radiance.size
        out = np.zeros((m + len(self.free), size))
        out[m:] = problem.jacobian(self.internal, self.free).T
        nuisances = make_nuisances(problem, observations, self.common_errors)
        if len(nuisances):
            nothing = np.zeros(len(nuisances))
            columns = np.zeros((len(nuisances), size))
            around = nuisances.neighbours(problem, nothing)
            nuisances.write_columns(columns, problem, self.internal, nothing, around)
            # a camera that few lights show nothing has no gains of its own
            out[[self._names.index(name) for name in nuisances.names]] = columns
        return out.reshape(-1, 3, problem.radiance.shape[1])


def _covariances(
    information: FloatArray, excess: FloatArray, m: int
) -> tuple[FloatArray, FloatArray, list[int]]:
    """Random and common covariance (q, q), and which of the q parameters have no information."""
    prior = np.zeros(len(information))
    prior[:m] = 1.0
    whole = information + np.diag(prior)
    size = np.sqrt(np.diag(whole))
    scale = np.where(size > _NOTHING, size, 1.0)
    values, axes = np.linalg.eigh(whole / np.outer(scale, scale))
    weak = values <= _RANK * max(float(values[-1]), _NOTHING)
    lost = (np.square(axes[:, weak]).sum(axis=1) > _NULL_SHARE)[m:]
    inverse = axes / np.where(weak, np.inf, values) @ axes.T / np.outer(scale, scale)
    parameters, shift = inverse[m:, m:], inverse[m:, :m]
    common = shift @ shift.T
    random = parameters - common + inverse[m:] @ excess @ inverse[:, m:]
    return random, common, np.flatnonzero(lost).tolist()
