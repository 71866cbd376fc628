"""The recorder as a real process beside a bare ``mcap`` writer in the same run.

Four synthetic cameras send 640×480 frames (3 × 16 bit, 1.84 MB) over the real bus. The bare writer
has the same bytes in memory already: no bus, no checks, no second process. Both end with the bytes
on the disk (fsync), so it is the disk's rate where that is lower.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from mcap.writer import CompressionType, Writer

from benchmarks.bus import frame
from tvbrdf_messages.bag import BagReader
from tvbrdf_messages.bus import ZmqPort
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_nodes.core.loading import NODES

CAMERAS = tuple(f"camera_{number}" for number in range(1, 5))
WIDTH, HEIGHT, RATE_HZ = 640, 480, 120.0
"""The full rig: four cameras at 30 frames/s."""
FRAMES, PACED_S, REPEATS = 600, 10.0, 3
IMAGES = np.random.default_rng(1).integers(0, 4096, (8, HEIGHT, WIDTH, 3), dtype=np.uint16)
FRAME_BYTES = int(IMAGES[0].nbytes)
CHUNK_BYTES = 4 << 20
QUEUE_BYTES = 128_000_000
LIMIT_S = 60.0


def graph(directory: str, *, required: bool) -> Graph:
    """Return a graph of four cameras and a recorder; the cameras wait where it is required."""
    topics = tuple(f"/{camera}/frame" for camera in CAMERAS)
    return Graph(
        directory=directory,
        utc_ns=time.time_ns(),
        monotonic_ns=time.monotonic_ns(),
        simulated=False,
        participants=(
            *(Participant(name=c, gives=(f"/{c}/frame",), live=not required) for c in CAMERAS),
            Participant(
                name="recorder",
                takes=("/clock", *topics),
                gives=("/diagnostics", "/log"),
                node=NODES["recorder"],
                parameters={"path": f"{directory}/bag", "required": required},
                counted_bytes=0 if required else QUEUE_BYTES,
            ),
        ),
    )


class Cameras:
    """Four publishers in this process, and the recorder in its own."""

    def __init__(self, described: Graph) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._ports = [ZmqPort(described, camera, self._context) for camera in CAMERAS]
        self._sent = 0

    def wait_ready(self) -> None:
        """Wait until the recorder reads all of them."""
        deadline = time.monotonic() + LIMIT_S
        while any(p.publisher.lacks_counted() or p.missing_readers() for p in self._ports):
            if time.monotonic() > deadline:
                raise RuntimeError("the recorder has not registered")
            self.service()
            time.sleep(0.001)

    def send(self) -> None:
        """Publish a frame of the camera whose turn it is."""
        port = self._ports[self._sent % len(self._ports)]
        index = self._sent // len(self._ports)
        message = frame(index, IMAGES[index % len(IMAGES)], port.name)
        port.publish(f"/{port.name}/frame", message, stamp_ns=time.time_ns())
        self._sent += 1

    def service(self) -> None:
        """Take the recorder's credit."""
        for port in self._ports:
            port.service()

    def left_out(self) -> int:
        """Return how many frames the recorder had no room for."""
        return sum(int(port.counters()["left_out"]) for port in self._ports)

    def close(self) -> None:
        """Close everything."""
        for port in self._ports:
            port.close()
        self._context.term()


@contextmanager
def _recorder(directory: str, *, required: bool) -> Iterator[tuple[Cameras, Any]]:
    described = graph(directory, required=required)
    described.write()
    words = ["-m", "tvbrdf_nodes.core.process", "--run", directory, "--name", "recorder"]
    with (Path(directory) / "recorder.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, *words, "--no-lifeline"], stdin=subprocess.DEVNULL, stderr=log
        )
        cameras = Cameras(described)
        try:
            cameras.wait_ready()
            yield cameras, process
        finally:
            cameras.close()
            process.kill()
            process.wait()


def _end(process: subprocess.Popen[bytes]) -> float:
    """Let the recorder finish its bag; return the processor's time (s) that it took in all."""
    process.send_signal(signal.SIGINT)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise RuntimeError(f"the recorder ended with {process.returncode}")
    return usage.ru_utime + usage.ru_stime


def _counts(directory: str) -> tuple[int, int]:
    """Return how many frames are in the bag, and how many its gaps lack."""
    with BagReader(f"{directory}/bag") as bag:
        streams = bag.summary().streams
    return sum(s.messages for s in streams), sum(s.lost for s in streams)


def sustained(directory: str) -> float:
    """Return the MB/s at which frames go through the bus onto the disk."""
    began = took_s = 0.0
    with _recorder(directory, required=True) as (cameras, process):
        began = time.perf_counter()
        for _ in range(FRAMES):
            cameras.send()
        bag = Path(directory) / "bag"
        # what is not in a chunk yet, or has no room there
        wanted, deadline = FRAMES * FRAME_BYTES - CHUNK_BYTES, time.monotonic() + LIMIT_S
        while sum(p.stat().st_size for p in bag.iterdir()) < wanted:
            if time.monotonic() > deadline:
                raise RuntimeError("the recorder does not write")
            cameras.service()
            time.sleep(0.001)
        _end(process)
        took_s = time.perf_counter() - began
    recorded, lost = _counts(directory)
    if (recorded, lost) != (FRAMES, 0):
        raise RuntimeError(f"{recorded} of {FRAMES} frames in the bag, {lost} lost")
    return FRAMES * FRAME_BYTES / 1e6 / took_s


def bare(directory: str) -> float:
    """Return the MB/s of a bare writer with the same bytes."""
    path = Path(directory) / "bare.mcap"
    pixels = [image.tobytes() for image in IMAGES]
    began = time.perf_counter()
    with path.open("wb") as file:
        writer: Any = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        writer.start()
        schema = writer.register_schema("Frame", "", b"")
        channels = [writer.register_channel(f"/{c}/frame", "raw", schema) for c in CAMERAS]
        for index in range(FRAMES):
            writer.add_message(
                channel_id=channels[index % len(channels)],
                log_time=index,
                data=pixels[index % len(pixels)],
                publish_time=index,
                sequence=index // len(channels),
            )
        writer.finish()
        file.flush()
        os.fsync(file.fileno())
    return FRAMES * FRAME_BYTES / 1e6 / (time.perf_counter() - began)


def paced(directory: str, rate_hz: float) -> tuple[float, int, float]:
    """Send at the rig's rate, waiting for nobody.

    Returns
    -------
    tuple
        Frames a second that were sent, frames that are not in the bag, and the processor's time
        that the recorder took, as a part of one core.
    """
    with _recorder(directory, required=False) as (cameras, process):
        count = round(PACED_S * rate_hz)
        began = time.perf_counter()
        for index in range(count):
            while (left_s := began + index / rate_hz - time.perf_counter()) > 0:
                time.sleep(min(left_s, 0.002))
            cameras.service()
            cameras.send()
        took_s = time.perf_counter() - began
        quiet = time.monotonic() + 2.0  # what is on its way is taken; it holds up nothing
        while time.monotonic() < quiet:
            cameras.service()
            time.sleep(0.005)
        busy_s = _end(process)
    return count / took_s, count - _counts(directory)[0], busy_s / took_s


def _in_folder(work: Callable[[str], Any]) -> Any:
    with tempfile.TemporaryDirectory(prefix="tvb") as directory:
        return work(directory)


def main() -> dict[str, float]:
    """Print and return the figures; rates are medians of interleaved runs."""
    print(f"Recorder, {WIDTH}×{HEIGHT} frames of {FRAME_BYTES / 1e6:.2f} MB, onto the disk")
    ours, theirs = [], []
    for _ in range(REPEATS):
        theirs.append(_in_folder(bare))
        ours.append(_in_folder(sustained))
    a, b = float(np.median(ours)), float(np.median(theirs))
    print(
        f"  sustained over the bus {a:6.0f} MB/s ({a * 1e6 / FRAME_BYTES:.0f} frames/s), "
        f"bare mcap writer {b:6.0f} MB/s, ratio {a / b:.2f}"
    )
    rate_hz, missing, share = _in_folder(lambda directory: paced(directory, RATE_HZ))
    print(
        f"  at the rig's {RATE_HZ:.0f} frames/s, for {PACED_S:.0f} s: {rate_hz:.1f} frames/s sent, "
        f"{missing} of {round(PACED_S * RATE_HZ)} lost; the recorder takes {100 * share:.0f} % of "
        "a core"
    )
    return {
        "sustained_frames_s": a * 1e6 / FRAME_BYTES,
        "ratio_to_bare": a / b,
        "lost_at_rig_rate": float(missing),
        "core_share_at_rig_rate": share,
    }


if __name__ == "__main__":
    main()
