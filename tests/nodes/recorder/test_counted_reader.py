"""A counted reader on the real bus: nobody waits for it, and what it misses is counted."""

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

from tvbrdf_messages.bus import InProcessBus, ZmqPort, zmq_port, zmq_publisher
from tvbrdf_messages.messages import ArmState, Frame, SweepResult
from tvbrdf_messages.run_directory import Graph, Participant

DEADLINE_S = 20.0
QUEUE_BYTES = 1 << 20
IMAGE = np.zeros((64, 64, 3), dtype=np.uint16)
"""24 576 bytes, so that about 43 fill the queue."""
STATE = ArmState(angle_deg=1.0, speed_deg_s=15.0, lamp=True, moving=True, homed=True)
GIVES = ("/camera_1/frame", "/arm/state", "/scan/sweep_result")


def graph(directory: Path, *, simulated: bool, live: bool = False) -> Graph:
    return Graph(
        directory=str(directory),
        utc_ns=1,
        monotonic_ns=1,
        simulated=simulated,
        participants=(
            Participant(name="source", gives=GIVES, live=live),
            Participant(name="merger", takes=("/camera_1/frame",)),
            Participant(name="recorder", takes=GIVES, counted_bytes=QUEUE_BYTES),
        ),
    )


def frame(index: int) -> Frame:
    return Frame(
        camera="camera_1",
        kind="light",
        sample="test",
        scan=1,
        sweep=0,
        attempt=1,
        index=index,
        exposure_ms=4.0,
        bit_depth=12,
        region_x=0,
        region_y=0,
        image=IMAGE,
    )


class Ports:
    """Ports of one graph, and a way to wait for them."""

    def __init__(self, described: Graph, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self._graph, self._context = described, context
        self.all: list[ZmqPort] = []

    def open(self, name: str) -> ZmqPort:
        self.all.append(ZmqPort(self._graph, name, self._context))
        return self.all[-1]

    def close(self, port: ZmqPort) -> None:
        self.all.remove(port)
        port.close()

    def pump(self, done: Callable[[], bool]) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not done():
            assert time.monotonic() < deadline, "it did not happen in time"
            for port in self.all:
                port.service()


MakePorts = Callable[..., Ports]


@pytest.fixture
def make_ports(tmp_path: Path) -> Iterator[MakePorts]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    made: list[Ports] = []

    def make(**options: bool) -> Ports:
        made.append(Ports(graph(tmp_path, **options), context))
        return made[-1]

    yield make
    for ports in made:
        for port in ports.all:
            port.close()
    context.term()


def ready(ports: Ports) -> tuple[ZmqPort, ZmqPort, ZmqPort]:
    source, merger, recorder = (ports.open(n) for n in ("source", "merger", "recorder"))
    ports.pump(lambda: all(port.ready() for port in ports.all))
    return source, merger, recorder


def read_all(ports: Ports, port: ZmqPort, until: Callable[[list[Any]], bool]) -> list[Any]:
    found: list[Any] = []

    def enough() -> bool:
        found.extend(port.receive())
        return until(found)

    ports.pump(enough)
    return found


def reads_meanwhile(port: ZmqPort, until: threading.Event) -> tuple[threading.Thread, list[Any]]:
    """Read in a thread, as another process would; the port is used by that thread alone then."""
    found: list[Any] = []

    def read() -> None:
        while not until.is_set():
            port.service()
            found.extend(port.receive())
            port.flush()

    thread = threading.Thread(target=read)
    thread.start()
    return thread, found


@pytest.mark.parametrize("live", [True, False])
def test_on_a_real_clock_nobody_waits_and_gaps_are_counted(
    make_ports: MakePorts, live: bool
) -> None:
    ports = make_ports(simulated=False, live=live)
    source, merger, recorder = ready(ports)
    frames = 200
    for index in range(frames):
        # the lossless reader reads each; the counted one reads nothing
        assert source.publish("/camera_1/frame", frame(index), stamp_ns=0)
        read_all(ports, merger, lambda found: len(found) == 1)
    left_out = source.counters()["left_out"]
    got = read_all(ports, recorder, lambda found: len(found) == frames - left_out)
    # one may overdraw the queue, none more
    assert sum(e.message.image.nbytes for e in got) <= QUEUE_BYTES + IMAGE.nbytes
    assert [e.header.sequence for e in got] == list(range(frames - left_out))
    assert left_out > frames // 2
    assert source.counters()["undelivered"] == 0
    recorder.receive()  # gives the credit back
    recorder.flush()

    def has_room() -> bool:
        source.publish("/camera_1/frame", frame(0), stamp_ns=0)
        found = recorder.receive()
        got.extend(found)
        merger.receive()
        return bool(found)

    ports.pump(has_room)
    assert recorder.counters()["gaps"] == got[-1].header.sequence + 1 - len(got)
    assert recorder.counters()["gaps"] >= left_out


def test_a_simulated_source_waits_for_one_that_reads(make_ports: MakePorts) -> None:
    """Simulated time costs nothing, so a recording of it is whole."""
    ports = make_ports(simulated=True)
    source, merger, recorder = ready(ports)
    done = threading.Event()
    readers = [reads_meanwhile(port, done) for port in (merger, recorder)]
    frames = 400
    try:
        for index in range(frames):
            assert source.publish("/camera_1/frame", frame(index), stamp_ns=0)
        deadline = time.monotonic() + DEADLINE_S
        while len(readers[1][1]) < frames and time.monotonic() < deadline:
            source.service()
    finally:
        done.set()
        for thread, _ in readers:
            thread.join()
    assert source.counters()["left_out"] == 0
    assert [e.header.sequence for e in readers[1][1]] == list(range(frames))


def test_a_simulated_source_waits_once_for_one_that_does_not(
    make_ports: MakePorts, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zmq_publisher, "COUNTED_WAIT_S", 0.2)
    ports = make_ports(simulated=True)
    source, merger, _ = ready(ports)
    done = threading.Event()
    thread, found = reads_meanwhile(merger, done)
    frames = 150
    began = time.monotonic()
    try:
        for index in range(frames):
            assert source.publish("/camera_1/frame", frame(index), stamp_ns=0)
        took_s = time.monotonic() - began
        deadline = time.monotonic() + DEADLINE_S
        while len(found) < frames and time.monotonic() < deadline:
            source.service()
    finally:
        done.set()
        thread.join()
    assert source.counters()["left_out"] > 50
    assert took_s >= 0.2
    assert took_s < 5.0  # a hundred that were waited for each would take 20 s
    assert [e.header.sequence for e in found] == list(range(frames))


def test_a_full_queue_of_commands_is_no_fault(make_ports: MakePorts) -> None:
    ports = make_ports(simulated=True)
    source, _, _ = ready(ports)
    result = SweepResult(source="x" * 200, command_id=0, action="sweep", state="done")
    # 8 MB of commands may wait at most; these are more
    for _ in range(40_000):
        source.publish("/scan/sweep_result", result, stamp_ns=0)
    assert source.counters()["left_out"] > 0


def test_what_is_there_without_it_begins_after_a_moment(
    make_ports: MakePorts, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zmq_port, "COUNTED_START_S", 0.3)
    ports = make_ports(simulated=False)
    source, merger = ports.open("source"), ports.open("merger")
    ports.pump(lambda: not source.missing_readers())
    assert not source.ready()
    began = time.monotonic()
    ports.pump(lambda: source.ready() and merger.ready())
    assert time.monotonic() - began < 5.0
    assert source.publish("/arm/state", STATE, stamp_ns=0)
    assert source.counters()["left_out"] == 1


def test_one_that_dies_is_not_waited_for(make_ports: MakePorts) -> None:
    ports = make_ports(simulated=True)
    source, _, recorder = ready(ports)
    ports.close(recorder)
    began = time.monotonic()
    for _ in range(1000):
        assert source.publish("/arm/state", STATE, stamp_ns=0)
        source.flush()
    assert time.monotonic() - began < DEADLINE_S
    again = ports.open("recorder")
    ports.pump(lambda: not source.publisher.lacks_counted() and again.ready())
    source.publish("/arm/state", STATE, stamp_ns=0)
    source.flush()
    got = read_all(ports, again, lambda found: len(found) >= 1)
    assert got[-1].header.sequence == 1000


def test_inside_one_process_one_that_is_not_there_is_no_reader_that_misses(tmp_path: Path) -> None:
    bus = InProcessBus(graph(tmp_path, simulated=True, live=True))
    source, merger = bus.port("source"), bus.port("merger")
    with contextlib.closing(source), contextlib.closing(merger):
        assert source.missing_readers() == ()
        assert source.publish("/camera_1/frame", frame(0), stamp_ns=0)
        assert source.publish("/arm/state", STATE, stamp_ns=0)
        counters = source.counters()
        assert (counters["left_out"], counters["undelivered"]) == (2, 0)
