"""Oren-Nayar's short ("qualitative") form: without inter-reflection and without C3.

Source: M. Oren and S. K. Nayar, "Generalization of Lambert's Reflectance Model", SIGGRAPH 1994,
the qualitative model.

Parameters: Kd (one a channel), sigma_d, standard deviation of the facets' slope angle in radians.
With alpha = max(theta_i, theta_r), beta = min(theta_i, theta_r), c = cos(phi_r - phi_i) and
s = sigma_d^2::

    A = 1 - 0.5 s / (s + 0.33)
    B = 0.45 s / (s + 0.09)
    BRDF = Kd / pi (A + B max(0, c) sin(alpha) tan(beta))

Option "interreflection": 0.57 in place of 0.33 in A, the published replacement that makes up, in
part, for the inter-reflection that the short form leaves out.

It is linear in Kd, cheaper and nowhere negative, but differs from the full form: most where light
and view graze from opposite sides. sigma_d = 0 is Lambert.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry import FloatArray
from .lobe import Lobe
from .oren_nayar import KD, SIGMA_D, single_bounce, single_bounce_slopes
from .registry import Registration, label


class OrenNayarShort(Lobe):
    """The short form; parameters `kd_b, kd_g, kd_r, sigma_d`.

    With `interreflection` 0.57 stands in A.
    """

    diffuse = True
    amplitude = KD
    shapes = (SIGMA_D,)

    def __init__(self, *, interreflection: bool = False) -> None:
        super().__init__(coloured=True)
        self.constant = 0.57 if interreflection else 0.33
        options = ("interreflection",) if interreflection else ()
        self.name = label("oren_nayar_short", *options)

    def prepare(self, light: FloatArray, view: FloatArray) -> FloatArray:
        """Return 0.45 max(0, c) sin(alpha) tan(beta) (n,)."""
        in_plane = light[:, 0] * view[:, 0] + light[:, 1] * view[:, 1]
        return 0.45 * np.maximum(in_plane, 0.0) / np.maximum(light[:, 2], view[:, 2])

    def lobe(self, prepared: FloatArray, shapes: Sequence[float]) -> FloatArray:
        """BRDF (n,) for Kd = 1 at sigma_d^2."""
        a, b = single_bounce(shapes[0], self.constant)
        return (a + b * prepared) / np.pi

    def lobe_slopes(
        self, prepared: FloatArray, shapes: Sequence[float]
    ) -> tuple[FloatArray, tuple[FloatArray]]:
        """Return the BRDF for Kd = 1 and its derivative by sigma_d^2."""
        a, b = single_bounce_slopes(shapes[0], self.constant)
        return self.lobe(prepared, shapes), ((a + b * prepared) / np.pi,)


REGISTERED = (
    Registration(
        "oren_nayar_short",
        "diffuse: V-shaped Lambertian facets, short form without inter-reflection",
        OrenNayarShort,
        options=("interreflection",),
    ),
)
