"""Stills: figures, histograms, pictures, and exposures merged to linear radiance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tvbrdf_fitting.measurement.calibration import CameraCalibration
    from tvbrdf_messages.messages import Frame

BINS = 32
CHANNELS = ("B", "G", "R")
_BARS = " ▁▂▃▄▅▆▇█"


@dataclass(frozen=True, slots=True)
class StillFigures:
    """What a still shows; arrays in B, G, R order."""

    camera: str
    exposure_ms: float
    mean: NDArray[np.float64]
    """Codes, (3,)."""
    minimum: NDArray[np.float64]
    maximum: NDArray[np.float64]
    saturated_percent: NDArray[np.float64]
    """Of the pixels, at or above ``saturation_dn``."""
    histogram: NDArray[np.int64]
    """Pixels in :data:`BINS` equal steps of code from 0 to full scale, (3, BINS)."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "camera": self.camera,
            "exposure_ms": self.exposure_ms,
            **{
                name: dict(zip(CHANNELS, getattr(self, name).tolist(), strict=True))
                for name in ("mean", "minimum", "maximum", "saturated_percent", "histogram")
            },
        }


def figures(frame: Frame, saturation_dn: float) -> StillFigures:
    """Return the figures of a frame whose codes saturate at ``saturation_dn``."""
    pixels = frame.image.reshape(-1, 3)
    top = float(1 << frame.bit_depth)
    histogram = np.stack(
        [np.histogram(pixels[:, c], bins=BINS, range=(0.0, top))[0] for c in range(3)]
    )
    return StillFigures(
        camera=frame.camera,
        exposure_ms=frame.exposure_ms,
        mean=pixels.mean(axis=0, dtype=np.float64),
        minimum=pixels.min(axis=0).astype(np.float64),
        maximum=pixels.max(axis=0).astype(np.float64),
        saturated_percent=100.0 * (pixels >= saturation_dn).mean(axis=0),
        histogram=histogram.astype(np.int64),
    )


def bars(histogram: NDArray[np.int64]) -> str:
    """Return a histogram of shape (n,) as n characters, by the logarithm of the counts."""
    heights = np.log1p(histogram.astype(np.float64))
    top = max(float(heights.max()), 1e-9)
    # a bin with even one pixel shows
    levels = np.where(histogram > 0, np.maximum(1, np.round(8 * heights / top)), 0).astype(int)
    return "".join(_BARS[level] for level in levels)


def merge_stills(
    frames: Sequence[Frame], camera: CameraCalibration
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Merge stills of one camera, one an exposure, into linear radiance.

    Returns
    -------
    radiance
        (height, width, 3), float32, channels B, G, R; 1 is a white diffuser facing the light. Where
        all exposures are saturated, the shortest one's: a lower limit.
    known
        Whether any exposure was not saturated there, same shape.

    Raises
    ------
    ValueError
        If the frames differ in shape, or are of other bits than the calibration.
    """
    from tvbrdf_fitting.measurement.exposure_merge import PixelRadiance, merge_exposures

    shapes = {frame.image.shape for frame in frames}
    if len(shapes) != 1:
        raise ValueError(f"stills of {len(shapes)} shapes: {sorted(shapes)}")
    calibrated = camera.with_bit_depth(frames[0].bit_depth)
    pixels = PixelRadiance(calibrated, calibrated.black_level_dn)
    exposed = [pixels.exposed(frame.image, frame.exposure_ms) for frame in frames]
    return merge_exposures(exposed, calibrated)


def write_png(path: Path, frame: Frame) -> None:
    """Write a still as PNG; more than 8 bits are stored as 16 with full scale at 65535."""
    import cv2

    image: NDArray[Any] = frame.image
    if image.dtype != np.uint8:
        codes = image.astype(np.float64) * (65535.0 / ((1 << frame.bit_depth) - 1))
        image = np.clip(np.round(codes), 0, 65535).astype(np.uint16)
    if not cv2.imwrite(str(path), np.ascontiguousarray(image)):
        raise OSError(f"{path} can't be written")


def write_exr(path: Path, radiance: NDArray[np.float32], frames: Sequence[Frame]) -> None:
    """Write linear radiance, (height, width, 3) in B, G, R order, as OpenEXR in float32."""
    import OpenEXR

    # OpenEXR writes wrong pixels for arrays that are not contiguous, and changes its header
    rgb = np.ascontiguousarray(radiance[..., ::-1], dtype=np.float32)
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "camera": frames[0].camera,
        "exposures_ms": ", ".join(f"{frame.exposure_ms:g}" for frame in frames),
        "comments": "pi * BRDF * cos(theta_i); 1: a white diffuser facing the light",
    }
    with OpenEXR.File(header, {"RGB": rgb}) as file:
        file.write(str(path))
