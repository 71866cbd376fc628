"""``tvbrdf report``: table and pictures of a measured database."""

from __future__ import annotations

import argparse
from pathlib import Path

from ._common import Subparsers, add_json_option, add_verb, print_json


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "report", run, "write table and pictures of a database")
    parser.add_argument("database", type=Path, help="folder of the database")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="where to (default: beside the database)"
    )
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from ..errors import RunError

    database: Path = arguments.database
    if not database.is_dir():
        raise RunError(f"no database {database}: not a folder")
    out = arguments.out or database.resolve().parent
    from tvbrdf_fitting.published.database import DatabaseError
    from tvbrdf_rendering import make_report

    try:
        written = make_report(database, out)
    except DatabaseError as error:
        raise RunError(str(error)) from error
    if arguments.json:
        print_json({"database": str(database), "out": str(out), "written": written})
        return 0
    print(f"{written['summary'].read_text().rstrip()}\n")
    for name, path in written.items():
        print(f"{name:14} {path}")
    return 0
