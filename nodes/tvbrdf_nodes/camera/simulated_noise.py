"""Sensor noise at the price of one multiplication and one addition a pixel.

A frame's noise is a window, at a random place and with random signs, of a field of standard
normals that is made once. Of each window and channel, mean and variance over each band of rows (the
sample's, the reference's) are known from prefix sums; they are replaced by fresh draws, the mean's
from a normal and the variance's from a chi-square distribution, as they are independent for normal
noise. So what a patch averages has exactly the right distribution and is independent from frame
to frame, although windows overlap. All draws are keyed by what the frame is, not by when it
is made.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

MARGIN = 128
"""Windows start at this many places in each direction."""
BLOCK = 32
"""Frames whose draws are made in one go."""
FIELD, FRAMES, CLOCK, GAIN = 0, 1, 2, 3
"""Purposes of the generators."""


def generator(seed: int, camera: int, purpose: int, *key: int) -> np.random.Generator:
    """Return a counter-based generator: the same arguments give the same numbers.

    Parameters
    ----------
    seed, camera, purpose
        The key; ``purpose`` is one of those above.
    key
        Up to three numbers below 2**64: the counter's upper words.
    """
    words = [0, *key, *(0,) * (3 - len(key))]
    stream = np.array([seed & (2**64 - 1), camera << 8 | purpose], dtype=np.uint64)
    counter = np.array(words, dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=stream, counter=counter))


class FrameDraws(NamedTuple):
    """Everything random about one frame."""

    row: int
    column: int
    """Where its window starts in the field."""
    scale: FloatArray
    """(bands, 3): noise = sigma · (scale · window + shift), standard normal."""
    shift: FloatArray
    """(bands, 3)."""
    flicker: float
    """Standard normal, common to the frame."""
    jitter: float
    """Exponential with mean 1: the frame's late arrival."""


class NoiseField:
    """The field of one camera.

    Parameters
    ----------
    seed, camera
        Key of all draws.
    height, width
        Of the largest frame; 0 for a camera without noise, which needs no field.
    """

    def __init__(self, seed: int, camera: int, height: int, width: int) -> None:
        self._seed, self._camera = seed, camera
        self._sums: FloatArray | None = None
        self.values = np.zeros((0, 0), dtype=np.float32)
        """(height + MARGIN, 3·(width + MARGIN)) float32."""
        if height and width:
            self._fill(height, width)

    def _fill(self, height: int, width: int) -> None:
        shape = (height + MARGIN, width + MARGIN, 3)
        values = generator(self._seed, self._camera, FIELD).standard_normal(shape, dtype=np.float32)
        self.values = values.reshape(shape[0], shape[1] * 3)
        sums = np.zeros((shape[0] + 1, shape[1] + 1, 6))
        np.cumsum(values, axis=0, dtype=np.float64, out=sums[1:, 1:, :3])
        np.cumsum(np.square(values, dtype=np.float64), axis=0, out=sums[1:, 1:, 3:])
        np.cumsum(sums, axis=1, out=sums)
        self._sums = sums

    def window(self, row: int, column: int, height: int, width: int) -> Float32Array:
        """Return a window (height, 3·width) of the field: a view."""
        return self.values[row : row + height, 3 * column : 3 * (column + width)]

    def draws(
        self, key: tuple[int, int], block: int, edges: tuple[int, ...], width: int
    ) -> list[FrameDraws]:
        """Return the draws of :data:`BLOCK` frames.

        Parameters
        ----------
        key
            What the frames are taken for: two numbers below 2**64.
        block
            Frames ``block·BLOCK`` and on.
        edges
            Rows where bands begin and, last, end: (0, height) or (0, edge, height).
        width
            Of the frames, pixels.
        """
        rng = generator(self._seed, self._camera, FRAMES, block, *key)
        bands = len(edges) - 1
        place = rng.integers(MARGIN, size=(2, BLOCK))
        sign = 1.0 - 2.0 * rng.integers(2, size=(BLOCK, 1, 3))
        fresh_mean = rng.standard_normal((BLOCK, bands, 3))
        pixels = width * np.diff(edges)[:, None]
        freedom = np.maximum(pixels - 1, 1)
        # the variance of n normals: chi-square over n - 1, and independent of their mean
        fresh_variance = rng.chisquare(np.broadcast_to(freedom, (BLOCK, bands, 3))) / freedom
        flicker, jitter = rng.standard_normal(BLOCK), rng.standard_exponential(BLOCK)
        mean, variance = np.zeros_like(fresh_mean), np.ones_like(fresh_mean)
        if self._sums is not None:
            mean, variance = self._statistics(self._sums, place, edges, width)
        scale = sign * np.sqrt(fresh_variance / variance)
        shift = fresh_mean / np.sqrt(pixels) - scale * mean
        return [
            FrameDraws(
                int(place[0, i]),
                int(place[1, i]),
                scale[i],
                shift[i],
                float(flicker[i]),
                float(jitter[i]),
            )
            for i in range(BLOCK)
        ]

    @staticmethod
    def _statistics(
        prefix: FloatArray, place: NDArray[np.int64], edges: tuple[int, ...], width: int
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (BLOCK, bands, 3) of each window, from the prefix sums."""
        rows = place[0][:, None] + np.array(edges)
        left = place[1][:, None]
        corners = prefix[rows, left + width] - prefix[rows, left]
        sums = np.diff(corners, axis=1)
        pixels = width * np.diff(edges)[:, None]
        mean = sums[..., :3] / pixels
        variance = (sums[..., 3:] - pixels * mean**2) / np.maximum(pixels - 1, 1)
        return mean, np.maximum(variance, 1e-12)
