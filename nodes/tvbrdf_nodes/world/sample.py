"""What lies under the simulated rig: an analytic material that changes, or measured reflectance.

Radiance is π·BRDF·cosθi, B, G, R: 1 for a perfect white diffuser facing the light. The light's
angle is the world angle, from the vertical; see :mod:`tvbrdf_fitting.geometry`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tvbrdf_fitting.geometry import (
    CAMERA_ANGLES_DEG,
    TILT_DEG,
    light_direction,
    light_world_angle_deg,
    view_direction,
)

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

FloatArray = NDArray[np.float64]
Truth = tuple[str, tuple[str, ...], tuple[float, ...]]
"""Model, names and values of its parameters, published units."""

HORIZONS_DEG = (TILT_DEG - 90.0, TILT_DEG + 90.0)
"""World angles at which the light passes the sample's horizon."""


class SampleError(ValueError):
    """A sample can't be used; the text names the key or the file."""


class Sample(Protocol):
    """What lies under the rig."""

    def radiance(
        self, camera: int, light_angle_deg: FloatArray, time_s: float, scan: int
    ) -> FloatArray:
        """Return π·BRDF·cosθi.

        Parameters
        ----------
        camera
            1 to 4.
        light_angle_deg
            (n,) world angles of the light.
        time_s
            The sample's time since t = 0.
        scan
            Number of the scan, from 1.

        Returns
        -------
        array (n, 3), B, G, R; 0 where the light is below the sample's horizon
        """
        ...

    def directional_radiance(
        self, light: FloatArray, view: FloatArray, time_s: float
    ) -> FloatArray | None:
        """Return π·BRDF·cosθi (n, 3) for unit vectors (n, 3); None where only the rig's are known.

        Both are in the sample's frame.
        """
        ...

    def truth(self, time_s: float) -> Truth | None:
        """Return the parameters at a time; None where nobody knows them."""
        ...


def make_sample(spec: Mapping[str, Any]) -> Sample:
    """Return the sample that a scene's ``sample`` describes.

    Parameters
    ----------
    spec
        ``kind`` and what belongs to it: ``measured`` with ``path``, or a kind of
        :mod:`tvbrdf_fitting.time_varying` with its parameters.

    Raises
    ------
    SampleError
        Naming what is missing, unknown or out of range.
    """
    values = dict(spec)
    kind = values.pop("kind", None)
    if not isinstance(kind, str):
        raise SampleError("sample: key 'kind' is missing")
    if kind != "measured":
        return AnalyticSample(kind, values)
    path = values.pop("path", None)
    if not isinstance(path, str) or values:
        given = ", ".join(values) or "no path"
        raise SampleError(f"sample: kind measured needs one key, path; found {given}")
    return MeasuredSample(path)


class AnalyticSample:
    """A material of :mod:`tvbrdf_fitting.time_varying`.

    Within a scan the sample's time stands still, so each camera's radiance is a function of the
    light's angle only: it is tabulated when the same time is asked for often, as cubics of which
    each was checked against the material at its middle.
    """

    TABLE_AFTER = 24
    """Angles asked for at one time before a table is worth it."""

    def __init__(self, kind: str, values: Mapping[str, Any]) -> None:
        from tvbrdf_fitting.time_varying import from_dict

        try:
            self.material = from_dict(kind, dict(values))
        except (ValueError, TypeError, KeyError) as error:
            raise SampleError(f"sample of kind {kind!r}: {error}") from error
        self._views = [view_direction(angle) for angle in CAMERA_ANGLES_DEG]
        self._asked: dict[int, tuple[float, int]] = {}
        self._tables: dict[int, tuple[float, AngleTable]] = {}

    def radiance(
        self, camera: int, light_angle_deg: FloatArray, time_s: float, scan: int
    ) -> FloatArray:
        """See :class:`Sample`."""
        table_time_s, table = self._tables.get(camera, (None, None))
        if table is not None and table_time_s == time_s:
            return table(light_angle_deg)
        asked_time_s, count = self._asked.get(camera, (time_s, 0))
        count = light_angle_deg.size + (count if asked_time_s == time_s else 0)
        self._asked[camera] = (time_s, count)

        def exact(angle_deg: FloatArray) -> FloatArray:
            return self._exact(camera, angle_deg, time_s)

        if count > self.TABLE_AFTER:
            self._tables[camera] = (time_s, AngleTable(exact))
        return exact(light_angle_deg)

    def _exact(self, camera: int, light_angle_deg: FloatArray, time_s: float) -> FloatArray:
        light = light_direction(light_angle_deg)
        view = np.broadcast_to(self._views[camera - 1], light.shape)
        return self.directional_radiance(light, view, time_s)

    def directional_radiance(
        self, light: FloatArray, view: FloatArray, time_s: float
    ) -> FloatArray:
        """See :class:`Sample`."""
        cosine = np.maximum(light[:, 2:], 0.0)
        brdf = np.asarray(self.material.brdf(light, view, time_s), dtype=np.float64)
        return np.where(cosine > 0.0, np.pi * brdf * cosine, 0.0)

    def truth(self, time_s: float) -> Truth | None:
        """See :class:`Sample`."""
        values = self.material.parameters_at(time_s)
        numbers = tuple(float(value) for value in values.values())
        return str(self.material.model), tuple(values), numbers


class AngleTable:
    """A function of the light's angle as one cubic a cell, exact where a cubic does not do.

    Parameters
    ----------
    function
        Angles (n,) in degrees to values (n, 3).
    """

    STEP_DEG = 0.05
    FIRST_DEG, LAST_DEG = -95.0, 95.0
    TOLERANCE = 2e-7
    """Of a cell's cubic at its middle: relative to the value there, or to 1e-3 of the largest."""

    def __init__(self, function: Callable[[FloatArray], FloatArray]) -> None:
        self._function = function
        cells = round((self.LAST_DEG - self.FIRST_DEG) / self.STEP_DEG)
        half_steps = self.FIRST_DEG + 0.5 * self.STEP_DEG * np.arange(-2.0, 2 * cells + 3)
        values = np.asarray(function(half_steps))
        nodes, middle = values[::2], values[3:-2:2]
        # Lagrange's cubic through the two nodes around the cell and the two beyond them
        before, left, right, after = nodes[:-3], nodes[1:-2], nodes[2:-1], nodes[3:]
        self._coefficients = np.stack(
            [
                left,
                right - after / 6.0 - left / 2.0 - before / 3.0,
                (before + right) / 2.0 - left,
                (after - before) / 6.0 + (left - right) / 2.0,
            ],
            axis=1,
        )
        largest = np.abs(values).max(axis=0, initial=0.0)
        allowed = self.TOLERANCE * np.maximum(np.abs(middle), 1e-3 * largest)
        self.good = (np.abs(self._cubic(np.arange(cells), 0.5) - middle) <= allowed).all(axis=1)
        """(cells,) whether the cubic does."""

    def _cubic(self, cell: NDArray[np.int64], u: FloatArray | float) -> FloatArray:
        c = self._coefficients[cell]
        u = np.asarray(u, dtype=np.float64)[..., None]
        value: FloatArray = c[:, 0] + u * (c[:, 1] + u * (c[:, 2] + u * c[:, 3]))
        return value

    def __call__(self, angle_deg: FloatArray) -> FloatArray:
        """Return the values (n, 3) at angles (n,)."""
        position = (angle_deg - self.FIRST_DEG) / self.STEP_DEG
        cell = np.floor(position).astype(np.int64)
        inside = np.minimum(np.maximum(cell, 0), self.good.size - 1)
        values = self._cubic(inside, position - inside)
        good = self.good[inside] & (inside == cell)
        if good.all():
            return values
        values[~good] = self._function(angle_deg[~good])
        return values


class MeasuredSample:
    """Reflectance in the published layout: scan k of a run shows the k-th scan on file.

    Between the light positions of a camera's file the radiance is a cubic spline; across a gap (the
    arm hid the sample) it is linear, and so it goes on from the last position to the sample's
    horizon, where it ends.

    Parameters
    ----------
    path
        Folder with ``tvBrdf-data/``, and ``tvBrdf-calibration.txt`` if the radiances are to be
        divided by constants.
    """

    def __init__(self, path: str | Path) -> None:
        from tvbrdf_fitting.published import PublishedFormatError, list_scans, read_calibration
        from tvbrdf_fitting.published.sample import CALIBRATION_FILE

        self._folder = Path(path)
        try:
            self._scans = list_scans(self._folder)
            calibration = self._folder / CALIBRATION_FILE
            self._constants = (
                read_calibration(calibration) if calibration.exists() else np.ones((4, 3))
            )
        except PublishedFormatError as error:
            raise SampleError(f"measured sample: {error}") from error
        if not self._scans:
            raise SampleError(f"measured sample: {self._folder} holds no scan in tvBrdf-data/")
        self._curves: dict[int, tuple[int, PPoly]] = {}

    def radiance(
        self, camera: int, light_angle_deg: FloatArray, time_s: float, scan: int
    ) -> FloatArray:
        """See :class:`Sample`."""
        number = self._scans[min(max(scan, 1), len(self._scans)) - 1]
        known, curve = self._curves.get(camera, (None, None))
        if curve is None or known != number:
            curve = self._read(number, camera)
            self._curves[camera] = (number, curve)
        low, high = HORIZONS_DEG
        inside = (light_angle_deg > low) & (light_angle_deg < high)
        values = np.maximum(curve(np.clip(light_angle_deg, low, high)), 0.0)
        return np.where(inside[:, None], values, 0.0)

    def _read(self, number: int, camera: int) -> PPoly:
        from tvbrdf_fitting.published import PublishedFormatError, read_scan_file, scan_file_name
        from tvbrdf_fitting.published.scan import DATA_FOLDER

        path = self._folder / DATA_FOLDER / scan_file_name(number, camera)
        try:
            scan = read_scan_file(path)
        except PublishedFormatError as error:
            raise SampleError(f"measured sample: {error}") from error
        angle_deg = light_world_angle_deg(scan.light_direction)
        order = np.argsort(angle_deg)
        values = scan.radiance[order] / self._constants[camera - 1]
        try:
            return piecewise_cubic(angle_deg[order], values)
        except ValueError as error:
            raise SampleError(f"measured sample: {path}: {error}") from error

    def directional_radiance(
        self, light: FloatArray, view: FloatArray, time_s: float
    ) -> FloatArray | None:
        """See :class:`Sample`."""
        return None

    def truth(self, time_s: float) -> Truth | None:
        """See :class:`Sample`."""
        return None


def piecewise_cubic(angle_deg: FloatArray, values: FloatArray) -> PPoly:
    """Return a curve through ``values`` (n, 3) at rising angles (n,), from horizon to horizon.

    A cubic spline where the positions are dense, linear where they are more than twice their
    usual distance apart. Beyond the first and last it goes on straight for that distance (nothing
    says that the curve bends there), and from there, if that is not the horizon yet, straight to 0.

    Raises
    ------
    ValueError
        If there are fewer than two positions, or two at one angle.
    """
    from scipy.interpolate import CubicSpline, PPoly

    steps = np.diff(angle_deg)
    if angle_deg.size < 2 or steps.min() <= 0:
        raise ValueError("needs two or more light positions, each at an angle of its own")
    step = float(np.median(steps))
    edges = [0, *(np.flatnonzero(steps > 2.0 * step) + 1), angle_deg.size]
    before = _beyond(angle_deg, values, step, HORIZONS_DEG[0])
    after = _beyond(angle_deg[::-1], values[::-1], step, HORIZONS_DEG[1])
    points = np.concatenate([before[0][::-1], angle_deg, after[0]])
    padded = np.concatenate([before[1][::-1], values, after[1]])
    # all cells linear first, then those between dense positions from their spline
    coefficients = np.zeros((4, points.size - 1, 3))
    coefficients[2] = np.diff(padded, axis=0) / np.diff(points)[:, None]
    coefficients[3] = padded[:-1]
    shift = before[0].size
    for first, last in pairwise(edges):
        if last - first >= 4:
            spline = CubicSpline(angle_deg[first:last], values[first:last])
            coefficients[:, first + shift : last + shift - 1] = spline.c
    return PPoly(coefficients, points)


def _beyond(
    angle_deg: FloatArray, values: FloatArray, step_deg: float, horizon_deg: float
) -> tuple[FloatArray, FloatArray]:
    """Angles (1 or 2,) and values from the first position on to the horizon, outwards."""
    way = horizon_deg - angle_deg[0]
    slope = (values[1] - values[0]) / (angle_deg[1] - angle_deg[0])
    reach = float(np.sign(way)) * min(step_deg, abs(way))
    straight = np.maximum(values[0] + slope * reach, 0.0)
    if abs(way) <= step_deg * (1.0 + 1e-9):
        return np.array([horizon_deg]), straight[None]
    return np.array([angle_deg[0] + reach, horizon_deg]), np.stack([straight, np.zeros(3)])
