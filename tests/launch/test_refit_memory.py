"""Memory of a refit does not grow with the bag."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.launch.refit_inputs import inside, results
from tests.replay.process_replay import BAG
from tests.replay.recorded_rig import read_all, write_bag
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import ArmState, Frame, ScanCommand, SweepResult

FEW, MANY = 2, 14
ENLARGED = 8
"""From 8 x 8 pixels to 64 x 64."""
PERIOD_NS = 60_000_000_000
GROWTH_MB = 25.0
"""Allowed; the larger bag has over 80 MB more. Fits and the database's rows stay."""


def scans(count: int) -> Iterator[Envelope]:
    """Yield the scan of the small bag again and again, as one run would have measured it."""
    messages = [_enlarged(envelope) for envelope in read_all(BAG)]
    sent = Counter((e.header.publisher, e.topic) for e in messages)
    for number in range(count):
        later_ns = number * PERIOD_NS
        for envelope in messages:
            header = envelope.header
            header = header._replace(
                sequence=header.sequence + number * 10_000,
                stamp_ns=header.stamp_ns + later_ns,
                received_ns=header.received_ns + later_ns,
                hardware_ns=header.hardware_ns + later_ns,
            )
            message = envelope.message
            if isinstance(message, SweepResult) and message.first_sequence >= 0:
                message = replace(
                    message,
                    scan=message.scan + number,
                    first_sequence=message.first_sequence + number * 10_000,
                    last_sequence=message.last_sequence + number * 10_000,
                )
            elif isinstance(message, (Frame, ScanCommand, SweepResult)):
                message = replace(message, scan=message.scan + number)
            yield Envelope(envelope.topic, header, message)
    assert max(sent.values()) < 10_000


def _enlarged(envelope: Envelope) -> Envelope:
    message: Any = envelope.message
    if isinstance(message, Frame):
        image = np.repeat(np.repeat(message.image, ENLARGED, axis=0), ENLARGED, axis=1)
        return envelope._replace(message=replace(message, image=image))
    assert isinstance(message, (ArmState, ScanCommand, SweepResult))
    return envelope


def largest_mb(bag: Path, out: Path) -> float:
    """Refit in a process of its own; return the most memory that it held."""
    words = ["-m", "tvbrdf_launch", "refit", str(bag), "--out", str(out), "--jobs", "1", "--json"]
    pid = os.posix_spawn(
        sys.executable,
        [sys.executable, *words],
        {**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)],
    )
    _, status, usage = os.wait4(pid, 0)
    assert os.waitstatus_to_exitcode(status) == 0
    return usage.ru_maxrss * 1024 / 1e6


@pytest.mark.slow
def test_memory_does_not_grow_with_the_bag(tmp_path: Path) -> None:
    sizes, memory = {}, {}
    for count in (FEW, MANY):
        bag = write_bag(tmp_path / f"of_{count}.mcap", scans(count), inside(), compression="none")
        sizes[count] = bag.stat().st_size / 1e6
        memory[count] = largest_mb(bag, tmp_path / "out")
        found = results(tmp_path / "out" / f"of_{count}")
        assert [record["scan"] for record in found] == list(range(1, count + 1))
        bag.unlink()
    assert sizes[MANY] - sizes[FEW] > 80.0
    assert memory[MANY] - memory[FEW] < GROWTH_MB, memory
