"""A counted reader on the real bus: nobody waits for it, and what it misses is counted."""

from __future__ import annotations

import contextlib
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.messages.bus_bench import DEADLINE_S, Bench
from tests.sample_messages import STATE, frame
from tvbrdf_messages.bus import InProcessBus, ZmqPort, zmq_port, zmq_publisher
from tvbrdf_messages.messages import Frame, SweepResult
from tvbrdf_messages.run_directory import Graph, Participant

if TYPE_CHECKING:
    from tests.messages.conftest import MakeBench

QUEUE_BYTES = 1 << 20
IMAGE = np.zeros((64, 64, 3), dtype=np.uint16)
"""24 576 bytes, so that about 43 fill the queue."""
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


def image_frame(index: int) -> Frame:
    return frame(IMAGE, index=index)


Three = tuple[ZmqPort, ZmqPort, ZmqPort]


def ready(bench: Bench[ZmqPort]) -> Three:
    """Open source, merger and recorder, and wait until nobody waits for anybody."""
    source, merger, recorder = (bench.port(n) for n in ("source", "merger", "recorder"))
    bench.pump(lambda: all(port.ready() for port in bench.ports))
    return source, merger, recorder


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
    tmp_path: Path, zmq_bench: MakeBench, live: bool
) -> None:
    bench = zmq_bench(graph(tmp_path, simulated=False, live=live))
    source, merger, recorder = ready(bench)
    frames = 200
    for index in range(frames):
        # the lossless reader reads each; the counted one reads nothing
        assert source.publish("/camera_1/frame", image_frame(index), stamp_ns=0)
        bench.collect(merger, 1)
    left_out = source.counters()["left_out"]
    got = bench.collect(recorder, frames - left_out)
    # one may overdraw the queue, none more
    assert len(got) * IMAGE.nbytes <= QUEUE_BYTES + IMAGE.nbytes
    assert [e.header.sequence for e in got] == list(range(frames - left_out))
    assert left_out > frames // 2
    assert source.counters()["undelivered"] == 0
    recorder.receive()  # gives the credit back
    recorder.flush()

    def has_room() -> bool:
        source.publish("/camera_1/frame", image_frame(0), stamp_ns=0)
        found = recorder.receive()
        got.extend(found)
        merger.receive()
        return bool(found)

    bench.pump(has_room)
    assert recorder.counters()["gaps"] == got[-1].header.sequence + 1 - len(got)
    assert recorder.counters()["gaps"] >= left_out


def test_a_simulated_source_waits_for_one_that_reads(tmp_path: Path, zmq_bench: MakeBench) -> None:
    """Simulated time costs nothing, so a recording of it is whole."""
    bench = zmq_bench(graph(tmp_path, simulated=True))
    source, merger, recorder = ready(bench)
    done = threading.Event()
    readers = [reads_meanwhile(port, done) for port in (merger, recorder)]
    frames = 400
    try:
        for index in range(frames):
            assert source.publish("/camera_1/frame", image_frame(index), stamp_ns=0)
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
    tmp_path: Path, zmq_bench: MakeBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zmq_publisher, "COUNTED_WAIT_S", 0.2)
    bench = zmq_bench(graph(tmp_path, simulated=True))
    source, merger, _ = ready(bench)
    done = threading.Event()
    thread, found = reads_meanwhile(merger, done)
    frames = 150
    began = time.monotonic()
    try:
        for index in range(frames):
            assert source.publish("/camera_1/frame", image_frame(index), stamp_ns=0)
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


def test_a_full_queue_of_commands_is_no_fault(tmp_path: Path, zmq_bench: MakeBench) -> None:
    bench = zmq_bench(graph(tmp_path, simulated=True))
    source, _, _ = ready(bench)
    result = SweepResult(source="x" * 200, command_id=0, action="sweep", state="done")
    # 8 MB of commands may wait at most; these are more
    for _ in range(40_000):
        source.publish("/scan/sweep_result", result, stamp_ns=0)
    assert source.counters()["left_out"] > 0


def test_what_is_there_without_it_begins_after_a_moment(
    tmp_path: Path, zmq_bench: MakeBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zmq_port, "COUNTED_START_S", 0.3)
    bench = zmq_bench(graph(tmp_path, simulated=False))
    source, merger = bench.port("source"), bench.port("merger")
    bench.pump(lambda: not source.missing_readers())
    assert not source.ready()
    began = time.monotonic()
    bench.pump(lambda: source.ready() and merger.ready())
    assert time.monotonic() - began < 5.0
    assert source.publish("/arm/state", STATE, stamp_ns=0)
    assert source.counters()["left_out"] == 1


def test_one_that_dies_is_not_waited_for(tmp_path: Path, zmq_bench: MakeBench) -> None:
    bench = zmq_bench(graph(tmp_path, simulated=True))
    source, _, recorder = ready(bench)
    bench.drop(recorder)
    began = time.monotonic()
    for _ in range(1000):
        assert source.publish("/arm/state", STATE, stamp_ns=0)
        source.flush()
    assert time.monotonic() - began < DEADLINE_S
    again = bench.port("recorder")
    bench.pump(lambda: not source.publisher.lacks_counted() and again.ready())
    source.publish("/arm/state", STATE, stamp_ns=0)
    source.flush()
    got = bench.collect(again, 1)
    assert got[-1].header.sequence == 1000


def test_inside_one_process_one_that_is_not_there_is_no_reader_that_misses(tmp_path: Path) -> None:
    bus = InProcessBus(graph(tmp_path, simulated=True, live=True))
    source, merger = bus.port("source"), bus.port("merger")
    with contextlib.closing(source), contextlib.closing(merger):
        assert source.missing_readers() == ()
        assert source.publish("/camera_1/frame", image_frame(0), stamp_ns=0)
        assert source.publish("/arm/state", STATE, stamp_ns=0)
        counters = source.counters()
        assert (counters["left_out"], counters["undelivered"]) == (2, 0)
