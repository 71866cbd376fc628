"""``tvbrdf bag export``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from .._common import Subparsers, add_json_option, add_verb, print_json
from ._options import add_bag, print_removed

if TYPE_CHECKING:
    from ...export import Report

FORMATS = ("text", "exr", "foxglove")
SHOWN_REMARKS = 10


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "export",
        run,
        "write a bag's contents for other tools: published text, OpenEXR, Foxglove and Rerun",
    )
    add_bag(parser)
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="a new folder")
    parser.add_argument(
        "-f",
        "--format",
        dest="formats",
        nargs="+",
        choices=FORMATS,
        help="text: the published layout, as a run's database has it; exr: HDR images, one a "
        "light position and camera; foxglove: a bag of protobuf messages that Foxglove and Rerun "
        "show (default: each that the bag has the messages for)",
    )
    parser.add_argument(
        "--calibration", type=Path, metavar="FILE", help="in place of the one in the bag"
    )
    parser.add_argument(
        "--each-exposure",
        action="store_true",
        help="exr: an image for each frame, instead of the exposures merged",
    )
    parser.add_argument(
        "--whole-frames",
        action="store_true",
        help="exr: all pixels, instead of the sample's patch; what the recorder did not keep is "
        "no measurement",
    )
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    import os

    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    from ...export import export_bag
    from ...export.exr import ExrOptions
    from ...refit.settings import read_calibration_file
    from ..refit import progress_bar

    given = arguments.calibration
    with progress_bar() as tell:
        report = export_bag(
            arguments.bag,
            arguments.out,
            arguments.formats,
            calibration=None if given is None else read_calibration_file(given),
            options=ExrOptions(arguments.each_exposure, arguments.whole_frames),
            tell=tell,
        )
    if arguments.json:
        print_json(report.plain())
    else:
        _print(report)
    return 0


def _print(report: Report) -> None:
    print_removed(report.removed)
    for written in report.written:
        counts = ", ".join(f"{name}: {count}" for name, count in sorted(written.counts.items()))
        print(f"{report.out / written.path}: {counts}")
        for remark in written.remarks[:SHOWN_REMARKS]:
            print(f"  left out: {remark}")
        if len(written.remarks) > SHOWN_REMARKS:
            print(f"  and {len(written.remarks) - SHOWN_REMARKS} more (all with --json)")
    for name, why in report.left_out.items():
        print(
            f"no {name}: the bag {why}" if why.startswith(("has", "does")) else f"no {name}: {why}"
        )
