"""``tvbrdf stop``: stop a run; first the arm, without the bus."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from typing import TYPE_CHECKING

from ._common import Subparsers, add_run_option, add_verb, find_run_directory, positive

if TYPE_CHECKING:
    from pathlib import Path

    from ..process_table import ProcessRecord, ProcessTable

REACT_S = 0.5
"""What an arm node has to take notice; after that it is killed: the controller stops by itself."""
DEFAULT_TIMEOUT_S = 60.0


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "stop", run, "stop the arm at once, then the whole run in order")
    add_run_option(parser)
    parser.add_argument(
        "--timeout",
        type=positive,
        default=DEFAULT_TIMEOUT_S,
        metavar="SECONDS",
        help=f"how long to wait until all processes are gone (default {DEFAULT_TIMEOUT_S:g})",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from ..process_table import read_processes, wait_until_gone

    directory = find_run_directory(arguments)
    table = read_processes(directory)
    if not table.alive():
        print(f"the run in {directory} has already ended")
        return 0
    for name in _arm_nodes(directory):
        if name in table.nodes:
            _stop_arm(name, table.nodes[name])
    table.launcher.send(signal.SIGINT)
    everybody = [table.launcher, *table.nodes.values()]
    if not wait_until_gone(everybody, arguments.timeout / 2):
        table.launcher.send(signal.SIGINT)  # once more: hurry
        wait_until_gone(everybody, arguments.timeout / 2)
    left = _left(read_processes(directory))
    if left:
        sys.stderr.write(f"tvbrdf: error: still there after {arguments.timeout:g} s: {left}\n")
        return 1
    print(f"stopped the run in {directory}")
    return 0


def _arm_nodes(directory: Path) -> list[str]:
    """Return the nodes that move an arm: those that tell its state."""
    from tvbrdf_messages.errors import BusError
    from tvbrdf_messages.run_directory import read_graph

    try:
        graph = read_graph(directory)
    except BusError as error:
        sys.stderr.write(f"tvbrdf: warning: {error}\n")
        return []
    return [name for name in graph.publishers("/arm/state") if graph.find(name).node]


def _stop_arm(name: str, record: ProcessRecord) -> None:
    """Tell the arm node to stop; kill one that takes no notice: the controller then stops alone."""
    if not record.alive():
        return
    if _handles(record.pid) and record.send(signal.SIGUSR1) and _reacts(record):
        print(f"{name}: told to stop and to switch the light off")
        return
    if record.send(signal.SIGKILL):
        print(f"{name} does not react; killed it, so that the controller's watchdog stops the arm")


def _handles(pid: int) -> bool:
    """Return whether a process has a handler for SIGUSR1 by now."""
    return _signal_in(pid, "SigCgt:", signal.SIGUSR1)


def _reacts(record: ProcessRecord) -> bool:
    """Return whether a process takes the signal that it was sent, within the time for it."""
    deadline = time.monotonic() + REACT_S
    while time.monotonic() < deadline:
        pending = _signal_in(record.pid, "ShdPnd:", signal.SIGUSR1)
        if not record.alive() or not pending:
            return True
        time.sleep(0.01)  # the kernel has nothing to wait on for this
    return False


def _signal_in(pid: int, field: str, number: signal.Signals) -> bool:
    from pathlib import Path

    try:
        text = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
    mask = next((line.split()[1] for line in text.splitlines() if line.startswith(field)), "0")
    return bool(int(mask, 16) >> (number - 1) & 1)


def _left(table: ProcessTable) -> str:
    return ", ".join(f"{name} (pid {record.pid})" for name, record in table.alive().items())
