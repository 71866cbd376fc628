"""What an export must know of the rig: its calibration, and which camera is which."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

from tvbrdf_messages.bag import BagReader
from tvbrdf_messages.bag.errors import BagError
from tvbrdf_nodes.player.selection import command_topic

from ..errors import RunError
from ..refit.bag_source import BagSource, recorded_parameters
from ..refit.pipeline import MERGER
from ..refit.settings import FRAMES, CalibrationFile, Settings

if TYPE_CHECKING:
    from tvbrdf_fitting.measurement.calibration import Calibration


_FRAME_TOPIC = re.compile(r"/([a-z][a-z0-9_]*)/frame")


@dataclass(frozen=True)
class Rig:
    """The rig that a bag was recorded from."""

    calibration: Calibration
    calibration_name: str
    calibration_sha256: str
    cameras: Mapping[str, int]
    """Numbers in the calibration, by name."""
    arm: str = "arm"


def cameras_of(bag: BagReader) -> list[str]:
    """Return the names of the cameras that have frames in a bag."""
    found = [match[1] for topic in bag.topics() if (match := _FRAME_TOPIC.fullmatch(topic))]
    return sorted(found, key=lambda name: (len(name), name))


def topics_for_light(bag: BagReader) -> tuple[str, ...]:
    """Return the topics that tell where the light was."""
    return (command_topic(bag.topics()), "/scan/sweep_result", "/arm/state")


def lacks_frames(bag: BagReader) -> str:
    """Return why a bag's frames can't be exported with the light's position; empty if they can."""
    topics = bag.topics()
    if not cameras_of(bag):
        return "has no frames (/camera_N/frame) for OpenEXR; record them, or export other formats"
    missing = [topic for topic in topics_for_light(bag) if topic not in topics]
    if missing:
        return (
            f"does not tell where the light was: {', '.join(missing)} is missing; record these "
            "topics too, or export other formats"
        )
    return ""


def rig_for_frames(bag: BagReader, given: CalibrationFile | None) -> Rig:
    """Return the rig as the merger would take it.

    Raises
    ------
    BagError, RunError
        If there is no calibration, or none that can be used.
    """
    plan = BagSource(bag.path).plan(Settings(start=FRAMES, calibration=given))
    if plan.calibration is None:
        raise BagError(bag.path, "has no calibration inside; give the rig's with --calibration")
    found = _parsed(bag, plan.calibration)
    bit_depth = plan.merger.get("bit_depth")
    if bit_depth is not None:
        cameras = tuple(camera.with_bit_depth(bit_depth) for camera in found.cameras)
        found = replace(found, cameras=cameras)
    return _checked(
        bag,
        Rig(
            calibration=found,
            calibration_name=plan.calibration.name,
            calibration_sha256=plan.calibration.sha256,
            cameras={name: number for number, name in enumerate(plan.merger["cameras"], start=1)},
            arm=plan.merger.get("arm", "arm"),
        ),
    )


def rig_for_geometry(bag: BagReader, given: CalibrationFile | None) -> Rig:
    """Return the rig for its geometry alone; of a bag without frames too.

    Raises
    ------
    BagError, RunError
        As :func:`rig_for_frames`.
    """
    from tvbrdf_nodes.hdr_merger.calibration_source import inside
    from tvbrdf_nodes.hdr_merger.node import HdrMergerParameters

    if given is None:
        name, data = inside(str(bag.path))
        given = CalibrationFile(name.rpartition("/")[2], data)
    merger = recorded_parameters(bag).get(MERGER, {})
    usual = next(part.default for part in fields(HdrMergerParameters) if part.name == "cameras")
    names = merger.get("cameras", usual)
    return _checked(
        bag,
        Rig(
            calibration=_parsed(bag, given),
            calibration_name=given.name,
            calibration_sha256=given.sha256,
            cameras={name: number for number, name in enumerate(names, start=1)},
            arm=merger.get("arm", "arm"),
        ),
    )


def _checked(bag: BagReader, rig: Rig) -> Rig:
    """Refuse cameras that are not calibrated."""
    known = {camera.camera for camera in rig.calibration.cameras}
    strange = [name for name, number in rig.cameras.items() if number not in known]
    if strange:
        raise BagError(
            bag.path,
            f"has {len(rig.cameras)} cameras, and calibration {rig.calibration_name} is of "
            f"{len(known)}: leave {', '.join(strange)} out with 'tvbrdf bag filter --exclude'",
        )
    return rig


def _parsed(bag: BagReader, file: CalibrationFile) -> Calibration:
    from tvbrdf_fitting.measurement.calibration import CalibrationError, parse_calibration

    source = f"{bag.path}: calibration {file.name}"
    try:
        return parse_calibration(file.data.decode(), source=source)
    except UnicodeDecodeError as error:
        raise RunError(f"{source}: is no text; give the rig's with --calibration FILE") from error
    except CalibrationError as error:
        raise RunError(f"{error}; give another with --calibration FILE") from error
