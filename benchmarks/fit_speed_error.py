"""Speed against error: how few lights and how cheap a solver reach the error one needs.

The short plan of ``tvbrdf bench fit``, which draws the figure as well, and takes one's own data.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from benchmarks.fit_timing import on_one_thread, write_figures
from tvbrdf_launch.cli.bench import grid, table


def main() -> dict[str, Any]:
    """Print and return the figures, with one thread for every library."""
    return on_one_thread("benchmarks.fit_speed_error")


def _run() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    parser.add_argument("--full", action="store_true", help="the whole plan: minutes")
    chosen = parser.parse_args()
    plan = grid.Plan() if chosen.full else grid.QUICK
    cells = grid.simulate(plan)
    print(f"Speed against error, {plan.scenes} simulated materials a combination\n")
    print(table.as_text(cells))
    write_figures(chosen.json, {"cells": [cell.as_dict() for cell in cells]})


if __name__ == "__main__":
    _run()
