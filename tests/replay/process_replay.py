"""Replays a recorded bag through merger and fitter, and compares with the results stored for it.

``rig.mcap`` is a small scan of the simulated rig: what devices and sequencer said. ``results.mcap``
holds what merger and fitter made of it, message by message. Both are the project's own work:

    python -m tests.replay.process_replay --record    # another bag, then also new results
    python -m tests.replay.process_replay --accept    # new results of the same bag

A change that moves results fails the test, which tells what moved by how much; who means the change
accepts the new results, and says in the commit why they moved.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.replay.recorded_rig import anonymous, read_all, record_rig, write_bag
from tvbrdf_launch.refit.bag_source import BagSource
from tvbrdf_launch.refit.pipeline import MERGER, NodesInProcess, Pipeline
from tvbrdf_launch.refit.settings import Settings
from tvbrdf_messages.envelope import Envelope, Header
from tvbrdf_messages.messages import Radiance, Stored

HERE = Path(__file__).parent
BAG, RESULTS = HERE / "rig.mcap", HERE / "results.mcap"
ACCEPT = "python -m tests.replay.process_replay --accept"
RELATIVE = 1e-9
"""The issue's: the same numbers on other machines and versions, but for rounding."""
COMPARED = ("/scan/sweep_result", "/scan/radiance", "/scan/parameters")
INPUTS = (
    "/scan/command",
    "/scan/sweep_result",
    "/arm/state",
    *(f"/camera_{number}/frame" for number in range(1, 5)),
)
NOT_COMPARED = frozenset({"solve_time_ms"})
SCENE: Mapping[str, Any] = {
    "scans": 1,
    "pixels": 8,
    "sweep_s": 4.0,
    "frame_rate_hz": 12.0,
    "dark_frames": 3,
    "exposures_ms": [0.2, 4.0],
    "seed": 7,
}


class Moved(NamedTuple):
    """A number, or a part of a message that is no number, that is not what it was."""

    message: str
    field: str
    stored: str
    now: str
    change: float
    """Relative; infinite where there is no such thing."""


def replay(bag: Path = BAG) -> list[Envelope]:
    """Return what merger and fitter publish on the compared topics, in order."""
    source = BagSource(bag)
    with Pipeline(source.plan(Settings())) as pipeline:
        nodes = pipeline.nodes
        found: list[Envelope] = []
        for envelope in read_all(bag):
            if envelope.header.publisher != MERGER:
                nodes.feed(envelope)
                found += _work(nodes)
        return [anonymous(each) for each in found if each.topic in COMPARED]


def _work(nodes: NodesInProcess) -> Iterator[Envelope]:
    for envelope in nodes.work():
        yield envelope
        if isinstance(envelope.message, Radiance):
            scan, sample = envelope.message.scan, envelope.message.sample
            header = Header("database_writer", "", "", "", 0, 0)
            stored = Stored(sample=sample, scan=scan, what="radiance")
            nodes.feed(Envelope("/scan/stored", header, stored))


def compare(stored: list[Envelope], now: list[Envelope]) -> list[Moved]:
    """Return all that has moved by more than the tolerance, message by message."""
    moved: list[Moved] = []
    for number in range(max(len(stored), len(now))):
        old = stored[number] if number < len(stored) else None
        new = now[number] if number < len(now) else None
        if old is None or new is None or old.topic != new.topic:
            names = [("nothing" if each is None else each.topic) for each in (old, new)]
            moved.append(Moved(f"message {number}", "", names[0], names[1], math.inf))
            continue
        moved += _compare_messages(f"{number} {old.topic}", old.message, new.message)
    return moved


def _compare_messages(name: str, old: Any, new: Any) -> Iterator[Moved]:
    for part in fields(old):
        if part.name not in NOT_COMPARED:
            yield from _compare(name, part.name, getattr(old, part.name), getattr(new, part.name))


def _compare(name: str, field: str, old: Any, new: Any) -> Iterator[Moved]:
    """Compare two values: arrays against their largest entry, other numbers each for itself."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in dict.fromkeys([*old, *new]):
            yield from _compare(name, f"{field}.{key}", old.get(key), new.get(key))
    elif isinstance(old, (list, tuple)) and isinstance(new, (list, tuple)):
        if len(old) != len(new):
            yield Moved(name, field, f"{len(old)} entries", f"{len(new)} entries", math.inf)
        for number, pair in enumerate(zip(old, new, strict=False)):
            yield from _compare(name, f"{field}[{number}]", *pair)
    elif isinstance(old, np.ndarray) and isinstance(new, np.ndarray):
        yield from _compare_arrays(name, field, old, new)
    elif isinstance(old, float) or isinstance(new, float):
        yield from _compare_arrays(name, field, np.array([old], float), np.array([new], float))
    elif old != new:
        yield Moved(name, field, repr(old), repr(new), math.inf)


def _compare_arrays(name: str, field: str, old: Any, new: Any) -> Iterator[Moved]:
    if old.shape != new.shape or old.dtype != new.dtype:
        shapes = [f"{each.dtype}{list(each.shape)}" for each in (old, new)]
        yield Moved(name, field, shapes[0], shapes[1], math.inf)
        return
    if old.dtype.kind != "f":
        wrong = np.flatnonzero(old.ravel() != new.ravel())
        if wrong.size:
            first = wrong[0]
            text = f"{wrong.size} of {old.size}, first {old.ravel()[first]}"
            yield Moved(name, field, text, str(new.ravel()[first]), math.inf)
        return
    unknown = np.isnan(old) & np.isnan(new)
    scale = max(np.nanmax(np.abs(old), initial=0.0), np.nanmax(np.abs(new), initial=0.0))
    change = np.where(unknown, 0.0, np.abs(new - old)) / (scale or 1.0)
    change[np.isnan(change)] = math.inf
    worst = int(np.argmax(change)) if change.size else 0
    if change.size and change.flat[worst] > RELATIVE:
        at = "" if old.size == 1 else f"[{', '.join(map(str, np.unravel_index(worst, old.shape)))}]"
        was, now = (f"{each.flat[worst]:.12g}" for each in (old, new))
        yield Moved(name, field + at, was, now, float(change.flat[worst]))


def table(moved: list[Moved]) -> str:
    """Return what moved by how much, and how to accept it."""
    rows = [("message", "field", "stored", "now", "change")]
    rows += [
        (m.message, m.field, m.stored[:40], m.now[:40], _percent(m.change))
        for m in sorted(moved, key=lambda m: -m.change)
    ]
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    return "\n".join(
        [
            f"{len(moved)} results of {BAG.name} have moved by more than {RELATIVE:g}:",
            *lines,
            f"If that is meant, accept it with '{ACCEPT}', and say in the commit why.",
        ]
    )


def _percent(change: float) -> str:
    return "another value" if math.isinf(change) else f"{change:.2e}"


def stored_results() -> list[Envelope]:
    """Return what was found of the bag when its results were accepted."""
    return [*read_all(RESULTS)]


def main() -> None:
    """Make the bag or its results anew."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--record", action="store_true", help="make another bag")
    parser.add_argument("--accept", action="store_true", help="take the new results")
    given = parser.parse_args()
    if not (given.record or given.accept):
        parser.error("give --record or --accept")
    if given.record:
        with tempfile.TemporaryDirectory(prefix="tvb") as folder:
            made = record_rig(Path(folder), topics=INPUTS, **SCENE)
            BAG.write_bytes(made.read_bytes())
    now = replay()
    if {each.topic for each in now} != set(COMPARED):
        raise SystemExit(f"{BAG} gives no whole scan; nothing is accepted")
    if RESULTS.exists():
        moved = compare(stored_results(), now)
        sys.stdout.write(f"{table(moved) if moved else 'nothing has moved'}\n")
        RESULTS.unlink()
    write_bag(RESULTS, now, {})
    for path in (BAG, RESULTS):
        sys.stdout.write(f"{path}: {path.stat().st_size} bytes\n")


if __name__ == "__main__":
    main()
