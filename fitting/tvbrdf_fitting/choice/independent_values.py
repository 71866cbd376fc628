"""How many independent values the residuals of a fit are worth.

What a wrong model gets wrong goes together over neighbouring directions and over the channels. Then
n values say as much as ``n / tau`` independent ones (Bayley and Hammersley, "The effective number
of independent observations in an autocorrelated time series", 1946). tau is how much larger the
variance of a sum over a block of neighbours is than for independent values (Flyvbjerg and Petersen,
"Error estimates on averages of correlated data", 1989), at the size of blocks where it is largest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..geometry import BoolArray, FloatArray, IntArray

FEWEST_BLOCKS = 4
"""Fewer blocks say too little of the variance of their sums."""

Blocks = Sequence[tuple[IntArray, IntArray]]
"""Level by level, an order of the points and where each block starts in it."""


def nested_blocks(points: FloatArray, groups: IntArray) -> Blocks:
    """Groups of points (n, d), and each halved along its longest side again and again.

    Levels of fewer than `FEWEST_BLOCKS` blocks are left out; the last has blocks of two or three.
    """
    n = len(points)
    order = np.argsort(groups, kind="stable")
    starts = np.flatnonzero(np.diff(groups[order], prepend=groups[order][:1] - 1))
    levels = []
    while n >= 2 * len(starts):
        if len(starts) >= FEWEST_BLOCKS:
            levels.append((order, starts))
        placed = points[order]
        sides = np.maximum.reduceat(placed, starts) - np.minimum.reduceat(placed, starts)
        sizes = np.diff(np.append(starts, n))
        block = np.repeat(np.arange(len(starts)), sizes)
        key = placed[np.arange(n), np.argmax(sides, axis=1)[block]]
        order = order[np.lexsort((key, block))]
        halves = np.stack([starts, starts + sizes // 2], axis=1)
        # a single point has no halves
        starts = np.concatenate([halves[:, 0], halves[sizes > 1, 1]])
        starts.sort()
    return levels


def correlation(residual: FloatArray, seen: BoolArray, blocks: Blocks) -> tuple[float, float]:
    """Return how many values count as one, and the largest block mean in its deviations.

    `residual` and `seen` are (3, n). With independent errors the sum over a block has the variance
    of a value times the block's size, and channels are independent. The Gram matrix of the three
    channels' block sums gives, as its largest eigenvalue, by how much that is exceeded, also where
    channels go together or one has all the error. The largest over sizes of blocks counts; of
    noise alone it would come out at (1 + sqrt(3 / blocks))^2, the edge of Marchenko and Pastur
    (1967), which is divided out.
    """
    measured = np.flatnonzero(seen.any(axis=1))
    residual, seen = residual[measured], seen[measured]
    total = float(np.sum(residual * residual))
    if not total:
        return 1.0, 0.0
    per_channel = seen.sum(axis=1)
    each = total / float(per_channel.sum())
    correlated, largest = 1.0, 0.0
    for order, starts in blocks:
        sums = np.add.reduceat(residual[:, order], starts, axis=1)
        counts = np.add.reduceat(seen[:, order].astype(np.int64), starts, axis=1)
        largest = max(largest, float(np.max(np.square(sums) / np.maximum(counts, 1))) / each)
        edge = (1 + math.sqrt(len(measured) / len(starts))) ** 2
        # as if all channels had one value
        alike = sums / np.sqrt(per_channel)[:, None]
        correlated = max(correlated, float(np.linalg.eigvalsh(alike @ alike.T)[-1]) / (each * edge))
    return correlated, math.sqrt(largest)
