"""What a bag has inside, to be refitted on its own: launch files, scene, calibration, notes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path

from tvbrdf_messages.bag import CALIBRATION, LAUNCH, NOTES, SCENE, About
from tvbrdf_messages.run_directory import GRAPH_FILE, Graph

ARGUMENTS_FILE = "launch.json"
SCENE_FILE = "scene.json"
NOTES_NAME = f"{NOTES}.txt"
SCENE_NAME = f"{SCENE}/{SCENE_FILE}"


def about_run(graph: Graph, extra: Mapping[str, str]) -> About:
    """Return where a bag of this run comes from; a directory may see several runs."""
    return About(run=f"{Path(graph.directory).name}-{graph.utc_ns}", extra=extra)


def attachments_of_run(graph: Graph) -> dict[str, bytes]:
    """Return what there is in a run's directory and in its nodes' parameters, by name.

    ``launch/*.yaml`` are the launch files as they were, ``launch/launch.json`` their arguments,
    ``launch/graph.json`` the nodes that came of them with all parameters; ``calibration/NAME`` the
    calibration that nodes were given; ``scene/scene.json`` the simulated scene, once it is there.

    Raises
    ------
    OSError
        If one that is named can't be read.
    """
    run = Path(graph.directory)
    files = sorted((run / "launch").glob("*.y*ml"))
    files += [run / name for name in (ARGUMENTS_FILE, GRAPH_FILE) if (run / name).is_file()]
    found = {f"{LAUNCH}/{path.name}": path.read_bytes() for path in files}
    paths: dict[Path, str] = {}
    for participant in graph.participants:
        given = participant.parameters.get("calibration")
        if isinstance(given, str) and given and Path(given).resolve() not in paths:
            name = f"{CALIBRATION}/{Path(given).name}"
            if name in found:  # another file of that name
                name = f"{CALIBRATION}/{participant.name}_{Path(given).name}"
            paths[Path(given).resolve()] = name
            found[name] = Path(given).read_bytes()
    scene = scene_of_run(graph)
    return found if scene is None else {**found, SCENE_NAME: scene}


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
