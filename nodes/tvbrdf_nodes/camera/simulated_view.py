"""What a simulated camera sees: the radiance of sample and reference piece, frame by frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tvbrdf_fitting.geometry import (
    CAMERA_ANGLES_DEG,
    TILT_DEG,
    light_direction,
    view_direction,
)

from ..core.device import DeviceError
from ..world.sample import SampleError, make_sample
from ..world.scene import Scene
from .driver import CaptureTag
from .simulated_light import SimulatedLight

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

REFERENCE_ALBEDO = np.array([0.7410, 0.7438, 0.752])
"""Of the grey Spectralon piece, B, G, R."""
HIDDEN_CAMERA = 1
HIDDEN_HALF_WIDTH_DEG = 1.5
"""The arm is between the top camera and the sample while the light is this near the vertical."""
ARM_RADIANCE = 0.02
"""Of the arm, in the light's own glow."""
LIGHT_RADIUS_CM = 44.0
CAMERA_DISTANCE_CM = 94.0
TRAY_HALF_WIDTH_CM = 2.54
_TRAY_NODES = 9

_GAUSS_NODES = np.array([-0.5, 0.0, 0.5]) * np.sqrt(3.0 / 5.0)
_GAUSS_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0


class SimulatedView:
    """The scene as one camera sees it.

    Raises
    ------
    DeviceError
        If the scene's sample can't be used.
    """

    def __init__(self, scene: Scene, camera: int, light: SimulatedLight) -> None:
        self._scene, self._camera, self._light = scene, camera, light
        try:
            self._sample = make_sample(scene.sample)
        except SampleError as error:
            raise DeviceError(f"scene: {error}") from error
        self._hidden = scene.hidden_by_arm and camera == HIDDEN_CAMERA
        blur = scene.camera.motion_blur
        self._nodes = _GAUSS_NODES if blur else np.zeros(1)
        self._weights = _GAUSS_WEIGHTS if blur else np.ones(1)
        self._tray = _Tray(camera) if scene.camera.near_field else None
        if self._tray is not None:
            straight = np.array([[0.0, 0.0, 1.0]])
            if self._sample.directional_radiance(straight, straight, 0.0) is None:
                raise DeviceError(
                    "scene: near_field needs an analytic sample; a measured one is known for the "
                    "rig's own directions only: switch near_field off"
                )

    @property
    def textured(self) -> bool:
        """Whether the sample's radiance differs from pixel to pixel."""
        return self._tray is not None

    def radiance(self, tag: CaptureTag, middle_ns: IntArray, exposure_ns: IntArray) -> FloatArray:
        """Return the lamp's part of the radiance, averaged over each exposure.

        Parameters
        ----------
        tag
            What the frames are taken for.
        middle_ns, exposure_ns
            (n,) middle and duration of each frame's exposure.

        Returns
        -------
        array (n, 2, 3): sample and reference piece, B, G, R

        Raises
        ------
        DeviceError
            If a file of a measured sample can't be read.
        """
        angle_deg, brightness = self._light_during(middle_ns, exposure_ns)
        shape = (*angle_deg.shape, 3)
        angles = angle_deg.ravel()
        radiance = np.empty((angles.size, 2, 3))
        try:
            radiance[:, 0] = self._of_sample(tag, angles, np.repeat(middle_ns, self._nodes.size))
        except SampleError as error:
            raise DeviceError(f"scene: {error}") from error
        cosine = np.cos(np.deg2rad(angles - TILT_DEG))
        radiance[:, 1] = REFERENCE_ALBEDO * np.maximum(cosine, 0.0)[:, None]
        if self._hidden:
            radiance[np.abs(angles) < HIDDEN_HALF_WIDTH_DEG] = ARM_RADIANCE
        radiance *= brightness.reshape(-1, 1, 1)
        if self._nodes.size == 1:
            return radiance
        over_exposure = radiance.reshape(shape[0], shape[1], 2, 3)
        return np.asarray(np.einsum("nkbc,k->nbc", over_exposure, self._weights))

    def _light_during(
        self, middle_ns: IntArray, exposure_ns: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Angle and brightness (n, k) at the k moments of each exposure."""
        moments = middle_ns[:, None] + (exposure_ns[:, None] * self._nodes).astype(np.int64)
        return self._light.at(moments)

    def _of_sample(self, tag: CaptureTag, angles: FloatArray, times_ns: IntArray) -> FloatArray:
        if not self._scene.evolves_during_scan:
            return self._sample.radiance(self._camera, angles, tag.scan_time_s, tag.scan)
        found = np.empty((angles.size, 3))
        for time_ns in np.unique(times_ns):
            at_once = times_ns == time_ns
            time_s = self._time_s(tag, int(time_ns))
            found[at_once] = self._sample.radiance(self._camera, angles[at_once], time_s, tag.scan)
        return found

    def _time_s(self, tag: CaptureTag, time_ns: int) -> float:
        if not self._scene.evolves_during_scan:
            return tag.scan_time_s
        return tag.scan_time_s + (time_ns - tag.scan_start_ns) * 1e-9

    def texture(
        self,
        tag: CaptureTag,
        middle_ns: int,
        exposure_ns: int,
        rows: FloatArray,
        columns: FloatArray,
    ) -> FloatArray:
        """Return the lamp's part of the sample's radiance, pixel by pixel (near field).

        Parameters
        ----------
        tag, middle_ns, exposure_ns
            As in :meth:`radiance`, of one frame.
        rows, columns
            Places of the pixels on the tray, -1 to 1; rows run down, columns along the light's way.

        Returns
        -------
        array (number of rows, number of columns, 3)
        """
        if self._tray is None:
            raise ValueError("texture() is for scenes with near_field")
        angles, brightness = self._light_during(np.array([middle_ns]), np.array([exposure_ns]))
        time_s = self._time_s(tag, middle_ns)
        coarse = np.zeros((_TRAY_NODES * _TRAY_NODES, 3))
        for angle, bright, weight in zip(angles[0], brightness[0], self._weights, strict=True):
            if self._hidden and abs(angle) < HIDDEN_HALF_WIDTH_DEG:
                coarse += weight * bright * ARM_RADIANCE
                continue
            light, view = self._tray.directions(angle)
            found = self._sample.directional_radiance(light, view, time_s)
            if found is not None:
                coarse += weight * bright * found
        return self._tray.upsample(coarse, rows, columns)


class _Tray:
    """A coarse grid of places on the tray, each with its own directions.

    Only directions differ: the lamp's brightness is taken as the same all over the tray.
    """

    def __init__(self, camera: int) -> None:
        self.places = np.linspace(-1.0, 1.0, _TRAY_NODES)
        y, x = np.meshgrid(-self.places, self.places, indexing="ij")
        points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        self._points_cm = TRAY_HALF_WIDTH_CM * points
        axis = view_direction(CAMERA_ANGLES_DEG[camera - 1])
        self._view = _unit(CAMERA_DISTANCE_CM * axis - self._points_cm)

    def directions(self, angle_deg: float) -> tuple[FloatArray, FloatArray]:
        """Return unit vectors (nodes², 3) to the light and to the camera."""
        light_cm = LIGHT_RADIUS_CM * light_direction(angle_deg)
        return _unit(light_cm - self._points_cm), self._view

    def upsample(self, coarse: FloatArray, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """Return values (rows, columns, 3), bilinear between the nodes."""
        grid = coarse.reshape(_TRAY_NODES, _TRAY_NODES, 3)
        down, along = self._weights(rows), self._weights(columns)
        return np.asarray(np.einsum("ri,ijc,kj->rkc", down, grid, along, optimize=True))

    def _weights(self, places: FloatArray) -> FloatArray:
        position = (np.clip(places, -1.0, 1.0) + 1.0) * (_TRAY_NODES - 1) / 2.0
        nodes = np.arange(_TRAY_NODES)
        return np.maximum(1.0 - np.abs(position[:, None] - nodes), 0.0)


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
