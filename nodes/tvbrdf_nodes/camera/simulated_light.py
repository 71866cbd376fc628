"""The light as a simulated camera knows it: its true motion, its lamp's brightness."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..world.scene import LampEffects

if TYPE_CHECKING:
    from tvbrdf_messages.messages import SimMotion

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class SimulatedLight:
    """Angle and brightness of the light over the run's clock.

    Parameters
    ----------
    lamp
        The scene's effects. The lamp's warmth follows the switch as a first-order system with time
        constant ``warm_up_s``; it gives light only while it is on, and ``warm_up_fraction`` less
        while it is cold.
    zero_ns
        When the simulation began; the drift counts from there.
    """

    def __init__(self, lamp: LampEffects, zero_ns: int) -> None:
        self._lamp, self._zero_ns = lamp, zero_ns
        self.until_ns = -1
        """The motion is final up to here."""
        self._starts = np.zeros(0, dtype=np.int64)
        self._pieces = np.zeros((0, 5))
        """(n, 5): angle, speed, acceleration, lamp on, warmth of the filament at the start."""

    def take(self, motion: SimMotion) -> None:
        """Add pieces of motion; one that starts where a known one does takes its place."""
        self.until_ns = max(self.until_ns, motion.until_ns)
        if motion.start_ns:
            starts = np.array(motion.start_ns, dtype=np.int64)
            columns = (motion.angle_deg, motion.speed_deg_s, motion.acceleration_deg_s2)
            pieces = np.zeros((starts.size, 5))
            for column, values in enumerate((*columns, motion.lamp)):
                pieces[:, column] = values
            kept = int(np.searchsorted(self._starts, starts[0], side="left"))
            self._starts = np.concatenate([self._starts[:kept], starts])
            self._pieces = np.concatenate([self._pieces[:kept], pieces])
            self._warm(kept)

    def forget(self, before_ns: int) -> None:
        """Drop the motion of before a moment that nobody asks for any more."""
        old = int(np.searchsorted(self._starts, before_ns, side="right")) - 1
        if old > 0:
            self._starts, self._pieces = self._starts[old:], self._pieces[old:]

    def _warm(self, first: int) -> None:
        """Fill in the filament's warmth at the start of each piece from ``first`` on."""
        if first == 0:  # the lamp has been as it is for long
            self._pieces[0, 4] = self._pieces[0, 3]
        for k in range(max(first, 1), self._starts.size):
            seconds = (self._starts[k] - self._starts[k - 1]) * 1e-9
            _, _, _, lamp, warmth = self._pieces[k - 1]
            self._pieces[k, 4] = lamp + (warmth - lamp) * self._decay(seconds)

    def _decay(self, seconds: FloatArray | float) -> FloatArray | float:
        if self._lamp.warm_up_s <= 0:
            return np.zeros_like(seconds)
        return np.exp(np.maximum(-np.asarray(seconds) / self._lamp.warm_up_s, -700.0))

    def at(self, times_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return angle (world, degrees) and brightness (1: warm, without drift) at times (n,).

        Before the first piece that is known, the light rests where that one begins. Without any
        piece the light is straight above, and off.
        """
        if not self._starts.size:
            return np.zeros(times_ns.shape), np.zeros(times_ns.shape)
        index = np.maximum(np.searchsorted(self._starts, times_ns, side="right") - 1, 0)
        seconds = np.maximum(times_ns - self._starts[index], 0) * 1e-9
        pieces = self._pieces[index]
        speed, lamp = pieces[..., 1], pieces[..., 3]
        angle_deg = pieces[..., 0] + seconds * (speed + 0.5 * pieces[..., 2] * seconds)
        brightness = lamp
        if self._lamp.warm_up_s > 0:
            cold = (1.0 - pieces[..., 4]) * self._decay(seconds)
            brightness = lamp * (1.0 - self._lamp.warm_up_fraction * cold)
        if self._lamp.drift_per_hour:
            hours = (times_ns - self._zero_ns) / 3.6e12
            brightness = brightness * (1.0 + self._lamp.drift_per_hour * hours)
        return angle_deg, brightness
