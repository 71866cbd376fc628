"""The recorder's node inside one process: what it records, and how it ends."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from tests.nodes.recorder.recording import (
    INFO,
    START_NS,
    STATE,
    Recording,
    frame,
    messages,
    recorder_graph,
)
from tests.paths import CALIBRATION_FILE
from tvbrdf_messages.bag import BagReader, attachment_kind
from tvbrdf_messages.messages import Frame, Log, Mark
from tvbrdf_nodes.core.device import DeviceError
from tvbrdf_nodes.core.node import GIVE_UP
from tvbrdf_nodes.core.parameters import ParameterError, build
from tvbrdf_nodes.recorder.node import selection
from tvbrdf_nodes.recorder.parameters import RecorderParameters
from tvbrdf_nodes.recorder.record_book import RecordBook

# -- what is recorded


def test_what_is_said_is_in_the_bag(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "launch").mkdir(parents=True)
    (run / "launch" / "rig.yaml").write_text("description: a rig\n")
    (run / "launch.json").write_text("{}")
    graph = recorder_graph(run, calibration=str(CALIBRATION_FILE), full_frames=True)
    graph.write()
    sent = [frame(index) for index in range(3)]
    with Recording(graph) as recording:
        recording.say("/camera_1/info", INFO)
        for index, each in enumerate(sent):
            recording.say("/camera_1/frame", each, seconds=index / 30)
        recording.say("/arm/state", STATE, seconds=2.5)
        recording.say("/operator/mark", Mark(text="paint applied", zero=True), seconds=3.0)
        assert recording.counters()["recorded"] == 6
    found = messages(run / "bag")
    assert [e.topic for _, e in found] == [
        "/camera_1/info",
        *3 * ["/camera_1/frame"],
        "/arm/state",
        "/operator/mark",
    ]
    for (log_time_ns, envelope), each in zip(found[1:4], sent, strict=True):
        assert log_time_ns == envelope.header.stamp_ns  # both on the run's clock
        assert envelope.header.publisher == "source"
        assert isinstance(envelope.message, Frame)
        assert replace(envelope.message, image=each.image) == each
        np.testing.assert_array_equal(envelope.message.image, each.image)
    with BagReader(run / "bag") as bag:
        attached = bag.attachments()
        assert {attachment_kind(name) for name in attached} == {"launch", "calibration", "notes"}
        assert attached["launch/rig.yaml"] == b"description: a rig\n"
        assert attached["calibration/calibration.yaml"] == CALIBRATION_FILE.read_bytes()
        assert {"launch/launch.json", "launch/graph.json"} <= attached.keys()
        # START_NS is 2027-01-15 08:00:00 UTC
        assert attached["notes.txt"] == b"2027-01-15T08:00:03.000+00:00 [t = 0] paint applied\n"
        assert str(START_NS) in bag.about.run
        assert bag.about.version


def test_counts_and_gaps_are_told(tmp_path: Path) -> None:
    with Recording(recorder_graph(tmp_path)) as recording:
        for index in range(6):
            if index == 3:  # the recorder does not see this one
                queue = recording.graph.bus.ports.pop("recorder")
                recording.source.publish("/arm/state", STATE, stamp_ns=START_NS)
                recording.graph.bus.ports["recorder"] = queue
            recording.say("/arm/state", STATE, seconds=2.0 * index)
        counters = recording.counters()
    # the last is in the present chunk, which is not written yet
    assert counters["bag_messages"] == {"/arm/state": 5}
    assert counters["bag_lost"] == {"/arm/state": 1}
    (entry,) = RecordBook(recording.runner.graph, "recorder").entries
    assert (entry.state, entry.messages, entry.lost) == (
        "complete",
        {"/arm/state": 6},
        {"/arm/state": 1},
    )


def test_one_that_joins_late_waits_for_the_clock(tmp_path: Path) -> None:
    """Messages that come before the simulated clock was told do not stand at its beginning."""
    with Recording(recorder_graph(tmp_path, simulated=True)) as recording:
        recording.say("/camera_1/info", INFO)
        assert recording.counters()["recorded"] == 0
        recording.say("/arm/state", STATE, seconds=100.0)
        assert recording.counters()["recorded"] == 2
    assert [at_ns - START_NS for at_ns, _ in messages(tmp_path / "bag")] == 2 * [100 * 10**9]


def test_a_clock_that_stands_holds_back_nothing_for_long(tmp_path: Path) -> None:
    """It stands rightly at the beginning of a run; then the next flush records what there is."""
    with Recording(recorder_graph(tmp_path, simulated=True)) as recording:
        recording.say("/camera_1/info", INFO)
        recording.runner.put(recording.runner.node.on_timer("flush"))
        assert recording.counters()["bag_messages"] == {"/camera_1/info": 1}
    assert [at_ns for at_ns, _ in messages(tmp_path / "bag")] == [START_NS]


def test_splits_repeat_what_is_latched(tmp_path: Path) -> None:
    with Recording(recorder_graph(tmp_path, split_s=10)) as recording:
        recording.say("/camera_1/info", INFO)
        for index in range(25):
            recording.say("/arm/state", STATE, seconds=1.0 + index)
    files = sorted((tmp_path / "bag").iterdir())
    assert [file.name for file in files] == ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"]
    assert all("/camera_1/info" in {e.topic for _, e in messages(file)} for file in files)


@pytest.mark.parametrize(
    ("topics", "regex", "exclude", "expected"),
    [
        ((), "", "", {"/arm/state", "/camera_1/frame", "/log"}),
        (("/arm/state",), "", "", {"/arm/state"}),
        ((), "camera", "", {"/camera_1/frame"}),
        (("/arm/state",), "^/log", "", {"/arm/state", "/log"}),
        ((), "", "frame|log", {"/arm/state"}),
        (("/scan/database",), "", "", {"/scan/database"}),
        ((), ".*", "", {"/arm/state", "/camera_1/frame", "/log", "/scan/database"}),
    ],
)
def test_topics_are_selected(topics: Any, regex: str, exclude: str, expected: set[str]) -> None:
    """Never the clock nor what is for simulated devices alone, whatever is asked for."""
    given = ("/arm/state", "/camera_1/frame", "/log", "/clock", "/sim/scene", "/scan/database")
    assert set(filter(selection(topics, regex, exclude), given)) == expected


# -- ends


class Disk(NamedTuple):
    """What ``fstatvfs`` says of a disk."""

    f_bavail: int
    f_frsize: int = 1


def test_below_the_floor_it_ends_and_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Recording(recorder_graph(tmp_path, floor_free_mb=1)) as recording:
        recording.say("/arm/state", STATE)
        monkeypatch.setattr(os, "fstatvfs", lambda _: Disk(999_999))
        for index in range(5):
            recording.say("/arm/state", STATE, seconds=2.0 + 2.0 * index)
        assert recording.runner.exit is None
        counters = recording.counters()
    (text,) = recording.errors()  # once
    assert "less than the floor of 1 MB" in text
    assert text.endswith("the run goes on without a recording")
    assert counters["recording"] is False
    assert "less than the floor" in counters["ended"]
    assert counters["bag_messages"] == {"/arm/state": 2}
    assert counters["not_recorded"] == 4
    assert len(messages(tmp_path / "bag")) == 2
    (entry,) = RecordBook(recording.runner.graph, "recorder").entries
    assert entry.state == "ended"
    assert "free on the disk" in entry.text


def test_a_run_that_requires_it_ends_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = recorder_graph(tmp_path, floor_free_mb=1, required=True)
    assert graph.find("recorder").counted_bytes == 0  # a lossless reader
    with Recording(graph) as recording:
        recording.say("/arm/state", STATE)
        monkeypatch.setattr(os, "fstatvfs", lambda _: Disk(0))
        recording.say("/arm/state", STATE, seconds=2.0)
        ended = recording.runner.exit
        assert ended is not None
        assert ended.code == GIVE_UP
        assert "less than the floor" in ended.text
        assert "requires its recorder" in ended.text
    assert len(messages(tmp_path / "bag")) == 2


def test_a_message_without_a_time_is_left_out_and_told(tmp_path: Path) -> None:
    with Recording(recorder_graph(tmp_path)) as recording:
        for _ in range(3):
            recording.source.publish("/arm/state", STATE, stamp_ns=-1)
        recording.say("/arm/state", STATE)
        assert recording.counters()["unfit"] == 3
        said = [e.message for e in recording.graph.published("/log")]
    warnings = [m.text for m in said if isinstance(m, Log) and m.level == "warning"]
    assert len(warnings) == 1
    assert "before 1970" in warnings[0]
    assert len(messages(tmp_path / "bag")) == 1


# -- lives


def test_a_second_life_records_beside_the_first(tmp_path: Path) -> None:
    for suffix in ("", ".mcap"):
        folder = tmp_path / f"run{suffix}"
        folder.mkdir()
        path = folder / f"bag{suffix}"
        for life in range(3):
            with Recording(recorder_graph(folder, path=str(path))) as recording:
                recording.say("/arm/state", STATE, seconds=life)
        for life, name in enumerate(("bag", "bag_2", "bag_3")):
            ((at_ns, _),) = messages(folder / f"{name}{suffix}")
            assert at_ns == START_NS + life * 1_000_000_000


def test_a_bag_of_another_run_is_refused(tmp_path: Path) -> None:
    with Recording(recorder_graph(tmp_path)) as recording:
        recording.say("/arm/state", STATE)
    with pytest.raises(DeviceError, match="bag: exists already; choose another name or remove it"):
        Recording(recorder_graph(tmp_path, utc_ns=START_NS + 1)).__enter__()
    assert len(messages(tmp_path / "bag")) == 1


def test_a_later_life_that_has_no_room_is_quiet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its run has been going on for long and goes on; the first life would have refused."""
    with Recording(recorder_graph(tmp_path, floor_free_mb=1)) as recording:
        recording.say("/arm/state", STATE)
    monkeypatch.setattr(os, "fstatvfs", lambda _: Disk(0))
    with Recording(recorder_graph(tmp_path, floor_free_mb=1)) as recording:
        recording.say("/arm/state", STATE)
        assert recording.runner.exit is None
        assert recording.counters()["recording"] is False
    (text,) = recording.errors()
    assert "nothing was recorded" in text
    with pytest.raises(DeviceError, match="less than the floor"):
        Recording(recorder_graph(tmp_path, floor_free_mb=1, required=True)).__enter__()


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"path": ""}, "path is empty"),
        ({"split_s": -1}, "split_s, split_mb and floor_free_mb must be 0 or more"),
        ({"queue_mb": 0}, "queue_mb above 0"),
        ({"margin": 2}, "margin is 2, expected 0 to 1"),
        ({"compression": "zip"}, "compression is 'zip', expected lz4 or none"),
        ({"path": "a.mcap", "split_mb": 10}, "a.mcap is one file; a bag in parts is a folder"),
        ({"regex": "("}, "regex is no regular expression"),
        ({"exclude": "["}, "exclude is no regular expression"),
        ({"full_frame": True}, "did you mean 'full_frames'"),
    ],
)
def test_wrong_parameters_are_told(wrong: dict[str, Any], text: str) -> None:
    with pytest.raises(ParameterError, match=text):
        build(RecorderParameters, {"path": "bag", **wrong})
