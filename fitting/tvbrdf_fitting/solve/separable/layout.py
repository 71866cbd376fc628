"""Which models the compiled search can fit, and how their parameters and vectors are laid out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from ...geometry import FloatArray
from ...models import Lambert, OrenNayar, ReflectanceModel, SumModel, TorranceSparrow
from ...models.oren_nayar_short import OrenNayarShort
from ...problem import Problem

Geometry = tuple[FloatArray, FloatArray, FloatArray]
"""What belongs to the directions alone: vectors, f, q."""
Data = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""What the compiled functions take: the same, radiance, weight."""
_FULL, _SHORT_E = (0.33, 0.17), 0.0


@dataclass(frozen=True, eq=False)
class Layout:
    """How a model's parameters become the search's coordinates.

    Attributes
    ----------
    form
        (2,) constant of C1 and factor of E.
    where
        (6,) or (8,) index of the model's parameter of each coordinate, -1 where the model has
        none (then it is 0: no lobe, or no roughness).
    diffuse, specular
        Position of the part among the model's, -1 for none.
    """

    form: FloatArray
    where: tuple[int, ...]
    diffuse: int
    specular: int


@cache
def layout_of(model: ReflectanceModel) -> Layout | None:
    """Return the layout of an Oren-Nayar or Lambert part, a Torrance-Sparrow lobe, or both.

    None for every other model.
    """
    parts = model.parts if isinstance(model, SumModel) else (model,)
    diffuse = [
        i for i, p in enumerate(parts) if isinstance(p, Lambert | OrenNayar | OrenNayarShort)
    ]
    specular = [i for i, p in enumerate(parts) if isinstance(p, TorranceSparrow)]
    if len(diffuse) > 1 or len(specular) > 1 or len(diffuse) + len(specular) < len(parts):
        return None
    first, second = (group[0] if group else -1 for group in (diffuse, specular))
    kd, roughness, form = [-1, -1, -1], -1, _FULL
    if diffuse:
        start, part = _start(model, first), parts[first]
        kd = [start, start + 1, start + 2]
        roughness = -1 if isinstance(part, Lambert) else start + 3
        form = (part.constant, _SHORT_E) if isinstance(part, OrenNayarShort) else _FULL
    ks, width = [-1], -1
    if specular:
        start, count = _start(model, second), len(parts[second].parameters) - 1
        ks, width = list(range(start, start + count)), start + count
    where = (*kd, roughness, *ks, width)
    return Layout(np.array(form), where, first, second)


def data_of(problem: Problem, layout: Layout) -> Data:
    """Return the vectors of a problem that the compiled functions take."""
    return *geometry_of(problem, layout), problem.radiance, problem.weight


def geometry_of(problem: Problem, layout: Layout) -> Geometry:
    """Return vectors (3, n), f (n,) and q (n,) of a problem's directions.

    Those of the last directions are kept, for fits that are repeated with other weights.
    """
    prepared, to_radiance = problem.prepared, problem.to_radiance
    key = id(layout), id(prepared), id(to_radiance)
    if (kept := _LAST.get(key)) is not None:
        return kept[0]
    geometry = _geometry(problem.model, layout, prepared, to_radiance * (1 / np.pi))
    _LAST.clear()
    _LAST[key] = geometry, prepared, to_radiance  # alive, so that the ids stay theirs
    return geometry


_LAST: dict[tuple[int, int, int], tuple[Geometry, Any, FloatArray]] = {}


def _geometry(
    model: ReflectanceModel, layout: Layout, prepared: Any, cosine: FloatArray
) -> Geometry:
    parts = model.parts if isinstance(model, SumModel) else (model,)
    prepared = prepared if isinstance(model, SumModel) else (prepared,)
    vectors = np.zeros((3, len(cosine)))
    if layout.diffuse >= 0:
        vectors[0] = cosine
        part, basis = parts[layout.diffuse], prepared[layout.diffuse]
        if isinstance(part, OrenNayarShort):
            np.multiply(basis, cosine, out=vectors[1])
        elif isinstance(part, OrenNayar):
            np.multiply(basis.g1, cosine, out=vectors[1])
            np.multiply(basis.g2, cosine, out=vectors[2])
    if layout.specular < 0:
        return vectors, np.zeros(len(cosine)), np.zeros(len(cosine))
    lobe = prepared[layout.specular]
    return vectors, lobe.factor * (np.pi * cosine), lobe.theta_h * lobe.theta_h


def _start(model: ReflectanceModel, part: int) -> int:
    return model.slices[part].start if isinstance(model, SumModel) else 0
