"""Times of calls that take turns, and benchmarks run in a process of their own with one thread."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tvbrdf_fitting.geometry import FloatArray

ONE_THREAD = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}
"""Every library on one core: several threads on a few thousand numbers only cost time."""


@dataclass(frozen=True)
class Times:
    """Seconds a call, each the least of a few single calls, by name; one value a round."""

    rounds: Mapping[str, FloatArray]

    def least(self, name: str) -> float:
        """Return the least time of a single call, in s."""
        return float(self.rounds[name].min())

    def ratio(self, slow: str, fast: str) -> tuple[float, float, float]:
        """How many times as long: of the least times, and the 5th and 95th per cent of rounds."""
        each = self.rounds[slow] / self.rounds[fast]
        low, high = np.quantile(each, (0.05, 0.95))
        return self.least(slow) / self.least(fast), float(low), float(high)


def take_turns(
    calls: Mapping[str, Callable[[], object]], rounds: int, *, at_least_s: float = 2e-3
) -> Times:
    """Time single calls, round by round, so that whatever else the machine does meets all alike.

    In a round a call is made until `at_least_s` is used up, at least once, at most ten times.
    """
    for call in calls.values():
        call()  # compiles, fills caches
    seen: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            best = total = 0.0
            for turn in range(10):
                began = time.perf_counter()
                call()
                took = time.perf_counter() - began
                best = took if turn == 0 else min(best, took)
                total += took
                if total >= at_least_s:
                    break
            seen[name].append(best)
    return Times({name: np.array(values) for name, values in seen.items()})


def on_one_thread(module: str, *words: str) -> dict[str, Any]:
    """Run a benchmark's module in a process of its own, one thread a library; return its figures.

    The module must take ``--json FILE``.
    """
    with tempfile.TemporaryDirectory(prefix="tvb") as folder:
        figures = Path(folder) / "figures.json"
        sys.stdout.flush()
        subprocess.run(
            [sys.executable, "-m", module, "--json", str(figures), *words],
            env=os.environ | ONE_THREAD,
            check=True,
        )
        found: dict[str, Any] = json.loads(figures.read_text())
    return found


def write_figures(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Write what `on_one_thread` reads."""
    if path is not None:
        path.write_text(json.dumps(figures))
