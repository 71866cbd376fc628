"""Sums of models: a diffuse one and any number of specular lobes, added."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..geometry import FloatArray
from .base import Parameter, ReflectanceModel, Term
from .lobe import Lobe, Twin


class SumModel(ReflectanceModel):
    """The sum of several models' BRDFs; parameters are theirs, one model after the other.

    Where two parts have parameters of the same name, the later ones get `_2`, `_3`: a second lobe
    of one kind has `ks_2`, `inverse_sigma_s_2`.
    """

    def __init__(self, parts: Sequence[ReflectanceModel]) -> None:
        self.parts = tuple(parts)
        self.name = "+".join(part.name for part in parts)
        self.reciprocal = all(part.reciprocal for part in parts)
        self.nonnegative = all(part.nonnegative for part in parts)
        self.isotropic = all(part.isotropic for part in parts)
        self.delta = any(part.delta for part in parts)
        parameters: list[Parameter] = []
        terms: list[Term] = []
        confounded: list[tuple[str, str]] = []
        self.slices: list[slice] = []
        seen: Counter[str] = Counter()
        for index, part in enumerate(self.parts):
            names = _unique_names(part, seen)
            self.slices.append(slice(len(parameters), len(parameters) + len(part.parameters)))
            parameters += [_renamed(p, names) for p in part.parameters]
            terms += [_renamed_term(through(term, index), names) for term in part.terms]
            confounded += [(names[one], names[other]) for one, other in part.confounded]
        self.parameters = tuple(parameters)
        self.terms = tuple(terms)
        self.confounded = tuple(confounded)
        self.twins = _twins(self.parts, self.slices)

    def refuse(self, light: FloatArray, view: FloatArray) -> str | None:
        """Return the first part's reason why these directions cannot determine it."""
        reasons = (part.refuse(light, view) for part in self.parts)
        return next((reason for reason in reasons if reason is not None), None)

    def prepare(self, light: FloatArray, view: FloatArray) -> tuple[Any, ...]:
        """Return each part's functions of the directions."""
        return tuple(part.prepare(light, view) for part in self.parts)

    def value(self, prepared: tuple[Any, ...], internal: FloatArray) -> FloatArray:
        """BRDF (3, n)."""
        total = self.parts[0].value(prepared[0], internal[self.slices[0]])
        for part, basis, where in zip(self.parts[1:], prepared[1:], self.slices[1:], strict=True):
            total = total + part.value(basis, internal[where])
        return np.asarray(total)

    def add_jacobian(
        self, prepared: tuple[Any, ...], internal: FloatArray, out: FloatArray
    ) -> None:
        """Write each part's derivatives into its own rows."""
        for part, basis, where in zip(self.parts, prepared, self.slices, strict=True):
            part.add_jacobian(basis, internal[where], out[where])


def through(term: Term, index: int) -> Term:
    """Return a part's term, taking the part's own item of the combination's prepared tuple."""

    def vector(prepared: Any, shapes: Sequence[float], typical: float) -> FloatArray:
        return term.vector(prepared[index], shapes, typical)

    return replace(term, vector=vector)


def _twins(
    parts: Sequence[ReflectanceModel], slices: Sequence[slice]
) -> tuple[tuple[Twin, ...], ...]:
    """Return the lobes of each kind, by name with its options, of which there are several."""
    kinds: dict[str, list[Twin]] = {}
    for part, where in zip(parts, slices, strict=True):
        if isinstance(part, Lobe):
            kinds.setdefault(part.name, []).append(Twin(part, where.start))
    return tuple(tuple(twins) for twins in kinds.values() if len(twins) > 1)


def _unique_names(part: ReflectanceModel, seen: Counter[str]) -> dict[str, str]:
    """Return the part's names as they are in the sum; all get the same number."""
    number = 1 + max((seen[name] for name in part.parameter_names), default=0)
    seen.update(part.parameter_names)
    return {n: n if number == 1 else f"{n}_{number}" for n in part.parameter_names}


def _renamed(parameter: Parameter, names: dict[str, str]) -> Parameter:
    groups = tuple(tuple(names[name] for name in group) for group in parameter.carried_by)
    return replace(parameter, name=names[parameter.name], carried_by=groups)


def _renamed_term(term: Term, names: dict[str, str]) -> Term:
    return replace(
        term,
        amplitudes=tuple(names[name] for name in term.amplitudes),
        shapes=tuple(names[name] for name in term.shapes),
    )
