"""What a bag has inside, to be refitted on its own: launch files, scene, calibration, notes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tvbrdf_messages.bag import CALIBRATION, LAUNCH, NOTES, SCENE, SOURCE, About, BagReader
from tvbrdf_messages.run_directory import GRAPH_FILE, Graph

from ..core.loading import NODES
from ..hdr_merger.calibration_source import inside, is_bag

ARGUMENTS_FILE = "launch.json"
SCENE_FILE = "scene.json"
NOTES_NAME = f"{NOTES}.txt"
SCENE_NAME = f"{SCENE}/{SCENE_FILE}"
SOURCE_NAME = f"{SOURCE}/bag.json"


def about_run(graph: Graph, extra: Mapping[str, str]) -> About:
    """Return where a bag of this run comes from; a directory may see several runs."""
    source = source_of_run(graph)
    if source is not None:
        replayed = f"{source['name']}, recording {source['recording']} of run {source['run']}"
        extra = {**extra, "replayed": replayed}
    return About(run=f"{Path(graph.directory).name}-{graph.utc_ns}", extra=extra)


def source_of_run(graph: Graph) -> dict[str, Any] | None:
    """Return which bag a run replays: name, path, and what it says of itself; None if it doesn't.

    Raises
    ------
    BagError
        If the bag can't be read.
    """
    players = [p for p in graph.participants if p.node == NODES["player"]]
    if not players:
        return None
    with BagReader(graph.located(players[0].parameters["bag"])) as bag:
        about = bag.about
        return {
            "name": bag.path.resolve().name,
            "path": str(bag.path.resolve()),
            "files": {file.path.name: file.size_bytes for file in bag.files},
            "run": about.run,
            "recording": about.recording,
            "recorded_with": about.version,
            "created_ns": about.created_ns,
            "start_ns": bag.start_ns,
            "end_ns": bag.end_ns,
        }


def attachments_of_run(graph: Graph) -> dict[str, bytes]:
    """Return what there is in a run's directory and in its nodes' parameters, by name.

    ``launch/*.yaml`` are the launch files as they were, ``launch/launch.json`` their arguments,
    ``launch/graph.json`` the nodes that came of them with all parameters; ``calibration/NAME`` the
    calibration that nodes were given, or that is inside the bag that they were given; and
    ``scene/scene.json`` the simulated scene, once it is there. Of a replay ``source/bag.json``
    says which bag is played.

    Raises
    ------
    OSError, BagError
        If one that is named can't be read.
    """
    run = Path(graph.directory)
    files = sorted((run / "launch").glob("*.y*ml"))
    files += [run / name for name in (ARGUMENTS_FILE, GRAPH_FILE) if (run / name).is_file()]
    found = {f"{LAUNCH}/{path.name}": path.read_bytes() for path in files}
    taken: set[Path] = set()
    for participant in graph.participants:
        given = participant.parameters.get("calibration")
        if not isinstance(given, str) or not given:
            continue
        path = graph.located(given)
        if path.resolve() not in taken:
            own_name, content = _calibration(path)
            name = f"{CALIBRATION}/{own_name}"
            if name in found:  # another file of that name
                name = f"{CALIBRATION}/{participant.name}_{own_name}"
            taken.add(path.resolve())
            found[name] = content
    source, scene = source_of_run(graph), scene_of_run(graph)
    if source is not None:
        found[SOURCE_NAME] = json.dumps(source, ensure_ascii=False, indent=1).encode()
    return found if scene is None else {**found, SCENE_NAME: scene}


def _calibration(path: Path) -> tuple[str, bytes]:
    """Return name and content of a calibration: a file, or what is inside a bag."""
    if not is_bag(str(path)):
        return path.name, path.read_bytes()
    name, content = inside(str(path))
    return Path(name).name, content


def scene_of_run(graph: Graph) -> bytes | None:
    """Return the simulated scene; None as long as there is none."""
    path = Path(graph.directory) / SCENE_FILE
    return path.read_bytes() if graph.simulated and path.is_file() else None


def notes_text(marks: Iterable[tuple[int, str, bool]]) -> bytes:
    """Return operators' notes as a text, a line each: (run's clock in ns, text, whether t = 0)."""
    lines = []
    for time_ns, text, zero in marks:
        moment = datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(timespec="milliseconds")
        lines.append(f"{moment} {'[t = 0] ' if zero else ''}{text}\n")
    return "".join(lines).encode()
