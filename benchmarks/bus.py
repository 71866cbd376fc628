"""The bus beside bare pyzmq in the same run: small messages, images, latency.

Bare pyzmq moves the same bytes over the same kind of sockets, without header, checks, sequence
numbers or credit. Two processes over ipc; both ends of each pair run the same loop.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import zmq

from tvbrdf_messages.bus import ZmqPort
from tvbrdf_messages.messages import ArmState, Frame
from tvbrdf_messages.run_directory import Graph, Participant

SMALL, IMAGES, PINGS = 60_000, 3_000, 3_000
STATE = ArmState(angle_deg=1.0, speed_deg_s=15.0, lamp=True, moving=True, homed=True)
PING = np.random.default_rng(2).integers(0, 4096, (128, 128, 3), dtype=np.uint16)
"""A frame of the rig at its usual size."""
IMAGE = np.random.default_rng(1).integers(0, 4096, (480, 640, 3), dtype=np.uint16)


def graph(directory: str) -> Graph:
    """Return a graph of two participants that read each other."""
    return Graph(
        directory=directory,
        utc_ns=0,
        monotonic_ns=0,
        simulated=True,
        participants=(
            Participant(
                name="source",
                gives=("/arm/state", "/camera_1/frame"),
                takes=("/scan/sweep_result", "/camera_2/frame"),
            ),
            Participant(
                name="sink",
                takes=("/arm/state", "/camera_1/frame"),
                gives=("/scan/sweep_result", "/camera_2/frame"),
            ),
        ),
    )


def frame(index: int, image: Any, camera: str = "camera_1") -> Frame:
    """Return a frame message."""
    return Frame(
        camera=camera,
        kind="light",
        sample="bench",
        scan=1,
        sweep=0,
        attempt=1,
        index=index,
        exposure_ms=4.0,
        bit_depth=12,
        region_x=0,
        region_y=0,
        image=image,
    )


class Pair:
    """One end of our bus: sends to and receives from the other."""

    def __init__(self, directory: str, name: str) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.port = ZmqPort(graph(directory), name, self.context)
        self.poller = zmq.Poller()
        for socket in self.port.sockets():
            self.poller.register(socket, zmq.POLLIN)
        while not self.port.ready():
            self.poller.poll(10)
            self.port.service()

    def receive(self) -> list[Any]:
        """Return what has come, waiting for at least one message, as a node's shell does."""
        self.port.flush()
        while True:
            self.port.service(dict(self.poller.poll(100)))
            found = self.port.receive()
            if found:
                return found

    def take(self, count: int) -> None:
        """Receive that many messages."""
        got = 0
        while got < count:
            got += len(self.receive())

    def close(self) -> None:
        """Give the last credit back and close."""
        self.port.receive()
        self.port.close()
        self.context.term()


def _sink(directory: str, what: str) -> None:
    pair = Pair(directory, "sink")
    if what == "ping":
        for index in range(PINGS):
            pair.receive()
            pair.port.publish("/camera_2/frame", frame(index, PING), stamp_ns=0)
    else:
        pair.take(SMALL if what == "small" else IMAGES)
        pair.port.publish("/camera_2/frame", frame(0, PING), stamp_ns=0)
    pair.close()


def _source(directory: str, what: str) -> Any:
    pair = Pair(directory, "source")
    started = time.perf_counter()
    result: Any
    if what == "ping":
        times = []
        for index in range(PINGS):
            sent = time.perf_counter()
            pair.port.publish("/camera_1/frame", frame(index, PING), stamp_ns=0)
            pair.receive()
            times.append(time.perf_counter() - sent)
        result = times
    else:
        if what == "small":
            for _ in range(SMALL):
                pair.port.publish("/arm/state", STATE, stamp_ns=0)
        else:
            for index in range(IMAGES):
                pair.port.publish("/camera_1/frame", frame(index, IMAGE), stamp_ns=0)
        pair.receive()
        result = time.perf_counter() - started
    pair.close()
    return result


def _bare_socket(context: Any, directory: str, bind: bool) -> Any:
    socket = context.socket(zmq.ROUTER if bind else zmq.DEALER)
    socket.sndhwm = socket.rcvhwm = 0
    if bind:
        socket.bind(f"ipc://{directory}/bare")
    else:
        socket.connect(f"ipc://{directory}/bare")
    return socket


def _bare_sink(directory: str, what: str) -> None:
    context: Any = zmq.Context()
    socket = _bare_socket(context, directory, bind=False)
    socket.send(b"hello")
    count = {"small": SMALL, "image": IMAGES, "ping": PINGS}[what]
    for index in range(count):
        socket.recv_multipart(copy=what == "small")
        if what == "image" and index % 32 == 31:
            socket.send(b"credit")
        if what == "ping":
            socket.send_multipart([b"topic", b"h" * 120, PING])
    if what != "ping":
        socket.send(b"done")
    socket.close(linger=1000)
    context.term()


def _bare_source(directory: str, what: str) -> Any:
    context: Any = zmq.Context()
    socket = _bare_socket(context, directory, bind=True)
    identity = socket.recv_multipart()[0]
    body = b"h" * 120
    started = time.perf_counter()
    result: Any
    if what == "ping":
        times = []
        for _ in range(PINGS):
            sent = time.perf_counter()
            socket.send_multipart([identity, b"topic", body, PING])
            socket.recv_multipart(copy=False)
            times.append(time.perf_counter() - sent)
        result = times
    else:
        if what == "small":
            for _ in range(SMALL):
                socket.send_multipart([identity, b"/arm/state", body])
        else:
            for index in range(IMAGES):
                socket.send_multipart([identity, b"topic", body], zmq.SNDMORE)
                socket.send(IMAGE, copy=False)
                if index >= 64 and index % 32 == 0:
                    socket.recv_multipart()  # bounded as ours is, or memory would grow
        while socket.recv_multipart()[-1] != b"done":
            pass
        result = time.perf_counter() - started
    socket.close(linger=0)
    context.term()
    return result


def _run(source: Callable[[str, str], Any], sink: Callable[[str, str], None], what: str) -> Any:
    spawn = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory(prefix="tvb") as directory:
        other = spawn.Process(target=sink, args=(directory, what))
        other.start()
        result = source(directory, what)
        other.join()
    return result


def main() -> dict[str, float]:
    """Print and return the figures; each is the median of five interleaved runs."""
    rows: dict[str, float] = {}
    print("Bus over ipc, two processes, beside bare pyzmq in the same run (median of 5)")
    for what, label in (("small", "small messages/s"), ("image", "images MB/s (1.84 MB each)")):
        ours, bare = [], []
        amount = SMALL if what == "small" else IMAGES * IMAGE.nbytes / 1e6
        for _ in range(5):
            bare.append(amount / _run(_bare_source, _bare_sink, what))
            ours.append(amount / _run(_source, _sink, what))
        a, b = float(np.median(ours)), float(np.median(bare))
        rows[what] = a / b
        print(f"  {label:31} ours {a:9.0f}   bare {b:9.0f}   ratio {a / b:.2f}")
    ours_us, bare_us = [], []
    for _ in range(5):
        bare_us.append(1e6 * np.median(_run(_bare_source, _bare_sink, "ping")))
        ours_us.append(1e6 * np.median(_run(_source, _sink, "ping")))
    a, b = float(np.median(ours_us)), float(np.median(bare_us))
    rows["latency"] = b / a
    print(
        f"  {'round trip of 98 kB frames, µs':31} ours {a:9.0f}   bare {b:9.0f}   ratio {b / a:.2f}"
    )
    return rows


if __name__ == "__main__":
    main()
