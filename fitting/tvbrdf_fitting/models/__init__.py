"""Reflectance models, one file each, and the one place where they are found by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from .base import Parameter, ReflectanceModel, Term, Transform
from .combination import SumModel
from .dust import DustForm, DustOverSurface
from .oren_nayar import OrenNayar
from .torrance_sparrow import TorranceSparrow

SURFACE = "oren_nayar+torrance_sparrow"
DUST = "dust+oren_nayar+torrance_sparrow"


def _surface() -> ReflectanceModel:
    return SumModel([OrenNayar(), TorranceSparrow()])


def _dust(form: DustForm) -> Callable[[], ReflectanceModel]:
    return lambda: DustOverSurface(OrenNayar(), TorranceSparrow(), form)


MODELS: dict[str, Callable[[], ReflectanceModel]] = {
    "oren_nayar": OrenNayar,
    "torrance_sparrow": TorranceSparrow,
    SURFACE: _surface,
    DUST: _dust("reciprocal"),
    f"dust(paper)+{SURFACE}": _dust("paper"),
    f"dust(blinn)+{SURFACE}": _dust("blinn"),
}
"""Every model by its full name, which is also what is recorded with fitted parameters."""
ALIASES = {"ON+TS": SURFACE, "dust": DUST}


def get_model(name: str, *, form: DustForm | None = None) -> ReflectanceModel:
    """Return a model by name or alias.

    Parameters
    ----------
    name
        A name of `MODELS` or an alias: "ON+TS", "dust".
    form
        For dust only: "reciprocal" (default), "paper" or "blinn"; see `models.dust`.

    Raises
    ------
    ValueError
        Unknown name (the message lists the known ones), or a form for a model that has none.
    """
    full = ALIASES.get(name, name)
    if form is not None:
        if full != DUST:
            raise ValueError(f"model {name!r} has no forms; only {DUST!r} has")
        return _build(DustOverSurface(OrenNayar(), TorranceSparrow(), form).name)
    return _build(full)


@cache
def _build(name: str) -> ReflectanceModel:
    if name not in MODELS:
        known = ", ".join([*MODELS, *(f"{a} (= {full})" for a, full in ALIASES.items())])
        raise ValueError(f"unknown model {name!r}; known models: {known}")
    return MODELS[name]()


__all__ = [
    "ALIASES",
    "DUST",
    "MODELS",
    "SURFACE",
    "DustForm",
    "DustOverSurface",
    "OrenNayar",
    "Parameter",
    "ReflectanceModel",
    "SumModel",
    "Term",
    "TorranceSparrow",
    "Transform",
    "get_model",
]
