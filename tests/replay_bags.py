"""Bags of runs inside one process, and their replay."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tests.paths import CALIBRATION_FILE
from tvbrdf_launch.find_files import find_launch_file
from tvbrdf_launch.launch_file import load_launch_file
from tvbrdf_launch.plan import make_plan
from tvbrdf_messages.bag import BagWriter
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Parameters, Radiance
from tvbrdf_messages.run_directory import Graph
from tvbrdf_messages.topics import find_topic

ALIKE = (
    "sample",
    "scan",
    "scan_time_s",
    "model",
    "parameter_names",
    "values",
    "standard_deviations",
    "at_bound",
    "undetermined",
    "errors",
    "chi_square",
    "degrees_of_freedom",
    "reason",
    "evaluations",
    "details",
    "covariance",
)
"""Of parameters: all but the time that the solver took."""


def write_bag(
    path: Path,
    messages: Iterable[Envelope],
    graph: Graph | None = None,
    *,
    calibration: bool = True,
    step_ns: int = 1_000_000,
    start_ns: int = 1_800_000_000_000_000_000,
) -> Path:
    """Write what was published, in that order, as a recorder does; messages a step apart."""
    attachments: dict[str, bytes] = {}
    if calibration:
        attachments["calibration/calibration.yaml"] = CALIBRATION_FILE.read_bytes()
    if graph is not None:
        attachments["launch/graph.json"] = json.dumps(asdict(graph)).encode()
    with BagWriter(path, attachments=attachments, floor_free_bytes=0) as bag:
        recorded = (envelope for envelope in messages if find_topic(envelope.topic).recorded)
        for index, envelope in enumerate(recorded):
            bag.write_envelope(envelope, start_ns + index * step_ns)
    return path


def replay_graph(bag: Path, folder: Path, **arguments: Any) -> Graph:
    """Return the graph of the shipped ``replay.yaml`` for a bag."""
    given = {"bag": bag, "database": folder / "replayed", **arguments}
    words = {name: str(value) for name, value in given.items()}
    return make_plan(load_launch_file(find_launch_file("replay"), words, folder), folder).graph


def assert_same_radiance(one: Radiance, other: Radiance) -> None:
    """Every field is the same, bit for bit."""
    for field in Radiance.schema():
        a, b = getattr(one, field.name), getattr(other, field.name)
        if field.array is None:
            assert a == b, field.name
        else:
            np.testing.assert_array_equal(a, b, err_msg=field.name, strict=True)


def assert_same_fit(found: Parameters, live: Parameters) -> None:
    """Bit for bit: the same code with the same input, on the same machine."""
    for name in ALIKE:
        mine, theirs = getattr(found, name), getattr(live, name)
        if name in ("values", "standard_deviations", "covariance"):
            np.testing.assert_array_equal(np.asarray(mine), np.asarray(theirs), err_msg=name)
        else:
            assert repr(mine) == repr(theirs), name
