"""``tvbrdf model check``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from .._common import Subparsers, add_json_option, add_verb, print_json, print_table
from ._models import find_model, values_of

if TYPE_CHECKING:
    from tvbrdf_fitting.properties.report import AlbedoRow, ModelReport


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "check",
        run,
        "check a model: reciprocity, sign, albedos, energy; status 1 if it creates energy, breaks "
        "a promise or is outside its bounds",
    )
    parser.add_argument("name", help="a model, a sum or an alias, e.g. oren_nayar or ON+TS")
    parser.add_argument(
        "arguments",
        nargs="*",
        metavar="key:=value",
        help="parameters, e.g. sigma_d:=0.3, or kd:=1 for all channels (default: typical values)",
    )
    parser.add_argument(
        "--angle",
        type=_angle,
        action="append",
        metavar="DEG",
        help="angle of the light for the table of albedos; may be repeated",
    )
    parser.add_argument(
        "--tolerance",
        type=_tolerance,
        default=1e-8,
        metavar="X",
        help="relative error of the albedos (default 1e-8)",
    )
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from tvbrdf_fitting.properties.report import ANGLES_DEG, check_model

    from ...errors import RunError

    model = find_model(arguments.name)
    values = values_of(model, arguments.arguments)
    try:
        report = check_model(
            model,
            model.from_mapping(values),
            angles_deg=arguments.angle or ANGLES_DEG,
            tolerance=arguments.tolerance,
        )
    except ValueError as error:
        raise RunError(str(error)) from error
    if arguments.json:
        print_json(report.as_dict())
    else:
        _print(report)
    return 0 if report.good else 1


def _print(report: ModelReport) -> None:
    print(report.model)
    for name, value in report.parameters.items():
        print(f"  {name} = {value:g}")
    for kind in dict.fromkeys(row.kind for row in report.albedo):
        what = "light" if kind.startswith("directional") else "view"
        what += " (or view: it is reciprocal)" if report.reciprocal else ""
        print(f"\nAlbedo, {kind}, against the angle of the {what} in degrees")
        rows = [_row(row, report) for row in report.albedo if row.kind == kind]
        print_table(rows, [*rows[0]])
    names = ("B", "G", "R")
    whole = zip(names, report.bihemispherical, report.bihemispherical_error, strict=True)
    told = ", ".join(f"{n} {v:#.6g} ± {e:.0e}" for n, v, e in whole)
    print(f"\nBihemispherical reflectance: {told}")
    largest = zip(names, report.largest_albedo, strict=True)
    print(f"Largest albedo: {', '.join(f'{n} {v:#.5g}' for n, v in largest)}")
    print(f"Exchange of light and view changes it by at most {report.reciprocity_defect.value:.1e}")
    print(f"Smallest value: {report.smallest.value:.3g} 1/sr")
    print()
    for finding in report.findings:
        print(f"! {finding}")
    print("good" if report.good else "not good")


def _row(row: AlbedoRow, report: ModelReport) -> dict[str, Any]:
    where = {"angle": f"{row.theta_deg:g}"}
    if not report.isotropic:
        where["azimuth"] = f"{row.phi_deg:g}"
    values = {name: f"{value:#.8g}" for name, value in zip("BGR", row.value, strict=True)}
    return {**where, **values, "error": f"{max(row.error):.0e}"}


def _angle(text: str) -> float:
    value = float(text)
    if not 0 <= value < 90:
        raise argparse.ArgumentTypeError(f"{text} is not an angle of at least 0 and below 90")
    return value


def _tolerance(text: str) -> float:
    value = float(text)
    if not 1e-12 <= value <= 1e-2:
        raise argparse.ArgumentTypeError(f"{text} is not between 1e-12 and 1e-2")
    return value
