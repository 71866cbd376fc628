"""``tvbrdf bench fit``."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from .._common import Subparsers, add_json_option, add_verb, count, print_json

if TYPE_CHECKING:
    from tvbrdf_fitting.observations import Observations

    from .grid import Cell, Plan, Progress

UNIFORM_VARIANCE = 1e-4


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "fit",
        run,
        "measure speed against error of a fit: solvers, precision, lights, cameras, noise",
    )
    parser.add_argument(
        "path",
        nargs="?",
        type=Path,
        metavar="PATH",
        help="folder of a sample in the published layout, whose scan is fitted in parts "
        "(default: simulated scans of random materials)",
    )
    parser.add_argument(
        "--scan", type=count, metavar="N", help="number of the sample's scan (default: its first)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/bench"),
        metavar="DIR",
        help="where figure and table go (default: out/bench)",
    )
    parser.add_argument(
        "--quick", action="store_true", help="fewer combinations, in seconds instead of minutes"
    )
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from ...errors import RunError

    if arguments.scan is not None and arguments.path is None:
        raise RunError("--scan needs the PATH of a sample")
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # before numpy is loaded: times are those of one core
    from tvbrdf_fitting.published import write_atomically
    from tvbrdf_rendering.speed_error import plot_speed_error

    from . import grid, table

    plan: Plan = grid.QUICK if arguments.quick else grid.Plan()
    out: Path = arguments.out
    measured = None if arguments.path is None else read(arguments.path, arguments.scan)
    # before the minutes of work, if it can't be made; after what else can be wrong
    out.mkdir(parents=True, exist_ok=True)
    cells: list[Cell]
    if measured is None:
        title = f"Oren-Nayar + Torrance-Sparrow, {plan.scenes} simulated materials"
        cells = grid.simulate(plan, _progress())
    else:
        observations, number = measured
        title = f"{arguments.path.resolve().name}, scan {number}, against the fit of all of it"
        cells = grid.on_scan(observations, plan, _progress())
    rows = [cell.as_dict() for cell in cells]
    text = f"{title}; {table.machine()}\n\n{table.as_text(cells)}\n"
    written = {name: out / f"speed_error.{name}" for name in ("png", "csv", "txt")}
    plot_speed_error(cells, written["png"], title=title)
    write_atomically(written["csv"], table.as_csv(rows).encode())
    write_atomically(written["txt"], text.encode())
    if arguments.json:
        print_json({"title": title, "machine": table.machine(), "cells": rows, "written": written})
        return 0
    print(text)
    for path in written.values():
        print(path)
    return 0


def read(path: Path, number: int | None) -> tuple[Observations, int]:
    """Return what all cameras saw in a scan of a sample, and its number.

    Weights are uniform, for a plain fit in radiance: a model never explains a real material within
    its noise, and all solvers here are to have the same problem.

    Raises
    ------
    RunError
        There is no such scan, or its files break the layout.
    """
    from dataclasses import replace

    import numpy as np

    from tvbrdf_fitting.published import PublishedFormatError, list_scans, read_sample

    from ...errors import RunError

    try:
        numbers = list_scans(path)
        chosen = number if number is not None else (numbers or (1,))[0]
        sample = read_sample(path, scans=[chosen])
    except PublishedFormatError as error:
        raise RunError(str(error)) from error
    seen = sample.scans[0].observations(sample.calibration)
    return replace(seen, variance=np.full(seen.radiance.shape, UNIFORM_VARIANCE)), chosen


def _progress() -> Progress:
    """Return what tells on a terminal how far the work is."""

    def tell(done: int, of: int) -> None:
        if sys.stderr.isatty():
            sys.stderr.write(f"\r{done} of {of} " if done < of else "\r\x1b[K")
            sys.stderr.flush()

    return tell
