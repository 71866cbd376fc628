"""What several verbs share: options, finding the run, tables, and asking the sequencer."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tvbrdf_messages.messages import OperatorReply
    from tvbrdf_messages.run_directory import Graph

Subparsers = Any
"""What ``add_subparsers`` returns; argparse keeps its class private."""


def add_verb(subparsers: Subparsers, name: str, run: Any, text: str) -> argparse.ArgumentParser:
    """Add a verb's parser that will call ``run``."""
    parser: argparse.ArgumentParser = subparsers.add_parser(name, help=text, description=text)
    parser.set_defaults(run=run)
    return parser


def add_run_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--run``."""
    parser.add_argument(
        "--run",
        dest="run_directory",
        metavar="DIR",
        help="the run's directory (default: $TVBRDF_RUN, else the newest run)",
    )


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    parser.add_argument("--json", action="store_true", help="print JSON")


def find_run_directory(arguments: argparse.Namespace) -> Path:
    """Return the directory of the run that is meant; it is this user's."""
    import os

    from tvbrdf_messages.run_directory import find_run

    from ..errors import RunError

    run = find_run(arguments.run_directory)
    if not run.is_dir():
        raise RunError(f"no run directory {run}")
    if run.stat().st_uid != os.getuid():
        raise RunError(f"run directory {run} belongs to somebody else")
    return run


def open_run(arguments: argparse.Namespace) -> tuple[Path, Graph]:
    """Return the directory and the graph of the run that is meant."""
    from tvbrdf_messages.run_directory import read_graph

    run = find_run_directory(arguments)
    return run, read_graph(run)


def is_going_on(run: Path) -> bool:
    """Return whether any process of a run is still there."""
    from ..process_table import read_processes

    return bool(read_processes(run).alive())


def require_going_on(run: Path) -> None:
    """Raise unless the run is still going on."""
    from ..errors import RunError

    if not is_going_on(run):
        raise RunError(f"the run in {run} has ended; its logs are there")


def print_json(value: Any) -> None:
    """Print a value as JSON on one line."""
    print(json.dumps(value, ensure_ascii=False, default=str), flush=True)


def print_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> None:
    """Print rows under headings, in columns."""
    texts = [[str(row.get(column, "")) for column in columns] for row in rows]
    headings = [column.replace("_", " ") for column in columns]
    widths = [max(map(len, column)) for column in zip(headings, *texts, strict=True)]
    for line in (headings, *texts):
        padded = (text.ljust(width) for text, width in zip(line, widths, strict=True))
        print("  ".join(padded).rstrip())


def ask(
    arguments: argparse.Namespace, verb: str, fields: Mapping[str, Any], timeout_s: float
) -> OperatorReply:
    """Ask the sequencer of the run that is meant, and return its answer."""
    from tvbrdf_messages.bus.watcher import ServiceClient

    run, graph = open_run(arguments)
    require_going_on(run)
    with ServiceClient(graph) as client:
        return client.ask(verb, dict(fields), timeout_s)


def tell(reply: OperatorReply, as_json: bool) -> int:
    """Print an answer; return the exit status."""
    if as_json:
        print_json({"ok": reply.ok, "text": reply.text, **reply.data})
    elif reply.ok:
        print(reply.text)
    if not reply.ok:
        sys.stderr.write(f"tvbrdf: error: {reply.text}\n")
    return 0 if reply.ok else 1


def add_timeout_option(parser: argparse.ArgumentParser, seconds: float) -> None:
    """Add ``--timeout``."""
    parser.add_argument(
        "--timeout",
        type=positive,
        default=seconds,
        metavar="SECONDS",
        help=f"how long to wait for the answer (default {seconds:g})",
    )


def positive(text: str) -> float:
    """Return a finite number above 0, for argparse."""
    value = float(text)
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text} is not a number above 0")
    return value


def count(text: str) -> int:
    """Return a whole number above 0, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a whole number above 0")
    return value
