"""What a scan measured: one row a frame and camera, as the merger gives it and the fit takes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from .geometry import CHANNELS, BoolArray, FloatArray, IntArray, above_horizon

UNIT_LENGTH_TOLERANCE = 1e-4
"""Directions in published files have six decimals; anything further from length 1 is an error."""
_DTYPES: dict[str, type] = {
    "light_direction": np.float64,
    "view_direction": np.float64,
    "radiance": np.float64,
    "variance": np.float64,
    "valid": np.bool_,
    "camera": np.int64,
    "sweep": np.int64,
    "exposure_ms": np.float64,
    "time_s": np.float64,
}
"""Of every field."""
_ONE_A_ROW = frozenset({"camera", "sweep", "exposure_ms", "time_s"})


@dataclass(frozen=True, eq=False)
class Observations:
    """Calibrated observations of one scan, in any order and not on any grid.

    Attributes
    ----------
    light_direction, view_direction
        (n, 3) unit vectors from the sample, in the sample's frame.
    radiance
        (n, 3) pi x BRDF x cos(theta_i), channels B, G, R: 1 is a perfect white diffuser that faces
        the light.
    variance
        (n, 3) variance of each radiance's random error. It should come from a noise model at a
        smoothed or averaged signal: a variance that follows each radiance's own noise makes the
        dark fluctuations weigh more and pulls a weighted fit down.
    valid
        (n, 3) False where a value is saturated, hidden, or missing. Radiance and variance may be
        anything there.
    camera, sweep
        (n,) number of the camera, from 1, and of the sweep.
    exposure_ms, time_s
        (n,) exposure, and time of the middle of the exposure.

    Raises
    ------
    ValueError
        Wrong shapes, values that are not finite, directions that are not unit vectors, a variance
        that is not positive; the message says where.
    """

    light_direction: FloatArray
    view_direction: FloatArray
    radiance: FloatArray
    variance: FloatArray
    valid: BoolArray
    camera: IntArray
    sweep: IntArray
    exposure_ms: FloatArray
    time_s: FloatArray

    def __post_init__(self) -> None:
        for name, dtype in _DTYPES.items():
            given = np.asarray(getattr(self, name))
            if dtype is np.int64 and given.dtype.kind not in "iu":
                raise ValueError(f"observations: {name} must be integers, not {given.dtype}")
            array: np.ndarray[Any, Any] = given.astype(dtype, copy=True)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        self._check_shapes()
        for name in ("light_direction", "view_direction"):
            self._check_directions(name)
        for name in ("exposure_ms", "time_s"):
            self._refuse(name, ~np.isfinite(getattr(self, name)), "is not finite")
        self._refuse("exposure_ms", self.exposure_ms <= 0, "is not positive")
        self._refuse("camera", self.camera < 1, "is below 1")
        finite = np.isfinite(self.radiance) & np.isfinite(self.variance)
        if not (finite & (self.variance > 0) | ~self.valid).all():
            self._refuse_values()

    def __len__(self) -> int:
        return int(self.light_direction.shape[0])

    @cached_property
    def usable(self) -> BoolArray:
        """(n, 3) mask of what a fit uses: valid, with light and camera above the horizon."""
        above = above_horizon(self.light_direction) & above_horizon(self.view_direction)
        mask = self.valid & above[:, None]
        mask.setflags(write=False)
        return mask

    @cached_property
    def used_rows(self) -> BoolArray:
        """(n,) mask of the rows with a channel that a fit uses."""
        mask = np.asarray(self.usable.any(axis=1))
        mask.setflags(write=False)
        return mask

    @property
    def cosine_light(self) -> FloatArray:
        """(n,) cosine of the angle between light and normal."""
        return self.light_direction[:, 2]

    def select(self, rows: BoolArray | IntArray | slice) -> Observations:
        """Return some of the rows (mask, indices or slice)."""
        return Observations(**{name: getattr(self, name)[rows] for name in _DTYPES})

    @staticmethod
    def concatenate(parts: Sequence[Observations]) -> Observations:
        """Return all rows of several sets, one after the other, for example of four cameras."""
        if not parts:
            raise ValueError("observations: nothing to concatenate")
        return Observations(
            **{name: np.concatenate([getattr(part, name) for part in parts]) for name in _DTYPES}
        )

    def _check_shapes(self) -> None:
        rows = self.radiance.shape[0] if self.radiance.ndim else 0
        for name in _DTYPES:
            shape = getattr(self, name).shape
            expected = (rows,) if name in _ONE_A_ROW else (rows, 3)
            if shape != expected:
                raise ValueError(
                    f"observations: {name} has shape {shape}, expected {expected} "
                    f"to go with {rows} rows of radiance"
                )

    def _check_directions(self, name: str) -> None:
        vectors = getattr(self, name)
        length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
        wrong = ~(np.abs(length - 1) <= UNIT_LENGTH_TOLERANCE)  # so is one that is not finite
        if wrong.any():
            self._refuse(name, ~np.isfinite(vectors), "is not finite")
            row = int(np.argmax(wrong))
            raise ValueError(
                f"observations: {name}[{row}] = {vectors[row].tolist()} has length "
                f"{length[row]:.6g}, not 1; directions must be unit vectors "
                f"({int(wrong.sum())} of {len(self)} are not)"
            )

    def _refuse_values(self) -> None:
        """Say which valid radiance or variance can't be used."""
        remedy = "; mark what could not be measured as not valid"
        for name in ("radiance", "variance"):
            wrong = ~np.isfinite(getattr(self, name)) & self.valid
            self._refuse(name, wrong, f"is not finite{remedy}")
        self._refuse("variance", ~(self.variance > 0) & self.valid, "is not positive")

    def _refuse(self, name: str, wrong: BoolArray, what: str) -> None:
        if not wrong.any():
            return
        place = tuple(int(i) for i in np.argwhere(wrong)[0])
        array = getattr(self, name)
        where = f"camera {self.camera[place[0]]}, sweep {self.sweep[place[0]]}"
        if len(place) == 2 and name in {"radiance", "variance"}:
            where += f", channel {CHANNELS[place[1]]}"
        raise ValueError(
            f"observations: {name}[{', '.join(map(str, place))}] = {array[place]} ({where}) {what} "
            f"({int(wrong.sum())} such values)"
        )
