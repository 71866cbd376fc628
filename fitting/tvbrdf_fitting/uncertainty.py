"""How well a fit knows its parameters: random and common errors, and what cannot be determined.

Random errors are those of each value, as the observations state them: covariance
``(J^T W J)^-1``, not rescaled by chi-square. A part of a frame's noise, the flicker of the lamp, is
the same in its three channels; with ``u_f`` the sum over a frame's channels of the weighted
Jacobian's rows times that part, and ``d`` each of them alone, the covariance is
``A^-1 (A + sum u u^T - sum d d^T) A^-1`` with ``A = J^T W J``.
*Common* errors are shared by whole groups of frames
(the light's offset in a sweep, a gain of a camera and channel), so that more frames do not average
them out. They are carried to the parameters to first order: with r the model's radiance and nu a
nuisance, ``S = (J^T W J)^-1 J^T W dr/dnu`` and their covariance is ``S Sigma S^T``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from .geometry import FloatArray, turned_in_light_plane
from .models.base import SQUARE
from .observations import Observations
from .problem import Problem

SIGNIFICANCE = 3.0
"""An amplitude within this many standard deviations of 0 carries no information on its shape."""
CONFOUNDED = 0.99
_RANK = 1e-10
_NULL_SHARE = 1e-3
_STEP_DEG = 1e-3
"""Step of the derivative by the light's angle: 1/280 of the narrowest lobe, and far above
rounding."""


@dataclass(frozen=True)
class CommonErrors:
    """Standard deviations of errors that many frames share.

    Attributes
    ----------
    light_angle_std_deg
        Offset of the light's angle in each sweep, independent between sweeps: one number for
        all, or a number by sweep.
    gain_relative_std
        Relative error of each camera's and channel's gain, independent between them.
    frame_relative_std
        Part of a frame's noise that its channels share (it is in the variances already),
        independent between frames: one number for all, or a number by camera. It concerns the
        random covariance.
    """

    light_angle_std_deg: float | Mapping[int, float] = 0.0
    gain_relative_std: float = 0.0
    frame_relative_std: float | Mapping[int, float] = 0.0

    def __post_init__(self) -> None:
        light, frame = self.light_angle_std_deg, self.frame_relative_std
        for name, values in (
            ("light_angle_std_deg", light.values() if isinstance(light, Mapping) else [light]),
            ("gain_relative_std", [self.gain_relative_std]),
            ("frame_relative_std", frame.values() if isinstance(frame, Mapping) else [frame]),
        ):
            for value in values:
                if not (math.isfinite(value) and value >= 0):
                    raise ValueError(f"common errors: {name} = {value} must be finite and >= 0")

    def light_angle_std_of(self, sweep: int) -> float:
        """Return the standard deviation of a sweep's light offset, in degrees."""
        if isinstance(self.light_angle_std_deg, Mapping):
            if sweep not in self.light_angle_std_deg:
                raise ValueError(f"common errors: no light_angle_std_deg for sweep {sweep}")
            return float(self.light_angle_std_deg[sweep])
        return float(self.light_angle_std_deg)

    def frame_relative_std_of(self, camera: int) -> float:
        """Return the relative noise that the channels of a camera's frame share."""
        if isinstance(self.frame_relative_std, Mapping):
            if camera not in self.frame_relative_std:
                raise ValueError(f"common errors: no frame_relative_std for camera {camera}")
            return float(self.frame_relative_std[camera])
        return float(self.frame_relative_std)


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariances (p, p) in internal coordinates; NaN for what the data say nothing of.

    Fixed parameters have variance 0.
    """

    random: FloatArray
    common: FloatArray
    uninformed: tuple[int, ...] = field(default=())


def estimate(
    problem: Problem,
    internal: FloatArray,
    observations: Observations,
    common_errors: CommonErrors | None,
) -> Uncertainty:
    """Covariances at a solution.

    Coordinates at a bound are treated as if the bound were not there, which overstates rather than
    understates the uncertainty of the others.
    """
    count = len(problem.model.parameters)
    jacobian = problem.jacobian(internal)
    scale = np.linalg.norm(jacobian, axis=0)
    known = scale > 0
    columns = [i for i, k in zip(problem.free, known, strict=True) if k]
    scaled = jacobian[:, known] / scale[known]
    triangle = np.linalg.qr(scaled, mode="r")
    _, singular, directions = np.linalg.svd(triangle)
    weak = singular < _RANK * singular.max(initial=0.0)
    # a coordinate that moves along a direction without information is itself without
    lost = (np.square(directions[weak]).sum(axis=0) > _NULL_SHARE) if weak.any() else None
    inverse_singular = np.where(weak, 0.0, 1 / np.where(weak, 1.0, singular))
    half = (directions.T * inverse_singular) / scale[known][:, None]

    random, common = np.zeros((count, count)), np.zeros((count, count))
    where = np.ix_(columns, columns)
    random[where] = half @ half.T
    if common_errors is not None:
        shared = _shared_by_channels(problem, jacobian[:, known], observations, common_errors)
        random[where] += half @ (half.T @ shared @ half) @ half.T
        nuisances = _nuisance_columns(problem, internal, observations, common_errors)
        shift = (half @ half.T) @ (jacobian[:, known].T @ nuisances)
        common[where] = shift @ shift.T
    uninformed = [i for i in range(count) if i not in columns and i not in problem.fixed]
    if lost is not None:
        uninformed += [i for i, gone in zip(columns, lost, strict=True) if gone]
    for matrix in (random, common):
        matrix[uninformed, :] = np.nan
        matrix[:, uninformed] = np.nan
    return Uncertainty(random, common, tuple(sorted(uninformed)))


def published_scale(problem: Problem, internal: FloatArray, uncertainty: Uncertainty) -> FloatArray:
    """Factors (p,) from deviations in internal coordinates to published ones; 0 where fixed.

    To first order, but for sigma_d: near 0 the square root has no slope. There the published
    deviation is a third of the way to the further end of the interval sigma_d^2 +- 3 deviations.
    It is finite at sigma_d = 0, and 3 published deviations cover what 3 internal ones do.
    """
    model = problem.model
    slopes = model.slopes(model.to_published(internal))
    deviations = np.sqrt(np.diag(uncertainty.random + uncertainty.common))
    scale = np.zeros(len(internal))
    for i, parameter in enumerate(model.parameters):
        if i in problem.fixed:
            continue
        if parameter.transform is SQUARE:
            square, reach = float(internal[i]), SIGNIFICANCE * float(deviations[i])
            root = math.sqrt(max(square, 0.0))
            up = math.sqrt(max(square + reach, 0.0)) - root
            down = root - math.sqrt(max(square - reach, 0.0))
            # a NaN deviation stays one
            scale[i] = max(up, down) / reach if reach > 0 else math.nan
        else:
            scale[i] = 1 / slopes[i]
    return scale


def to_published(covariance: FloatArray, scale: FloatArray) -> FloatArray:
    """Covariance in published units, given `published_scale`."""
    out = covariance * np.outer(scale, scale)
    out[scale == 0, :] = 0.0
    out[:, scale == 0] = 0.0
    return np.asarray(out)


def bounds_reached(problem: Problem, internal: FloatArray) -> tuple[int, ...]:
    """Free coordinates at a bound (within rounding, or a trust region's distance to it)."""
    reached = []
    for i in problem.free:
        tolerance = 1e-9 * max(1.0, abs(internal[i]))
        lower, upper = problem.lower[i], problem.upper[i]
        if internal[i] <= lower + tolerance or internal[i] >= upper - tolerance:
            reached.append(i)
    return tuple(reached)


def undetermined(
    problem: Problem, internal: FloatArray, uncertainty: Uncertainty, at_bound: tuple[int, ...]
) -> tuple[int, ...]:
    """Free parameters of which the fitted number means nothing.

    Those without information; those whose carrier (a lobe's amplitude for its width, every Kd for
    sigma_d, tau for w) is within 3 standard deviations of 0; those whose standard deviation is
    their full scale, or, for sigma_d^2 and tau, the value itself; pairs that only act together.
    """
    model = problem.model
    total = uncertainty.random + uncertainty.common
    deviation = np.sqrt(np.diag(total))
    names = list(model.parameter_names)
    found = {i for i in range(len(names)) if i not in problem.free and i not in problem.fixed}

    def significant(name: str) -> bool:
        i = names.index(name)
        # a fixed value has deviation 0; NaN compares as False
        return bool(internal[i] > 0 and internal[i] >= SIGNIFICANCE * deviation[i])

    for i in problem.free:
        parameter = model.parameters[i]
        carried = all(any(significant(n) for n in group) for group in parameter.carried_by)
        vague = not deviation[i] < parameter.full_scale  # catches NaN
        # shapes that start at 0 (sigma_d^2, tau) and are indistinguishable from it
        lost_at_zero = (
            bool(parameter.grid)
            and problem.lower[i] == 0
            and i not in at_bound
            and deviation[i] >= internal[i]
        )
        if i in uncertainty.uninformed or not carried or vague or lost_at_zero:
            found.add(i)
    for one, other in model.confounded:
        i, j = names.index(one), names.index(other)
        if i in problem.free and j in problem.free:
            bound = deviation[i] * deviation[j]
            if bound > 0 and abs(total[i, j]) > CONFOUNDED * bound:
                found.update((i, j))
    return tuple(sorted(found))


def _shared_by_channels(
    problem: Problem, jacobian: FloatArray, observations: Observations, errors: CommonErrors
) -> FloatArray:
    """What (q, q) to add to J^T W J for noise that the channels of a frame share."""
    rows = np.flatnonzero(observations.usable.any(axis=1))
    cameras, index = np.unique(observations.camera[rows], return_inverse=True)
    relative = np.array([errors.frame_relative_std_of(int(camera)) for camera in cameras])[index]
    # never more than all of a value's noise
    part = np.minimum(relative * np.abs(problem.radiance) * problem.weight, 1.0)
    each = part[..., None] * jacobian.reshape(*part.shape, -1)
    together, alone = each.sum(axis=0), each.reshape(-1, each.shape[-1])
    return np.asarray(together.T @ together - alone.T @ alone)


def _nuisance_columns(
    problem: Problem, internal: FloatArray, observations: Observations, errors: CommonErrors
) -> FloatArray:
    """Weighted change (3 n, nuisances) of the radiance by one standard deviation of each."""
    rows = np.flatnonzero(observations.usable.any(axis=1))
    seen = observations.select(rows)
    columns = []
    if errors.gain_relative_std:
        predicted = problem.predict(internal) * problem.weight * errors.gain_relative_std
        for camera in np.unique(seen.camera):
            for channel in range(3):
                column = np.zeros_like(predicted)
                column[channel] = predicted[channel] * (seen.camera == camera)
                columns.append(column.ravel())
    deviations = {int(k): errors.light_angle_std_of(int(k)) for k in np.unique(seen.sweep)}
    if any(deviations.values()):
        slope = _light_slope(problem, internal, seen) * problem.weight
        columns += [(slope * (seen.sweep == k) * d).ravel() for k, d in deviations.items() if d]
    return np.array(columns).reshape(len(columns), problem.radiance.size).T


def _light_slope(problem: Problem, internal: FloatArray, seen: Observations) -> FloatArray:
    """Change (3, n) of the radiance by a degree of the light's angle, by central difference."""
    values = []
    for sign in (1.0, -1.0):
        light = turned_in_light_plane(seen.light_direction, sign * _STEP_DEG)
        # a light on the horizon's edge stays above it: HORIZON_COSINE is 57 steps wide
        prepared = problem.model.prepare(light, seen.view_direction)
        values.append(problem.model.value(prepared, internal) * (np.pi * light[:, 2]))
    return np.asarray((values[0] - values[1]) / (2 * _STEP_DEG))
