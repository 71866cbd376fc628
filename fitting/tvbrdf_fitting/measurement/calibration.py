"""Calibration of the rig: the dataclasses, and the strict reader of a calibration file.

What a frame's pixel means (see `CameraCalibration`):

    linear_dn = response(code)
    signal_dn = linear_dn - black level
    radiance  = signal_dn / exposure_ms * radiance_per_dn_per_ms

with one constant a camera and channel, such that radiance 1 is a perfect white diffuser facing
the light: radiance = pi * BRDF * cos(theta_i). When a frame was taken (all in milliseconds):

    received = middle of exposure + exposure / 2 + frame_delay + jitter,   jitter >= 0

where ``frame_delay`` is the smallest time from the end of an exposure to the frame's arrival.
Colours are in B, G, R order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import FloatArray, view_direction
from .response import (
    MAX_BIT_DEPTH,
    MIN_BIT_DEPTH,
    Response,
    ResponseKind,
    largest_code,
)
from .strict_fields import StrictFields, numbers_of

Bgr = tuple[float, float, float]
HardwareStampEvent = Literal["exposure_start", "exposure_middle", "exposure_end"]

CAMERAS = (1, 2, 3, 4)


class CalibrationError(ValueError):
    """A calibration that cannot be used; the message names file, key and what to do."""


@dataclass(frozen=True)
class Rectangle:
    """Part of the region of interest, in fractions of its width and height.

    So one file serves every size of region. x runs right and y down from the upper left corner.
    """

    x: float
    y: float
    width: float
    height: float

    def pixels(self, image_width: int, image_height: int) -> tuple[slice, slice]:
        """Rows and columns of the rectangle in an image of the given size.

        Edges are rounded to whole pixels, so rectangles that share an edge never overlap.

        Raises
        ------
        ValueError
            If no whole pixel is left.
        """
        left, right = round(self.x * image_width), round((self.x + self.width) * image_width)
        upper, lower = round(self.y * image_height), round((self.y + self.height) * image_height)
        if right <= left or lower <= upper:
            raise ValueError(
                f"{self} holds no pixel of a {image_width}x{image_height} region: "
                "use a larger region of interest or a larger rectangle"
            )
        return slice(upper, lower), slice(left, right)


@dataclass(frozen=True)
class CameraCalibration:
    """One camera. dn are codes on the linear scale of `tvbrdf_fitting.measurement.response`.

    Parameters
    ----------
    camera : int
        1 to 4.
    camera_angle_deg : float
        From the plate's vertical, in the cameras' plane.
    response : Response
        From codes to linear dn.
    bit_depth : int
        8 (frames of uint8) to 16 (uint16); codes lie in [0, 2**bit_depth).
    black_level_dn, black_level_std_dn : float
        Linear dn without light, and its standard deviation; dark frames replace both.
    saturation_dn : int
        Codes at or above are saturated.
    max_saturated_fraction : float
        Largest share of a rectangle's pixels that may saturate before its channel is masked. 0
        unless the sensor has hot pixels: light clipped in a share p of the pixels lowers the
        mean by an unknown amount that p bounds for stuck pixels only.
    gain_e_per_dn, read_noise_e : float
        Photon transfer: electrons a linear dn, and the noise of a pixel without light.
    relative_noise_std : float
        Noise proportional to the signal and common to a frame's pixels (flicker of the lamp).
    radiance_per_dn_per_ms : (float, float, float)
        The radiometric constants B, G, R.
    gain_relative_std : float
        Relative standard deviation of these constants (shared by all frames).
    frame_delay_ms, frame_delay_std_ms : float
        Smallest time from the end of exposure to arrival, and its standard deviation.
    hardware_stamp_event : {"exposure_start", "exposure_middle", "exposure_end"}
        What the device's own time stamp marks.
    patch : Rectangle
        Where the sample's radiance is averaged.
    reference_patch : Rectangle or None
        Where a piece of known albedo under the same light is seen, if anywhere.
    hidden_light_intervals_deg : tuple of (float, float)
        World angles of the light at which the arm hides the sample from this camera.
    """

    camera: int
    camera_angle_deg: float
    response: Response
    bit_depth: int
    black_level_dn: float
    black_level_std_dn: float
    saturation_dn: int
    max_saturated_fraction: float
    gain_e_per_dn: float
    read_noise_e: float
    relative_noise_std: float
    radiance_per_dn_per_ms: Bgr
    gain_relative_std: float
    frame_delay_ms: float
    frame_delay_std_ms: float
    hardware_stamp_event: HardwareStampEvent
    patch: Rectangle
    reference_patch: Rectangle | None
    hidden_light_intervals_deg: tuple[tuple[float, float], ...]

    @property
    def saturation_linear_dn(self) -> float:
        """Linear dn of the lowest saturated code."""
        return float(self.response.linear_table(self.bit_depth)[self.saturation_dn])

    def pixel_variance_dn2(self, signal_dn: ArrayLike) -> FloatArray:
        """Variance of one pixel of one frame in linear dn squared, by photon transfer.

        read noise**2 + shot noise (its variance in electrons is the number of electrons) +
        rounding to codes (slope**2 / 12). The common noise of a frame is not part of it.

        Parameters
        ----------
        signal_dn : array_like
            Linear dn above the black level, any shape; below 0 there is no shot noise.
        """
        signal = np.maximum(np.asarray(signal_dn, dtype=np.float64), 0.0)
        slope = self.response.slope(signal + self.black_level_dn, self.bit_depth)
        shot_and_read = signal / self.gain_e_per_dn + (self.read_noise_e / self.gain_e_per_dn) ** 2
        return np.asarray(shot_and_read + slope**2 / 12.0)

    def with_bit_depth(self, bit_depth: int) -> CameraCalibration:
        """Calibration of the same sensor read out with another number of bits."""
        ratio = largest_code(bit_depth) / largest_code(self.bit_depth)
        blue, green, red = (constant / ratio for constant in self.radiance_per_dn_per_ms)
        return replace(
            self,
            bit_depth=bit_depth,
            black_level_dn=self.black_level_dn * ratio,
            black_level_std_dn=self.black_level_std_dn * ratio,
            saturation_dn=round(self.saturation_dn * ratio),
            gain_e_per_dn=self.gain_e_per_dn / ratio,
            radiance_per_dn_per_ms=(blue, green, red),
        )


@dataclass(frozen=True)
class Calibration:
    """The whole rig: tilt of the plate, light's circle, reference piece and the four cameras.

    ``reference_relative_std`` is the relative standard deviation of the reference's albedo: the
    scale's uncertainty that is left where a camera sees the reference.
    """

    tilt_deg: float
    light_radius_cm: float
    camera_distance_cm: float
    reference_albedo: Bgr
    reference_relative_std: float
    cameras: tuple[CameraCalibration, ...]

    def camera(self, number: int) -> CameraCalibration:
        """Calibration of camera 1 to 4."""
        for camera in self.cameras:
            if camera.camera == number:
                return camera
        raise CalibrationError(f"camera {number} is not calibrated; the rig has {CAMERAS}")

    @property
    def view_directions(self) -> FloatArray:
        """Unit vectors to the cameras in the sample's frame, (4, 3), derived from their angles."""
        return np.stack(
            [view_direction(camera.camera_angle_deg, self.tilt_deg) for camera in self.cameras]
        )


class _Fields(StrictFields):
    fault = CalibrationError


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration file (YAML).

    Raises
    ------
    CalibrationError
        If the file is missing, is no YAML, lacks a key, has an unknown one or a value out of
        range.
    """
    file = Path(path)
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(
            f"calibration {file}: cannot be read ({error}); give the path of a calibration file"
        ) from error
    return parse_calibration(text, source=str(file))


def parse_calibration(text: str, source: str = "calibration") -> Calibration:
    """Read the text of a calibration file; ``source`` is named in errors."""
    import yaml

    try:
        data = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise CalibrationError(f"{source}: is not valid YAML: {error}") from error
    return calibration_from_dict(data, source)


def calibration_from_dict(data: object, source: str = "calibration") -> Calibration:
    """Build a calibration from a mapping with the file's keys; ``source`` is named in errors.

    Keys of ``every_camera`` hold for all cameras; those of a camera override them.
    """
    top = _Fields(data, source)
    every_camera, numbered = top.mapping("every_camera"), top.mapping("cameras")
    if set(numbered) != set(CAMERAS):
        found = ", ".join(map(str, numbered)) or "none"
        raise CalibrationError(
            f"{source}: cameras: has {found}; give each of 1, 2, 3, 4 and no other"
        )
    cameras = []
    for number in CAMERAS:
        where = f"{source}: cameras: {number}"
        own = numbered[number] if numbered[number] is not None else {}
        cameras.append(_camera(number, _Fields(own, where, every_camera)))
    calibration = Calibration(
        tilt_deg=top.number("tilt_deg", -45.0, 45.0),
        light_radius_cm=top.number("light_radius_cm", 1e-3),
        camera_distance_cm=top.number("camera_distance_cm", 1e-3),
        reference_albedo=top.bgr("reference_albedo"),
        reference_relative_std=top.number("reference_relative_std", 0.0, 1.0),
        cameras=tuple(cameras),
    )
    top.finish()
    return calibration


def _camera(number: int, fields: _Fields) -> CameraCalibration:
    bit_depth = fields.integer("bit_depth", MIN_BIT_DEPTH, MAX_BIT_DEPTH)
    top = largest_code(bit_depth)
    camera = CameraCalibration(
        camera=number,
        camera_angle_deg=fields.number("camera_angle_deg", -89.0, 89.0),
        response=_response(fields.child("response")),
        bit_depth=bit_depth,
        black_level_dn=fields.number("black_level_dn", 0.0, float(top)),
        black_level_std_dn=fields.number("black_level_std_dn", 0.0),
        saturation_dn=fields.integer("saturation_dn", 1, top),
        max_saturated_fraction=fields.number("max_saturated_fraction", 0.0, 0.01),
        gain_e_per_dn=fields.number("gain_e_per_dn", 1e-9),
        read_noise_e=fields.number("read_noise_e", 0.0),
        relative_noise_std=fields.number("relative_noise_std", 0.0, 1.0),
        radiance_per_dn_per_ms=fields.bgr("radiance_per_dn_per_ms"),
        gain_relative_std=fields.number("gain_relative_std", 0.0, 1.0),
        frame_delay_ms=fields.number("frame_delay_ms", 0.0),
        frame_delay_std_ms=fields.number("frame_delay_std_ms", 0.0),
        hardware_stamp_event=fields.choice(
            "hardware_stamp_event", "exposure_start", "exposure_middle", "exposure_end"
        ),
        patch=_rectangle(fields.child("patch")),
        reference_patch=_optional_rectangle(fields, "reference_patch"),
        hidden_light_intervals_deg=_intervals(fields, "hidden_light_intervals_deg"),
    )
    fields.finish()
    if camera.black_level_dn >= camera.saturation_linear_dn:
        highest = f"give one below saturation, {camera.saturation_linear_dn:g} linear dn"
        raise fields.error("black_level_dn", camera.black_level_dn, highest)
    return camera


def _response(fields: _Fields) -> Response:
    kind: ResponseKind = fields.choice("kind", "linear", "gamma", "table")
    exponent = 1.0
    linear: tuple[float, ...] = ()
    code: tuple[float, ...] = ()
    if kind == "gamma":
        exponent = fields.number("exponent")
    elif kind == "table":
        linear, code = fields.numbers("linear"), fields.numbers("code")
    fields.finish()
    try:
        return Response(kind, exponent, linear, code)
    except ValueError as error:
        raise CalibrationError(f"{fields.where}: {error}") from error


def _rectangle(fields: _Fields) -> Rectangle:
    x, y = fields.number("x", 0.0, 1.0), fields.number("y", 0.0, 1.0)
    width, height = fields.number("width", 1e-6, 1.0), fields.number("height", 1e-6, 1.0)
    fields.finish()
    if max(x + width, y + height) > 1.0 + 1e-9:
        raise CalibrationError(
            f"{fields.where}: reaches to {x + width:g} x {y + height:g} of the region of interest; "
            "give fractions (not pixels) with x + width and y + height at most 1"
        )
    return Rectangle(x, y, width, height)


def _optional_rectangle(fields: _Fields, key: str) -> Rectangle | None:
    if fields.take(key) is None:
        return None
    return _rectangle(fields.child(key))


def _intervals(fields: _Fields, key: str) -> tuple[tuple[float, float], ...]:
    value = fields.take(key)
    remedy = "give a list of [from, to] in degrees within [-180, 180], or [] for none"
    pairs = [numbers_of(pair, 2) for pair in value] if isinstance(value, list) else [None]
    intervals = []
    for pair in pairs:
        if pair is None or not -180.0 <= pair[0] < pair[1] <= 180.0:
            raise fields.error(key, value, remedy)
        intervals.append((pair[0], pair[1]))
    return tuple(intervals)
