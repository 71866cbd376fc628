"""Exposures merged pixel by pixel, at the light positions of one sweep's frames.

The sweeps of a scan, one an exposure, have their frames at different light positions. So the
positions are those of the longest exposure's frames, whose pixels enter as they are; each other
exposure is brought there by a straight line between the two frames around it, in the light's
angle. At half a degree between frames that is off by at most 0.5 % of the height of a lobe of
sigma_s = 0.03 (h**2 / 8 · f'', with f'' = 2 / (2 sigma_s)**2 at its peak), and exact where the
radiance is a straight line in the angle.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tvbrdf_fitting.measurement.calibration import CameraCalibration
from tvbrdf_fitting.measurement.exposure_merge import Exposed, PixelRadiance, merge_exposures
from tvbrdf_messages.bag import BagReader
from tvbrdf_messages.messages import Frame
from tvbrdf_messages.topics import frame_topic

from .scans import CameraSweep, LitFrame, Place

BLOCK_FRAMES = 8
"""Read at once: neighbours share chunks of the bag."""
KEPT_BLOCKS = 2
MAX_GAP = 2.5
"""Between the two frames around a position, in the sweep's usual steps."""


class BlockReader:
    """Gives one camera's frames of one sweep in any order; keeps two blocks of them."""

    def __init__(self, bag: BagReader, camera: str, sweep: CameraSweep) -> None:
        self._bag, self._topic = bag, frame_topic(camera)
        self._places = [frame.place for frame in sweep.frames]
        self._blocks: dict[int, dict[Place, Frame]] = {}

    def frame(self, index: int) -> Frame:
        """Return a frame by its place in the sweep."""
        number = index // BLOCK_FRAMES
        block = self._blocks.pop(number, None)
        if block is None:
            block = self._read(self._places[number * BLOCK_FRAMES :][:BLOCK_FRAMES])
        self._blocks[number] = block  # the last used is the last
        while len(self._blocks) > KEPT_BLOCKS:
            del self._blocks[next(iter(self._blocks))]
        return block[self._places[index]]

    def _read(self, places: list[Place]) -> dict[Place, Frame]:
        wanted = {*places}
        times = [place.log_time_ns for place in places]
        found: dict[Place, Frame] = {}
        for log_time_ns, envelope in self._bag.messages([self._topic], min(times), max(times) + 1):
            place = Place(log_time_ns, envelope.header.incarnation, envelope.header.sequence)
            if place in wanted and isinstance(envelope.message, Frame):
                found[place] = envelope.message
        return found


@dataclass(frozen=True)
class HdrImage:
    """Linear radiance at one light position: pi · BRDF · cos(theta_i)."""

    radiance: NDArray[np.float32]
    """(height, width, 3), channels B, G, R."""
    light_angle_deg: float
    exposures_ms: tuple[float, ...]
    stamps_ns: tuple[int, ...]
    """Of each exposure the frame that is nearest in angle."""
    saturated_fraction: float
    """Of the values, that were saturated in every exposure: a lower limit stands there."""
    left: int
    """Of the image's left upper corner on the sensor, pixels."""
    upper: int


def hdr_images(
    bag: BagReader,
    name: str,
    sweeps: Sequence[CameraSweep],
    camera: CameraCalibration,
    *,
    whole: bool = False,
) -> Iterator[HdrImage]:
    """Yield an image for each light position of the longest exposure that the others cover too.

    Parameters
    ----------
    sweeps
        One camera's of one scan.
    whole
        The whole frame instead of the sample's patch.
    """
    readers = [BlockReader(bag, name, sweep) for sweep in sweeps]
    pixels = [_Pixels(camera, sweep.dark_dn, whole=whole) for sweep in sweeps]
    main = sweeps.index(longest(sweeps))
    for position, at in enumerate(sweeps[main].frames):
        around = [_around(sweep.frames, at.light_angle_deg) for sweep in sweeps]
        places = [pair for pair in around if pair is not None]
        if len(places) < len(sweeps):
            continue
        exposed, stamps = [], []
        for sweep, reader, made, (index, u) in zip(sweeps, readers, pixels, places, strict=True):
            exposed.append(_exposed(reader, made, sweep, index, u))
            stamps.append(sweep.frames[index + (u > 0.5)].stamp_ns)
        frame = readers[main].frame(position)
        rows, columns = pixels[main].window(frame.image)
        radiance, known = merge_exposures(exposed, camera)
        yield HdrImage(
            radiance=radiance,
            light_angle_deg=at.light_angle_deg,
            exposures_ms=tuple(each.exposure_ms for each in exposed),
            stamps_ns=tuple(stamps),
            saturated_fraction=float(1.0 - known.mean()),
            left=frame.region_x + columns.start,
            upper=frame.region_y + rows.start,
        )


def longest(sweeps: Sequence[CameraSweep]) -> CameraSweep:
    """Return the sweep at whose light positions the images are."""
    return max(sweeps, key=lambda sweep: sweep.exposure_ms)


def _around(frames: Sequence[LitFrame], angle_deg: float) -> tuple[int, float] | None:
    """Return the frame below an angle and how far it is to the next, 0 to 1; None in a gap."""
    angles = np.array([frame.light_angle_deg for frame in frames])
    if not angles.size:
        return None
    index = int(np.searchsorted(angles, angle_deg, side="right")) - 1
    if index >= 0 and angles[index] == angle_deg:
        return index, 0.0
    if index < 0 or index + 1 == angles.size:
        return None
    gap = angles[index + 1] - angles[index]
    if gap > MAX_GAP * float(np.median(np.diff(angles))):
        return None
    return index, float((angle_deg - angles[index]) / gap)


def _exposed(
    reader: BlockReader, pixels: _Pixels, sweep: CameraSweep, index: int, u: float
) -> Exposed:
    first = pixels.exposed(reader.frame(index))
    exposure_ms = sweep.frames[index].exposure_ms
    if u == 0.0:
        return first._replace(exposure_ms=exposure_ms)
    second = pixels.exposed(reader.frame(index + 1))
    mixed = (1.0 - u) * first.radiance + u * second.radiance
    return Exposed(exposure_ms, mixed, first.good & second.good, (1.0 - u) ** 2 + u**2)


class _Pixels:
    """From codes to radiance, before exposures are merged."""

    def __init__(
        self, camera: CameraCalibration, dark_dn: NDArray[np.float64], *, whole: bool
    ) -> None:
        self._camera, self._whole = camera, whole
        self._radiance = PixelRadiance(camera, dark_dn)

    def window(self, image: NDArray[Any]) -> tuple[slice, slice]:
        height, width = image.shape[:2]
        if self._whole:
            return slice(0, height), slice(0, width)
        return self._camera.patch.pixels(width, height)

    def exposed(self, frame: Frame) -> Exposed:
        return self._radiance.exposed(frame.image[self.window(frame.image)], frame.exposure_ms)
