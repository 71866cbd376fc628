"""``tvbrdf refit``: refit bags, databases and published samples without any device or socket."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ._common import Subparsers, add_json_option, add_verb, count, print_json, print_table

if TYPE_CHECKING:
    from ..refit import Report, Settings

SHOWN_REMARKS = 10
SMALLEST_STEP = 0.005
"""Of progress that is shown."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers, "refit", run, "refit what was recorded or stored, without the rig"
    )
    parser.add_argument(
        "inputs",
        type=Path,
        nargs="+",
        metavar="BAG_OR_DATABASE",
        help="a bag, a database of a run, a sample in the published layout, or a folder of such",
    )
    parser.add_argument(
        "--out", "-o", type=Path, required=True, metavar="DIR", help="gets a folder for each input"
    )
    parser.add_argument(
        "--from",
        dest="start",
        choices=("frames", "radiance"),
        help="merge the frames again, or only fit (default: frames where a bag has them)",
    )
    parser.add_argument(
        "--model",
        metavar="NAME",
        help="as 'tvbrdf model list' has them, or 'auto' (default: the recorded run's, else "
        "oren_nayar+torrance_sparrow; so with the next ones)",
    )
    parser.add_argument(
        "--metric", metavar="NAME", help="radiance, cosine_weighted, log or relative"
    )
    parser.add_argument("--loss", metavar="NAME", help="least_squares, huber or cauchy")
    parser.add_argument("--method", metavar="NAME", help="separable, paper or trust_region")
    parser.add_argument(
        "--fixed",
        action="append",
        metavar="key:=value",
        help="a parameter that is known, e.g. sigma_d:=0.3, or kd:=1 for all channels; repeatable",
    )
    parser.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="of the rig, in place of the one in the bag; for published samples the constants of "
        "the cameras, in place of tvBrdf-calibration.txt",
    )
    parser.add_argument(
        "--jobs", type=count, metavar="N", help="processes (default: as many as there are cores)"
    )
    parser.add_argument(
        "--again", action="store_true", help="make results anew that are there already"
    )
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    import os

    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    from ..refit import Refit, find_sources

    settings = _settings(arguments)
    sources = find_sources(arguments.inputs)
    jobs = arguments.jobs or len(os.sched_getaffinity(0))
    with progress_bar() as tell:
        report = Refit(
            sources, arguments.out, settings, jobs=jobs, again=arguments.again, tell=tell
        ).run()
    if arguments.json:
        print_json(
            {"targets": [target.plain() for target in report.targets], "seconds": report.seconds}
        )
    else:
        _print(report)
    for text in report.problems:
        sys.stderr.write(f"tvbrdf: error: {text}\n")
    return 1 if report.problems else 0


def _settings(arguments: argparse.Namespace) -> Settings:
    """Return what is asked for, checked before anything is read."""
    from ..refit.settings import AUTO, Settings, check_settings, read_calibration_file

    calibration = arguments.calibration
    settings = Settings(
        model=arguments.model,
        metric=arguments.metric,
        loss=arguments.loss,
        method=arguments.method,
        fixed=None if arguments.fixed is None or arguments.model == AUTO else _fixed(arguments),
        calibration=None if calibration is None else read_calibration_file(calibration),
        start=arguments.start,
    )
    if arguments.fixed and arguments.model == AUTO:
        from ..errors import RunError

        raise RunError("--fixed needs a model: with --model auto, parameters differ")
    check_settings(settings)
    return settings


def _fixed(arguments: argparse.Namespace) -> dict[str, float]:
    """Return the values of ``key:=value`` words; a key may stand for three channels."""
    from tvbrdf_nodes.fitter.node import FitterParameters

    from ..arguments import parse_assignments
    from .model._models import find_model, shared_name, values_of

    model = find_model(arguments.model or FitterParameters().model)
    given = parse_assignments(arguments.fixed)
    values = values_of(model, arguments.fixed)
    return {
        parameter.name: values[parameter.name]
        for parameter in model.parameters
        if parameter.name in given or shared_name(parameter) in given
    }


@contextmanager
def progress_bar() -> Iterator[Callable[[float, str], None]]:
    """Give what shows a progress bar on a terminal, and nothing elsewhere."""
    if not sys.stderr.isatty():
        yield lambda fraction, text: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    progress = Progress(
        BarColumn(bar_width=30),
        TextColumn("{task.percentage:3.0f} %", markup=False),
        TextColumn("{task.description}", markup=False),
        console=Console(stderr=True, highlight=False, markup=False),
        auto_refresh=False,  # its own thread would forbid to fork
        transient=True,
    )
    with progress:
        task = progress.add_task("", total=1.0)
        shown: tuple[float, str] = (-1.0, "")

        def tell(fraction: float, text: str) -> None:
            nonlocal shown
            if fraction - shown[0] >= SMALLEST_STEP or (not fraction and text != shown[1]):
                shown = fraction, text
                progress.update(task, completed=fraction, description=text)
                progress.refresh()

        yield tell


def _print(report: Report) -> None:
    rows = [
        {
            "input": target.source.name or str(target.source),
            "scans": target.scans,
            "refitted_now": target.refitted,
            "not_whole": len(target.unfinished) or "",
            "results": str(target.folder) if target.scans else "",
        }
        for target in report.targets
    ]
    print_table(rows, ("input", "scans", "refitted_now", "not_whole", "results"))
    remarks = [
        f"{target.source}: scan {scan} is not refitted: {reason}"
        for target in report.targets
        for scan, reason in target.unfinished.items()
    ]
    for text in remarks[:SHOWN_REMARKS]:
        print(text)
    if len(remarks) > SHOWN_REMARKS:
        print(f"and {len(remarks) - SHOWN_REMARKS} more (all with --json)")
    if report.refitted and report.seconds > 0:
        rate = report.refitted / report.seconds
        print(f"{report.refitted} scans in {report.seconds:.1f} s ({rate:.3g} a second)")
