"""A simulated camera's own clock: what paces its frames and stamps them."""

from __future__ import annotations

from ..world.scene import CameraEffects
from .simulated_noise import CLOCK, generator

SWITCHED_ON_NS = 1_000_000_000_000
"""The camera was switched on about this long before the simulation began."""


class CameraClock:
    """Camera time = (1 + drift) · (run time - zero) + offset.

    Parameters
    ----------
    seed, camera
        Of what is drawn: offset and drift (normal), and the phase of its frames (uniform).
    effects
        Standard deviations of offset and drift.
    zero_ns
        Run-clock time when the simulation began.
    """

    def __init__(self, seed: int, camera: int, effects: CameraEffects, zero_ns: int) -> None:
        rng = generator(seed, camera, CLOCK)
        offset_s = effects.clock_offset_s * rng.standard_normal()
        self.drift = 1e-6 * effects.clock_drift_ppm * rng.standard_normal()
        self.phase = rng.random()
        """Of free running, in periods."""
        self._offset_ns = SWITCHED_ON_NS + round(1e9 * offset_s)
        self._zero_ns = zero_ns

    def tell_ns(self, run_ns: int) -> int:
        """Return the camera's time at a time of the run's clock."""
        since = run_ns - self._zero_ns
        return since + round(self.drift * since) + self._offset_ns

    def frame_after(self, run_ns: int, period_ns: int) -> int:
        """Return the number of the first free-running frame that starts at ``run_ns`` or later."""
        since = (run_ns - self._zero_ns) * (1.0 + self.drift)
        number = int(since / period_ns - self.phase)
        while self.frame_start_ns(number, period_ns) < run_ns:
            number += 1
        return number

    def frame_start_ns(self, number: int, period_ns: int) -> int:
        """Return when a free-running frame starts, on the run's clock."""
        since = (number + self.phase) * period_ns
        return self._zero_ns + round(since / (1.0 + self.drift))
