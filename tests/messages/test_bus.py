"""The two buses keep one contract: order, registration, what is kept, gaps."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from tvbrdf_messages.bus import InProcessBus, ZmqPort
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.errors import MessageError, QueueFullError, StoppedError
from tvbrdf_messages.messages import ArmState, Frame, Log, Mark, ScanCommand, SweepResult
from tvbrdf_messages.run_directory import Graph, Participant

STATE = ArmState(angle_deg=1.0, speed_deg_s=15.0, lamp=True, moving=True, homed=True)
DEADLINE_S = 20.0


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


class Bench:
    """Opens ports of one kind, and pumps them until something is so."""

    def __init__(self, open_port: Callable[[str], Any], close: Callable[[], None]) -> None:
        self.open = open_port
        self.close = close
        self.ports: list[Any] = []

    def port(self, name: str) -> Any:
        port = self.open(name)
        self.ports.append(port)
        return port

    def pump(self, done: Callable[[], bool]) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not done():
            assert time.monotonic() < deadline, "it did not happen in time"
            for port in self.ports:
                if isinstance(port, ZmqPort):
                    port.service()

    def collect(self, port: Any, count: int) -> list[Envelope]:
        found: list[Envelope] = []

        def enough() -> bool:
            found.extend(port.receive())
            return len(found) >= count

        self.pump(enough)
        return found


@pytest.fixture(params=["zmq", "inprocess"])
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    described = graph(tmp_path)
    if request.param == "inprocess":
        bus = InProcessBus(described)
        yield Bench(bus.port, lambda: None)
        return
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    found = Bench(lambda name: ZmqPort(described, name, context), lambda: None)
    yield found
    for port in found.ports:
        port.close()
    context.term()


def send(port: Any, topic: str, message: Any, **more: Any) -> bool:
    return bool(port.publish(topic, message, stamp_ns=5, received_ns=6, hardware_ns=7, **more))


def test_every_reader_gets_every_message_in_order(bench: Bench) -> None:
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


def test_nobody_is_ready_before_every_named_reader_is_there(bench: Bench) -> None:
    arm = bench.port("arm")
    assert "merger:/arm/state" in arm.missing_readers()
    assert "writer:/arm/state" in arm.missing_readers()
    bench.port("merger")
    bench.pump(lambda: "merger:/arm/state" not in arm.missing_readers())
    assert "writer:/arm/state" in arm.missing_readers()


def test_what_is_kept_is_sent_again_to_a_restarted_reader(bench: Bench) -> None:
    arm, writer = bench.port("arm"), bench.port("writer")
    bench.pump(lambda: "writer:/operator/mark" not in arm.missing_readers())
    send(arm, "/operator/mark", Mark(text="first"), keep="1")
    send(arm, "/operator/mark", Mark(text="second"), keep="2")
    assert len(bench.collect(writer, 2)) == 2
    arm.release("/operator/mark", "1")
    writer.close()
    bench.ports.remove(writer)
    again = bench.port("writer")
    got = bench.collect(again, 1)
    assert [envelope.message for envelope in got] == [Mark(text="second")]
    assert "reader" in {event.kind for event in arm.events()}


def test_a_topic_that_is_not_given_is_refused(bench: Bench) -> None:
    arm = bench.port("arm")
    with pytest.raises(MessageError, match="does not give /camera_1/frame"):
        send(arm, "/camera_1/frame", STATE)


def test_a_lost_publisher_is_noticed(bench: Bench) -> None:
    merger = bench.port("merger")
    camera = bench.port("camera_1")
    kinds: list[tuple[str, str]] = []

    def saw(kind: str, name: str) -> bool:
        kinds.extend((event.kind, event.name) for event in merger.events())
        return (kind, name) in kinds

    bench.pump(lambda: saw("found", "camera_1"))
    camera.close()
    bench.ports.remove(camera)
    bench.pump(lambda: saw("lost", "camera_1"))


# -- what only sockets can get wrong


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    made: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield made
    made.destroy(linger=0)  # also after a failure, when ports are still open


def image_frame(index: int) -> Frame:
    return Frame(
        camera="camera_1",
        kind="light",
        sample="",
        scan=1,
        sweep=0,
        attempt=1,
        index=index,
        exposure_ms=1.0,
        bit_depth=12,
        region_x=0,
        region_y=0,
        image=np.full((100, 100, 3), index % 4096, np.uint16),
    )


def ready(*ports: ZmqPort, of: ZmqPort, reader: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while any(name.startswith(reader) for name in of.missing_readers()):
        assert time.monotonic() < deadline
        for port in ports:
            port.service()


def test_a_slow_reader_holds_a_simulated_source_and_nothing_is_lost(
    tmp_path: Path, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    described = graph(tmp_path)
    camera = ZmqPort(described, "camera_1", context)
    merger = ZmqPort(described, "merger", context, credit_bytes=300_000)
    ready(camera, merger, of=camera, reader="merger")
    sent = threading.Event()

    def publish() -> None:
        for index in range(60):  # 60 kB each: five fit
            camera.publish("/camera_1/frame", image_frame(index), stamp_ns=0)
        sent.set()

    thread = threading.Thread(target=publish)
    thread.start()
    assert not sent.wait(0.3), "the source did not wait for credit"
    got: list[Envelope] = []
    deadline = time.monotonic() + DEADLINE_S
    while len(got) < 60:
        assert time.monotonic() < deadline
        merger.service()
        got.extend(merger.receive(limit=2))
    thread.join()
    assert [envelope.header.sequence for envelope in got] == list(range(60))
    last = got[-1].message
    assert isinstance(last, Frame)
    assert int(last.image[0, 0, 0]) == 59
    for port in (camera, merger):
        port.close()


def test_a_live_source_does_not_wait(
    tmp_path: Path, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    base = graph(tmp_path)
    live = Graph(
        directory=base.directory,
        utc_ns=1,
        monotonic_ns=1,
        simulated=False,
        participants=(
            Participant(name="camera_1", gives=("/camera_1/frame",), live=True),
            Participant(name="merger", takes=("/camera_1/frame",)),
        ),
    )
    camera = ZmqPort(live, "camera_1", context)
    merger = ZmqPort(live, "merger", context, credit_bytes=300_000)
    ready(camera, merger, of=camera, reader="merger")
    delivered = [camera.publish("/camera_1/frame", image_frame(i), stamp_ns=0) for i in range(60)]
    assert delivered[:5] == [True] * 5
    assert not delivered[-1]
    got: list[Envelope] = []
    deadline = time.monotonic() + DEADLINE_S
    while len(got) < sum(delivered):
        assert time.monotonic() < deadline
        merger.service()
        got.extend(merger.receive())
    while camera.publisher._readers["merger"].lossless <= 0:  # until credit is back
        assert time.monotonic() < deadline
        got.extend(merger.receive())
        camera.service()
    assert camera.publish("/camera_1/frame", image_frame(60), stamp_ns=0)
    while len(got) < sum(delivered) + 1:
        assert time.monotonic() < deadline
        got.extend(merger.receive())
    assert merger.counters()["gaps"] == 60 - sum(delivered), "the loss was not counted"
    for port in (camera, merger):
        port.close()


def test_a_reader_that_takes_no_commands_is_a_fault(
    tmp_path: Path, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    arm = ZmqPort(graph(tmp_path), "arm", context)
    sequencer = ZmqPort(graph(tmp_path), "sequencer", context)
    ready(arm, sequencer, of=arm, reader="sequencer")
    result = SweepResult(
        source="arm", command_id=1, action="sweep", state="broken", reason="x" * 100_000
    )

    def flood() -> None:
        for _ in range(200):
            send(arm, "/scan/sweep_result", result)

    with pytest.raises(QueueFullError, match="sequencer has not read /scan/sweep_result"):
        flood()
    for port in (arm, sequencer):
        port.close()


def test_a_wait_for_credit_ends_when_the_node_is_stopped(
    tmp_path: Path, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    stopping = threading.Event()
    camera = ZmqPort(graph(tmp_path), "camera_1", context, stopping=stopping.is_set)
    stopping.set()
    with pytest.raises(StoppedError, match="camera_1 was stopped"):
        camera.publish("/camera_1/frame", image_frame(0), stamp_ns=0)
    camera.close()


def test_a_hostile_message_is_refused_and_counted_and_the_rest_goes_on(
    tmp_path: Path, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    described = graph(tmp_path)
    arm, writer = ZmqPort(described, "arm", context), ZmqPort(described, "writer", context)
    ready(arm, writer, of=arm, reader="writer")
    with contextlib.closing(context.socket(zmq.DEALER)) as stranger:
        stranger.linger = 0
        stranger.connect(described.endpoint("arm", "lossless"))
        stranger.send_multipart([b"GET / HTTP/1.1", b"\xff" * 50])
        stranger.send_multipart([b"!HELLO", b"\xc1broken"])
        stranger.send_multipart([b"!CREDIT", b"\x01"])
        stranger.send(b"")
        hello = {"reader": "spy", "incarnation": "1", "topics": ["/arm/state"], "credit_bytes": 9}
        import msgpack

        stranger.send_multipart([b"!HELLO", msgpack.packb(hello)])
        deadline = time.monotonic() + DEADLINE_S
        while arm.counters()["refused"] < 4:
            assert time.monotonic() < deadline
            arm.service()
    assert any("spy" in event.text for event in arm.events())
    send(arm, "/operator/mark", Mark(text="still here"))
    got: list[Envelope] = []
    while not got:
        assert time.monotonic() < deadline
        arm.service()
        writer.service()
        got = writer.receive()
    assert got[0].message == Mark(text="still here")
    for port in (arm, writer):
        port.close()


def test_a_watcher_can_fall_behind_without_slowing_a_reader(
    tmp_path: Path, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    described = graph(tmp_path)
    camera, merger = ZmqPort(described, "camera_1", context), ZmqPort(described, "merger", context)
    ready(camera, merger, of=camera, reader="merger")
    watcher = context.socket(zmq.SUB)
    watcher.linger = 0
    watcher.rcvhwm = 1
    watcher.connect(described.endpoint("camera_1", "latest"))
    watcher.subscribe("/camera_1/frame")
    deadline = time.monotonic() + DEADLINE_S
    while "/camera_1/frame" not in camera.publisher._watched:
        assert time.monotonic() < deadline
        camera.service()
    got: list[Envelope] = []
    for index in range(300):
        assert camera.publish("/camera_1/frame", image_frame(index), stamp_ns=0)
        merger.service()
        got.extend(merger.receive())
        camera.service()
    while len(got) < 300:
        assert time.monotonic() < deadline
        got.extend(merger.receive())
    assert merger.counters()["gaps"] == 0
    watcher.close()
    for port in (camera, merger):
        port.close()


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
