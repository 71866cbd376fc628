"""Bytes that nobody of the run has sent: they are refused and counted, and the run goes on."""

from __future__ import annotations

import contextlib
import random
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgpack
import pytest
import zmq

from tvbrdf_messages.messages import Diagnostics

if TYPE_CHECKING:
    from tests.system.conftest import Rig

pytestmark = pytest.mark.system

RANDOM = random.Random(7)
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
READY = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER"[:2] + (
    b"\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER"
)


def hello(**changes: Any) -> bytes:
    """Return a registration in which something is wrong."""
    good = {"reader": "fitter", "incarnation": "x", "topics": ["/scan/radiance"]}
    packed: bytes = msgpack.packb({**good, "credit_bytes": 1 << 20, **changes})
    return packed


MESSAGES = [
    [b""],
    [RANDOM.randbytes(1000)],
    [b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"],
    [b"a"] * 200,
    [b"!HELLO"],
    [b"!HELLO", b""],
    [b"!HELLO", b"\xc1"],
    [b"!HELLO", b"\xdd\xff\xff\xff\xff"],  # an array that would have 4 thousand million entries
    [b"!HELLO", b"\x91" * 100_000],  # nested deeply
    [b"!HELLO", msgpack.packb(1)],
    [b"!HELLO", hello(reader="nobody")],
    [b"!HELLO", hello(topics=["/no/such"])],
    [b"!HELLO", hello(topics=7)],
    [b"!HELLO", hello(reader="stranger", topics=[])],
    [b"!HELLO", hello(topics=[])],  # would take the place of the true one, and read nothing
    [b"!HELLO", hello(topics=[], credit_bytes=float("inf"))],
    [b"!CREDIT", b""],
    [b"!CREDIT", msgpack.packb([1])],
    [b"!CREDIT", msgpack.packb([float("nan"), float("inf")])],
    [b"!WELCOME", msgpack.packb({"publisher": "arm"})],
    [b"/scan/command", msgpack.packb([1, 2, 3]), bytes(64)],
]
REQUESTS = [
    [b""],
    [RANDOM.randbytes(1000)],
    [b"a", b"b", b"c"],
    [msgpack.packb({"request_id": "1"})],
    [msgpack.packb({"request_id": 1, "verb": ["x"], "arguments": [1, 2]})],
    [msgpack.packb({"request_id": "2", "verb": "mark", "arguments": {"text": 5}})],
    [msgpack.packb({"request_id": "3", "verb": "mark", "arguments": {"text": "x" * 1_000_000}})],
    [msgpack.packb({"request_id": "4", "verb": "jog", "arguments": {"angle_deg": float("nan")}})],
    [msgpack.packb({"request_id": "5", "verb": "y" * 100_000, "arguments": {}})],
    [b"\x91" * 100_000],
]
RAW = [
    b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
    RANDOM.randbytes(4096),
    bytes(4096),
    GREETING[:20],  # half a greeting, then nothing
    GREETING + b"\x06" + struct.pack(">Q", 1 << 40),  # a command of a terabyte
    GREETING + READY + b"\x02" + struct.pack(">Q", 1 << 62) + b"x",  # a message of 4 exabytes
    GREETING + READY + b"\x02" + struct.pack(">Q", 8 << 30) + bytes(65536),
    GREETING + READY + b"\x00\x05abc",  # half a message
    GREETING + READY + b"\xff\xff\xff\xff",
]


@contextlib.contextmanager
def dealer(endpoint: str) -> Iterator[zmq.Socket[bytes]]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    one = context.socket(zmq.DEALER)
    one.linger = 2000
    one.connect(endpoint)
    try:
        yield one
    finally:
        one.close()
        context.term()


@contextlib.contextmanager
def raw(endpoint: str, sent: bytes) -> Iterator[None]:
    """Hold a connection open on which something was sent that is no ZeroMQ."""
    path = endpoint.removeprefix("ipc://")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as one:
        one.connect(path)
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            one.sendall(sent)
        yield


def resident_mb(pid: int) -> float:
    """Return the memory that a process takes."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def test_hostile_bytes_are_refused_and_counted(rig: Rig) -> None:
    rig.launch(speedup=8)
    graph = rig.graph()
    attacked = ("hdr_merger", "arm", "camera_1", "sequencer", "database_writer")
    with contextlib.ExitStack() as held:
        watcher = held.enter_context(rig.watch("/diagnostics", "/scan/status"))
        rig.until(watcher, lambda m: getattr(m, "state", "") == "sweeping")
        for node in attacked:
            endpoint = graph.endpoint(node, "lossless")
            one = held.enter_context(dealer(endpoint))
            for parts in MESSAGES:
                one.send_multipart(parts)
            for sent in RAW:
                held.enter_context(raw(endpoint, sent))
        service = graph.endpoint("sequencer", "service")
        one = held.enter_context(dealer(service))
        for parts in REQUESTS:
            one.send_multipart(parts)
        for sent in RAW:
            held.enter_context(raw(service, sent))
        counted: dict[str, int] = {}

        def all_counted(message: object) -> bool:
            if isinstance(message, Diagnostics):
                counted[message.node] = int(message.counters["refused"])
            return all(counted.get(node, 0) >= len(MESSAGES) for node in attacked)

        rig.until(watcher, all_counted)
        big = {n: resident_mb(rig.table().nodes[n].pid) for n in attacked}
        assert max(big.values()) < 1000, big  # nobody made room for what was only announced
        assert rig.wait() == 0, rig.text()
    rig.expect_nothing_left()
    sample = rig.expect_whole_database()
    assert [scan.scan for scan in sample.scans] == [1, 2], rig.text()
    assert {n for n, each in rig.table().nodes.items() if each.incarnations > 1} == set()
    assert "Traceback" not in "".join(path.read_text() for path in rig.run.glob("*.log"))
