"""A replay that is recorded: its bag says what was played, and is as good as what was played."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from tests.launch.refit_inputs import found_values, inside
from tests.replay.process_replay import BAG
from tests.replay.recorded_rig import START_NS
from tests.replay_bags import assert_same_radiance, replay_graph
from tvbrdf_launch.find_files import find_launch_file
from tvbrdf_launch.launch_file import load_launch_file
from tvbrdf_launch.plan import make_plan
from tvbrdf_launch.refit import Refit, Settings, find_sources
from tvbrdf_messages.bag import BagReader, attachment_kind, check_bag
from tvbrdf_messages.messages import Radiance
from tvbrdf_messages.run_directory import Graph
from tvbrdf_nodes.core.inprocess import InProcessGraph
from tvbrdf_nodes.recorder.attachments import SOURCE_NAME

LIMIT_S = 60.0
DAY_NS = 86_400_000_000_000
AHEAD_NS = 250_000_000
"""Of its clock, how far a simulated camera may stamp frames."""


def run(graph: Graph) -> list[Radiance]:
    """Replay until it has ended; return what was merged."""
    graph.write()
    with InProcessGraph(graph) as running:
        player = running.runners["player"]
        running.run_until(lambda: player.exit is not None, LIMIT_S)
        assert player.exit is not None
        assert player.exit.code == 0, player.exit.text
        while running.step():
            pass
    merged = [e.message for e in running.published("/scan/radiance")]
    return [message for message in merged if isinstance(message, Radiance)]


@dataclass
class Replay:
    """A bag, its replay's, and what the replay merged."""

    source: Path
    bag: Path
    radiance: list[Radiance]


@pytest.fixture(scope="module", params=["file", "folder"])
def replay(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Replay:
    folder = tmp_path_factory.mktemp("replay")
    source = folder / "monday.mcap"
    if request.param == "folder":
        source = folder / "monday"
        source.mkdir()
        shutil.copy(BAG, source / "monday_0.mcap")
    else:
        shutil.copy(BAG, source)
    words = {"bag": str(source), "database": str(folder / "db"), "record": str(folder / "again")}
    graph = make_plan(load_launch_file(find_launch_file("replay"), words, folder), folder).graph
    # launched before or after the times in the bag
    utc_ns = START_NS + DAY_NS * (1 if request.param == "file" else -1)
    radiance = run(replace(graph, utc_ns=utc_ns))
    return Replay(source, folder / "again", radiance)


def test_only_the_calibration_of_what_was_played_is_in_it_and_what_was_played(
    replay: Replay,
) -> None:
    attached, original = inside(replay.bag), inside(replay.source)
    name = "calibration/calibration.yaml"
    assert attached[name] == original[name]
    assert {attachment_kind(name) for name in attached} == {"calibration", "launch", "source"}
    assert sum(map(len, attached.values())) < 50_000  # the bag that was played: 300 kB
    told = json.loads(attached[SOURCE_NAME])
    assert (told["name"], told["path"]) == (replay.source.name, str(replay.source))
    assert (told["run"], told["recording"]) == ("simulated", "simulated")
    assert sum(told["files"].values()) == BAG.stat().st_size
    with BagReader(replay.bag) as bag, BagReader(BAG) as played:
        assert (told["start_ns"], told["end_ns"]) == (played.start_ns, played.end_ns)
        told_short = bag.about.extra["replayed"]
        assert told_short == f"{replay.source.name}, recording simulated of run simulated"
        assert bag.about.run != played.about.run
        assert "/replay/command" in bag.topics()
        assert "/scan/command" not in bag.topics()


def test_its_times_are_those_of_what_was_played(replay: Replay) -> None:
    with BagReader(replay.bag) as bag, BagReader(BAG) as played:
        assert played.start_ns <= bag.start_ns < bag.end_ns
        assert bag.end_ns < played.end_ns + AHEAD_NS
        # how much later depends on how fast it is played; nothing is before it happened
        for at_ns, envelope in bag.messages(["/arm/state", "/scan/sweep_result"]):
            assert at_ns >= envelope.header.stamp_ns
    assert [p.text for p in check_bag(replay.bag).problems] == []


def refit(bag: Path, out: Path) -> Path:
    report = Refit(find_sources([bag]), out, Settings(), jobs=1).run()
    assert report.problems == []
    (target,) = report.targets
    assert target.scans == 1
    return target.folder


def test_its_refit_is_the_refit_of_what_was_played(replay: Replay, tmp_path: Path) -> None:
    """Bit for bit; and its record says where the frames are from."""
    mine, theirs = refit(replay.bag, tmp_path / "a"), refit(replay.source, tmp_path / "b")
    assert found_values(mine) == found_values(theirs)
    told, original = (json.loads((f / "refit.json").read_text()) for f in (mine, theirs))
    assert told["settings"]["from"] == "frames"
    assert "replayed" not in told["settings"]["hdr_merger"]
    for name, value in original["settings"]["hdr_merger"].items():
        assert told["settings"]["hdr_merger"][name] == value
    assert told["settings"]["calibration"] == original["settings"]["calibration"]
    assert told["source"]["replay_of"]["recording"] == "simulated"
    assert "replay_of" not in original["source"]


def test_it_can_be_replayed_itself(replay: Replay, tmp_path: Path) -> None:
    (again,) = run(replay_graph(replay.bag, tmp_path))
    assert_same_radiance(again, replay.radiance[0])
