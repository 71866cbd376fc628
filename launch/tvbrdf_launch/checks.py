"""What ``tvbrdf doctor`` looks at; each check says what to do."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

OK, WARN, FAIL = "ok", "warn", "fail"
MIN_DISK_GB = 5.0
MIN_CORES = 2
MIN_PYTHON = (3, 11)
PROBE_S = 20.0
_ARAVIS_PROBE = """
from tvbrdf_nodes.camera.aravis_library import load_aravis
Aravis = load_aravis()
Aravis.update_device_list()
print(Aravis.get_n_devices())
"""


class Finding(NamedTuple):
    """One thing that was looked at."""

    name: str
    state: str
    """``ok``, ``warn`` or ``fail``."""
    text: str
    advice: str = ""


def run_checks() -> list[Finding]:
    """Look at everything."""
    return [finding for check in CHECKS for finding in check()]


def check_python() -> Iterator[Finding]:
    """Look at the interpreter."""
    version = ".".join(map(str, sys.version_info[:3]))
    if sys.version_info[:2] < MIN_PYTHON:
        yield Finding("Python", FAIL, version, "install Python 3.11 or later")
    else:
        yield Finding("Python", OK, version)


def check_packages() -> Iterator[Finding]:
    """Look at what the distribution requires, and at its version."""
    from importlib.metadata import PackageNotFoundError, requires, version

    try:
        wanted = requires("tvbrdf") or []
    except PackageNotFoundError:
        yield Finding("packages", FAIL, "tvbrdf is not installed", "install it: pip install -e .")
        return
    good = []
    for line in wanted:
        if "extra ==" in line:
            continue
        name, minimum, below = _requirement(line)
        advice = f"install it: pip install '{line}'"
        try:
            found = version(name)
        except PackageNotFoundError:
            yield Finding(f"package {name}", FAIL, "missing", advice)
            continue
        too_new = below and _numbers(found) >= _numbers(below)
        if too_new or _numbers(found) < _numbers(minimum):
            yield Finding(f"package {name}", FAIL, f"{found}, needed is {line}", advice)
        else:
            good.append(f"{name} {found}")
    yield Finding("packages", OK, ", ".join(good))


def _requirement(line: str) -> tuple[str, str, str]:
    """Return name, lowest version and the one that it must be below, of a requirement."""
    name = re.split(r"[^A-Za-z0-9._-]", line, maxsplit=1)[0]
    minimum = re.search(r">=\s*([0-9.]+)", line)
    below = re.search(r"<\s*([0-9.]+)", line)
    return name, minimum[1] if minimum else "0", below[1] if below else ""


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def check_run_directory() -> Iterator[Finding]:
    """Look whether a run's directory can be made, private and short enough for sockets."""
    from tvbrdf_messages.errors import BusError
    from tvbrdf_messages.run_directory import Graph, Participant, make_private

    from .run_folder import choose_run_directory

    path = choose_run_directory()
    longest = "camera_1.device"
    graph = Graph(
        directory=str(path),
        utc_ns=0,
        monotonic_ns=0,
        simulated=False,
        participants=(Participant(name=longest),),
    )
    try:
        make_private(path.parent if not os.environ.get("TVBRDF_RUN") else path)
        graph.endpoint(longest, "lossless")
    except (BusError, OSError) as error:
        advice = "set TVBRDF_RUN to a short path in a folder of your own"
        yield Finding("run directory", FAIL, str(error), advice)
    else:
        yield Finding("run directory", OK, str(path.parent))


def check_sockets() -> Iterator[Finding]:
    """Look whether a message passes through a Unix socket of ZeroMQ."""
    import zmq

    with (
        tempfile.TemporaryDirectory(prefix="tvbrdf-") as folder,
        zmq.Context() as context,
        context.socket(zmq.PAIR) as here,
        context.socket(zmq.PAIR) as there,
    ):
        here.linger = there.linger = 0
        try:
            here.bind(f"ipc://{folder}/probe")
            there.connect(f"ipc://{folder}/probe")
            there.send(b"probe")
            passed = bool(here.poll(2000)) and here.recv() == b"probe"
        except zmq.ZMQError as error:
            yield Finding("sockets", FAIL, str(error), "Unix sockets must be allowed")
            return
    if passed:
        yield Finding("sockets", OK, f"a message passed (ZeroMQ {zmq.zmq_version()})")
    else:
        yield Finding("sockets", FAIL, "a message did not pass in 2 s", "look for a sandbox")


def check_serial_ports() -> Iterator[Finding]:
    """Look for serial ports that the arm may hang on."""
    from serial.tools.list_ports import comports

    ports = [port.device for port in comports()]
    if not ports:
        advice = "plug the arm's controller in, or use a simulated rig, socket:// or rfc2217://"
        yield Finding("serial ports", WARN, "none", advice)
        return
    for port in ports:
        if os.access(port, os.R_OK | os.W_OK):
            yield Finding(f"serial port {port}", OK, "may be opened")
        else:
            advice = "join the group that owns it: sudo usermod -aG dialout $USER, log in again"
            yield Finding(f"serial port {port}", WARN, "may not be opened", advice)


def check_disk() -> Iterator[Finding]:
    """Look at the room for databases in the current folder, and at the runs'."""
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    text = f"{free_gb:.1f} GB free in {Path.cwd()}"
    if free_gb < MIN_DISK_GB:
        yield Finding("disk", WARN, text, f"make room: below {MIN_DISK_GB:g} GB is little")
    else:
        yield Finding("disk", OK, text)


def check_cores() -> Iterator[Finding]:
    """Look how many processors the nodes may use."""
    cores = len(os.sched_getaffinity(0))
    if cores < MIN_CORES:
        advice = f"use {MIN_CORES} or more: four cameras and the merger work at once"
        yield Finding("cores", WARN, str(cores), advice)
    else:
        yield Finding("cores", OK, str(cores))


def check_aravis() -> Iterator[Finding]:
    """Look for Aravis and its cameras, in a process of its own: it may hang or crash."""
    advice = "for GenICam cameras: install Debian's gir1.2-aravis-0.8 and python3-gi"
    try:
        done = subprocess.run(
            [sys.executable, "-c", _ARAVIS_PROBE],
            capture_output=True,
            text=True,
            timeout=PROBE_S,
            stdin=subprocess.DEVNULL,
            check=False,
        )
    except subprocess.TimeoutExpired:
        yield Finding("Aravis", WARN, f"did not answer in {PROBE_S:g} s", "look at the network")
        return
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        yield Finding("Aravis", WARN, lines[-1], advice)
    elif done.stdout.strip() == "0":
        yield Finding("Aravis", OK, "installed, no camera found")
    else:
        yield Finding("Aravis", OK, f"{done.stdout.strip()} cameras")


def check_video_devices() -> Iterator[Finding]:
    """Look for video devices."""
    devices = sorted(Path("/dev").glob("video*"))
    if not devices:
        yield Finding("video devices", OK, "none (needed for OpenCV cameras only)")
        return
    closed = [str(path) for path in devices if not os.access(path, os.R_OK | os.W_OK)]
    if closed:
        advice = "join the group that owns them: sudo usermod -aG video $USER, log in again"
        yield Finding("video devices", WARN, f"may not be opened: {', '.join(closed)}", advice)
    else:
        yield Finding("video devices", OK, ", ".join(map(str, devices)))


CHECKS: tuple[Callable[[], Iterator[Finding]], ...] = (
    check_python,
    check_packages,
    check_run_directory,
    check_sockets,
    check_serial_ports,
    check_disk,
    check_cores,
    check_aravis,
    check_video_devices,
)
