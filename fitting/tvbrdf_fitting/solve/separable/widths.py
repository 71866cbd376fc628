"""Compiled: the widths that are tried, and a lobe whose peak nobody saw."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ...geometry import FloatArray
from .elementary import JIT, clip
from .products import write_lobe_products


class Sweep(NamedTuple):
    """What every width that is tried gives.

    Attributes
    ----------
    us
        (w,) ascending.
    lobes
        (w, 3, 5) a lobe's products with the vectors, with itself, and with the data.
    reduced
        (w, 3, 4) what `reduce_lobe` makes of them.
    """

    us: FloatArray
    lobes: FloatArray
    reduced: FloatArray


STEP = 0.5 * math.log(2.0)
"""Between neighbours' u: the scale of q doubles, so a falloff is its neighbour's square."""
_FEWEST = 3
_FARTHEST = 680.0
"""Largest exponent between a lobe's peak and its nearest observation: Ks stays below 1e296 times
what was seen."""
_NEAR = 2.0
"""Exponent at the narrowest width up to which a lobe is in sight."""


@njit(**JIT)
def widths_between(lower, upper):
    """Return the values of u to be tried, ascending: one where it is fixed.

    All but the first are `STEP` apart, or closer where the bounds are close.
    """
    low, high = lower[lower.shape[0] - 1], upper[upper.shape[0] - 1]
    if not high > low:
        return np.full(1, low)
    count = max(math.ceil((high - low) / STEP - 1e-9), _FEWEST)
    step = min(STEP, (high - low) / count) if count == _FEWEST else STEP
    us = np.empty(count + 1)
    for k in range(count + 1):
        us[k] = max(low, high - (count - k) * step)
    return us


@njit(**JIT)
def write_sweep(us, scan, falloff, lobes):
    """Write a lobe's products for every width: (w, 3, 5). `falloff` (n,) is overwritten."""
    for k in range(us.shape[0]):
        doubled = k > 1 and abs(us[k] - us[k - 1] - STEP) < 1e-12
        scale, power = math.exp(2 * us[k]), 2 if doubled else 1
        write_lobe_products(scale, power, scan, falloff, lobes[k])


@njit(**JIT)
def width_between(us, costs, lowest):
    """Return the u of the parabola's bottom through the lowest cost and its neighbours."""
    if lowest == 0 or lowest == us.shape[0] - 1:
        return us[lowest]
    left, right = us[lowest] - us[lowest - 1], us[lowest + 1] - us[lowest]
    down = (costs[lowest - 1] - costs[lowest]) / left
    up = (costs[lowest + 1] - costs[lowest]) / right
    if not 0 < down + up < np.inf:
        return us[lowest]
    bottom = us[lowest] + 0.5 * (down * right - up * left) / (down + up)
    return clip(bottom, us[lowest - 1], us[lowest + 1])


@njit(**JIT)
def nearest_seen(q, squares, lower, upper):
    """Return the smallest q with a weight, and the upper bounds of the search that go with it.

    Where amplitudes are free and a lobe can be out of sight, the search's amplitudes are those at
    the nearest observation: the peak's can be any number of powers of ten higher. Elsewhere 0.
    """
    last = lower.shape[0] - 1
    for k in range(4, last):
        if lower[k] != 0 or upper[k] != np.inf:
            return 0.0, upper
    seen, near = np.inf, _NEAR * math.exp(-2 * upper[last])
    for i in range(q.shape[0]):
        if q[i] < seen and (squares[0, i] > 0 or squares[1, i] > 0 or squares[2, i] > 0):
            seen = q[i]
            if seen < near:
                return 0.0, upper
    farthest = 0.5 * math.log(_FARTHEST / seen)
    if not (seen < np.inf and lower[last] < min(upper[last], farthest)):
        return 0.0, upper
    high = upper.copy()
    high[last] = min(upper[last], farthest)
    return seen, high


@njit(**JIT)
def shifted(q, nearer):
    """Return q less that of the nearest observation; 0 for what was not seen."""
    out = np.empty(q.shape[0])
    for i in range(q.shape[0]):
        out[i] = max(q[i] - nearer, 0.0)
    return out


@njit(**JIT)
def seen_amplitudes(x, nearer):
    """Turn amplitudes at the nearest observation into those of the peak, in place."""
    last = x.shape[0] - 1
    if nearer != 0:
        for k in range(4, last):
            x[k] *= math.exp(nearer * math.exp(2 * x[last]))
