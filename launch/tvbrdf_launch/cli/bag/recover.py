"""``tvbrdf bag recover``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from .._common import Subparsers, add_json_option, add_verb, print_json
from ._options import add_bag, print_removed, utc

if TYPE_CHECKING:
    from tvbrdf_messages.bag import Lost, RecoverReport


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers, "recover", run, "save what is intact in a bag that was cut or damaged"
    )
    add_bag(parser)
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        metavar="BAG",
        help="a new file or folder (default: NAME_recovered beside)",
    )
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from tvbrdf_messages.bag import recover

    bag: Path = arguments.bag
    out = arguments.out or bag.with_name(f"{bag.stem}_recovered{bag.suffix}")
    report = recover(bag, out)
    if arguments.json:
        print_json(report.plain())
    else:
        _print(report)
    return 0


def _print(report: RecoverReport) -> None:
    from ...text import size

    print_removed(report.removed)
    print(f"{report.out}: {report.messages} messages saved and read back")
    if report.messages:
        print(f"  from {utc(report.start_ns)} to {utc(report.end_ns)}")
    print(f"  attachments: {', '.join(report.attachments) or 'none'}")
    if not report.complete:
        print(
            "the file had no end: what its recorder had not yet written (about the last second) "
            "is missing"
        )
    for lost in report.lost:
        print(f"lost: {size(lost.bytes)} at byte {lost.offset} of {lost.path.name}: {lost.why}")
        print(f"  {_span(lost)}")
    if not report.lost:
        print("nothing of the file was lost")


def _span(lost: Lost) -> str:
    after = "the beginning" if lost.after_ns is None else utc(lost.after_ns)
    before = "the end" if lost.before_ns is None else utc(lost.before_ns)
    return f"between {after} and {before}"
