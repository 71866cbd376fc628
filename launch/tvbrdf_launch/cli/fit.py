"""``tvbrdf fit``: fit published scans, print parameters and errors, draw what was fitted."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ._common import Subparsers, add_json_option, add_verb, count, print_json

if TYPE_CHECKING:
    from tvbrdf_rendering.fit_report import FittedSample

    from ._fit_samples import Request, Target

DEFAULT_MODEL = "ON+TS"
AXES = ("auto", "linear", "log")
FITS_FILE = "fit.json"


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(subparsers, "fit", run, "fit a reflectance model to measured scans")
    parser.add_argument(
        "path",
        type=Path,
        help="a scan file (all cameras of that scan), a sample's folder, or a folder of samples",
    )
    parser.add_argument(
        "--scan", type=count, metavar="N", help="of a sample, this scan only (default: all)"
    )
    parser.add_argument(
        "--model",
        default=DEFAULT_MODEL,
        metavar="NAME",
        help="as 'tvbrdf model list' has them, or 'auto': the simplest one that explains the data "
        f"(default {DEFAULT_MODEL})",
    )
    parser.add_argument(
        "--scan-by-scan",
        action="store_true",
        help="with --model auto: a model for each scan instead of one for all",
    )
    parser.add_argument(
        "--metric",
        default="radiance",
        metavar="NAME",
        help="what counts as equal misfit: radiance (default), cosine_weighted, log, relative",
    )
    parser.add_argument(
        "--loss",
        default="least_squares",
        metavar="NAME",
        help="least_squares (default), or against stray values huber, cauchy",
    )
    parser.add_argument(
        "--method", metavar="NAME", help="of solving: separable (default), paper, trust_region"
    )
    parser.add_argument(
        "--fix",
        action="append",
        default=[],
        metavar="key:=value",
        help="a parameter that is known, e.g. sigma_d:=0.3, or kd:=1 for all channels; repeatable",
    )
    parser.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="constants of the cameras (default: tvBrdf-calibration.txt of the sample, if any)",
    )
    parser.add_argument(
        "--grid",
        action="store_true",
        help="fit the published grid also where the database has kept the frames",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="for pictures and JSON (default: PATH_fit beside)"
    )
    parser.add_argument("--no-pictures", action="store_true", help="write no pictures and no JSON")
    parser.add_argument(
        "--strict", action="store_true", help="end with status 1 if anything in the files is odd"
    )
    parser.add_argument(
        "--axis", choices=AXES, default="auto", help="of radiance in pictures (default auto)"
    )
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from ..errors import RunError
    from ._fit_samples import find_targets, fit_sample

    targets = find_targets(arguments.path, arguments.scan)
    request = _request(arguments)
    samples: list[FittedSample] = []
    written: dict[str, dict[str, Path]] = {}
    failures: list[str] = []
    for target in targets:
        try:
            sample = fit_sample(target, request)
        except RunError as error:
            failures.append(str(error))
            continue
        failures += sample.failures
        samples.append(sample)
        if not sample.scans:
            continue
        if not arguments.json:
            _print_sample(sample, first=len(samples) == 1)
        if not arguments.no_pictures:
            out = _out_folder(arguments, target, len(targets))
            written[str(target.folder)] = files = _draw(sample, out, arguments.axis)
            if not arguments.json:
                _print_files(files)
    if len(failures) == 1 and not any(sample.scans for sample in samples):
        raise RunError(failures[0])
    if arguments.json:
        print_json(
            {
                "path": str(arguments.path),
                "samples": [sample.as_dict() for sample in samples],
                "failures": failures,
                "written": written,
            }
        )
    for failure in failures:
        sys.stderr.write(f"tvbrdf: error: {failure}\n")
    odd = any(sample.all_remarks for sample in samples)
    return 1 if failures or (arguments.strict and odd) else 0


def _request(arguments: argparse.Namespace) -> Request:
    """Return what is asked for, or raise :class:`RunError` before anything is read."""
    from tvbrdf_fitting.metrics import METRICS
    from tvbrdf_fitting.solve.losses import LOSSES
    from tvbrdf_fitting.solve.solvers import SOLVERS

    from ..errors import RunError, did_you_mean
    from ._fit_samples import AUTO, Request

    options: dict[str, Any] = {"metric": arguments.metric, "loss": arguments.loss}
    if arguments.method is not None:
        options["method"] = arguments.method
    for name, known in (("metric", METRICS), ("loss", LOSSES), ("method", SOLVERS)):
        if name in options and options[name] not in known:
            hint = did_you_mean(options[name], known, "there are")
            raise RunError(f"unknown {name} {options[name]!r}; {hint}")
    model = arguments.model
    if model == AUTO and arguments.fix:
        raise RunError(
            "--fix needs a model: with --model auto, parameters differ from rung to rung"
        )
    if model != AUTO:
        from .model._models import find_model

        chosen = find_model(model)
        if chosen.delta:
            raise RunError(f"model {chosen.name} is a delta function: for rendering, not for fits")
        model, options["fixed"] = chosen.name, _fixed(chosen, arguments.fix)
    return Request(model, options, arguments.scan_by_scan, arguments.calibration, arguments.grid)


def _fixed(model: Any, words: list[str]) -> dict[str, float]:
    """Return the values that ``key:=value`` words fix; a key may stand for three channels."""
    from ..arguments import parse_assignments
    from .model._models import shared_name, values_of

    given = parse_assignments(words)
    values = values_of(model, words)
    return {
        parameter.name: values[parameter.name]
        for parameter in model.parameters
        if parameter.name in given or shared_name(parameter) in given
    }


def _out_folder(arguments: argparse.Namespace, target: Target, targets: int) -> Path:
    """Where a sample's pictures go: beside the data, or where the user wants them."""
    path: Path = arguments.path.resolve()
    if targets == 1:
        beside = target.folder.resolve().parent if target.file is None else path.parent
        return arguments.out or beside / f"{target.label}_fit"
    return (arguments.out or path.parent / f"{path.name}_fit") / target.label


def _draw(sample: FittedSample, out: Path, axis: Any) -> dict[str, Path]:
    from tvbrdf_rendering.fit_report import write_fits, write_pictures

    from ..errors import RunError

    try:
        files = {"fit": write_fits(out / FITS_FILE, sample.as_dict())}
        return files | write_pictures(sample, out, axis=axis)
    except OSError as error:
        raise RunError(
            f"{out}: {error.strerror or error}; give another folder with --out, or --no-pictures"
        ) from error


def _print_sample(sample: FittedSample, *, first: bool) -> None:
    from ._fit_tables import scan_lines, series_lines

    if not first:
        print()
    lines = scan_lines(sample) if len(sample.scans) == 1 else series_lines(sample)
    print("\n".join(lines), flush=True)


def _print_files(files: dict[str, Path]) -> None:
    width = max(map(len, files))
    print()
    for name, path in files.items():
        print(f"{name:{width}}  {path}")
