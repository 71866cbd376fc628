"""Messages of a small rig, as a recorder would get them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from tests import sample_messages
from tests.sample_messages import START_NS, noise
from tvbrdf_messages.bag import About, BagReader, BagWriter
from tvbrdf_messages.codec import encode
from tvbrdf_messages.envelope import Envelope, Header
from tvbrdf_messages.messages import ArmState, Diagnostics
from tvbrdf_messages.topics import find_topic, frame_topic, info_topic

STEP_NS = 20_000_000
"""Of the arm's states: 50 a second."""
ATTACHMENTS = {
    "calibration/rig.yaml": b"cameras: {camera_1: {}}\n" * 20,
    "launch/rig.yaml": b"nodes: []\n",
    "notes.txt": "Farbe: grün".encode(),
}


class Told(NamedTuple):
    """What was written: log time and envelope."""

    log_time_ns: int
    envelope: Envelope


def as_bytes(envelope: Envelope) -> list[bytes]:
    """Return the parts of a message; equal for equal messages."""
    parts = encode(find_topic(envelope.topic), envelope.header, envelope.message)
    return [bytes(memoryview(part).cast("B")) for part in parts]


def header(publisher: str, sequence: int, stamp_ns: int, incarnation: str = "one") -> Header:
    return Header(publisher, incarnation, "host", "boot", sequence, stamp_ns, stamp_ns + 7)


def arm_state(sequence: int, log_time_ns: int, incarnation: str = "one") -> Told:
    state = ArmState(angle_deg=sequence / 7, speed_deg_s=1.0, lamp=True, moving=True, homed=True)
    stamp_ns = log_time_ns - 1_000_000
    sent = header("arm", sequence, stamp_ns, incarnation)._replace(hardware_ns=stamp_ns - START_NS)
    return Told(log_time_ns, Envelope("/arm/state", sent, state))


def camera_info(sequence: int, log_time_ns: int, camera: str = "camera_1") -> Told:
    info = sample_messages.camera_info(camera=camera, serial=str(sequence))
    sent = header(camera, sequence, log_time_ns - 500)
    return Told(log_time_ns, Envelope(info_topic(camera), sent, info))


def frame(
    sequence: int, log_time_ns: int, camera: str = "camera_1", shape: tuple[int, int] = (12, 16)
) -> Told:
    height, width = shape
    image = noise(sequence, log_time_ns % 2**32, height=height, width=width)
    message = sample_messages.frame(image, camera=camera, index=sequence)
    sent = header(camera, sequence, log_time_ns - 3_000_000)
    return Told(log_time_ns, Envelope(frame_topic(camera), sent, message))


def diagnostics(node: str, sequence: int, log_time_ns: int) -> Told:
    message = Diagnostics(node=node, state="running", counters={"sent": sequence})
    return Told(log_time_ns, Envelope("/diagnostics", header(node, sequence, log_time_ns), message))


def rig_messages(seconds: float, start_ns: int = START_NS) -> list[Told]:
    """Return what a rig of an arm and two cameras says, in the order of log time."""
    told = [camera_info(0, start_ns + 1, name) for name in ("camera_1", "camera_2")]
    for k in range(round(seconds * 1e9) // STEP_NS):
        now_ns = start_ns + k * STEP_NS
        told.append(arm_state(k, now_ns + 1000))
        if k % 5 == 0:
            told += [frame(k // 5, now_ns + 2000 + c, f"camera_{c}") for c in (1, 2)]
        if k % 50 == 0:
            told += [diagnostics(node, k // 50, now_ns + 3000) for node in ("arm", "fitter")]
    return sorted(told, key=lambda each: each.log_time_ns)


def write(path: Path, told: Iterable[Told], **options: Any) -> Path:
    """Write a bag and return its path."""
    options = {"attachments": ATTACHMENTS, "about": About(run="run-1"), **options}
    with BagWriter(path, **options) as writer:
        for log_time_ns, envelope in told:
            writer.write_envelope(envelope, log_time_ns)
    return path


def read(path: Path, *topics: str) -> list[Told]:
    """Return all messages of a bag, decoded."""
    with BagReader(path) as reader:
        return [Told(*each) for each in reader.messages(topics or None)]


def plain(told: Iterable[Told]) -> list[tuple[int, list[bytes]]]:
    """Return messages in a form that can be compared."""
    return [(each.log_time_ns, as_bytes(each.envelope)) for each in told]
