"""The recorder's node inside one process: what it records, and how it ends."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from tests.messages.bag_samples import read
from tests.nodes.recorder.recording import (
    GIVES,
    INFO,
    REPORTS,
    Recording,
    frame,
    recorder_graph,
)
from tests.paths import CALIBRATION_FILE
from tests.sample_messages import START_NS, STATE
from tvbrdf_messages.bag import BagReader, attachment_kind
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Diagnostics, Frame, Log, Mark
from tvbrdf_nodes.core.device import DeviceError
from tvbrdf_nodes.core.node import GIVE_UP
from tvbrdf_nodes.core.parameters import ParameterError, build
from tvbrdf_nodes.recorder.attachments import attachments_of_run
from tvbrdf_nodes.recorder.node import selection
from tvbrdf_nodes.recorder.parameters import RecorderParameters
from tvbrdf_nodes.recorder.record_book import RecordBook

SECOND_NS = 1_000_000_000

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
    found = read(run / "bag")
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


def test_a_calibration_is_found_from_another_folder(tmp_path: Path) -> None:
    """Nodes take relative paths from the launcher's folder; who records later may be elsewhere."""
    graph = recorder_graph(tmp_path, calibration=CALIBRATION_FILE.name)
    there = replace(graph, working_directory=str(CALIBRATION_FILE.parent))
    attached = attachments_of_run(there)
    assert attached == {"calibration/calibration.yaml": CALIBRATION_FILE.read_bytes()}


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


def test_what_is_sent_again_is_recorded_once(tmp_path: Path) -> None:
    """A kept message comes again for a reader that begins to look on; also after it was written."""
    with Recording(recorder_graph(tmp_path)) as recording:
        recording.say("/camera_1/info", INFO)
        (kept,) = recording.graph.published("/camera_1/info")
        for seconds in (0.1, 5.0):
            recording.say("/arm/state", STATE, seconds)
            recording.graph.bus.ports["recorder"].take(kept)
            recording.settle()
        recording.say("/arm/state", STATE, 9.0)
    said = [envelope.topic for _, envelope in read(tmp_path / "bag")]
    assert said == ["/camera_1/info", "/arm/state", "/arm/state", "/arm/state"]


def test_one_that_joins_late_waits_for_the_clock(tmp_path: Path) -> None:
    """Messages that come before the simulated clock was told do not stand at its beginning."""
    with Recording(recorder_graph(tmp_path, simulated=True)) as recording:
        recording.say("/camera_1/info", INFO)
        assert recording.counters()["recorded"] == 0
        recording.say("/arm/state", STATE, seconds=100.0)
        assert recording.counters()["recorded"] == 2
    assert [at_ns - START_NS for at_ns, _ in read(tmp_path / "bag")] == 2 * [100 * 10**9]


def test_a_clock_that_stands_holds_back_nothing_for_long(tmp_path: Path) -> None:
    """It stands rightly at the beginning of a run; then the next flush records what there is."""
    with Recording(recorder_graph(tmp_path, simulated=True)) as recording:
        recording.say("/camera_1/info", INFO)
        recording.runner.put(recording.runner.node.on_timer("flush"))
        assert recording.counters()["bag_messages"] == {"/camera_1/info": 1}
    assert [at_ns for at_ns, _ in read(tmp_path / "bag")] == [START_NS]


def test_a_replay_has_the_times_of_what_is_played(tmp_path: Path) -> None:
    """Which lie before its launch; nodes have that one's time until they are told."""
    played_ns = START_NS - 3600 * SECOND_NS
    graph = recorder_graph(tmp_path, simulated=True, gives=(*GIVES, *REPORTS))
    with Recording(graph) as recording:
        source, clock = recording.source, recording.graph.clock
        for index in range(3):
            clock.tell(played_ns + index * SECOND_NS, epoch=1)
            source.publish("/arm/state", STATE, stamp_ns=played_ns + index * SECOND_NS + 7)
            late = Log(node="source", level="info", text="of a node that was not told the time")
            source.publish("/log", late, stamp_ns=START_NS)
            recording.settle()
        clock.tell(played_ns, epoch=2)
        source.publish("/log", late, stamp_ns=played_ns + 2 * SECOND_NS)  # told too late
        source.publish("/arm/state", STATE, stamp_ns=played_ns + 7)
        recording.settle()
    said = [(at_ns - played_ns, e) for at_ns, e in read(tmp_path / "bag")]
    own_ns = [at_ns for at_ns, e in said if e.header.publisher == "recorder"]
    assert len(own_ns) == 3
    assert all(0 <= at_ns <= 7 for at_ns in own_ns)
    found = [at_ns for at_ns, e in said if e.header.publisher == "source"]
    steps = [7, 7, SECOND_NS + 7, SECOND_NS + 7, 2 * SECOND_NS + 7, 2 * SECOND_NS + 7]
    assert found == sorted([*steps, 0, 0])  # the reader gives them by log time


def test_splits_repeat_what_is_latched(tmp_path: Path) -> None:
    with Recording(recorder_graph(tmp_path, split_s=10)) as recording:
        recording.say("/camera_1/info", INFO)
        for index in range(25):
            recording.say("/arm/state", STATE, seconds=1.0 + index)
    files = sorted((tmp_path / "bag").iterdir())
    assert [file.name for file in files] == ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"]
    assert all("/camera_1/info" in {e.topic for _, e in read(file)} for file in files)


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


# -- what it says itself


def said_by_itself(recording: Recording) -> list[Envelope]:
    return [e for topic in REPORTS for e in recording.graph.published(topic)]


def test_its_own_reports_are_in_the_bag_as_they_were_sent(tmp_path: Path) -> None:
    with Recording(recorder_graph(tmp_path, gives=(*GIVES, *REPORTS))) as recording:
        recording.say("/log", Log(node="source", level="info", text="here"), seconds=1.0)
        recording.runner.tell_diagnostics()
        recording.settle()
        recording.runner.log.warning("the disk is slow")  # said, and stopped at once
        own = [e for e in said_by_itself(recording) if e.header.publisher == "recorder"]
    found = read(tmp_path / "bag")
    mine = [envelope for _, envelope in found if envelope.header.publisher == "recorder"]
    assert sorted(map(Envelope.order, mine)) == sorted(map(Envelope.order, own))
    assert {e.order(): (e.header, e.message) for e in mine} == {
        e.order(): (e.header, e.message) for e in own
    }
    states = [e.message.state for e in mine if isinstance(e.message, Diagnostics)]
    assert states == ["ready", "running", "running"]
    texts = [e.message.text for e in mine if isinstance(e.message, Log)]
    assert texts[0].startswith("records 6 topics into")
    assert texts[1:] == ["the disk is slow"]
    assert len(found) == len(mine) + 1
    with BagReader(tmp_path / "bag") as bag:
        assert not any(stream.lost for stream in bag.summary().streams)


def test_its_own_reports_cause_no_further_ones(tmp_path: Path) -> None:
    """Also where they can't be recorded themselves: nothing has a time before 1970."""
    graph = recorder_graph(tmp_path, utc_ns=-SECOND_NS, gives=(*GIVES, *REPORTS))
    with Recording(graph) as recording:
        recording.settle()
        before = len(said_by_itself(recording))
        recording.settle()
        assert len(said_by_itself(recording)) == before
        assert recording.counters()["unfit"] == before
    said = [e.message for e in recording.graph.published("/log") if isinstance(e.message, Log)]
    assert len([m for m in said if "before 1970" in m.text]) == 1
    assert read(tmp_path / "bag") == []


def test_what_it_says_of_its_end_is_not_recorded_and_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = recorder_graph(tmp_path, floor_free_mb=1, gives=(*GIVES, *REPORTS))
    with Recording(graph) as recording:
        recording.say("/arm/state", STATE)
        monkeypatch.setattr(os, "fstatvfs", lambda _: Disk(0))
        recording.say("/arm/state", STATE, seconds=2.0)
        assert len(recording.errors()) == 1
        assert recording.counters()["not_recorded"] == 1  # the error
    assert [e.topic for _, e in read(tmp_path / "bag")][-1] == "/arm/state"


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
    assert len(read(tmp_path / "bag")) == 2
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
    assert len(read(tmp_path / "bag")) == 2


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
    assert len(read(tmp_path / "bag")) == 1


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
            ((at_ns, _),) = read(folder / f"{name}{suffix}")
            assert at_ns == START_NS + life * SECOND_NS


def test_a_bag_of_another_run_is_refused(tmp_path: Path) -> None:
    with Recording(recorder_graph(tmp_path)) as recording:
        recording.say("/arm/state", STATE)
    with pytest.raises(DeviceError, match="bag: exists already; choose another name or remove it"):
        Recording(recorder_graph(tmp_path, utc_ns=START_NS + 1)).__enter__()
    assert len(read(tmp_path / "bag")) == 1


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
