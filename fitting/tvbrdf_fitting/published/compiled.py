"""Loops over the text and the radiances of a scan, compiled when this module is first imported.

They are as exact as the numpy that they stand for: no sum is reordered, no product fused.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from ..geometry import FloatArray

_Function = TypeVar("_Function", bound=Callable[..., Any])

LONGEST_WHOLE = 9
"""Digits before the point: with 6 behind it, an integer of 1e-6 that a double holds exactly."""
SHORTEST_GROUP = 3 * len("F 0.000000 0.000000 0.000000\n")
_SPACE, _LINE_END, _MINUS, _POINT, _ZERO = (ord(character) for character in " \n-.0")
_KEYS = (ord("F"), ord("L"), ord("V"))


def _compiled(result: Any, *arguments: Any) -> Callable[[_Function], _Function]:
    """Compile a function for these types, or load it from the disk."""
    given = njit(result(*arguments), cache=True, nogil=True, error_model="numpy")
    return cast(Callable[[_Function], _Function], given)


_TEXT = types.Array(types.uint8, 1, "C", readonly=True)
_VECTOR = types.Array(types.float64, 1, "C")
_ROWS = types.Array(types.float64, 2, "C")
_GROUPS = types.Array(types.float64, 3, "C")


@_compiled(types.int64, _TEXT, _GROUPS)
def parse_groups(text: NDArray[np.uint8], out: FloatArray) -> int:
    """Read the groups ``F b g r``, ``L x y z``, ``V x y z`` with 6 decimals into (m, 3, 3).

    The text must end with the end of a line; there must be room for a group in every
    `SHORTEST_GROUP` of it, and for one more.

    Returns
    -------
    The number of groups, or -1 where anything is not exactly as the layout's writer writes it.
    """
    at = group = 0
    while at < len(text):
        for line in range(3):
            if at == len(text) or text[at] != _KEYS[line]:
                return -1
            at += 1
            for column in range(3):
                # what is read next is there: within a line, nothing goes past a line's end
                if text[at] != _SPACE:
                    return -1
                at += 1
                negative = text[at] == _MINUS
                if negative:
                    at += 1
                begin, millionths = at, np.int64(0)
                while _ZERO <= text[at] <= _ZERO + 9:
                    millionths = 10 * millionths + np.int64(text[at]) - _ZERO
                    at += 1
                if not 1 <= at - begin <= LONGEST_WHOLE or text[at] != _POINT:
                    return -1
                at += 1
                for _ in range(6):
                    if not _ZERO <= text[at] <= _ZERO + 9:
                        return -1
                    millionths = 10 * millionths + np.int64(text[at]) - _ZERO
                    at += 1
                # rounded once, so it is the double that any correct reader gives
                number = millionths / 1e6
                out[group, line, column] = -number if negative else number
            if text[at] != _LINE_END:
                return -1
            at += 1
        group += 1
    return group


@_compiled(types.boolean, _GROUPS, types.float64, types.float64)
def are_sound(groups: FloatArray, largest: float, tolerance: float) -> bool:
    """Whether radiances, unit lengths, the horizon and the one view of (m, 3, 3) are as they must.

    See `scan_file`, which says what is wrong where they are not.
    """
    for group in range(len(groups)):
        for channel in range(3):
            if not abs(groups[group, 0, channel]) <= largest:
                return False
            if groups[group, 2, channel] != groups[0, 2, channel]:
                return False
        for line in range(1, 3):
            x, y, z = groups[group, line, 0], groups[group, line, 1], groups[group, line, 2]
            if not (abs(math.sqrt(x * x + y * y + z * z) - 1) <= tolerance and z > 0):
                return False
    return True


@_compiled(_ROWS, _ROWS, types.int64)
def running_mean(values: FloatArray, most: int) -> FloatArray:
    """Mean (n, 3) of (n, 3) values over up to `most` neighbours; fewer at the ends."""
    count = len(values)
    width = min(most, count)
    out = np.empty_like(values)
    for row in range(count):
        begin = row - width // 2
        first, last = max(begin, 0), min(begin + width, count)
        for channel in range(values.shape[1]):
            total = 0.0
            for other in range(first, last):
                total += values[other, channel]
            out[row, channel] = total / (last - first)
    return out


@_compiled(types.int64, _VECTOR, _ROWS, types.float64, _ROWS, _ROWS, types.int64)
def add_differences(
    angle: FloatArray,
    values: FloatArray,
    gap: float,
    square: FloatArray,
    level: FloatArray,
    count: int,
) -> int:
    """Add squared scaled third differences, and their mean values, of n sorted lights.

    Parameters
    ----------
    angle, values
        (n,) in ascending order, and (n, 3).
    gap
        Steps of 0, or of at least this one, are not bridged.
    square, level
        (3, m) that are written from `count` on.

    Returns
    -------
    `count` with those that were added
    """
    for row in range(len(angle) - 3):
        one, two = angle[row + 1] - angle[row], angle[row + 2] - angle[row + 1]
        three = angle[row + 3] - angle[row + 2]
        if not (0 < one < gap and 0 < two < gap and 0 < three < gap):
            continue
        first, last, whole = one + two, two + three, one + two + three
        # Lagrange's: 1 / product of the distances to the three others
        a, b = -1 / (one * first * whole), 1 / (one * two * last)
        c, d = -1 / (first * two * three), 1 / (whole * last * three)
        size = math.sqrt(a * a + b * b + c * c + d * d)
        a, b, c, d = a / size, b / size, c / size, d / size
        for channel in range(values.shape[1]):
            p, q = values[row, channel], values[row + 1, channel]
            r, s = values[row + 2, channel], values[row + 3, channel]
            difference = a * p + b * q + c * r + d * s
            square[channel, count] = difference * difference
            level[channel, count] = (p + q + r + s) / 4
        count += 1
    return count
