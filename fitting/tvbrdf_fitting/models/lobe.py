"""Models that are an amplitude times a function of the directions and a few shape parameters.

Most published lobes are of this kind. A subclass gives the amplitude, the shapes, what depends on
the directions alone, and the function with its derivatives; value, Jacobian and the solver's view
follow. The amplitude is one number for all channels, or (`coloured`) one a channel, as metals and
car paint need.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..geometry import FloatArray
from .base import Parameter, ReflectanceModel, Term


class Lobe(ReflectanceModel):
    """BRDF = amplitude x f(light, view; shapes); subclasses give the latter.

    Attributes
    ----------
    amplitude
        Set by the subclass; `parameters` then has it once or once a channel, and first.
    shapes
        Set by the subclass: what `lobe` takes besides the directions, in order.
    """

    amplitude: Parameter
    shapes: tuple[Parameter, ...]

    def __init__(self, *, coloured: bool = False) -> None:
        self.coloured = coloured
        amplitudes = self.amplitude.one_a_channel() if coloured else (self.amplitude,)
        names = tuple(p.name for p in amplitudes)
        self.parameters = (
            *amplitudes,
            *(carried_by(p, self.amplitude.name, names) for p in self.shapes),
        )
        self.terms = (Term(names, tuple(p.name for p in self.shapes), self._vector),)

    @abstractmethod
    def lobe(self, prepared: Any, shapes: Sequence[float]) -> FloatArray:
        """Return the function (n,) at internal shape values, per unit of amplitude."""

    def sharpness(self, shapes: Sequence[float]) -> float:
        """Return how narrow the lobe is at internal shape values, to compare lobes of one kind.

        To be given by every lobe that has a width.
        """
        return 0.0

    @abstractmethod
    def lobe_slopes(
        self, prepared: Any, shapes: Sequence[float]
    ) -> tuple[FloatArray, Sequence[FloatArray]]:
        """Return the function (n,), and its derivatives (n,) by each internal shape value."""

    def value(self, prepared: Any, internal: FloatArray) -> FloatArray:
        """BRDF (3, n), or (1, n) where the channels share the amplitude."""
        count = len(internal) - len(self.shapes)
        lobe = self.lobe(prepared, internal[count:].tolist())
        return np.asarray(internal[:count, None] * lobe)

    def add_jacobian(self, prepared: Any, internal: FloatArray, out: FloatArray) -> None:
        """Write the derivatives by the amplitudes and the internal shape values."""
        count = len(internal) - len(self.shapes)
        lobe, slopes = self.lobe_slopes(prepared, internal[count:].tolist())
        if self.coloured:
            for channel in range(3):
                out[channel, channel] = lobe
        else:
            out[0] = lobe
        for index, slope in enumerate(slopes, start=count):
            np.multiply(internal[:count, None], slope, out=out[index])

    def _vector(self, prepared: Any, shapes: Sequence[float], _typical: float) -> FloatArray:
        return self.lobe(prepared, shapes)


@dataclass(frozen=True)
class Twin:
    """One of several lobes of the same kind in a model.

    Attributes
    ----------
    lobe
        Its model.
    first
        Place of its first parameter among the whole model's; its amplitudes come first.
    """

    lobe: Lobe
    first: int

    @property
    def amplitudes(self) -> slice:
        """Places of the amplitudes."""
        return slice(self.first, self.first + len(self.lobe.terms[0].amplitudes))

    @property
    def places(self) -> slice:
        """Places of all parameters."""
        return slice(self.first, self.first + len(self.lobe.parameters))

    def sharpness(self, internal: FloatArray) -> float:
        """Return how narrow the lobe is at the whole model's internal coordinates (p,)."""
        return self.lobe.sharpness(internal[self.amplitudes.stop : self.places.stop].tolist())


def carried_by(parameter: Parameter, amplitude: str, names: tuple[str, ...]) -> Parameter:
    """Return a shape that is carried by the amplitudes' names instead of by `amplitude`."""
    groups = tuple(names if group == (amplitude,) else group for group in parameter.carried_by)
    return replace(parameter, carried_by=groups)
