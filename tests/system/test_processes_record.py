"""A rig that is recorded: whole, killed, out of disk. The measurement never suffers from it."""

from __future__ import annotations

import json
import resource
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml

from tests.paths import CALIBRATION_FILE
from tests.replay_bags import assert_same_radiance
from tvbrdf_messages.bag import BagIncompleteError, BagReader, recover
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Diagnostics, Frame, Radiance
from tvbrdf_messages.run_directory import Graph, read_graph
from tvbrdf_messages.schema import Message
from tvbrdf_nodes.core.inprocess import InProcessGraph

if TYPE_CHECKING:
    from tests.system.conftest import Rig

pytestmark = [pytest.mark.system, pytest.mark.slow]

SECOND_NS = 1_000_000_000
CLOCK_STEP_NS = 250_000_000
"""The world tells the run's clock in steps of that."""


def merged_again(graph: Graph, bags: list[Path]) -> list[Radiance]:
    """Return what the merger makes of the recorded frames."""
    found: list[Message] = []
    with InProcessGraph(graph, run=["hdr_merger"]) as again:
        for bag in bags:
            with BagReader(bag) as reader:
                for _, envelope in reader.messages():
                    if envelope.topic in graph.find("hdr_merger").takes:
                        again.bus.ports["hdr_merger"].take(envelope)
                        while again.step():
                            pass
        found = [e.message for e in again.published("/scan/radiance")]
    return [message for message in found if isinstance(message, Radiance)]


def recorded(bag: Path, topic: str) -> list[Envelope]:
    with BagReader(bag) as reader:
        return [each.envelope for each in reader.messages(topics=[topic])]


def book(rig: Rig) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((rig.run / "recorder.bags.json").read_text())["bags"]
    return found


def with_small_patches(folder: Path) -> Path:
    """Write a calibration that uses a part of the pixels, so that the others are not recorded."""
    content = yaml.safe_load(CALIBRATION_FILE.read_text())
    content["every_camera"]["patch"] = {"x": 0.3, "y": 0.2, "width": 0.4, "height": 0.3}
    reference = {"x": 0.4, "y": 0.9, "width": 0.3, "height": 0.08}
    content["every_camera"]["reference_patch"] = reference
    path = folder / "calibration.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.mark.parametrize("small", [False, True])
def test_a_recorded_run_can_be_merged_again(rig: Rig, small: bool) -> None:
    """What the merger makes of the bag is what it made of the live frames, bit for bit."""
    bag = rig.folder / "bag"
    calibration = with_small_patches(rig.folder) if small else CALIBRATION_FILE
    rig.launch(record=bag, calibration=calibration)
    assert rig.wait() == 0, rig.text()
    rig.expect_nothing_left()
    assert "recorder: records regions of interest into" in rig.text()
    assert f"{bag}: " in rig.text()
    assert "no gaps" in rig.text()
    with BagReader(bag) as reader:
        summary = reader.summary(recount=True)
        kinds = {name.split("/")[0] for name in reader.attachments()}
        scene = json.loads(reader.attachment("scene/scene.json"))
    assert kinds == {"launch", "calibration", "scene"}
    assert scene == json.loads((rig.run / "scene.json").read_text())
    assert [stream.lost for stream in summary.streams if stream.lost] == []
    for topic in ("/diagnostics", "/log"):  # its own too
        told = {stream.publisher for stream in summary.streams if stream.topic == topic}
        assert told >= {"recorder", "arm"}, topic
    image: Any = recorded(bag, "/camera_1/frame")[-1].message
    # blank: all but (0.4 + 0.1)·(0.3 + 0.1) and less than (0.3 + 0.1)·(0.08 + 0.15) of the pixels
    assert (np.count_nonzero(image.image) < 0.33 * image.image.size) == small
    (entry,) = book(rig)
    assert entry["state"] == "complete"
    assert entry["messages"] == {t.topic: t.messages for t in summary.topics}
    live = [e.message for e in recorded(bag, "/scan/radiance")]
    again = merged_again(read_graph(rig.run), [bag])
    assert len(live) == len(again) == 2
    for one, other in zip(live, again, strict=True):
        assert isinstance(one, Radiance)
        assert_same_radiance(one, other)


def test_a_killed_recorder_loses_a_second_at_most(rig: Rig) -> None:
    """And goes on beside, while the measurement takes no notice."""
    bag = rig.folder / "bag"
    rig.launch(record=bag, speedup=4)
    seen: list[Envelope] = []
    with rig.watch("/camera_1/frame") as watcher:

        def in_mid_sweep(message: Message) -> bool:
            return isinstance(message, Frame) and (message.kind, message.sweep) == ("light", 1)

        rig.until(watcher, in_mid_sweep)
        while len(seen) < 60:  # a second of 30 frames has been written, and more is on its way
            arrival = watcher.receive(rig.limit_s)
            assert arrival is not None
            seen.append(arrival.envelope)
        rig.kill("recorder")
    assert rig.wait() == 0, rig.text()
    rig.expect_nothing_left()
    sample = rig.expect_whole_database()
    assert (sample.notes, sample.missing) == ((), ())
    assert "was lost" not in rig.text()  # no sweep was taken again
    assert rig.table().nodes["recorder"].incarnations == 2
    with pytest.raises(BagIncompleteError):
        BagReader(bag).__enter__()
    report = recover(bag, rig.folder / "saved")
    assert report.messages > 0
    saved = recorded(rig.folder / "saved", "/camera_1/frame")
    # chunks of a second of the run's clock, which it tells in steps, and cameras work ahead of it
    lost_ns = seen[-1].header.stamp_ns - saved[-1].header.stamp_ns
    assert lost_ns <= SECOND_NS + 2 * CLOCK_STEP_NS
    numbers = [e.header.sequence for e in saved]
    assert numbers == list(range(numbers[-1] + 1))
    first, second = book(rig)
    assert (first["state"], second["state"]) == ("recording", "complete")
    assert second["path"] == f"{bag}_2"
    assert f"{bag} was cut off; save it with: tvbrdf bag recover {bag}" in rig.text()
    after = recorded(Path(second["path"]), "/camera_1/frame")
    assert after[0].header.incarnation == saved[-1].header.incarnation
    assert after[0].header.sequence > saved[-1].header.sequence
    with BagReader(rig.folder / "saved") as before, BagReader(second["path"]) as behind:
        assert before.end_ns < behind.start_ns
    # the second scan is whole in it
    live = [e.message for e in recorded(Path(second["path"]), "/scan/radiance")]
    again = merged_again(read_graph(rig.run), [Path(second["path"])])
    assert [each.scan for each in again] == [2]
    (other,) = (m for m in live if isinstance(m, Radiance) and m.scan == 2)
    assert_same_radiance(other, again[0])


def let_no_file_grow(rig: Rig, beyond: int) -> None:
    """Let the system refuse the recorder to write files longer than that: a full disk, for it."""
    pid = rig.table().nodes["recorder"].pid
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (beyond, beyond))


def test_a_write_error_ends_the_recording_only(rig: Rig) -> None:
    bag = rig.folder / "bag"
    rig.launch(record=bag, speedup=8)
    rig.wait_state("sweeping")
    with rig.watch("/diagnostics") as watcher:
        let_no_file_grow(rig, 2_000_000)

        def ended(message: Message) -> bool:
            return (
                isinstance(message, Diagnostics)
                and message.node == "recorder"
                and bool(message.counters["ended"])
            )

        told = rig.until(watcher, ended)
    assert isinstance(told, Diagnostics)
    assert told.state == "running"
    assert "File too large" in told.counters["ended"]
    assert told.counters["recording"] is False
    assert rig.wait() == 0, rig.text()
    rig.expect_nothing_left()
    sample = rig.expect_whole_database()
    assert (sample.notes, sample.missing) == ((), ())
    assert rig.text().count("the run goes on without a recording") == 1
    assert "ended early: can't be written: File too large" in rig.text()
    assert rig.table().nodes["recorder"].incarnations == 1
    (entry,) = book(rig)
    assert entry["state"] == "ended"
    (file,) = bag.iterdir()
    assert 500_000 < file.stat().st_size <= 2_000_000
    recover(bag, rig.folder / "saved")
    saved = recorded(rig.folder / "saved", "/camera_1/frame")
    assert len(saved) == entry["messages"]["/camera_1/frame"]


def test_a_run_that_requires_its_recorder_ends_with_it(rig: Rig) -> None:
    bag = rig.folder / "bag"
    rig.launch(record=bag, record_required="true", speedup=8)
    rig.wait_state("sweeping")
    assert rig.graph().find("recorder").counted_bytes == 0
    let_no_file_grow(rig, 2_000_000)
    assert rig.wait() == 1, rig.text()
    rig.expect_nothing_left()
    assert "node recorder failed (exit code 3); the end of" in rig.text()
    assert "can't be written: File too large" in rig.text()
    assert "the run requires its recorder" in rig.text()
    assert rig.table().nodes["recorder"].incarnations == 1
    recover(bag, rig.folder / "saved")
    saved = recorded(rig.folder / "saved", "/camera_1/frame")
    assert [e.header.sequence for e in saved] == list(range(len(saved)))
