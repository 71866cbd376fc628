"""``tvbrdf design``: how few lights, cameras and exposures a material needs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from .._common import Subparsers, add_json_option, add_verb, count, print_json
from ._asked import finite, fraction, integer_list, not_negative, number_list, word_list

if TYPE_CHECKING:
    from tvbrdf_fitting.design.search import DesignStudy
    from tvbrdf_fitting.design.simulation import Trial

EPILOG = """\
The material is a sample (tvbrdf samples), a sample's .yaml file, tvbrdf fit's .json, or a model
(tvbrdf model list) with its typical values; key:=value sets parameters, kd:=0.3 all three channels.
Wanted by default: 5 % of amplitudes and widths, 0.03 rad of sigma_d. Deviations are those of a fit
of one scan with the lights where they stand worst. "images" are frames of all cameras.
"""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "design",
        run,
        "find the fewest lights, cameras and exposures for a wanted accuracy of a material",
    )
    parser.epilog = EPILOG
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "material", nargs="?", default="ON+TS", help="sample, fit or model (default: ON+TS)"
    )
    parser.add_argument("arguments", nargs="*", metavar="key:=value", help="parameters")
    _add_material(parser)
    _add_rig(parser)
    parser.add_argument(
        "--most-lights", type=count, default=361, metavar="N", help="in a sweep (default 361)"
    )
    parser.add_argument(
        "--simulate",
        type=not_negative,
        default=200,
        metavar="N",
        help="noisy scans to fit of what is proposed (default 200; 0: none)",
    )
    parser.add_argument("--seed", type=not_negative, default=0, help="of their noise (default 0)")
    add_json_option(parser)


def _add_material(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--model", metavar="NAME", help="model to fit, if not the material's own")
    parser.add_argument(
        "--accuracy",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="wanted deviation: ks=5%%, sigma_d=0.02, or any; may be given again",
    )
    parser.add_argument(
        "--fixed", type=word_list, default=[], metavar="NAMES", help="known parameters, as in w,g"
    )
    parser.add_argument("--scan", type=count, metavar="N", help="of a fit's file that has several")
    parser.add_argument(
        "--at-s", type=finite, metavar="SECONDS", help="time of a sample (default 0)"
    )


def _add_rig(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--cameras", type=integer_list, metavar="LIST", help="to choose from (default: all)"
    )
    parser.add_argument(
        "--exposures",
        type=number_list,
        default=[0.2, 4.0, 32.0],
        metavar="LIST",
        help="in ms, to choose from (default 0.2,4,32)",
    )
    parser.add_argument(
        "--camera-angles", type=number_list, metavar="LIST", help="degrees (default 0,25,50,75)"
    )
    parser.add_argument("--tilt", type=float, metavar="DEGREES", help="of the plate (default 12)")
    parser.add_argument(
        "--sweep", type=number_list, metavar="LIST", help="its ends in degrees (default -90,90)"
    )
    parser.add_argument(
        "--noise",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="pixels, read_noise_e, electrons_per_radiance_ms, saturation_radiance_ms, or "
        "frame_relative_std (default: the simulated rig's); may be given again",
    )
    parser.add_argument(
        "--gain-error",
        type=fraction,
        default=0.0,
        metavar="PART",
        help="of each camera, as in 0.5%%",
    )
    parser.add_argument(
        "--light-error", type=float, default=0.0, metavar="DEGREES", help="of a sweep's light"
    )
    parser.add_argument(
        "--tilt-error", type=float, default=0.0, metavar="DEGREES", help="of the plate's tilt"
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb."""
    from tvbrdf_fitting.design.search import find_designs
    from tvbrdf_fitting.design.simulation import confirm
    from tvbrdf_fitting.inference.nuisances import CommonErrors

    from ...errors import RunError
    from ._asked import accuracy_of, find_material, names_of, rig_of
    from ._told import as_dict, print_study

    model, parameters, source = find_material(arguments)
    try:
        common = CommonErrors(
            light_angle_std_deg=arguments.light_error,
            gain_relative_std=arguments.gain_error,
            plate_tilt_std_deg=arguments.tilt_error,
        )
        study = find_designs(
            model,
            parameters,
            rig=rig_of(arguments),
            accuracy=accuracy_of(model, arguments.accuracy),
            cameras=arguments.cameras,
            exposures_ms=arguments.exposures,
            fixed=names_of(model, arguments.fixed),
            common_errors=common,
            most_lights=arguments.most_lights,
        )
        trials: tuple[Trial, ...] = ()
        if arguments.simulate:
            trials = confirm(study, scans=arguments.simulate, seed=arguments.seed)
    except ValueError as error:
        raise RunError(str(error)) from error
    reason = _reason(study, trials)
    if arguments.json:
        print_json(as_dict(study, trials, source) | {"reason": reason})
    else:
        print_study(study, trials, source)
    if reason:
        sys.stdout.flush()
        sys.stderr.write(f"tvbrdf: error: {reason}\n")
    return 1 if reason else 0


def _reason(study: DesignStudy, trials: Sequence[Trial]) -> str:
    """Why there is nothing to propose; empty where there is."""
    if trials and not trials[-1].reached:
        last = trials[-1].design
        return (
            f"simulated scans do not reach the accuracy, although predicted: {len(trials)} designs "
            f"were tried, up to {last.lights} lights; the fit's errors are not linear here"
        )
    return study.reason()
