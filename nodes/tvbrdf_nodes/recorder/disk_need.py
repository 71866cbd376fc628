"""How much disk a recording will need, foretold from the graph before the run starts."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_messages.topics import frame_topic

from ..core.loading import load_class
from ..core.parameters import build
from .parameters import RecorderParameters
from .regions import UsedRegions


@dataclass(frozen=True, slots=True)
class CameraNeed:
    """What one camera sends in one scan."""

    name: str
    frames: float
    frame_bytes: int
    """0 if the driver alone knows: the whole sensor of a real camera."""
    kept_fraction: float
    """Of the pixels, with the region of interest only."""


@dataclass(frozen=True, slots=True)
class DiskNeed:
    """What a recording needs."""

    cameras: tuple[CameraNeed, ...]
    scans: int

    def scan_bytes(self, full_frames: bool) -> float:
        """Return the bytes of one scan's frames."""
        return sum(
            each.frames * each.frame_bytes * (1.0 if full_frames else each.kept_fraction)
            for each in self.cameras
        )

    @property
    def unknown(self) -> tuple[str, ...]:
        """Cameras whose images' size only their driver knows."""
        return tuple(each.name for each in self.cameras if not each.frame_bytes)


def disk_need(graph: Graph, parameters: RecorderParameters, topics: set[str]) -> DiskNeed | None:
    """Return what the frames of a run need; None without a sequencer or frames to record.

    Scans and sweeps that are taken again are not foreseen.
    """
    commander = next((p for p in graph.participants if "/scan/command" in p.gives), None)
    plan = _parameters(commander) if commander is not None else None
    if plan is None or not hasattr(plan, "exposures_ms"):
        return None
    regions = UsedRegions(parameters.calibration, parameters.cameras, parameters.margin)
    found = []
    for participant in graph.participants:
        own = _parameters(participant)
        if frame_topic(participant.name) not in topics or own is None:
            continue
        rate_hz = float(getattr(own, "frame_rate_hz", 30.0))
        each_ms = [max(1e3 / rate_hz, exposure) for exposure in plan.exposures_ms]
        frames = sum(plan.sweep_s * 1e3 / ms + plan.dark_frames for ms in each_ms)
        size = _image_size(graph, own)
        kept, count = 1.0, 0
        if size is not None:
            width, height, pixel_bytes = size
            count = width * height * pixel_bytes
            kept = regions.kept_fraction(participant.name, height, width)
        found.append(CameraNeed(participant.name, frames, count, kept))
    return DiskNeed(tuple(found), int(plan.scans)) if found else None


def describe_need(need: DiskNeed, parameters: RecorderParameters) -> list[str]:
    """Return the need in words, with a warning if the disk has less room."""
    scan = need.scan_bytes(parameters.full_frames)
    total = need.scans * scan
    what = "full frames" if parameters.full_frames else "regions of interest"
    text = (
        f"records {what} into {parameters.path}: about {_size(scan)} a scan, "
        f"{_size(total)} for {need.scans}"
    )
    full = need.scan_bytes(full_frames=True)
    if not parameters.full_frames and full > scan:
        text += f" (full frames: {_size(need.scans * full)})"
    if need.unknown:
        text += f"; and what {', '.join(need.unknown)} will send of a whole sensor"
    lines = [text]
    free = shutil.disk_usage(_existing(Path(parameters.path))).free
    if total > free - 1e6 * parameters.floor_free_mb:
        lines.append(
            f"warning: only {_size(free)} of that disk are free, and recording ends when "
            f"{parameters.floor_free_mb:g} MB are left: make room, or record fewer topics"
        )
    return lines


def _parameters(participant: Participant) -> Any:
    """Return a node's parameters with its defaults; None for a device inside another process."""
    if not participant.node:
        return None
    return build(load_class(participant.node).parameters_type, participant.parameters)


def _image_size(graph: Graph, camera: Any) -> tuple[int, int, int] | None:
    """Return width, height and bytes of a pixel as far as the launch file says so."""
    driver = getattr(camera, "driver_parameters", {})
    region = getattr(camera, "region", None)
    depths = [driver.get("bit_depth"), *(p.parameters.get("bit_depth") for p in graph.participants)]
    bit_depth = next((depth for depth in depths if isinstance(depth, int)), 16)
    pixel_bytes = 3 if bit_depth <= 8 else 6
    if region is not None:
        return region[2], region[3], pixel_bytes
    width, height = driver.get("width"), driver.get("height")
    if isinstance(width, int) and isinstance(height, int):
        return width, height, pixel_bytes
    return None


def _existing(path: Path) -> Path:
    """Return the first of a path and its parents that exists."""
    path = path.absolute()
    return next(each for each in (path, *path.parents) if each.exists())


def _size(count: float) -> str:
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.1f} GB"
