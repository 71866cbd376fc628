"""Camera response: from the codes a camera gives to a scale linear in light, and back.

*Linear dn* is the scale on which everything after this module works: proportional to the light
collected plus a constant black level, and equal to the code at code 0 and at the largest code
``2**bit_depth - 1``. A linear camera's codes are linear dn already.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import FloatArray

ResponseKind = Literal["linear", "gamma", "table"]

MIN_BIT_DEPTH = 8
MAX_BIT_DEPTH = 16


@dataclass(frozen=True)
class Response:
    """How a camera's code depends on linear dn, both as fractions of the largest code.

    Parameters
    ----------
    kind : {"linear", "gamma", "table"}
        ``linear``: code = linear dn. ``gamma``: code = linear**exponent (fractions), so that a
        camera that brightens its shadows has an exponent below 1, for example 0.4545.
        ``table``: piecewise linear through the points below.
    exponent : float
        Used by ``gamma`` only.
    table_linear, table_code : tuple of float
        Used by ``table`` only: fractions that both start at 0, end at 1 and increase strictly
        (the columns ``E`` and ``f`` of a measured response function).

    Raises
    ------
    ValueError
        If the parameters do not describe a strictly increasing response.
    """

    kind: ResponseKind = "linear"
    exponent: float = 1.0
    table_linear: tuple[float, ...] = ()
    table_code: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in ("linear", "gamma", "table"):
            raise ValueError(f"response kind {self.kind!r}: use linear, gamma or table")
        if self.kind == "gamma" and not 0.05 <= self.exponent <= 20.0:
            raise ValueError(f"response exponent {self.exponent}: give one in [0.05, 20]")
        if self.kind == "table":
            self._check_table()

    def _check_table(self) -> None:
        if len(self.table_linear) != len(self.table_code) or len(self.table_code) < 2:
            raise ValueError(
                f"response table has {len(self.table_linear)} linear and {len(self.table_code)} "
                "code values: give as many of one as of the other, at least 2"
            )
        for name, values in (("linear", self.table_linear), ("code", self.table_code)):
            column = np.asarray(values, dtype=np.float64)
            if not np.all(np.isfinite(column)) or column[0] != 0.0 or column[-1] != 1.0:
                raise ValueError(
                    f"response table, column {name}: runs from {column[0]:g} to {column[-1]:g}; "
                    "give fractions of full scale from 0 to 1"
                )
            rises = np.diff(column)
            if np.any(rises <= 0.0):
                where = int(np.argmax(rises <= 0.0))
                raise ValueError(
                    f"response table, column {name}: value {where + 2} ({column[where + 1]:g}) is "
                    f"not above value {where + 1} ({column[where]:g}); a response that does not "
                    "increase strictly cannot be undone: smooth or shorten the table"
                )

    @property
    def is_linear(self) -> bool:
        """Whether codes are linear dn as they are."""
        return self.kind == "linear" or (self.kind == "gamma" and self.exponent == 1.0)

    def linearise(self, code: ArrayLike, bit_depth: int) -> FloatArray:
        """Linear dn of codes (any shape, need not be whole); codes beyond the range are clipped."""
        top = largest_code(bit_depth)
        fraction = np.clip(np.asarray(code, dtype=np.float64) / top, 0.0, 1.0)
        if self.is_linear:
            linear = fraction
        elif self.kind == "gamma":
            linear = fraction ** (1.0 / self.exponent)
        else:
            linear = np.interp(fraction, self.table_code, self.table_linear)
        return np.asarray(linear * top, dtype=np.float64)

    def encode(self, linear_dn: ArrayLike, bit_depth: int) -> FloatArray:
        """Codes, not yet rounded, of linear dn (any shape): what a simulated camera needs.

        The exact inverse of `linearise` within the range; light beyond the range is clipped, as
        a sensor clips it. Rounding to whole codes is the caller's, after its noise.
        """
        top = largest_code(bit_depth)
        fraction = np.clip(np.asarray(linear_dn, dtype=np.float64) / top, 0.0, 1.0)
        if self.is_linear:
            code = fraction
        elif self.kind == "gamma":
            code = fraction**self.exponent
        else:
            code = np.interp(fraction, self.table_linear, self.table_code)
        return np.asarray(code * top, dtype=np.float64)

    def linear_table(self, bit_depth: int) -> FloatArray:
        """Linear dn of every code, shape (2**bit_depth,), strictly increasing, read-only."""
        return _linear_table(self, bit_depth)

    def slope(self, linear_dn: ArrayLike, bit_depth: int) -> FloatArray:
        """Linear dn a code step is worth at the given linear dn (any shape).

        The rounding to whole codes adds slope**2 / 12 to a pixel's variance in linear dn.
        """
        level = np.asarray(linear_dn, dtype=np.float64)
        if self.is_linear:
            return np.ones_like(level)
        table = self.linear_table(bit_depth)
        return np.asarray(np.interp(level, table, _slope_table(self, bit_depth)))


def largest_code(bit_depth: int) -> int:
    """Largest code, 2**bit_depth - 1, of a camera with 8 to 16 bits."""
    if not MIN_BIT_DEPTH <= bit_depth <= MAX_BIT_DEPTH:
        raise ValueError(f"bit depth {bit_depth}: give {MIN_BIT_DEPTH} to {MAX_BIT_DEPTH}")
    return (1 << bit_depth) - 1


@lru_cache(maxsize=32)
def _linear_table(response: Response, bit_depth: int) -> FloatArray:
    table = response.linearise(np.arange(largest_code(bit_depth) + 1), bit_depth)
    if np.any(np.diff(table) <= 0.0):
        where = int(np.argmax(np.diff(table) <= 0.0))
        raise ValueError(
            f"response ({response.kind}) gives codes {where} and {where + 1} of {bit_depth} bits "
            "the same light: it is too flat or steep for float64; use a shorter table"
        )
    table.setflags(write=False)
    return table


@lru_cache(maxsize=32)
def _slope_table(response: Response, bit_depth: int) -> FloatArray:
    slope: FloatArray = np.gradient(response.linear_table(bit_depth))
    slope.setflags(write=False)
    return slope
