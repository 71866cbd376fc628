"""A bag with protobuf schemas, for Foxglove and Rerun.

=====================  ==========================  =============================================
topic                  schema                      what
=====================  ==========================  =============================================
``/camera_N/image``    foxglove.RawImage           frames; of more than 8 bits the upper 8
``/camera_N/frame``    tvbrdf.Frame                each frame's scan, sweep and exposure
``/tf_static``         foxglove.FrameTransforms    sample and cameras (see :mod:`.geometry`)
``/tf``                foxglove.FrameTransforms    the light, moving with the arm
``/arm/state``         tvbrdf.ArmState             angle, speed, lamp
``/scan/parameters``   tvbrdf.Parameters           a field a parameter, ``_std`` for deviations
``/log``               foxglove.Log                log, notes, broken sweeps, missing scans
=====================  ==========================  =============================================

Plot in Foxglove by a path such as ``/scan/parameters.sigma_d``. Log time is the run's clock,
publish time and ``timestamp`` are when it happened.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tvbrdf_messages.bag import BagReader
from tvbrdf_messages.bag.errors import BagError
from tvbrdf_messages.envelope import Header
from tvbrdf_messages.messages import (
    ArmState,
    Frame,
    Log,
    Mark,
    Parameters,
    ScanMissing,
    SweepResult,
)
from tvbrdf_messages.topics import frame_topic

from .geometry import Transform, fixed_transforms, light_transform
from .protobuf import ProtobufBag, field_names, own_schema, schema, set_time
from .result import Progress, Tell, Written
from .rig import cameras_of

if TYPE_CHECKING:
    from .rig import Rig

TOPICS = (
    "/arm/state", "/scan/parameters", "/scan/missing", "/scan/sweep_result", "/operator/mark",
    "/log",
)  # fmt: skip
_OF_SCAN: Mapping[str, type] = {"sample": str, "scan": int, "scan_time_s": float, "model": str}
_OF_FRAME: Mapping[str, type] = {
    "kind": str,
    "sample": str,
    "scan": int,
    "sweep": int,
    "attempt": int,
    "index": int,
    "exposure_ms": float,
}
_OF_ARM: Mapping[str, type] = {
    "angle_deg": float,
    "speed_deg_s": float,
    "lamp": bool,
    "moving": bool,
    "homed": bool,
    "fault": str,
}
_LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "critical": 5, "fatal": 5}
_INFO, _WARNING = 2, 3


def lacks(bag: BagReader) -> str:
    """Return why there is nothing to show; empty if there is."""
    known = {*TOPICS, *(frame_topic(camera) for camera in cameras_of(bag))}
    if known.intersection(bag.topics()):
        return ""
    return "has nothing to show: no frames, states, parameters or log"


def write_protobuf(bag: BagReader, path: Path, rig: Rig | None, tell: Tell) -> Written:
    """Write the new bag.

    Parameters
    ----------
    rig
        For the geometry; None leaves the transforms out.

    Raises
    ------
    BagError
        If the bag has nothing to show, or damaged parts.
    OSError
        If writing fails.
    """
    why = lacks(bag)
    if why:
        raise BagError(bag.path, why)
    written = Written("foxglove", path.name)
    progress = Progress(tell, bag.start_ns, bag.end_ns)
    topics = [*TOPICS, *(frame_topic(camera) for camera in cameras_of(bag))]
    with ProtobufBag(path) as out:
        about = bag.about
        out.note("tvbrdf", {"run": about.run, "recorded_with": about.version})
        converter = _Converter(bag, out, rig, written)
        converter.write_fixed(bag.start_ns)
        for log_time_ns, envelope in bag.messages(topics):
            converter.take(log_time_ns, envelope.header, envelope.message)
            progress.at(log_time_ns)
    return written


class _Converter:
    """Turns messages into protobuf, one by one."""

    def __init__(self, bag: BagReader, out: ProtobufBag, rig: Rig | None, written: Written) -> None:
        self._out, self._rig, self._written = out, rig, written
        self._transforms, self._log = schema("FrameTransforms"), schema("Log")
        self._image = schema("RawImage")
        self._arm = own_schema("ArmState", _OF_ARM)
        self._frame = own_schema("Frame", _OF_FRAME)
        self._fields = _parameter_fields(bag)
        self._empty = dict.fromkeys(self._fields.values(), math.nan)
        self._parameters = own_schema(
            "Parameters", {**_OF_SCAN, **dict.fromkeys(self._fields.values(), float)}
        )
        self._by_type: dict[type, Callable[[int, Header, Any], None]] = {
            Frame: self._take_frame,
            ArmState: self._take_state,
            Parameters: self._take_parameters,
            Log: self._take_log,
            Mark: self._take_mark,
            ScanMissing: self._take_missing,
            SweepResult: self._take_result,
        }

    def take(self, log_time_ns: int, header: Header, message: Any) -> None:
        """Write what there is to show of a message."""
        self._by_type[type(message)](log_time_ns, header, message)

    def write_fixed(self, time_ns: int) -> None:
        """Write what does not move."""
        if self._rig is not None:
            self._write_transforms("/tf_static", fixed_transforms(self._rig), time_ns, time_ns)

    def _write(self, topic: str, message: Any, log_time_ns: int, stamp_ns: int) -> None:
        self._out.write(topic, message, log_time_ns, stamp_ns or log_time_ns)
        self._written.count(topic)

    def _write_transforms(
        self, topic: str, transforms: list[Transform], log_time_ns: int, stamp_ns: int
    ) -> None:
        message = self._transforms()
        for transform in transforms:
            each = message.transforms.add(
                parent_frame_id=transform.parent, child_frame_id=transform.child
            )
            set_time(each.timestamp, stamp_ns)
            for name, value in zip("xyz", transform.translation, strict=True):
                setattr(each.translation, name, value)
            for name, value in zip("xyzw", transform.rotation, strict=True):
                setattr(each.rotation, name, value)
        self._write(topic, message, log_time_ns, stamp_ns)

    def _take_frame(self, log_time_ns: int, header: Header, frame: Frame) -> None:
        image = eight_bits(frame)
        message = self._image(
            frame_id=frame.camera,
            width=image.shape[1],
            height=image.shape[0],
            encoding="bgr8",
            step=3 * image.shape[1],
            data=image.tobytes(),
        )
        self._write(f"/{frame.camera}/image", message, log_time_ns, header.stamp_ns)
        facts = self._frame(**{name: getattr(frame, name) for name in _OF_FRAME})
        self._write(frame_topic(frame.camera), facts, log_time_ns, header.stamp_ns)

    def _take_state(self, log_time_ns: int, header: Header, state: ArmState) -> None:
        message = self._arm(**{name: getattr(state, name) for name in _OF_ARM})
        self._write("/arm/state", message, log_time_ns, header.stamp_ns)
        if self._rig is not None:
            light = light_transform(self._rig.calibration, state.angle_deg)
            self._write_transforms("/tf", [light], log_time_ns, header.stamp_ns or log_time_ns)

    def _take_parameters(self, log_time_ns: int, header: Header, found: Parameters) -> None:
        message = self._parameters(
            **{name: getattr(found, name) for name in _OF_SCAN},
            **self._empty,
        )
        for name, value in _numbers(found).items():
            setattr(message, self._fields[name], value)
        self._write("/scan/parameters", message, log_time_ns, header.stamp_ns)

    def _take_log(self, log_time_ns: int, header: Header, line: Log) -> None:
        level = _LEVELS.get(line.level.lower(), 0)
        self._say(log_time_ns, header, line.node, level, line.text)

    def _take_mark(self, log_time_ns: int, header: Header, mark: Mark) -> None:
        text = f"{mark.text} (t = 0)" if mark.zero else mark.text
        self._say(log_time_ns, header, "operator", _INFO, text)

    def _take_missing(self, log_time_ns: int, header: Header, missing: ScanMissing) -> None:
        text = f"scan {missing.scan} is missing: {missing.reason}"
        self._say(log_time_ns, header, header.publisher, _WARNING, text)

    def _take_result(self, log_time_ns: int, header: Header, result: SweepResult) -> None:
        if result.state != "done":
            text = f"{result.action} of scan {result.scan} {result.state}: {result.reason}"
            self._say(log_time_ns, header, result.source, _WARNING, text)

    def _say(self, log_time_ns: int, header: Header, node: str, level: int, text: str) -> None:
        message = self._log(level=level, message=text, name=node)
        self._write("/log", message, log_time_ns, header.stamp_ns)


def eight_bits(frame: Frame) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return a frame's codes as 8 bits, the lower ones cut off; (height, width, 3), B, G, R."""
    image: Any = frame.image
    if image.dtype.kind == "f":
        image = np.clip(image, 0, (1 << frame.bit_depth) - 1).astype(np.uint16)
    return np.ascontiguousarray(image >> max(0, frame.bit_depth - 8), dtype=np.uint8)


def _parameter_fields(bag: BagReader) -> dict[str, str]:
    """Return the field of each number that any scan of the bag has: models may differ."""
    names: dict[str, None] = {}
    for _, envelope in bag.messages(["/scan/parameters"]):
        if isinstance(envelope.message, Parameters):
            names.update(dict.fromkeys(_numbers(envelope.message)))
    return field_names(names, taken=_OF_SCAN)


def _numbers(found: Parameters) -> dict[str, float]:
    """Return a scan's numbers by name: parameters, their deviations, error measures."""
    numbers = dict(zip(found.parameter_names, found.values, strict=True))
    deviations = zip(found.parameter_names, found.standard_deviations, strict=True)
    numbers |= {f"{name}_std": deviation for name, deviation in deviations}
    numbers |= {
        f"error_{name}": value
        for name, value in found.errors.items()
        if isinstance(value, int | float)
    }
    return {name: float(value) for name, value in numbers.items()}
