"""All benchmarks: ``make bench``. Run one alone with ``python -m benchmarks.NAME``."""

from __future__ import annotations

import os
import platform

from benchmarks import (
    bus,
    coverage,
    fit_optimum,
    fit_speed,
    fit_speed_error,
    fit_starts,
    playback,
    real_materials,
    recorder,
    refit,
    rig,
    startup,
)


def main() -> None:
    """Print every figure."""
    print(f"{platform.platform()}, Python {platform.python_version()}, {os.cpu_count()} cores\n")
    fits = (fit_speed, fit_starts, fit_optimum, fit_speed_error, coverage, real_materials)
    bags = (recorder, playback, refit)
    for benchmark in (bus, rig, startup, *bags, *fits):
        benchmark.main()
        print()


if __name__ == "__main__":
    main()
