"""What is asked of ``tvbrdf design``: material, accuracy and rig, from words to objects."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tvbrdf_fitting.design.fisher_information import Rig
    from tvbrdf_fitting.design.search import Accuracy
    from tvbrdf_fitting.models import ReflectanceModel


def find_material(arguments: argparse.Namespace) -> tuple[ReflectanceModel, dict[str, float], str]:
    """Return the model, its parameters, and where they are from."""
    from tvbrdf_nodes.world.scene import available

    from ...errors import RunError
    from ..model._models import find_model, shared_name, values_of

    words = list(arguments.arguments)
    name: str = arguments.material
    if ":=" in name:  # no material, only parameters
        words.insert(0, name)
        name = "ON+TS"
    known: Mapping[str, float] = {}
    suffix = name.rpartition(".")[2]
    is_sample = name in available("samples") or suffix in {"yaml", "yml"} or name[:9] == "measured:"
    if arguments.scan is not None and suffix != "json":
        raise RunError("--scan needs the .json file of a fit")
    if arguments.at_s is not None and not is_sample:
        raise RunError("--at-s needs a sample, whose parameters change with time")
    if suffix == "json":
        model_name, known = _from_fit(name, arguments.scan)
        source = f"fit {name}" + (f", scan {arguments.scan}" if arguments.scan else "")
    elif is_sample:
        time_s = arguments.at_s or 0.0
        model_name, known = _from_sample(name, time_s)
        source = f"sample {name} at {time_s:g} s"
    else:
        try:
            model_name = find_model(arguments.model or name).name
        except RunError as error:
            samples = ", ".join(available("samples"))
            raise RunError(f"{error}; nor is it a sample: {samples}") from error
        source = "typical values"
    model = find_model(arguments.model or model_name)
    given = {word.partition(":=")[0] for word in words}
    values = values_of(model, words)
    for p in model.parameters:
        common = shared_name(p)
        if not {p.name, common} & given and {p.name, common} & set(known):
            values[p.name] = known[p.name if p.name in known else common]
    unmeasured = [name for name, value in values.items() if math.isnan(value)]
    if unmeasured:
        raise RunError(f"{source}: no value of {', '.join(unmeasured)}; set it with key:=value")
    return model, values, source + (f" with {' '.join(words)}" if words else "")


def _from_sample(name: str, time_s: float) -> tuple[str, dict[str, float]]:
    from tvbrdf_nodes.world.sample import SampleError, make_sample
    from tvbrdf_nodes.world.scene import SceneError, load_scene

    from ...errors import RunError

    try:
        truth = make_sample(load_scene(name, "ideal", 1).sample).truth(time_s)
    except (SceneError, SampleError) as error:
        raise RunError(str(error)) from error
    if truth is None:
        raise RunError(
            f"{name}: nobody knows the parameters of a measured sample; fit it, and give the fit"
        )
    model, names, values = truth
    return model, dict(zip(names, values, strict=True))


def _from_fit(path: str, scan: int | None) -> tuple[str, dict[str, float]]:
    """Return the model and the parameters of a fit as JSON, NaN for what was not measured."""
    import json
    from pathlib import Path

    from ...errors import RunError

    try:
        fits = [*_fits_in(json.loads(Path(path).read_text()))]
        if scan is not None:
            fits = [(number, fit) for number, fit in fits if number == scan]
        if len(fits) != 1:
            what = "has no fit" if not fits else f"has {len(fits)} fits: choose one with --scan"
            raise RunError(f"{path}{'' if scan is None else f', scan {scan}'}: {what}")
        ((_, fit),) = fits
        pairs = zip(fit["parameter_names"], fit["values"], strict=True)
        return str(fit["model"]), {
            str(name): math.nan if value is None else float(value) for name, value in pairs
        }
    except json.JSONDecodeError as error:
        raise RunError(f"{path}: not JSON: {error}") from error
    except (TypeError, KeyError, ValueError) as error:
        raise RunError(
            f"{path}: is no fit: expected model, parameter_names and values, as 'tvbrdf fit' "
            f"writes them"
        ) from error


def _fits_in(content: Any, scan: int | None = None) -> Iterator[tuple[int | None, dict[str, Any]]]:
    """Yield fits with their scan's number: a fit, a model choice, or what ``tvbrdf fit`` writes."""
    if isinstance(content, list):
        for each in content:
            yield from _fits_in(each, scan)
    elif isinstance(content, dict):
        if "parameter_names" in content:
            yield scan, content
            return
        for key in ("samples", "scans", "fit", "result"):
            yield from _fits_in(content.get(key), content.get("scan", scan))


def rig_of(arguments: argparse.Namespace) -> Rig:
    """Return the paper's rig with what was said of it."""
    from dataclasses import fields

    from tvbrdf_fitting.design.fisher_information import NoiseModel, Rig

    from ...errors import RunError, did_you_mean

    known = [field.name for field in fields(NoiseModel)]
    noise: dict[str, float] = {}
    for word in arguments.noise:
        name, value = _assigned(word, "--noise")
        if name not in known:
            raise RunError(f"--noise: no {name!r}; {did_you_mean(name, known, 'there are')}")
        noise[name] = value
    given: dict[str, Any] = {"noise": NoiseModel(**noise)}
    if arguments.camera_angles is not None:
        given["camera_angles_deg"] = tuple(arguments.camera_angles)
    if arguments.tilt is not None:
        given["tilt_deg"] = arguments.tilt
    if arguments.sweep is not None:
        if len(arguments.sweep) != 2:
            raise RunError("--sweep: expected two angles, as in --sweep=-90,90")
        given["sweep_deg"] = tuple(arguments.sweep)
    return Rig(**given)


def accuracy_of(model: ReflectanceModel, words: Sequence[str]) -> dict[str, Accuracy]:
    """Return what ``NAME=VALUE`` words want: a number, a part as 5%, or any."""
    from tvbrdf_fitting.design.search import Accuracy

    from ...errors import RunError

    wanted: dict[str, Accuracy] = {}
    for word in words:
        name, separator, text = word.partition("=")
        if separator and text == "any":
            accuracy = Accuracy(math.inf)
        else:
            _, number = _assigned(word, "--accuracy")
            accuracy = Accuracy(number, relative=text.endswith("%"))
            if not number > 0:
                raise RunError(f"--accuracy: {word!r} must be above 0")
        wanted |= dict.fromkeys(names_of(model, [name]), accuracy)
    return wanted


def names_of(model: ReflectanceModel, given: Sequence[str]) -> list[str]:
    """Return parameters by their names, or those that three channels share."""
    from ...errors import RunError, did_you_mean
    from ..model._models import shared_name

    groups: dict[str, list[str]] = {}
    for p in model.parameters:
        for name in {p.name, shared_name(p)}:
            groups.setdefault(name, []).append(p.name)
    for name in given:
        if name not in groups:
            hint = did_you_mean(name, groups, "it has")
            raise RunError(f"model {model.name} has no parameter {name!r}; {hint}")
    return [one for name in given for one in groups[name]]


def _assigned(word: str, option: str) -> tuple[str, float]:
    from ...errors import RunError

    name, _, text = word.partition("=")
    try:
        number = fraction(text)
    except ValueError:
        raise RunError(f"{option}: {word!r} is not of the form NAME=NUMBER or NAME=5%") from None
    return name, number


def finite(text: str) -> float:
    """Return a finite number."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not finite")
    return number


def fraction(text: str) -> float:
    """Return a finite number; 5% is 0.05."""
    return finite(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)


def word_list(text: str) -> list[str]:
    """Return what stands between commas."""
    return [word.strip() for word in text.split(",") if word.strip()]


def number_list(text: str) -> list[float]:
    """Return numbers between commas, for argparse."""
    return [float(word) for word in word_list(text)]


def integer_list(text: str) -> list[int]:
    """Return whole numbers between commas, for argparse."""
    return [int(word) for word in word_list(text)]


def not_negative(text: str) -> int:
    """Return a whole number of 0 or more, for argparse."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is below 0")
    return value
