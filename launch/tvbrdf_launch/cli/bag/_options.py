"""What verbs share that select topics and times."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tvbrdf_messages.bag import EditReport


def add_topic_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that select topics, named as in ``ros2 bag``."""
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="full names of topics")
    parser.add_argument("-e", "--regex", metavar="REGEX", help="topics that contain it, too")
    parser.add_argument("-x", "--exclude", metavar="REGEX", help="but none that contain this one")


def add_bag(parser: argparse.ArgumentParser) -> None:
    """Add the bag."""
    parser.add_argument("bag", type=Path, help="an .mcap file, or the folder of a bag in parts")


def add_out(parser: argparse.ArgumentParser) -> None:
    """Add where a new bag is written."""
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        required=True,
        metavar="BAG",
        help="a new file (NAME.mcap), or a new folder (NAME)",
    )


def utc(time_ns: int) -> str:
    """Return a time in UTC with milliseconds."""
    from datetime import UTC, datetime

    moment = datetime.fromtimestamp(time_ns // 10**9, UTC)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{time_ns // 10**6 % 1000:03} UTC"


def print_removed(removed: Iterable[Path]) -> None:
    """Print what was cleared away before the work began."""
    for folder in removed:
        print(f"removed {folder}: what a run that was killed had left of the same output")


def print_edit(report: EditReport, why_left_out: str) -> None:
    """Print what came of making a bag."""
    print_removed(report.removed)
    print(f"{report.out}: {report.messages} messages")
    for topic, count in sorted(report.topics.items()):
        print(f"  {topic}: {count}")
    if report.left_out:
        print(f"left out: {report.left_out} messages {why_left_out}")
