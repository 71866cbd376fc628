"""A bag of a run, replayed through the real merger, fitter and database writer in one process."""

from __future__ import annotations

import random
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.replay_bags import assert_same_fit, replay_graph, write_bag
from tvbrdf_fitting.published.database import StoredSample, read_database
from tvbrdf_messages.envelope import Envelope, epoch_of, in_epoch
from tvbrdf_messages.messages import (
    ArmState,
    Frame,
    Mark,
    OperatorRequest,
    Parameters,
    Radiance,
    ScanCommand,
    ScanMissing,
)
from tvbrdf_nodes.core.inprocess import InProcessGraph

if TYPE_CHECKING:
    from conftest import Run, RunRig

LIMIT_S = 60.0


def replay(bag: Path, folder: Path, **arguments: Any) -> tuple[InProcessGraph, Any]:
    """Replay until the player has ended; return what was published and how it ended."""
    graph = replay_graph(bag, folder, **arguments)
    with InProcessGraph(graph) as running:
        player = running.runners["player"]
        running.run_until(lambda: player.exit is not None, LIMIT_S)
    return running, player.exit


def fits(graph: InProcessGraph) -> list[Any]:
    return [e.message for e in graph.published("/scan/parameters")]


def sample_in(database: Path) -> StoredSample:
    (sample,) = read_database(database).samples
    return sample


def test_frames_give_what_the_live_run_gave(record: Run, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.mcap", record.messages, record.graph)
    running, end = replay(bag, tmp_path)
    assert end.code == 0, end.text
    (mine,) = fits(running)
    assert_same_fit(mine, record.parameters[0])
    (radiance,) = (e.message for e in running.published("/scan/radiance"))
    assert isinstance(radiance, Radiance)
    np.testing.assert_array_equal(radiance.radiance, record.radiance[0].radiance)
    np.testing.assert_array_equal(radiance.stamp_ns, record.radiance[0].stamp_ns)
    (scan,) = sample_in(tmp_path / "replayed").scans
    (live,) = sample_in(record.database).scans
    assert scan.fit is not None
    assert live.fit is not None
    np.testing.assert_array_equal(scan.fit.values, live.fit.values)
    assert scan.start_stamp_ns == live.start_stamp_ns
    assert not running.published("/scan/command")


def test_radiance_alone_gives_the_same(record: Run, tmp_path: Path) -> None:
    """Also when a restarted database writer has sent the scan again."""
    (radiance,) = (e for e in record.messages if e.topic == "/scan/radiance")
    again = radiance._replace(
        header=radiance.header._replace(publisher="database_writer", incarnation="other")
    )
    kept = [e for e in record.messages if not isinstance(e.message, Frame)]
    bag = write_bag(tmp_path / "run.mcap", [*kept, again], record.graph)
    running, end = replay(bag, tmp_path, **{"from": "radiance"})
    assert end.code == 0, end.text
    assert "hdr_merger" not in running.runners
    (mine,) = fits(running)
    assert_same_fit(mine, record.parameters[0])
    assert len(running.published("/scan/radiance")) == 1


def shuffled(messages: Iterable[Envelope], seed: int) -> list[Envelope]:
    """Interleave publishers at random; what each said stays in its order."""
    by_publisher: dict[str, list[Envelope]] = {}
    for envelope in messages:
        by_publisher.setdefault(envelope.header.publisher, []).append(envelope)
    turns = [name for name, said in by_publisher.items() for _ in said]
    random.Random(seed).shuffle(turns)
    order = {name: iter(said) for name, said in by_publisher.items()}
    return [next(order[name]) for name in turns]


@pytest.mark.parametrize("seed", [1, 2])
def test_the_order_of_arrival_does_not_matter(record: Run, tmp_path: Path, seed: int) -> None:
    bag = write_bag(tmp_path / "run.mcap", shuffled(record.messages, seed), record.graph)
    running, end = replay(bag, tmp_path)
    assert end.code == 0, end.text
    (mine,) = fits(running)
    assert_same_fit(mine, record.parameters[0])


def test_several_scans_with_a_missing_one_and_a_mark(run_rig: RunRig, tmp_path: Path) -> None:
    """The database says of the replay what it said of the run."""
    live = run_rig(scans=3, exposures_ms=[0.2, 4.0], sweep_s=4, width=16, height=16,
                   keep_frames=True)  # fmt: skip
    first = live.messages[0].header._replace(publisher="sequencer", incarnation="other")
    missing = ScanMissing(sample="drying_paint", scan=4, scan_time_s=180.0, reason="the lamp died")
    told = [
        Envelope("/scan/missing", first._replace(sequence=0), missing),
        Envelope("/operator/mark", first._replace(sequence=7), Mark(text="a fly sat down")),
    ]
    bag = write_bag(tmp_path / "run.mcap", [*live.messages, *told], live.graph)
    running, end = replay(bag, tmp_path)
    assert end.code == 0, end.text
    found: list[Parameters] = fits(running)
    assert [one.scan for one in found] == [1, 2, 3]
    sample = sample_in(tmp_path / "replayed")
    assert [(one.scan, one.reason) for one in sample.missing] == [(4, "the lamp died")]
    assert [note.text for note in sample.notes] == ["a fly sat down"]
    for mine, theirs in zip(found, live.parameters, strict=True):
        assert_same_fit(mine, theirs)


def test_a_seek_leaves_nothing_of_before_in_the_merger(record: Run, tmp_path: Path) -> None:
    """In mid-sweep back to the beginning: the scan that follows is the live one, bit for bit."""
    bag = write_bag(tmp_path / "run.mcap", record.messages, record.graph)
    graph = replay_graph(bag, tmp_path)
    with InProcessGraph(graph) as running:
        player = running.runners["player"]
        half = sum(isinstance(e.message, Frame) for e in record.messages) // 2

        def frames() -> int:
            return sum(isinstance(e.message, Frame) for e in running.bus.taps)

        running.run_until(lambda: frames() >= half, LIMIT_S)
        assert not fits(running)
        asked = OperatorRequest(request_id="1", verb="seek", arguments={"seconds": 0})
        player.put(player.node.on_request(asked))
        assert player.replies[0].ok, player.replies[0].text
        running.run_until(lambda: player.exit is not None, LIMIT_S)
    assert player.exit is not None
    assert player.exit.code == 0, player.exit.text
    (mine,) = fits(running)
    assert_same_fit(mine, record.parameters[0])
    results: list[Any] = [e.message for e in running.published("/scan/sweep_result")]
    assert [m for m in results if m.source == "hdr_merger" and m.state != "done"] == []
    assert running.clock.epoch == 2


def test_a_bag_without_a_whole_scan_fails_clearly(record: Run, tmp_path: Path) -> None:
    half = record.messages[: len(record.messages) // 2]
    bag = write_bag(tmp_path / "half.mcap", half, record.graph)
    _, end = replay(bag, tmp_path)
    assert end.code == 1
    assert f"{bag}: no scan came out of it" in end.text


def test_commands_reach_the_merger_where_nothing_moves(record: Run, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.mcap", record.messages, record.graph)
    graph = replay_graph(bag, tmp_path)
    assert "/scan/command" not in {t for p in graph.participants for t in (*p.takes, *p.gives)}
    running, _ = replay(bag, tmp_path)
    told = [e.message for e in running.published("/replay/command")]
    assert told == [e.message for e in record.messages if isinstance(e.message, ScanCommand)]


def choice_of(fit: Parameters) -> str:
    """Return why a model was chosen, without how long that took."""
    choice = fit.details["choice"]
    untimed = ({k: v for k, v in r.items() if k != "solve_time_s"} for r in choice["rungs"])
    return repr((choice["reason"], *untimed))


def test_a_seek_begins_the_choice_of_models_anew(record: Run, tmp_path: Path) -> None:
    """Of scans that are merged anew, too: the merger passes the epoch on."""
    state = next(e for e in record.messages if isinstance(e.message, ArmState))
    still = state.header._replace(incarnation="later")
    rest = [state._replace(header=still._replace(sequence=k)) for k in range(2000)]
    bag = write_bag(tmp_path / "run.mcap", [*record.messages, *rest], record.graph)
    with InProcessGraph(replay_graph(bag, tmp_path, model="auto")) as running:
        player = running.runners["player"]
        running.run_until(lambda: bool(fits(running)), LIMIT_S)
        asked = OperatorRequest(request_id="1", verb="seek", arguments={"seconds": 0})
        player.put(player.node.on_request(asked))
        assert player.replies[0].ok, player.replies[0].text
        running.run_until(lambda: player.exit is not None, LIMIT_S)
    assert player.exit is not None
    assert player.exit.code == 0, player.exit.text
    first, again = (choice_of(fit) for fit in fits(running))
    assert first == again  # with a model of before there is another reason, see below
    epochs = [epoch_of(e.header.incarnation) for e in running.published("/scan/parameters")]
    assert epochs == [0, 2]


def test_a_new_epoch_begins_the_choice_of_models_anew(record: Run) -> None:
    """The model of the scan before speaks for itself, but not over a jump back in time."""
    graph = replace(
        record.graph,
        participants=tuple(
            replace(p, parameters={**p.parameters, "model": "auto"}) if p.name == "fitter" else p
            for p in record.graph.participants
        ),
    )
    (radiance,) = (e for e in record.messages if e.topic == "/scan/radiance")
    header = radiance.header
    later = [header._replace(incarnation=in_epoch(header.incarnation, k)) for k in (2, 3)]
    with InProcessGraph(graph, run=["fitter"]) as running:
        for attempt, sent in enumerate((header, header, later[0], later[1], later[1])):
            message = replace(radiance.message, attempt=attempt)  # type: ignore[type-var]
            running.bus.ports["fitter"].take(radiance._replace(header=sent, message=message))
            while running.step():
                pass
        first, again, second, third, third_again = (choice_of(fit) for fit in fits(running))
    assert first == second == third
    assert again == third_again != first  # it knows the scan before, so the epochs matter
