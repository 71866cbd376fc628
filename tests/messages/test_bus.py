"""The two buses keep one contract: order, registration, what is kept, gaps."""

from __future__ import annotations

import contextlib
import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgpack
import numpy as np
import pytest
import zmq

from tests.messages.bus_bench import Bench
from tests.sample_messages import STATE, frame
from tvbrdf_messages.bus import InProcessBus, ZmqPort
from tvbrdf_messages.envelope import Envelope, epoch_of
from tvbrdf_messages.errors import MessageError, QueueFullError, StoppedError
from tvbrdf_messages.messages import Frame, Log, Mark, ScanCommand, SweepResult
from tvbrdf_messages.run_directory import Graph, Participant

if TYPE_CHECKING:
    from tests.messages.conftest import MakeBench


def graph(directory: Path) -> Graph:
    return Graph(
        directory=str(directory),
        utc_ns=1,
        monotonic_ns=1,
        simulated=True,
        participants=(
            Participant(
                name="arm", gives=("/arm/state", "/scan/sweep_result", "/log", "/operator/mark")
            ),
            Participant(name="camera_1", gives=("/camera_1/frame",)),
            Participant(name="merger", takes=("/arm/state", "/camera_1/frame", "/log")),
            Participant(name="writer", takes=("/arm/state", "/operator/mark")),
            Participant(name="sequencer", takes=("/scan/sweep_result",)),
        ),
    )


@pytest.fixture(params=["zmq", "inprocess"])
def bench(request: pytest.FixtureRequest, tmp_path: Path, zmq_bench: MakeBench) -> Bench[Any]:
    if request.param == "zmq":
        return zmq_bench(graph(tmp_path))
    return Bench(InProcessBus(graph(tmp_path)).port)


def send(port: Any, topic: str, message: Any, **more: Any) -> bool:
    return bool(port.publish(topic, message, stamp_ns=5, received_ns=6, hardware_ns=7, **more))


def test_every_reader_gets_every_message_in_order(bench: Bench[Any]) -> None:
    arm, merger, writer = bench.port("arm"), bench.port("merger"), bench.port("writer")
    bench.port("sequencer")
    bench.pump(lambda: not arm.missing_readers())
    for _ in range(500):
        assert send(arm, "/arm/state", STATE)
    for reader in (merger, writer):
        got = bench.collect(reader, 500)
        assert [envelope.header.sequence for envelope in got] == list(range(500))
        assert got[0].header[5:] == (5, 6, 7)
        assert got[0].header.publisher == "arm"
        assert reader.counters()["gaps"] == 0


def test_nobody_is_ready_before_every_named_reader_is_there(bench: Bench[Any]) -> None:
    arm = bench.port("arm")
    assert "merger:/arm/state" in arm.missing_readers()
    assert "writer:/arm/state" in arm.missing_readers()
    bench.port("merger")
    bench.pump(lambda: "merger:/arm/state" not in arm.missing_readers())
    assert "writer:/arm/state" in arm.missing_readers()


def test_what_is_kept_is_sent_again_to_a_restarted_reader(bench: Bench[Any]) -> None:
    arm, writer = bench.port("arm"), bench.port("writer")
    bench.pump(lambda: "writer:/operator/mark" not in arm.missing_readers())
    send(arm, "/operator/mark", Mark(text="first"), keep="1")
    send(arm, "/operator/mark", Mark(text="second"), keep="2")
    assert len(bench.collect(writer, 2)) == 2
    arm.release("/operator/mark", "1")
    bench.drop(writer)
    again = bench.port("writer")
    got = bench.collect(again, 1)
    assert [envelope.message for envelope in got] == [Mark(text="second")]
    assert "reader" in {event.kind for event in arm.events()}


def test_a_topic_that_is_not_given_is_refused(bench: Bench[Any]) -> None:
    arm = bench.port("arm")
    with pytest.raises(MessageError, match="does not give /camera_1/frame"):
        send(arm, "/camera_1/frame", STATE)


def test_a_new_epoch_is_told_and_is_no_gap(bench: Bench[Any]) -> None:
    """Of a replay: what a node says after a jump tells it to those behind."""
    arm, merger = bench.port("arm"), bench.port("merger")
    bench.port("writer")
    bench.pump(lambda: not [r for r in arm.missing_readers() if "/arm/state" in r])
    for epoch in (0, 2, 7):
        if epoch:
            arm.begin_epoch(epoch)
        for _ in range(3):
            assert send(arm, "/arm/state", STATE)
    got = bench.collect(merger, 9)
    assert [epoch_of(e.header.incarnation) for e in got] == [0, 0, 0, 2, 2, 2, 7, 7, 7]
    assert [e.header.sequence for e in got] == list(range(9))
    assert merger.counters()["gaps"] == 0


def test_a_lost_publisher_is_noticed(bench: Bench[Any]) -> None:
    merger = bench.port("merger")
    camera = bench.port("camera_1")
    kinds: list[tuple[str, str]] = []

    def saw(kind: str, name: str) -> bool:
        kinds.extend((event.kind, event.name) for event in merger.events())
        return (kind, name) in kinds

    bench.pump(lambda: saw("found", "camera_1"))
    bench.drop(camera)
    bench.pump(lambda: saw("lost", "camera_1"))


# -- what only sockets can get wrong


def image_frame(index: int) -> Frame:
    """Return a frame of 60 kB."""
    return frame(np.full((100, 100, 3), index % 4096, np.uint16), index=index)


def camera_and_merger(bench: Bench[ZmqPort], **options: Any) -> tuple[ZmqPort, ZmqPort]:
    """Open both, and wait until the merger has registered."""
    camera, merger = bench.port("camera_1"), bench.port("merger", **options)
    bench.pump(lambda: not camera.missing_readers())
    return camera, merger


def test_a_slow_reader_holds_a_simulated_source_and_nothing_is_lost(
    tmp_path: Path, zmq_bench: MakeBench
) -> None:
    bench = zmq_bench(graph(tmp_path))
    camera, merger = camera_and_merger(bench, credit_bytes=300_000)
    sent = threading.Event()

    def publish() -> None:
        for index in range(60):  # five fit
            camera.publish("/camera_1/frame", image_frame(index), stamp_ns=0)
        sent.set()

    thread = threading.Thread(target=publish)
    thread.start()
    assert not sent.wait(0.3), "the source did not wait for credit"
    bench.ports.remove(camera)  # the thread uses it
    got = bench.collect(merger, 60, limit=2)
    thread.join()
    bench.ports.append(camera)
    assert [envelope.header.sequence for envelope in got] == list(range(60))
    last = got[-1].message
    assert isinstance(last, Frame)
    assert int(last.image[0, 0, 0]) == 59


def test_a_live_source_does_not_wait(tmp_path: Path, zmq_bench: MakeBench) -> None:
    described = graph(tmp_path)
    participants = tuple(
        replace(p, live=True) if p.name == "camera_1" else p for p in described.participants
    )
    bench = zmq_bench(replace(described, simulated=False, participants=participants))
    camera, merger = camera_and_merger(bench, credit_bytes=300_000)
    delivered = [camera.publish("/camera_1/frame", image_frame(i), stamp_ns=0) for i in range(60)]
    assert delivered[:5] == [True] * 5
    assert not delivered[-1]
    got = bench.collect(merger, sum(delivered))

    def has_credit() -> bool:
        got.extend(merger.receive())
        return camera.publisher._readers["merger"].lossless > 0

    bench.pump(has_credit)
    assert camera.publish("/camera_1/frame", image_frame(60), stamp_ns=0)
    bench.collect(merger, 1)
    assert merger.counters()["gaps"] == 60 - sum(delivered), "the loss was not counted"


def test_a_reader_that_takes_no_commands_is_a_fault(tmp_path: Path, zmq_bench: MakeBench) -> None:
    bench = zmq_bench(graph(tmp_path))
    arm = bench.port("arm")
    bench.port("sequencer")
    bench.pump(lambda: not any(name.startswith("sequencer") for name in arm.missing_readers()))
    result = SweepResult(
        source="arm", command_id=1, action="sweep", state="broken", reason="x" * 100_000
    )

    def flood() -> None:
        for _ in range(200):
            send(arm, "/scan/sweep_result", result)

    with pytest.raises(QueueFullError, match="sequencer has not read /scan/sweep_result"):
        flood()


def test_a_wait_for_credit_ends_when_the_node_is_stopped(
    tmp_path: Path, zmq_bench: MakeBench
) -> None:
    stopping = threading.Event()
    camera = zmq_bench(graph(tmp_path)).port("camera_1", stopping=stopping.is_set)
    stopping.set()
    with pytest.raises(StoppedError, match="camera_1 was stopped"):
        camera.publish("/camera_1/frame", image_frame(0), stamp_ns=0)


def test_a_hostile_message_is_refused_and_counted_and_the_rest_goes_on(
    tmp_path: Path, context: zmq.Context[zmq.Socket[bytes]], zmq_bench: MakeBench
) -> None:
    described = graph(tmp_path)
    bench = zmq_bench(described)
    arm, writer = bench.port("arm"), bench.port("writer")
    bench.pump(lambda: not any(name.startswith("writer") for name in arm.missing_readers()))
    with contextlib.closing(context.socket(zmq.DEALER)) as stranger:
        stranger.linger = 0
        stranger.connect(described.endpoint("arm", "lossless"))
        stranger.send_multipart([b"GET / HTTP/1.1", b"\xff" * 50])
        stranger.send_multipart([b"!HELLO", b"\xc1broken"])
        stranger.send_multipart([b"!CREDIT", b"\x01"])
        stranger.send(b"")
        hello = {"reader": "spy", "incarnation": "1", "topics": ["/arm/state"], "credit_bytes": 9}
        stranger.send_multipart([b"!HELLO", msgpack.packb(hello)])
        bench.pump(lambda: arm.counters()["refused"] >= 4)
    assert any("spy" in event.text for event in arm.events())
    send(arm, "/operator/mark", Mark(text="still here"))
    assert bench.collect(writer, 1)[0].message == Mark(text="still here")


def test_a_watcher_can_fall_behind_without_slowing_a_reader(
    tmp_path: Path, context: zmq.Context[zmq.Socket[bytes]], zmq_bench: MakeBench
) -> None:
    described = graph(tmp_path)
    bench = zmq_bench(described)
    camera, merger = camera_and_merger(bench)
    with contextlib.closing(context.socket(zmq.SUB)) as watcher:
        watcher.linger = 0
        watcher.rcvhwm = 1
        watcher.connect(described.endpoint("camera_1", "latest"))
        watcher.subscribe("/camera_1/frame")
        bench.pump(lambda: "/camera_1/frame" in camera.publisher._watched)
        got: list[Envelope] = []
        for index in range(300):
            assert camera.publish("/camera_1/frame", image_frame(index), stamp_ns=0)
            merger.service()
            got.extend(merger.receive())
            camera.service()
        bench.collect(merger, 300 - len(got))
    assert merger.counters()["gaps"] == 0


def test_commands_of_a_name_are_typed(tmp_path: Path) -> None:
    bus = InProcessBus(graph(tmp_path))
    arm = bus.port("arm")
    with pytest.raises(MessageError, match="carries SweepResult, not ScanCommand"):
        send(
            arm,
            "/scan/sweep_result",
            ScanCommand(command_id=1, incarnation="", not_after_ns=0, action="stop"),
        )
    assert not bus.taps
    assert send(arm, "/log", Log(node="arm", level="info", text="x")) is False
