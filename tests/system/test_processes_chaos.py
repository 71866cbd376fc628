"""Nodes killed at any moment, and runs that go on: each scan still ends exactly once."""

from __future__ import annotations

import random
import signal
import time
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.system.conftest import Rig

pytestmark = [pytest.mark.system, pytest.mark.slow]

VICTIMS = ("camera_1", "camera_3", "hdr_merger", "fitter", "database_writer", "arm")
KILLS = 3
SCANS = 2


@pytest.mark.parametrize("seed", [1, 2])
def test_nodes_are_killed_at_any_moment(rig: Rig, seed: int) -> None:
    rng = random.Random(seed)
    # idle simulated time runs 20 times as fast as a restart: leave each scan a long slot
    rig.launch(speedup=8, scans=SCANS, interval_s=80)
    killed: list[str] = []
    with rig.watch("/scan/status") as watcher:
        rig.until(watcher, lambda m: m.state == "homing")  # type: ignore[attr-defined]
        watcher.socket.unsubscribe("/scan/status")
        for _ in range(KILLS):
            wait_s = rng.uniform(0.3, 2.0)
            watcher.receive(wait_s)  # nothing comes: the moment is what is random here
            if rig.process is not None and rig.process.poll() is not None:
                break
            alive = [n for n in VICTIMS if rig.table().nodes[n].alive() and n not in killed]
            victim = rng.choice(alive)
            if rig.table().nodes[victim].send(signal.SIGKILL):
                killed.append(victim)
    assert len(killed) >= 2
    began = time.monotonic()
    assert rig.wait() == 0, rig.text()
    assert time.monotonic() - began < 60.0
    rig.expect_nothing_left()
    sample = rig.expect_whole_database(SCANS)
    assert sample.scans, rig.text()
    times = [scan.time_s for scan in sample.scans]
    assert times == sorted(times)
    lives = {name: node.incarnations for name, node in rig.table().nodes.items()}
    assert {name for name, count in lives.items() if count > 1} == set(killed), rig.text()
    assert "Traceback" not in "".join(path.read_text() for path in rig.run.glob("*.log"))


def test_time_goes_on_in_a_run_that_goes_on_with_another(rig: Rig) -> None:
    """A simulated run's clock starts at the time of day, where the one before may be ahead."""
    rig.launch(scans=2, interval_s=40)
    assert rig.wait() == 0, rig.text()
    first = [scan.time_s for scan in rig.sample().scans]
    rig.launch(scans=3, interval_s=40, resume="true")
    assert rig.wait() == 0, rig.text()
    rig.expect_nothing_left()
    times = [scan.time_s for scan in rig.expect_whole_database(3).scans]
    assert times[:2] == first
    # a scan begins when it is due, or a little later: commands take real time
    assert 40.0 <= times[2] - times[1] < 50.0
