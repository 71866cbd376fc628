"""How late a bag's messages are played at rate 1, beside a bare timer in the same minute.

The bag has what the rig says at 128x128: four cameras at 30 frames/s, staggered as their clocks
drift, and the arm at 50 states/s. Late is how long after it was due, on the monotonic clock, a
message had been handed to its reader's socket. The bare timer wakes a process at the same moments,
which then does nothing: what it is late is the machine's.
"""

from __future__ import annotations

import itertools
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from tvbrdf_messages.bag import BagWriter
from tvbrdf_messages.bus import ZmqPort
from tvbrdf_messages.envelope import Envelope, Header
from tvbrdf_messages.messages import ArmState, Diagnostics, Frame
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_messages.topics import frame_topic
from tvbrdf_nodes.core.loading import NODES
from tvbrdf_nodes.player.alarm import Alarm
from tvbrdf_nodes.player.lateness import Lateness

DURATION_S = 20.0
CAMERAS = tuple(f"camera_{number}" for number in range(1, 5))
FRAME_HZ, STATE_HZ = 30.0, 50.0
START_NS = 1_700_000_000_000_000_000
TARGET_P99_MS = 2.0


def moments(duration_s: float) -> list[tuple[int, str]]:
    """Return when who says something, in order: ns after the beginning, and the name."""
    found = [(round(k * 1e9 / STATE_HZ), "arm") for k in range(int(duration_s * STATE_HZ))]
    for number, camera in enumerate(CAMERAS):
        drifting = FRAME_HZ * (1 + 1e-4 * number)
        found += [
            (round((k + 0.2 * number) * 1e9 / drifting), camera)
            for k in range(int(duration_s * FRAME_HZ))
        ]
    return sorted(found)


def write_bag(path: Path, duration_s: float, *, small: bool = False) -> int:
    """Write the rig's messages; return how many."""
    side = 16 if small else 128
    image = np.random.default_rng(1).integers(0, 4096, (side, side, 3), dtype=np.uint16)
    count = 0
    numbers = {name: itertools.count() for name in ("arm", *CAMERAS)}
    with BagWriter(path, floor_free_bytes=0) as bag:
        for after_ns, name in moments(duration_s):
            at = START_NS + after_ns
            header = Header(name, "one", "host", "boot", next(numbers[name]), at, at, after_ns)
            bag.write_envelope(_envelope(name, header, image), at)
            count += 1
    return count


def _envelope(name: str, header: Header, image: Any) -> Envelope:
    if name == "arm":
        state = ArmState(angle_deg=1.0, speed_deg_s=15.0, lamp=True, moving=True, homed=True)
        return Envelope("/arm/state", header, state)
    frame = Frame(
        camera=name, kind="light", sample="x", scan=1, sweep=0, attempt=1, index=header.sequence,
        exposure_ms=4.0, bit_depth=12, region_x=0, region_y=0, image=image,
    )  # fmt: skip
    return Envelope(frame_topic(name), header, frame)


def graph_of(directory: str, bag: Path) -> Graph:
    """Return the graph of a player and one reader of everything."""
    topics = ("/arm/state", *map(frame_topic, CAMERAS))
    parameters = {"bag": str(bag), "topics": list(topics)}
    return Graph(
        directory=directory,
        utc_ns=time.time_ns(),
        monotonic_ns=time.monotonic_ns(),
        simulated=True,
        participants=(
            Participant(
                name="player",
                gives=("/clock", *topics, "/diagnostics", "/log"),
                node=NODES["player"],
                parameters=parameters,
            ),
            Participant(name="reader", takes=(*topics, "/diagnostics")),
        ),
    )


def play(bag: Path) -> dict[str, float]:
    """Play a bag at rate 1 to a reader in this process; return the player's figures."""
    with tempfile.TemporaryDirectory(prefix="tv") as folder:
        graph = graph_of(folder, bag)
        graph.write()
        command = [sys.executable, "-m", "tvbrdf_nodes.core.process", "--run", folder]
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        port = ZmqPort(graph, "reader", context)
        process = subprocess.Popen([*command, "--name", "player", "--no-lifeline"])
        try:
            return _read(port, process)
        finally:
            process.kill()
            process.wait()
            port.close()
            context.term()


def _read(port: ZmqPort, process: subprocess.Popen[bytes]) -> dict[str, float]:
    figures: dict[str, float] = {}
    received = 0
    poller = zmq.Poller()
    for socket in port.sockets():
        poller.register(socket, zmq.POLLIN)
    while process.poll() is None or poller.poll(100):
        port.service()
        for envelope in _arrived(port, poller):
            message = envelope.message
            received += not isinstance(message, Diagnostics)
            if isinstance(message, Diagnostics) and "late_p99_ms" in message.counters:
                figures = {k: float(v) for k, v in message.counters.items() if k[:4] == "late"}
                figures["messages"] = float(message.counters["timed"])
    if process.returncode != 0:
        raise RuntimeError(f"the player failed with exit code {process.returncode}")
    return {**figures, "received": float(received)}


def _arrived(port: ZmqPort, poller: zmq.Poller) -> Iterator[Envelope]:
    poller.poll(100)
    port.service()
    yield from port.receive()


def bare_timer(duration_s: float) -> dict[str, float]:
    """Wake up at the same moments and do nothing."""
    alarm, lateness = Alarm(), Lateness()
    poll = select.poll()
    poll.register(alarm.fileno(), select.POLLIN)
    begin_ns = alarm.now_ns() + 50_000_000
    for after_ns, _ in moments(duration_s):
        due_ns = begin_ns + after_ns
        while alarm.now_ns() < due_ns:
            alarm.set(due_ns)
            poll.poll()
            alarm.clear()
        lateness.add(alarm.now_ns() - due_ns)
    alarm.close()
    return lateness.as_dict()


def main(duration_s: float = DURATION_S, *, small: bool = False) -> dict[str, float]:
    """Measure and print; return the figures."""
    with tempfile.TemporaryDirectory(prefix="tv") as folder:
        bag = Path(folder) / "rig.mcap"
        count = write_bag(bag, duration_s, small=small)
        played = play(bag)
    if played["received"] != count:
        raise RuntimeError(f"{played['received']:.0f} of {count} messages arrived")
    bare = bare_timer(duration_s)
    print(f"playback at rate 1: {count} messages in {duration_s:g} s, all arrived")
    for name, found in (("player", played), ("bare timer", bare)):
        print(
            f"  {name}: late by {found['late_p50_ms']:.2f} ms (median), "
            f"{found['late_p99_ms']:.2f} ms (p99), {found['late_max_ms']:.2f} ms (largest)"
        )
    print(f"  target: p99 below {TARGET_P99_MS:g} ms")
    bare = {f"bare_{name}": value for name, value in bare.items() if name.startswith("late")}
    return {**played, **bare, "target_p99_ms": TARGET_P99_MS}


if __name__ == "__main__":
    main()
