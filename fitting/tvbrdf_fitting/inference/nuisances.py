"""Errors that many frames share, as unknowns of the fit with a prior each: nuisances.

A gain of each camera and channel, a light offset of each sweep, and the plate's tilt (the sample's
normal turns about an axis in its plane: light and view directions turn together) change what a
model predicts: ``(1 + gain) pi BRDF(l', v') cos(theta_i')``. Each nuisance is counted in its
prior's standard deviations, so its prior is the standard normal one.

More frames do not average such errors out, but the data do know something of them: a gain of one
camera alone disagrees with the other cameras, a light offset moves a sharp peak.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..geometry import CHANNELS, HORIZON_COSINE, BoolArray, FloatArray, IntArray
from ..observations import Observations
from ..problem import Problem

_STEP_DEG = 1e-3
"""Step of a derivative by an angle: 1/280 of the narrowest lobe, and far above rounding."""


@dataclass(frozen=True)
class CommonErrors:
    """Standard deviations of errors that many frames share: the nuisances' priors.

    Attributes
    ----------
    light_angle_std_deg
        Offset of the light's angle in each sweep, independent between sweeps: one number for
        all, or a number by sweep.
    gain_relative_std
        Relative error of each camera's and channel's gain, independent between them.
    frame_relative_std
        Part of a frame's noise that its channels share (it is in the variances already),
        independent between frames: one number for all, or a number by camera. It is no nuisance:
        it concerns the random covariance.
    plate_tilt_std_deg
        Error of the sample normal's direction about each of the two axes in the plate.
    """

    light_angle_std_deg: float | Mapping[int, float] = 0.0
    gain_relative_std: float = 0.0
    frame_relative_std: float | Mapping[int, float] = 0.0
    plate_tilt_std_deg: float = 0.0

    def __post_init__(self) -> None:
        light, frame = self.light_angle_std_deg, self.frame_relative_std
        for name, values in (
            ("light_angle_std_deg", light.values() if isinstance(light, Mapping) else [light]),
            ("gain_relative_std", [self.gain_relative_std]),
            ("frame_relative_std", frame.values() if isinstance(frame, Mapping) else [frame]),
            ("plate_tilt_std_deg", [self.plate_tilt_std_deg]),
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
class Nuisances:
    """The m nuisances of one scan, in the order gains, light offsets, tilts.

    Attributes
    ----------
    names
        Such as `gain_camera1_b`, `light_offset_sweep2_deg`, `plate_tilt_x_deg`.
    deviations
        (m,) prior standard deviations, in the names' units (a gain's is relative).
    light, view
        (n, 3) stated directions of the problem's rows.
    gain_of, offset_of
        (3, n) and (n,) index of each value's gain and of each row's light offset; -1 for none.
    tilt
        Index of the tilt about x, the one about y follows; -1 for none.
    frame_relative
        (n,) relative noise that a row's channels share; None where it is 0 everywhere.
    """

    names: tuple[str, ...]
    deviations: FloatArray
    light: FloatArray
    view: FloatArray
    gain_of: IntArray
    offset_of: IntArray
    tilt: int
    frame_relative: FloatArray | None

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def is_angle(self) -> BoolArray:
        """(m,) True for offsets and tilts."""
        return np.array([name.endswith("_deg") for name in self.names], dtype=bool)

    @cached_property
    def _has_offsets(self) -> bool:
        return bool((self.offset_of >= 0).any())

    def angles_deg(self, values: FloatArray) -> FloatArray:
        """Angles in degrees (m,) at nuisances (m,) in prior deviations; 0 for gains."""
        return np.where(self.is_angle, values * self.deviations, 0.0)

    def named(self, values: FloatArray, deviations: FloatArray) -> dict[str, tuple[float, float]]:
        """Values and deviations by name, in the names' units, of these in prior deviations.

        Without values, as of a fit that left the nuisances out, they are 0.
        """
        found = values if len(values) else np.zeros(len(self))
        pairs = zip(found * self.deviations, deviations * self.deviations, strict=True)
        return {n: (float(v), float(d)) for n, (v, d) in zip(self.names, pairs, strict=True)}

    def gain(self, values: FloatArray) -> FloatArray:
        """Factor (3, n) of the radiance at nuisances (m,) in prior deviations."""
        relative = np.append(values * self.deviations, 0.0)
        return np.asarray(1.0 + relative[self.gain_of])

    def apply(
        self,
        problem: Problem,
        values: FloatArray,
        extra_deg: tuple[float, float, float] = (0, 0, 0),
    ) -> Problem:
        """Return the problem as nuisances (m,) have it: other directions, other radiances.

        `extra_deg` adds to the light's angle, to the tilt about x and to the tilt about y.
        """
        to_radiance, prepared = problem.to_radiance, problem.prepared
        if any(extra_deg) or values[self.is_angle].any():
            light, view = self._directions(values, extra_deg)
            prepared = problem.model.prepare(light, view)
            to_radiance = np.pi * light[:, 2]
        if values[~self.is_angle].any():
            to_radiance = to_radiance * self.gain(values)
        return replace(problem, prepared=prepared, to_radiance=to_radiance)

    def _directions(
        self, values: FloatArray, extra_deg: tuple[float, float, float]
    ) -> tuple[FloatArray, FloatArray]:
        angle = np.append(values * self.deviations, 0.0)
        # one number for all rows, where it is, is quicker than a number a row
        rows = angle[self.offset_of] if self._has_offsets and angle.any() else 0.0
        offset = rows + extra_deg[0]
        if self.tilt < 0:
            return _turned(self.light, offset, 0.0), self.view
        about_x, about_y = angle[self.tilt] + extra_deg[1], angle[self.tilt + 1] + extra_deg[2]
        return (
            _turned(self.light, offset + about_y, about_x),
            _turned(self.view, about_y, about_x),
        )

    def neighbours(self, problem: Problem, values: FloatArray) -> list[tuple[Problem, Problem]]:
        """Return the problem a step forward and back from nuisances (m,): light, each tilt."""
        steps = [(_STEP_DEG, 0.0, 0.0)] if self._has_offsets else []
        steps += [(0.0, _STEP_DEG, 0.0), (0.0, 0.0, _STEP_DEG)] if self.tilt >= 0 else []
        return [
            (
                self.apply(problem, values, step),
                self.apply(problem, values, (-step[0], -step[1], -step[2])),
            )
            for step in steps
        ]

    def write_columns(
        self,
        out: FloatArray,
        here: Problem,
        internal: FloatArray,
        values: FloatArray,
        around: list[tuple[Problem, Problem]],
    ) -> None:
        """Write the derivatives of the weighted residual by the nuisances into `out` (m, 3 n).

        `out` is given as zeros; `here` and `around` are `apply` and `neighbours` at `values`.
        """
        place = np.arange(out.shape[1])
        deviations = np.append(self.deviations, 0.0)
        predicted = here.predict(internal)
        slope = here.slope_of(predicted)
        if not self.is_angle.all():
            size = deviations[self.gain_of] / self.gain(values) * slope
            # a value without a gain has weight 0, and its index -1 writes that 0
            out[self.gain_of.ravel(), place] = (predicted * size).ravel()
        slopes = [
            (plus.predict(internal) - minus.predict(internal)) * (slope / (2 * _STEP_DEG))
            for plus, minus in around
        ]
        if self._has_offsets:
            index = np.broadcast_to(self.offset_of, self.gain_of.shape).ravel()
            known = index >= 0
            light = (slopes.pop(0) * deviations[self.offset_of]).ravel()
            out[index[known], place[known]] = light[known]
        for tilt, column in enumerate(slopes, start=self.tilt):
            out[tilt] = column.ravel() * deviations[tilt]


def no_nuisances(problem: Problem) -> Nuisances:
    """Return the nuisances of a scan whose common errors were not stated: none."""
    count = problem.radiance.shape[1]
    none = np.zeros((0, 3))
    nobody = np.full((3, count), -1)
    return Nuisances((), np.zeros(0), none, none, nobody, nobody[0], -1, None)


def make_nuisances(
    problem: Problem, observations: Observations, errors: CommonErrors | None
) -> Nuisances:
    """Return the nuisances with a prior above 0 that the observations of a problem see.

    Raises
    ------
    ValueError
        A sweep or camera without a stated error, where errors are stated for each.
    """
    if errors is None:
        return no_nuisances(problem)
    used = observations.used_rows
    rows = slice(None) if used.all() else used
    camera, sweep = observations.camera[rows], observations.sweep[rows]
    names: list[str] = []
    deviations: list[float] = []
    gain_of = np.full(problem.weight.shape, -1)
    cameras = np.unique(camera)
    if errors.gain_relative_std:
        for number in cameras.tolist():
            for channel, letter in enumerate(CHANNELS):
                seen = (camera == number) & (problem.weight[channel] > 0)
                if seen.any():
                    gain_of[channel, seen] = len(names)
                    names.append(f"gain_camera{number}_{letter}")
                    deviations.append(errors.gain_relative_std)
    offset_of = np.full(camera.shape, -1)
    for number in np.unique(sweep).tolist():
        deviation = errors.light_angle_std_of(number)
        if deviation:
            offset_of[sweep == number] = len(names)
            names.append(f"light_offset_sweep{number}_deg")
            deviations.append(deviation)
    tilt = len(names) if errors.plate_tilt_std_deg else -1
    if errors.plate_tilt_std_deg:
        names += ["plate_tilt_x_deg", "plate_tilt_y_deg"]
        deviations += [errors.plate_tilt_std_deg] * 2
    frame = np.array([errors.frame_relative_std_of(number) for number in cameras.tolist()])
    return Nuisances(
        names=tuple(names),
        deviations=np.array(deviations),
        light=observations.light_direction[rows],
        view=observations.view_direction[rows],
        gain_of=gain_of,
        offset_of=offset_of,
        tilt=tilt,
        frame_relative=frame[np.searchsorted(cameras, camera)] if frame.any() else None,
    )


def _turned(vectors: FloatArray, about_y_deg: FloatArray | float, about_x_deg: float) -> FloatArray:
    """Directions (n, 3) turned in the light's plane, then in the cameras', z towards x and y."""
    about_y, about_x = np.deg2rad(about_y_deg), math.radians(about_x_deg)
    cosine, sine = np.cos(about_y), np.sin(about_y)
    x = cosine * vectors[:, 0] + sine * vectors[:, 2]
    z = cosine * vectors[:, 2] - sine * vectors[:, 0]
    y = vectors[:, 1]
    if about_x:
        y, z = (
            math.cos(about_x) * y + math.sin(about_x) * z,
            math.cos(about_x) * z - math.sin(about_x) * y,
        )
    # a direction on the horizon's edge stays above it, where models are defined
    return np.stack([x, y, np.maximum(z, 0.5 * HORIZON_COSINE)], axis=1)
