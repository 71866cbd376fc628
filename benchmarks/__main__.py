"""All benchmarks: ``make bench``. Run one alone with ``python -m benchmarks.NAME``."""

from __future__ import annotations

import os
import platform

from benchmarks import bus, rig, startup


def main() -> None:
    """Print every figure."""
    print(f"{platform.platform()}, Python {platform.python_version()}, {os.cpu_count()} cores\n")
    for benchmark in (bus, rig, startup):
        benchmark.main()
        print()


if __name__ == "__main__":
    main()
