"""A bag replayed through the real merger, fitter and database writer in processes of their own."""

from __future__ import annotations

import json
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.replay_bags import write_bag
from tests.system.inprocess.conftest import Run
from tvbrdf_fitting.published.database import StoredScan, read_database
from tvbrdf_messages.bus.watcher import ServiceClient
from tvbrdf_messages.messages import ArmState, Diagnostics, Frame

if TYPE_CHECKING:
    from tests.system.conftest import Rig

pytestmark = pytest.mark.system


class Recorded:
    """A run inside one process, and bags of it."""

    def __init__(self, folder: Path) -> None:
        arguments: dict[str, Any] = {
            "width": 16,
            "height": 16,
            "scans": 2,
            "sweep_s": 4,
            "warm_up_s": 1,
            "exposures_ms": [0.2, 4.0],
        }
        self.live = Run(folder, arguments, {}, keep_frames=True)
        messages = self.live.messages
        self.bag = write_bag(folder / "run.mcap", messages, self.live.graph)
        self.bare = write_bag(folder / "bare.mcap", messages, self.live.graph, calibration=False)
        self.cut = folder / "cut.mcap"
        self.cut.write_bytes(self.bag.read_bytes()[: self.bag.stat().st_size // 2])
        kept = [e for e in messages if not isinstance(e.message, (Frame, ArmState))]
        self.radiance = write_bag(folder / "radiance.mcap", kept, self.live.graph)


@pytest.fixture(scope="module")
def recorded() -> Iterator[Recorded]:
    with tempfile.TemporaryDirectory(prefix="tv") as folder:
        yield Recorded(Path(folder))


def scans(database: Path) -> list[StoredScan]:
    (sample,) = read_database(database).samples
    return list(sample.scans)


def expect_the_same(database: Path, live: Path) -> None:
    """Bit for bit: what was measured, and what was fitted to it."""
    mine, theirs = scans(database), scans(live)
    assert [scan.scan for scan in mine] == [scan.scan for scan in theirs] == [1, 2]
    for found, one in zip(mine, theirs, strict=True):
        assert found.fit is not None
        assert one.fit is not None
        np.testing.assert_array_equal(found.fit.values, one.fit.values)
        np.testing.assert_array_equal(found.fit.covariance, one.fit.covariance)
        assert (found.fit.model, found.fit.reason) == (one.fit.model, one.fit.reason)
        observations, wanted = found.observations(), one.observations()
        assert observations.keys() == wanted.keys()
        for name, array in observations.items():
            assert array.tobytes() == wanted[name].tobytes(), name


@pytest.mark.parametrize("start", ["frames", "radiance"])
def test_the_replay_is_the_run(rig: Rig, recorded: Recorded, start: str) -> None:
    bag = recorded.bag if start == "frames" else recorded.radiance
    rig.launch(file="replay", bag=bag, database=rig.database, **{"from": start})
    assert rig.wait() == 0, rig.text()
    rig.expect_no_process()
    assert "player has finished" in rig.text()
    expect_the_same(rig.database, recorded.live.database)
    # a bag's messages, from several publishers through one, leave no gap
    assert "refused" not in rig.text()


def test_people_direct_it_while_it_plays(rig: Rig, recorded: Recorded) -> None:
    """Slow enough that it does not end by itself; back to the beginning, it gives the same."""
    rig.launch(file="replay", bag=recorded.bag, database=rig.database, rate=0.5)
    graph = rig.graph()
    with rig.watch("/diagnostics") as watcher:
        rig.until(
            watcher,
            lambda m: isinstance(m, Diagnostics) and (m.node, m.state) == ("player", "running"),
        )
    with ServiceClient(graph, "player") as client:
        assert client.ask("pause", {}, 10).ok
        said = rig.tvbrdf("bag", "control", "status", "--json", "--run", str(rig.run))
        assert said.returncode == 0, said.stderr
        assert json.loads(said.stdout)["paused"] is True
        before = client.ask("status", {}, 10).data["played"]
        assert client.ask("step", {}, 10).ok
        rig.wait_for(
            lambda: client.ask("status", {}, 10).data["played"] == before + 1, "one message"
        )
        found = client.ask("seek", {"seconds": 0.0}, 10)
        assert (found.ok, found.data["epoch"]) == (True, 2)
        assert client.ask("rate", {"rate": 0}, 10).ok
        assert client.ask("resume", {}, 10).ok
    assert rig.wait() == 0, rig.text()
    expect_the_same(rig.database, recorded.live.database)


def test_ctrl_c_ends_it(rig: Rig, recorded: Recorded) -> None:
    rig.launch(file="replay", bag=recorded.bag, database=rig.database, rate=0.01)
    with rig.watch("/diagnostics") as watcher:
        rig.until(
            watcher,
            lambda m: isinstance(m, Diagnostics) and (m.node, m.state) == ("player", "running"),
        )
    rig.signal(signal.SIGINT)
    assert rig.wait() == 130, rig.text()
    rig.expect_no_process()


def test_a_bag_that_can_not_be_replayed_is_told(rig: Rig, recorded: Recorded) -> None:
    for bag, words, text in (
        (recorded.bare, (), "has no calibration inside; give the rig's file: calibration:=FILE"),
        (recorded.radiance, (), "replay that with from:=radiance"),
        (recorded.cut, (), "tvbrdf bag recover"),
        (rig.folder / "no.mcap", (), "there is no such bag"),
        (recorded.bag, ("from:=frame",), "expected frames, radiance"),
    ):
        said = rig.tvbrdf("launch", "replay", f"bag:={bag}", "--run", str(rig.run), *words)
        assert said.returncode == 1
        assert text in said.stderr
        if not words:
            assert str(bag) in said.stderr
        assert not rig.run.exists()
