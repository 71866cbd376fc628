"""What the verbs of ``tvbrdf model`` share: finding a model, naming and setting its parameters."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tvbrdf_fitting.models import Parameter, ReflectanceModel


def find_model(name: str) -> ReflectanceModel:
    """Return a model by name or alias, or raise :class:`RunError`."""
    from tvbrdf_fitting.models import get_model

    from ...errors import RunError

    try:
        return get_model(name)
    except ValueError as error:
        raise RunError(str(error)) from error


def shared_name(parameter: Parameter) -> str:
    """Return the name of a parameter without its channel: kd of kd_b, ks_2 of ks_g_2."""
    from tvbrdf_fitting.geometry import CHANNELS

    if parameter.channel is None:
        return parameter.name
    return re.sub(rf"_{CHANNELS[parameter.channel]}(?=_\d+$|$)", "", parameter.name)


def short_names(parameters: Iterable[Parameter]) -> str:
    """Return the names on one line, those of three channels as one."""
    names = [shared_name(p) + ("[bgr]" if p.channel is not None else "") for p in parameters]
    return " ".join(dict.fromkeys(names))


def values_of(model: ReflectanceModel, words: Iterable[str]) -> dict[str, float]:
    """Return the typical values with those that ``key:=value`` words set.

    A key is a parameter, or the common name of three channels' (``kd`` for ``kd_b, kd_g, kd_r``).
    """
    from ...arguments import parse_assignments
    from ...errors import RunError, did_you_mean

    values = model.as_mapping(model.typical)
    groups: dict[str, list[str]] = {name: [name] for name in values}
    for parameter in model.parameters:
        if parameter.channel is not None:
            groups.setdefault(shared_name(parameter), []).append(parameter.name)
    for key, text in parse_assignments(words).items():
        if key not in groups:
            hint = did_you_mean(key, groups, "it has")
            raise RunError(f"model {model.name} has no parameter {key!r}; {hint}")
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise RunError(f"parameter {key} is {text!r}, expected a finite number")
        values.update(dict.fromkeys(groups[key], number))
    return values


def plain(value: float) -> Any:
    """Return a number as JSON can have it: None for one that is not finite."""
    return float(value) if math.isfinite(value) else None
