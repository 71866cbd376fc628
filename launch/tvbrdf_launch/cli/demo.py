"""``tvbrdf demo``: the main job on the simulated rig, up to its table and pictures."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from ._common import Subparsers, add_verb

MARKER = "catalogue.sqlite"
ARGUMENTS = {"sample": "drying_paint", "scans": "5", "interval_s": "120", "warm_up_s": "30"}


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "demo", run, "measure a drying paint on the simulated rig")
    parser.add_argument(
        "--out", type=Path, default=Path("out/demo"), metavar="DIR", help="(default: out/demo)"
    )
    parser.add_argument(
        "arguments", nargs="*", metavar="key:=value", help="arguments of simulated_rig"
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from ..arguments import parse_assignments
    from . import launch

    out: Path = arguments.out
    database = out / "database"
    _clear(out)
    given = {**ARGUMENTS, **parse_assignments(arguments.arguments), "database": str(database)}
    status = launch.launch("simulated_rig", [f"{key}:={value}" for key, value in given.items()])
    if status:
        return status
    from tvbrdf_rendering import make_report

    written = make_report(database, out)
    print(f"\n{(out / 'summary.txt').read_text().rstrip()}\n")
    print(f"database  {database}")
    for name, path in written.items():
        print(f"{name:9} {path}")
    return 0


def _clear(out: Path) -> None:
    """Remove what an earlier demo left; refuse a folder that holds anything else."""
    from ..errors import RunError

    if not out.exists() or not any(out.iterdir()):
        return
    if not (out / "database" / MARKER).is_file():
        raise RunError(f"{out} is not empty and no earlier demo; give --out with another folder")
    shutil.rmtree(out)
