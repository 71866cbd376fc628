"""``tvbrdf bag info``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from .._common import Subparsers, add_json_option, add_verb, print_json, print_table
from ._options import add_bag, utc

if TYPE_CHECKING:
    from tvbrdf_messages.bag import BagSummary

SHOWN_GAPS = SHOWN_JUMPS = 10


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "info", run, "tell what is in a bag, from its index")
    add_bag(parser)
    parser.add_argument(
        "--recount", action="store_true", help="read all messages instead of the kept counts"
    )
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from tvbrdf_messages.bag import BagReader

    with BagReader(arguments.bag) as bag:
        summary = bag.summary(recount=arguments.recount)
    if arguments.json:
        print_json(summary.plain())
        return 0
    _print_whole(summary)
    _print_topics(summary)
    _print_gaps(summary)
    _print_clock_jumps(summary)
    return 0


def _print_whole(summary: BagSummary) -> None:
    from ...text import size

    about = summary.about
    rows = [("Bag", str(summary.path)), ("Size", size(summary.size_bytes))]
    if summary.messages:
        rows += [
            ("Duration", f"{summary.duration_s:.3f} s"),
            ("Start", f"{utc(summary.start_ns)} ({summary.start_ns})"),
            ("End", f"{utc(summary.end_ns)} ({summary.end_ns})"),
        ]
    rows += [
        ("Messages", str(summary.messages)),
        ("Run", about.run or "not known"),
        ("Recorded", f"{utc(about.created_ns)} on {about.host}"),
        ("Versions", f"tvbrdf {about.version}, bag format {about.format_version}"),
        *((name.capitalize(), text) for name, text in about.extra.items()),
    ]
    for name, text in rows:
        print(f"{name + ':':<13}{text}")
    print("Attachments:" + ("" if summary.attachments else " none"))
    for attachment in summary.attachments:
        print(f"  {attachment.name} ({size(attachment.size_bytes)})")
    if len(summary.files) > 1:
        print("Files:")
        for file in summary.files:
            span_s = (file.end_ns - file.start_ns) / 1e9
            print(f"  {file.path.name}: {span_s:.3f} s, {size(file.size_bytes)}")


def _print_topics(summary: BagSummary) -> None:
    from ...text import size

    rows = [
        {
            "topic": topic.topic,
            "type": topic.type,
            "messages": topic.messages,
            "rate": f"{topic.rate_hz:.2f} Hz" if topic.rate_hz else "",
            "size": size(topic.bytes),
            "lost": topic.lost or "",
            "publishers": ", ".join(topic.publishers),
        }
        for topic in summary.topics
    ]
    print("Topics:" + ("" if rows else " none"))
    if rows:
        print_table(rows, ("topic", "type", "messages", "rate", "size", "lost", "publishers"))


def _print_gaps(summary: BagSummary) -> None:
    gaps = [(stream, gap) for stream in summary.streams for gap in stream.gaps]
    if not gaps:
        return
    print("Gaps:")
    for stream, (first, last) in gaps[:SHOWN_GAPS]:
        numbers = f"{first}" if first == last else f"{first} to {last}"
        print(f"  {stream.topic} of {stream.publisher} ({stream.incarnation}): {numbers}")
    if len(gaps) > SHOWN_GAPS:
        print(f"  and {len(gaps) - SHOWN_GAPS} more (all with --json)")


def _print_clock_jumps(summary: BagSummary) -> None:
    if not summary.clock_jumps:
        return
    print("Jumps of clocks:")
    for jump in summary.clock_jumps[:SHOWN_JUMPS]:
        after_s = (jump.log_time_ns - summary.start_ns) / 1e9
        print(f"  {jump.topic}, {after_s:.3f} s after the start: {jump.text}")
    if len(summary.clock_jumps) > SHOWN_JUMPS:
        print(f"  and {len(summary.clock_jumps) - SHOWN_JUMPS} more (all with --json)")
