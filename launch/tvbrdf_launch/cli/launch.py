"""``tvbrdf launch``: start a run from a launch file."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ._common import Subparsers, add_json_option, add_verb, print_json, print_table

if TYPE_CHECKING:
    from tvbrdf_messages.run_directory import Graph

    from ..display import Display


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "launch", run, "start all nodes of a launch file")
    parser.add_argument("file", nargs="?", help="name of a shipped launch file, or a path")
    parser.add_argument(
        "arguments", nargs="*", metavar="key:=value", help="arguments of the launch file"
    )
    parser.add_argument(
        "-s", "--show-args", action="store_true", help="print the arguments it takes, and end"
    )
    parser.add_argument("--check", action="store_true", help="check everything, start nothing")
    parser.add_argument("--list", action="store_true", help="print the shipped launch files")
    parser.add_argument(
        "--run",
        dest="run_directory",
        metavar="DIR",
        help="where the run lives (default: $TVBRDF_RUN, else a new private directory)",
    )
    parser.add_argument("--plain", action="store_true", help="lines in place of a progress bar")
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    if arguments.list:
        return _list(arguments.json)
    if arguments.file is None:
        sys.stderr.write("tvbrdf launch: give the name or path of a launch file (see --list)\n")
        return 2
    if arguments.show_args:
        return _show_arguments(arguments.file, arguments.json)
    return launch(
        arguments.file,
        arguments.arguments,
        run_directory=arguments.run_directory,
        check=arguments.check,
        plain=arguments.plain,
        as_json=arguments.json,
    )


def _list(as_json: bool) -> int:
    from ..find_files import shipped

    rows = [{"name": name, "description": d.description} for name, d in shipped().items()]
    if as_json:
        print_json(rows)
    else:
        print_table(rows, ("name", "description"))
    return 0


def _show_arguments(file: str, as_json: bool) -> int:
    from ..find_files import find_launch_file
    from ..launch_file import load_declaration

    declared = load_declaration(find_launch_file(file)).arguments.values()
    rows: list[dict[str, Any]] = [
        {
            "name": each.name,
            "type": each.type,
            "default": each.default.plain() if each.default is not None else None,
            "required": each.default is None,
            "description": each.description,
            "choices": list(each.choices),
        }
        for each in declared
    ]
    if as_json:
        print_json(rows)
        return 0
    print("Arguments (pass arguments as '<name>:=<value>'):")
    for row in rows:
        print(f"\n    '{row['name']}' ({row['type']}):")
        if row["description"]:
            print(f"        {row['description']}")
        if row["choices"]:
            print(f"        one of: {', '.join(map(str, row['choices']))}")
        print("        (required)" if row["required"] else f"        (default: {row['default']!r})")
    return 0


def launch(
    file: str,
    words: list[str],
    *,
    run_directory: str | None = None,
    check: bool = False,
    plain: bool = False,
    as_json: bool = False,
) -> int:
    """Launch a file with ``key:=value`` words; return the exit status."""
    from ..arguments import parse_assignments
    from ..find_files import find_launch_file
    from ..launch_file import load_launch_file
    from ..plan import make_plan
    from ..run_folder import RunFolder, choose_run_directory

    given = parse_assignments(words)
    directory = choose_run_directory(run_directory)
    described = load_launch_file(find_launch_file(file), given, directory)
    plan = make_plan(described, directory)
    if check:
        names = [node.name for node in plan.nodes]
        settings = dict(described.arguments)
        if as_json:
            found = {"file": str(described.path), "arguments": settings, "nodes": names}
            print_json({**found, "notices": list(plan.notices)} if plan.notices else found)
        else:
            print(f"{described.path}: good; {len(names)} nodes: {', '.join(names)}")
            _print_lines(plan.notices)
        return 0
    from ..launcher import Launcher
    from ..truth import write_truth

    def make_display() -> Display:
        if plain or not sys.stdout.isatty():
            from ..display import Display

            return Display(plan.graph.simulated)
        from ..display_terminal import TerminalDisplay

        return TerminalDisplay(plan.graph.simulated)

    _print_lines(plan.notices)
    status = Launcher(plan, RunFolder(directory), make_display).run()
    if plan.graph.simulated:
        write_truth(plan.graph)
    _print_recorded(plan.graph)
    return status


def _print_recorded(graph: Graph) -> None:
    """Print what was recorded, if anything was."""
    from tvbrdf_nodes.core.loading import NODES

    if any(p.node == NODES["recorder"] for p in graph.participants):
        from tvbrdf_nodes.recorder.record_book import describe_bags

        _print_lines(describe_bags(graph))


def _print_lines(lines: Iterable[str]) -> None:
    """Print lines at once; that nobody looks any more ends nothing."""
    with contextlib.suppress(BrokenPipeError):
        for line in lines:
            print(line, flush=True)
