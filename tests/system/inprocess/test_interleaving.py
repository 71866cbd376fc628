"""What merger and fitter find does not depend on how their inputs interleave."""

from __future__ import annotations

import random
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from tvbrdf_launch.testing.inprocess import InProcessRun
from tvbrdf_messages.codec import encode
from tvbrdf_messages.envelope import Envelope, Header
from tvbrdf_messages.messages import Mark
from tvbrdf_messages.topics import find_topic
from tvbrdf_nodes.world import scene

if TYPE_CHECKING:
    from tests.system.inprocess.conftest import Run, RunRig

EFFECTS = Path(scene.__file__).parent / "effects"
SEEDS = 4
NODES = ("hdr_merger", "fitter")
Queues = dict[str, deque[Envelope]]


def one_by_one(queues: Queues) -> Iterator[Envelope]:
    """All of one publisher, then all of the next: devices before the one who commands them."""
    for name in sorted(queues):
        yield from queues[name]


def the_other_way_round(queues: Queues) -> Iterator[Envelope]:
    for name in sorted(queues, reverse=True):
        yield from queues[name]


def shuffled(seed: int) -> Callable[[Queues], Iterator[Envelope]]:
    """Return an order in which publishers take turns by chance, in bursts of any length."""

    def order(queues: Queues) -> Iterator[Envelope]:
        rng = random.Random(seed)
        left = {name: deque(queue) for name, queue in queues.items()}
        while left:
            name = rng.choice(sorted(left))
            for _ in range(min(len(left[name]), int(rng.paretovariate(0.5)))):
                yield left[name].popleft()
            if not left[name]:
                del left[name]

    return order


ORDERS: dict[str, Callable[[Queues], Iterator[Envelope]]] = {
    "one by one": one_by_one,
    "the other way round": the_other_way_round,
    **{f"seed {seed}": shuffled(seed) for seed in range(SEEDS)},
}


def found(messages: list[Envelope]) -> list[bytes]:
    """Return what was measured and fitted, byte for byte, without how long it took."""
    header = Header("", "", "", "", 0, 0)
    results: list[bytes] = []
    for envelope in messages:
        message: Any = envelope.message
        if envelope.topic == "/scan/parameters":
            message = replace(message, solve_time_ms=0.0)
        elif envelope.topic != "/scan/radiance":
            continue
        parts = encode(find_topic(envelope.topic), header, message)
        results.append(b"".join(bytes(part) for part in parts))
    return results


def refit(run: Run, order: Callable[[Queues], Iterator[Envelope]]) -> list[bytes]:
    """Feed what was recorded to a fresh merger and fitter; each publisher's own order is kept."""
    queues: Queues = defaultdict(deque)
    for envelope in run.messages:
        queues[envelope.header.publisher].append(envelope)
    for name in NODES:
        queues.pop(name, None)
    with InProcessRun(run.graph, NODES) as nodes:
        nodes.feed(order(queues))
        return found([told.envelope for told in nodes.history])


@pytest.fixture
def effects(tmp_path: Path) -> Path:
    """Everything that a careful rig has to live with, and a camera that drops frames once."""
    raw = yaml.safe_load((EFFECTS / "realistic.yaml").read_text())
    drop = {"kind": "drop", "camera": 2, "scan": 1, "sweep": 1, "attempt": 1, "frame": 50}
    raw["camera"]["faults"] = [drop]
    path = tmp_path / "effects.yaml"
    path.write_text(yaml.safe_dump(raw))
    return path


@pytest.mark.slow
def test_a_refit_equals_the_live_run_bit_for_bit(run_rig: RunRig, effects: Path) -> None:
    run = run_rig(effects=effects, scans=2, exposures_ms=[0.2, 4.0], keep_frames=True)
    tries = {(c.scan, c.sweep, c.attempt) for c in run.on("/scan/command") if c.action == "sweep"}
    assert tries == {(1, 0, 1), (1, 1, 1), (1, 1, 2), (2, 0, 1), (2, 1, 1)}
    live = found(run.messages)
    assert len(live) == 4
    for name, order in ORDERS.items():
        # what comes of scan 1 may come before or after that of scan 2, but it is the same
        assert sorted(refit(run, order)) == sorted(live), name


def test_the_orders_differ_and_keep_each_publishers_own() -> None:
    """Of the test itself."""
    message = Mark(text="")
    queues: Queues = {
        name: deque(
            Envelope("/operator/mark", Header(name, "", "", "", number, 0), message)
            for number in range(50)
        )
        for name in "abc"
    }
    sequences = [list(order(queues)) for order in ORDERS.values()]
    assert len({tuple(e.order() for e in sequence) for sequence in sequences}) == len(ORDERS)
    for sequence in sequences:
        for name, queue in queues.items():
            assert [e for e in sequence if e.header.publisher == name] == list(queue)
