"""Sums of models: a diffuse one and specular lobes, added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..geometry import FloatArray
from .base import ReflectanceModel, Term


class SumModel(ReflectanceModel):
    """The sum of several models' BRDFs; parameters are theirs, one model after the other."""

    def __init__(self, parts: Sequence[ReflectanceModel]) -> None:
        self.parts = tuple(parts)
        self.name = "+".join(part.name for part in parts)
        self.parameters = tuple(p for part in parts for p in part.parameters)
        self.confounded = tuple(pair for part in parts for pair in part.confounded)
        self.slices: list[slice] = []
        start = 0
        for part in self.parts:
            self.slices.append(slice(start, start + len(part.parameters)))
            start += len(part.parameters)
        if len(set(self.parameter_names)) != len(self.parameters):
            raise ValueError(f"{self.name}: two parts have parameters of the same name")
        self.terms = tuple(
            through(term, index) for index, part in enumerate(parts) for term in part.terms
        )

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
