"""Lambert's ideal diffuse reflectance.

Source: J. H. Lambert, "Photometria", 1760.

Parameters: Kd, the albedo, one a channel::

    BRDF = Kd / pi
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry import FloatArray
from .lobe import Lobe
from .oren_nayar import KD
from .registry import Registration


class Lambert(Lobe):
    """The same in all directions; parameters `kd_b, kd_g, kd_r`."""

    name = "lambert"
    diffuse = True
    amplitude = KD
    shapes = ()

    def __init__(self) -> None:
        super().__init__(coloured=True)

    def prepare(self, light: FloatArray, view: FloatArray) -> FloatArray:
        """Return the BRDF (n,) of a white surface."""
        return np.full(light.shape[0], 1 / np.pi)

    def lobe(self, prepared: FloatArray, shapes: Sequence[float]) -> FloatArray:
        """1 / pi (n,)."""
        return prepared

    def lobe_slopes(
        self, prepared: FloatArray, shapes: Sequence[float]
    ) -> tuple[FloatArray, tuple[()]]:
        """1 / pi (n,), and nothing to derive by."""
        return prepared, ()


REGISTERED = (Registration("lambert", "diffuse: the same in all directions", Lambert),)
