"""``tvbrdf preview``: stills at each exposure, with histogram and saturation."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ._common import (
    Subparsers,
    add_json_option,
    add_run_option,
    add_timeout_option,
    add_verb,
    open_run,
    print_json,
    require_going_on,
)

if TYPE_CHECKING:
    from tvbrdf_fitting.measurement.calibration import CameraCalibration
    from tvbrdf_messages.bus.watcher import Watcher
    from tvbrdf_messages.messages import Frame
    from tvbrdf_messages.run_directory import Graph

CONNECT_S = 5.0
LATE_S = 10.0
"""What a still may need to get here after the cameras have said that all are taken."""

Stills = dict[str, list["Frame"]]


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers, "preview", run, "take a still at each exposure; show histogram and saturation"
    )
    add_run_option(parser)
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/preview"),
        metavar="DIR",
        help="for PNG and OpenEXR files",
    )
    add_json_option(parser)
    add_timeout_option(parser, 60.0)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    directory, graph = open_run(arguments)
    require_going_on(directory)
    calibrations = _calibrations(graph)
    stills = _take(graph, arguments.timeout)
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    rows, files = [], []
    for name in sorted(stills):
        frames = sorted(stills[name], key=lambda frame: frame.exposure_ms)
        rows += [_figures(frame, calibrations.get(name)) for frame in frames]
        files += _write(out, frames, calibrations.get(name))
    if arguments.json:
        print_json({"stills": [row.as_dict() for row in rows], "files": files})
    else:
        _print(rows)
        print(f"wrote {len(files)} files into {out}")
    return 0


def _take(graph: Graph, timeout_s: float) -> Stills:
    """Let all cameras take their stills, and return them by camera."""
    from tvbrdf_messages.bus.watcher import ServiceClient, Watcher

    from ..errors import RunError

    topics = [topic for topic in graph.topics() if topic.endswith("/frame")]
    if not topics:
        raise RunError("this run has no cameras")
    with Watcher(graph, topics) as watcher, ServiceClient(graph) as client:
        if not watcher.wait_connected(CONNECT_S):
            raise RunError(f"not all cameras could be reached within {CONNECT_S:g} s")
        reply = client.ask("still", {}, timeout_s)
        if not reply.ok:
            raise RunError(reply.text)
        return _collect(watcher, graph, topics)


def _collect(watcher: Watcher, graph: Graph, topics: list[str]) -> Stills:
    from tvbrdf_messages.messages import Frame

    expected = _exposures(graph)
    cameras = [publisher for topic in topics for publisher in graph.publishers(topic)]
    stills: Stills = {camera: [] for camera in cameras}
    for envelope in watcher.until(time.monotonic() + LATE_S):
        frame = envelope.message
        if isinstance(frame, Frame) and frame.kind == "still" and frame.camera in stills:
            stills[frame.camera].append(frame)
        if all(len(taken) >= expected for taken in stills.values()):
            break
    for camera, taken in stills.items():
        if len(taken) < expected:
            sys.stderr.write(f"tvbrdf: warning: {camera}: {len(taken)} of {expected} stills came\n")
    return {camera: taken for camera, taken in stills.items() if taken}


def _exposures(graph: Graph) -> int:
    """Return the number of exposures that the sequencer has each camera take."""
    from tvbrdf_nodes.core.loading import load_class
    from tvbrdf_nodes.core.parameters import build

    sequencer = graph.find("sequencer")
    parameters: Any = build(load_class(sequencer.node).parameters_type, sequencer.parameters)
    return len(getattr(parameters, "exposures_ms", ())) or 1


def _calibrations(graph: Graph) -> dict[str, CameraCalibration]:
    """Return the calibration of each camera of the run's merger; none where it has none."""
    from tvbrdf_fitting.measurement.calibration import load_calibration
    from tvbrdf_nodes.core.loading import load_class
    from tvbrdf_nodes.core.parameters import build

    for participant in graph.participants:
        path = participant.parameters.get("calibration")
        if not isinstance(path, str):
            continue
        kind = load_class(participant.node).parameters_type
        names = getattr(build(kind, participant.parameters), "cameras", ())
        try:
            calibration = load_calibration(path)
        except (OSError, ValueError) as error:
            sys.stderr.write(f"tvbrdf: warning: no radiance: {error}\n")
            continue
        return dict(zip(names, calibration.cameras, strict=False))
    return {}


def _figures(frame: Frame, camera: CameraCalibration | None) -> Any:
    from ..still import figures

    if camera is None:
        return figures(frame, (1 << frame.bit_depth) - 1)
    return figures(frame, camera.with_bit_depth(frame.bit_depth).saturation_dn)


def _write(out: Path, frames: list[Frame], camera: CameraCalibration | None) -> list[str]:
    """Write one camera's stills; return the paths."""
    from ..errors import RunError
    from ..still import merge_stills, write_exr, write_png

    name = frames[0].camera
    files = []
    for frame in frames:
        path = out / f"{name}_{frame.exposure_ms:g}ms.png"
        write_png(path, frame)
        files.append(str(path))
    if camera is not None:
        try:
            radiance, _ = merge_stills(frames, camera)
        except ValueError as error:
            raise RunError(f"{name}: {error}") from error
        path = out / f"{name}_radiance.exr"
        write_exr(path, radiance, frames)
        files.append(str(path))
    return files


def _print(rows: list[Any]) -> None:
    from ..still import CHANNELS, bars

    print("camera    exposure    channel  mean    min    max  saturated  histogram (log count)")
    for row in rows:
        for c, channel in enumerate(CHANNELS):
            head = f"{row.camera:9} {row.exposure_ms:8.4g} ms" if c == 0 else " " * 21
            print(
                f"{head}  {channel:>5}  {row.mean[c]:8.1f} {row.minimum[c]:6.0f} "
                f"{row.maximum[c]:6.0f}  {row.saturated_percent[c]:7.2f} %  "
                f"|{bars(row.histogram[c])}|"
            )
