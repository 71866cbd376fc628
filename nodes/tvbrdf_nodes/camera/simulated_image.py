"""From radiance to an image: response, noise, saturation and quantisation of a simulated sensor.

linear dn = black level + radiance · exposure · dn_per_radiance_ms · gain error. Shot noise has the
variance of the electrons, read noise is added, and the response maps linear dn to codes
(`tvbrdf_fitting.measurement.response`). An image has up to two bands of rows: the sample's above,
the grey reference piece's in the lowest eighth of the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tvbrdf_fitting.measurement.response import Response, largest_code

from ..world.scene import CameraEffects
from .driver import Region
from .simulated_noise import GAIN, FrameDraws, NoiseField, generator

if TYPE_CHECKING:
    from .driver import Image

FloatArray = NDArray[np.float64]

REFERENCE_ROWS = 1 / 8
"""Part of the sensor, at its lower edge, that shows the reference piece."""
BITS = 12
"""Of the parameters that are given in dn."""
SAMPLE, REFERENCE = 0, 1
_SURE_SIGMAS = 6.0
"""No value of the noise field of the largest sensor is beyond that by chance of 1 in 100."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedCameraParameters:
    """What a simulated camera is; what goes wrong with it is the scene's business."""

    camera: int
    """1 to 4: where it stands."""
    width: int = 128
    """Of the sensor, pixels."""
    height: int = 128
    bit_depth: int = 12
    frame_rate_hz: float = 120.0
    """Highest rate that the sensor can have; the node's own parameter sets the rate."""
    black_level_dn: float = 64.0
    """Of 12 bits; scaled with the depth."""
    full_well_e: float = 10_000.0
    """Electrons at the largest code."""
    read_noise_e: float = 5.0
    dn_per_radiance_ms: tuple[float, ...] = (604.65, 604.65, 604.65)
    """B, G, R, of 12 bits: a white diffuser facing the light gives 60 % of full scale at 4 ms."""
    response: str = "linear"
    """Or ``gamma``."""
    response_exponent: float = 0.4545
    """Of ``gamma``: code = linear ** exponent, both as fractions of the largest code."""
    frame_delay_ms: float = 5.0
    """From the end of an exposure to the earliest arrival of its frame."""

    def __post_init__(self) -> None:
        """Refuse values that make no camera."""
        if self.camera not in (1, 2, 3, 4):
            raise ValueError(f"camera is {self.camera}, expected 1, 2, 3 or 4")
        if not 8 <= self.bit_depth <= 16:
            raise ValueError(f"bit_depth is {self.bit_depth}, expected 8 to 16")
        if not 1 <= self.width <= 8192 or not 1 <= self.height <= 8192:
            raise ValueError(f"sensor of {self.width}x{self.height}, expected 1 to 8192 each")
        if len(self.dn_per_radiance_ms) != 3 or min(self.dn_per_radiance_ms) <= 0:
            raise ValueError("dn_per_radiance_ms needs three numbers above 0: B, G, R")
        if self.response not in ("linear", "gamma"):
            raise ValueError(f"response is {self.response!r}, expected linear or gamma")
        if self.full_well_e <= 0 or self.read_noise_e < 0 or self.frame_delay_ms < 0:
            raise ValueError("full_well_e must be above 0; read_noise_e, frame_delay_ms 0 or more")
        if not 0 <= self.black_level_dn < 4095 or self.frame_rate_hz <= 0:
            raise ValueError("black_level_dn must be in [0, 4095), frame_rate_hz above 0")


class Bands:
    """Which rows of a region show what."""

    def __init__(self, region: Region, sensor_height: int) -> None:
        first = round((1.0 - REFERENCE_ROWS) * sensor_height)
        edge = min(max(first - region.y, 0), region.height)
        self.width, self.height = region.width, region.height
        self.edges: tuple[int, ...] = (0, edge, region.height)
        self.shown: tuple[int, ...] = (SAMPLE, REFERENCE)
        if edge in (0, region.height):
            self.edges = (0, region.height)
            self.shown = (SAMPLE,) if edge else (REFERENCE,)


class ImageMaker:
    """Makes the images of one camera; keeps its buffers between them.

    Parameters
    ----------
    parameters, effects, seed
        Of the camera and of the scene.
    """

    def __init__(
        self, parameters: SimulatedCameraParameters, effects: CameraEffects, seed: int
    ) -> None:
        import cv2

        cv2.setNumThreads(1)
        self._cv2: Any = cv2
        self._effects, self._depth = effects, parameters.bit_depth
        self._top = float(largest_code(parameters.bit_depth))
        ratio = self._top / largest_code(BITS)
        self._black = parameters.black_level_dn * ratio
        self._electron_dn = (self._top - self._black) / parameters.full_well_e
        self._read_variance = (parameters.read_noise_e * self._electron_dn) ** 2
        errors = generator(seed, parameters.camera, GAIN).standard_normal(3)
        gain = 1.0 + effects.gain_error_std * errors
        self._dn_per_radiance_ms = np.array(parameters.dn_per_radiance_ms) * ratio * gain
        self._response = Response()
        if parameters.response == "gamma":
            self._response = Response("gamma", parameters.response_exponent)
        self._dtype: np.dtype[np.uint8] | np.dtype[np.uint16] = (
            np.dtype(np.uint8) if parameters.bit_depth == 8 else np.dtype(np.uint16)
        )
        self._largest = float(np.iinfo(self._dtype).max)
        self._cv_type = cv2.CV_8U if parameters.bit_depth == 8 else cv2.CV_16U
        self._noisy = effects.shot_noise or (effects.read_noise and parameters.read_noise_e > 0)
        self.noise = NoiseField(
            seed,
            parameters.camera,
            *((parameters.height, parameters.width) if self._noisy else (0, 0)),
        )
        self._buffer = np.empty((0, 0, 3), dtype=np.float32)
        self._row = np.empty((0, 3), dtype=np.float32)

    def signal_dn(self, radiance: FloatArray, exposure_ms: float) -> FloatArray:
        """Return linear dn above the black level for radiances (..., 3)."""
        return np.asarray(radiance * (exposure_ms * self._dn_per_radiance_ms))

    def make(self, bands: Bands, signal_dn: FloatArray, draws: FrameDraws) -> Image:
        """Return one image of uniform bands.

        Parameters
        ----------
        bands
            Which rows show what.
        signal_dn
            (number of bands, 3) linear dn above the black level.
        draws
            Everything random about the frame.
        """
        if not self._noisy:
            return self._flat(bands, signal_dn + self._black)
        if not (self._effects.quantisation and self._response.is_linear):
            signals = [np.broadcast_to(s, (1, bands.width, 3)) for s in signal_dn]
            return self.make_textured(bands, signals, draws)
        cv2, width = self._cv2, bands.width
        buffer, row = self._buffers(bands.height, width)
        sigma = np.sqrt(self._variance(signal_dn))
        mean = signal_dn + (self._black + sigma * draws.shift)
        sigma *= draws.scale
        out = np.empty((bands.height, width, 3), dtype=self._dtype)
        window = self.noise.window(draws.row, draws.column, bands.height, width)
        flat = buffer.reshape(bands.height, 3 * width)
        for k, (first, last) in enumerate(zip(bands.edges[:-1], bands.edges[1:], strict=True)):
            row[:] = sigma[k]
            np.multiply(window[first:last], row.reshape(-1), out=flat[first:last])
            # adds, rounds and cuts off at the type's ends in one pass
            level = (*mean[k].tolist(), 0.0)
            cv2.add(buffer[first:last], level, dst=out[first:last], dtype=self._cv_type)
        self._cut(out, float((mean + _SURE_SIGMAS * np.abs(sigma)).max()))
        return out

    def _cut(self, out: Image, highest: float) -> None:
        """Saturate codes that the image's type can hold but the sensor can't."""
        if self._effects.saturation and highest >= self._top < self._largest:
            codes = out.reshape(out.shape[0], -1)
            self._cv2.min(codes, self._top, dst=codes)

    def _variance(self, signal_dn: FloatArray) -> FloatArray:
        variance = np.full_like(signal_dn, self._read_variance if self._effects.read_noise else 0.0)
        if self._effects.shot_noise:
            variance += np.maximum(signal_dn, 0.0) * self._electron_dn
        return variance

    def _buffers(self, height: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        if self._buffer.shape[:2] != (height, width):
            self._buffer = np.empty((height, width, 3), dtype=np.float32)
            self._row = np.empty((width, 3), dtype=np.float32)
        return self._buffer, self._row

    def _flat(self, bands: Bands, linear_dn: FloatArray) -> Image:
        """Return an image without noise: one code a band."""
        codes = self._codes(linear_dn)
        out: Image = np.empty((bands.height, bands.width, 3), dtype=codes.dtype)
        for k, (first, last) in enumerate(zip(bands.edges[:-1], bands.edges[1:], strict=True)):
            # a whole row at a time is many times as fast as a pixel at a time
            out[first:last] = np.tile(codes[k], (bands.width, 1))
        return out

    def make_textured(self, bands: Bands, signals_dn: list[FloatArray], draws: FrameDraws) -> Image:
        """Return one image whose bands may differ from pixel to pixel.

        Parameters
        ----------
        bands, draws
            As in :meth:`make`.
        signals_dn
            For each band, linear dn above the black level: (rows or 1, width or 1, 3).
        """
        linear = np.empty((bands.height, bands.width, 3))
        for k, (first, last) in enumerate(zip(bands.edges[:-1], bands.edges[1:], strict=True)):
            linear[first:last] = signals_dn[k] + self._black
            if self._noisy:
                row = draws.row + first
                window = self.noise.window(row, draws.column, last - first, bands.width)
                normal = window.reshape(last - first, bands.width, 3) * draws.scale[k]
                normal += draws.shift[k]
                linear[first:last] += np.sqrt(self._variance(signals_dn[k])) * normal
        return self._codes(linear)

    def _codes(self, linear_dn: FloatArray) -> Image:
        """Return codes of linear dn: through the response, cut off, rounded."""
        codes = linear_dn
        if not self._response.is_linear:
            codes = self._response.encode(linear_dn, self._depth)
        quantised = self._effects.quantisation
        if self._effects.saturation or quantised:
            top = self._top if self._effects.saturation else self._largest
            codes = np.clip(codes, 0.0, top)
        if quantised and self._depth == 8:
            return np.rint(codes).astype(np.uint8)
        if quantised:
            return np.rint(codes).astype(np.uint16)
        return codes.astype(np.float32)
