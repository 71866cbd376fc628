"""Which pixels of a frame are recorded: those that the calibration makes use of, with a margin.

A frame on the bus is the camera's own region of interest already (its parameter ``region``), and
the calibration's rectangles are fractions of that. What lies outside both rectangles is recorded
as 0, at the same shape: so the same calibration finds the same pixels in the bag, a refit is the
same bit for bit, and LZ4 takes the rest away.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from tvbrdf_messages.messages import Frame

from ..core.device import DeviceError
from ..hdr_merger.calibration_source import read_calibration

if TYPE_CHECKING:
    from tvbrdf_fitting.measurement.calibration import CameraCalibration, Rectangle

Slices = tuple[slice, slice]


class UsedRegions:
    """Blanks what the merger makes no use of.

    Parameters
    ----------
    calibration
        Path of the calibration file, or of a bag that has one inside; empty: everything is kept.
    cameras
        Names in the calibration's order.
    margin
        Kept around each rectangle, as a part of the image's width and height.

    Raises
    ------
    DeviceError
        If the calibration can't be read.
    """

    def __init__(self, calibration: str, cameras: tuple[str, ...], margin: float) -> None:
        self._margin = margin
        self._cameras: dict[str, CameraCalibration] = {}
        self._slices: dict[tuple[str, int, int], tuple[Slices, ...]] = {}
        if not calibration:
            return
        from tvbrdf_fitting.measurement.calibration import CalibrationError
        from tvbrdf_messages.bag import BagError

        try:
            found = read_calibration(calibration)
            self._cameras = {name: found.camera(i) for i, name in enumerate(cameras, start=1)}
        except (CalibrationError, BagError) as error:
            raise DeviceError(str(error)) from error

    def blanked(self, frame: Frame) -> Frame:
        """Return the frame with 0 outside what is used; a still, for people, stays whole."""
        import numpy as np

        if frame.kind == "still" or frame.camera not in self._cameras:
            return frame
        height, width = frame.image.shape[:2]
        slices = self._used(frame.camera, height, width)
        if any(_is_whole(each, height, width) for each in slices):
            return frame
        image: Any = np.zeros_like(frame.image)
        for each in slices:
            image[each] = frame.image[each]
        return replace(frame, image=image)

    def kept_fraction(self, camera: str, height: int, width: int) -> float:
        """Return which part of a camera's pixels is kept."""
        import numpy as np

        if camera not in self._cameras:
            return 1.0
        kept = np.zeros((height, width), dtype=bool)
        for each in self._used(camera, height, width):
            kept[each] = True
        return float(kept.mean())

    def _used(self, camera: str, height: int, width: int) -> tuple[Slices, ...]:
        key = (camera, height, width)
        found = self._slices.get(key)
        if found is None:
            found = self._slices[key] = tuple(self._find(self._cameras[camera], height, width))
        return found

    def _find(self, camera: CameraCalibration, height: int, width: int) -> list[Slices]:
        used = [r for r in (camera.patch, camera.reference_patch) if r is not None]
        found = [_widened(rectangle, self._margin, height, width) for rectangle in used]
        box = _around(found)
        # rectangles that fill their box are one: a frame of them alone needs no copy
        area = sum((r.stop - r.start) * (c.stop - c.start) for r, c in found)
        whole = (box[0].stop - box[0].start) * (box[1].stop - box[1].start)
        return [box] if area >= whole else found


def _widened(rectangle: Rectangle, margin: float, height: int, width: int) -> Slices:
    """Return a rectangle's rows and columns with its margin, a pixel at least."""
    rows, columns = rectangle.pixels(width, height)
    dy, dx = max(1, round(margin * height)), max(1, round(margin * width))
    return (
        slice(max(0, rows.start - dy), min(height, rows.stop + dy)),
        slice(max(0, columns.start - dx), min(width, columns.stop + dx)),
    )


def _around(found: list[Slices]) -> Slices:
    return (
        slice(min(r.start for r, _ in found), max(r.stop for r, _ in found)),
        slice(min(c.start for _, c in found), max(c.stop for _, c in found)),
    )


def _is_whole(slices: Slices, height: int, width: int) -> bool:
    return slices == (slice(0, height), slice(0, width))
