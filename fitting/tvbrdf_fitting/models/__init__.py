"""Reflectance models, one file each, found by name."""

from __future__ import annotations

from functools import cache

from .base import Parameter, ReflectanceModel, Term, Transform
from .combination import SumModel
from .dust import DustForm, DustOverSurface
from .lambert import Lambert
from .lobe import Lobe
from .oren_nayar import OrenNayar
from .registry import Registration, build, label, registered, split
from .torrance_sparrow import TorranceSparrow

SURFACE = "oren_nayar+torrance_sparrow"
DUST = f"dust+{SURFACE}"
COLOURED = f"{SURFACE}(coloured)"
ALIASES = {"ON+TS": SURFACE, "dust": DUST}
"""Of whole models; those of parts, which sums may use, are in their registrations."""


def get_model(name: str, *, form: DustForm | None = None) -> ReflectanceModel:
    """Return a model by name or alias.

    Parameters
    ----------
    name
        One model or a sum, ``"lambert"``, ``"oren_nayar+torrance_sparrow(coloured)"``, with options
        in brackets and parts by name or alias, ``"ON+TS(coloured)"``. ``"dust"``, or with an option
        ``"dust(paper)"``, lies over ON+TS unless a surface is named. `registered()` lists the
        parts.
    form
        For "dust" over ON+TS only: "reciprocal" (default), "paper" or "blinn"; see `models.dust`.

    Raises
    ------
    ValueError
        Unknown name or option (the message lists the known ones), or a form for a model that has
        none.
    """
    model = _build(name)
    if form is not None:
        if model.name != DUST:
            raise ValueError(f"model {name!r} has no forms; only {DUST!r} has")
        model = _build(DustOverSurface(OrenNayar(), TorranceSparrow(), form).name)
    return model


@cache
def _build(name: str) -> ReflectanceModel:
    """Return the one model that all names of it have."""
    parts = split(name)
    alone = len(parts) == 1 and parts[0][0].over
    model = build(f"{name}+{SURFACE}" if alone else name)
    return model if model.name == name else _build(model.name)


@cache
def catalogue() -> tuple[str, ...]:
    """Return the names of every model with each of its options, and the sums in common use."""
    names: list[str] = []
    for entry in registered().values():
        below = f"+{SURFACE}" if entry.over else ""
        names += [label(entry.name) + below]
        names += [label(entry.name, option) + below for option in entry.options]
    return (*names, SURFACE, COLOURED)


__all__ = [
    "ALIASES",
    "COLOURED",
    "DUST",
    "SURFACE",
    "DustForm",
    "DustOverSurface",
    "Lambert",
    "Lobe",
    "OrenNayar",
    "Parameter",
    "ReflectanceModel",
    "Registration",
    "SumModel",
    "Term",
    "TorranceSparrow",
    "Transform",
    "catalogue",
    "get_model",
    "registered",
    "split",
]
