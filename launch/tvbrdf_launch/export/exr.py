"""HDR images of a bag as OpenEXR: one a light position and camera, or one a frame.

``exr/scan01/camera_1/light0001.exr`` and so on, by rising angle of the light; ``exr/index.csv`` has
a line an image. Channels are R, G, B in float32, linear: pi · BRDF · cos(theta_i), so that 1 is a
white diffuser facing the light, as ``cv2.imread`` (B, G, R) and Mitsuba's ``Bitmap`` take them.
The lamp's drift, which the merger takes from the reference, is not divided out.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tvbrdf_messages.bag import BagReader
from tvbrdf_messages.bag.errors import BagError

from ..errors import RunError
from .result import Progress, Tell, Written

if TYPE_CHECKING:
    from .hdr import HdrImage
    from .rig import Rig
    from .scans import CameraSweep, Scan

INDEX_FILE = "index.csv"
COLUMNS = (
    "file", "sample", "scan", "camera", "light_angle_deg", "light_x", "light_y", "light_z",
    "view_x", "view_y", "view_z", "exposures_ms", "stamps_ns", "saturated_fraction",
)  # fmt: skip
MEANING = "pi * BRDF * cos(theta_i); 1: a white diffuser facing the light"


@dataclass(frozen=True)
class ExrOptions:
    """How HDR images are made."""

    each_exposure: bool = False
    """An image for each frame instead of merged exposures."""
    whole_frames: bool = False
    """All pixels instead of the sample's patch; what a recorder did not keep is no measurement."""


def write_exr_images(
    bag: BagReader, folder: Path, rig: Rig, options: ExrOptions, tell: Tell
) -> Written:
    """Write the images of all whole scans into a new folder, with an index.

    Raises
    ------
    BagError
        If no scan of the bag is whole.
    RunError
        If an image can't be written.
    """
    from .scans import ScanBook

    folder.mkdir()
    written = Written("exr", folder.name)
    book = ScanBook(bag, rig, Progress(tell, bag.start_ns, bag.end_ns))
    with (folder / INDEX_FILE).open("w", newline="") as file:
        index = csv.writer(file, lineterminator="\n")
        index.writerow(COLUMNS)
        for scan in book.scans():
            written.count("scans")
            for row in _write_scan(bag, folder, rig, scan, options, written):
                written.count("images")
                index.writerow(row)
    left_out = book.unfinished()
    written.remarks += [f"scan {scan}: {why}" for scan, why in left_out.items()]
    if not written.counts.get("images"):
        why = "; ".join(written.remarks) or "no sweep ended"
        raise BagError(bag.path, f"has no whole scan to make OpenEXR images of: {why}")
    return written


def _write_scan(
    bag: BagReader, folder: Path, rig: Rig, scan: Scan, options: ExrOptions, written: Written
) -> Iterator[list[Any]]:
    from .hdr import hdr_images, longest

    for name, sweeps in scan.cameras.items():
        camera = rig.calibration.camera(rig.cameras[name])
        place = folder / f"scan{scan.scan:02}" / name
        place.mkdir(parents=True)
        for prefix, group in _groups(sweeps, each=options.each_exposure):
            images = hdr_images(bag, name, group, camera, whole=options.whole_frames)
            left = len(longest(group).frames)
            for number, image in enumerate(images, start=1):
                path = place / f"{prefix}light{number:04}.exr"
                facts = _facts(rig, scan, name, image)
                write_exr(path, image, facts)
                yield _row(path.relative_to(folder), facts)
                left -= 1
            if left:
                written.remarks.append(
                    f"scan {scan.scan}, {name}: light positions that not every exposure has frames "
                    f"around: {left}"
                )


def _groups(
    sweeps: Sequence[CameraSweep], *, each: bool
) -> list[tuple[str, Sequence[CameraSweep]]]:
    """Return which sweeps make an image together, with the beginning of its name."""
    if not each:
        return [("", sweeps)]
    return [(f"exposure{sweep.sweep + 1}_", [sweep]) for sweep in sweeps]


def _facts(rig: Rig, scan: Scan, name: str, image: HdrImage) -> dict[str, Any]:
    """Return what is told of an image, as its attributes."""
    from tvbrdf_fitting.geometry import light_direction

    light = light_direction(image.light_angle_deg, rig.calibration.tilt_deg)
    view = rig.calibration.view_directions[rig.cameras[name] - 1]
    return {
        "comments": MEANING,
        "sample": scan.sample,
        "scan": scan.scan,
        "scan_time_s": float(scan.time_s),
        "camera": name,
        "camera_angle_deg": rig.calibration.camera(rig.cameras[name]).camera_angle_deg,
        "light_angle_deg": image.light_angle_deg,
        "light_direction": tuple(map(float, light)),
        "view_direction": tuple(map(float, view)),
        # text: an attribute's whole numbers have 32 bits, its others 24 bits of precision
        "exposures_ms": ", ".join(f"{exposure:.9g}" for exposure in image.exposures_ms),
        "stamps_ns": ", ".join(map(str, image.stamps_ns)),
        "calibration": rig.calibration_name,
        "calibration_sha256": rig.calibration_sha256,
        "saturated_fraction": image.saturated_fraction,
        "region_x": int(image.left),
        "region_y": int(image.upper),
    }


def _row(path: Path, facts: dict[str, Any]) -> list[Any]:
    names = ("sample", "scan", "camera", "light_angle_deg")
    return [
        str(path),
        *(facts[name] for name in names),
        *facts["light_direction"],
        *facts["view_direction"],
        *(facts[name] for name in ("exposures_ms", "stamps_ns", "saturated_fraction")),
    ]


def write_exr(path: Path, image: HdrImage, facts: dict[str, Any]) -> None:
    """Write an image with its attributes.

    Raises
    ------
    RunError
        If the system refuses.
    """
    import OpenEXR

    # OpenEXR writes wrong pixels for arrays that are not contiguous, and changes its header
    rgb = np.ascontiguousarray(image.radiance[..., ::-1], dtype=np.float32)
    header = {
        **facts,
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
    }
    try:
        with OpenEXR.File(header, {"RGB": rgb}) as file:
            file.write(str(path))
    except (RuntimeError, OSError) as error:
        why = str(error).rstrip(".")
        raise RunError(
            f"{path}: can't be written: {why}; nothing is left of the export: free some space, or "
            "give another place with --out"
        ) from error
