"""What a simulated run knows of its sample, put beside what was measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tvbrdf_messages.run_directory import Graph


def write_truth(graph: Graph) -> bool:
    """Write ``truth.json`` into the database of a finished simulated run.

    It holds the true parameters at each stored scan's time, in published units. Nothing is written
    for a real rig, for a sample whose parameters nobody knows, or without a database.

    Returns
    -------
    bool
        Whether there is a truth to compare with.
    """
    scene_file = Path(graph.directory) / "scene.json"
    writers = [p for p in graph.participants if "/scan/stored" in p.gives]
    if not scene_file.is_file() or not writers:
        return False
    from tvbrdf_fitting.published.database import DatabaseError, read_database
    from tvbrdf_nodes.world.sample import make_sample

    folder = Path(writers[0].parameters["path"])
    scene: dict[str, Any] = json.loads(scene_file.read_text())
    sample = make_sample(scene["sample"])
    try:
        stored = read_database(folder).samples[0].scans
    except (DatabaseError, IndexError):
        return False
    names: tuple[str, ...] = ()
    scans: dict[str, Any] = {}
    for scan in stored:
        truth = sample.truth(scan.time_s)
        if truth is None:
            return False
        _, names, values = truth
        scans[str(scan.scan)] = {"time_s": scan.time_s, "values": list(values)}
    content = json.dumps({"parameter_names": list(names), "scans": scans}, indent=1)
    beside = folder / "truth.json.new"
    beside.write_text(content)
    beside.rename(folder / "truth.json")
    return bool(scans)
