"""Half and difference angles: the coordinates in which a BRDF's features lie along the axes.

Source: S. M. Rusinkiewicz, "A New Change of Variables for Efficient BRDF Representation", 1998.
With H = l + v and D = l - v, theta_h is the angle of H to the normal n, theta_d that of l to H, and
phi_d the azimuth of l about H, counted from the great circle that leads away from the normal::

    theta_h = atan2(|H_xy|, H_z),  theta_d = atan2(|D|, |H|),
    phi_d = atan2(2 (v_x l_y - v_y l_x), (v_z - l_z) |H|)

The azimuth of H is left out: an isotropic BRDF does not depend on it. Theta_h = 0 is the mirror
direction, theta_d = 0 exact retro-reflection, phi_d = 0 or 180 degrees the plane of incidence.
Exchanging light and view adds 180 degrees to phi_d; a reflection at the plane of H and n, after
which an isotropic BRDF is the same, reverses its sign.

No arc cosine is taken, so that angles near 0 and 90 degrees keep their digits. At the poles phi_d
is what is left of a direction: the azimuth of D about the normal at theta_h = 0, and 0 at theta_d
= 0, where it does not exist.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .geometry import FloatArray, paired
from .models.torrance_sparrow import half_vector
from .observations import UNIT_LENGTH_TOLERANCE


@dataclass(frozen=True, eq=False)
class HalfAngles:
    """Angles in radians, (n,) each: theta_h, theta_d in [0, pi/2], phi_d in (-pi, pi]."""

    theta_h: FloatArray
    theta_d: FloatArray
    phi_d: FloatArray

    @property
    def folded_phi_d(self) -> FloatArray:
        """Phi_d in [0, pi/2]: the same for a reciprocal, isotropic BRDF."""
        turned = np.abs(self.phi_d)
        return np.asarray(np.minimum(turned, np.pi - turned))


def to_half_angles(light: ArrayLike, view: ArrayLike) -> HalfAngles:
    """Return the half and difference angles of unit directions (n, 3), or one (3,) for all n.

    Raises
    ------
    ValueError
        Other shapes, or no unit vectors.
    """
    lights, views = unit_pairs(light, view)
    radius, height = half_vector(lights, views)
    together = np.hypot(radius, height)
    apart = lights - views
    (lx, ly, lz), (vx, vy, vz) = lights.T, views.T
    phi_d = np.arctan2(2 * (vx * ly - vy * lx), (vz - lz) * together)
    # H along the normal: both arguments vanish, and the azimuth of D about the normal is left
    phi_d = np.where(radius > 0, phi_d, np.arctan2(apart[:, 1], apart[:, 0]))
    phi_d = np.where(phi_d == -np.pi, np.pi, phi_d)
    return HalfAngles(
        theta_h=np.arctan2(radius, height),
        theta_d=np.arctan2(np.linalg.norm(apart, axis=1), together),
        phi_d=phi_d + 0.0,  # no -0
    )


def from_half_angles(
    theta_h: ArrayLike, theta_d: ArrayLike, phi_d: ArrayLike, phi_h: ArrayLike = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return light and view (n, 3) of angles in radians, scalars or (n,).

    `phi_h` is the azimuth of the half vector; an isotropic BRDF does not depend on it. Directions
    may lie below the horizon.
    """
    arrays = (np.asarray(a, dtype=np.float64) for a in (theta_h, theta_d, phi_d, phi_h))
    h, d, phi, azimuth = np.broadcast_arrays(*(np.atleast_1d(a) for a in arrays))
    # H, and what leads from it towards the light, with H's azimuth still 0
    zero = np.zeros(h.shape)
    half = np.cos(d) * np.array([np.sin(h), zero, np.cos(h)])
    side = np.sin(d) * np.array(
        [np.cos(phi) * np.cos(h), np.sin(phi), -np.cos(phi) * np.sin(h)],
    )
    cosine, sine = np.cos(azimuth), np.sin(azimuth)

    def turned(vector: FloatArray) -> FloatArray:
        x, y, z = vector
        return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1)

    return turned(half + side), turned(half - side)


def unit_pairs(light: ArrayLike, view: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return light and view directions as (n, 3) each, one of them repeated where it is single.

    Raises
    ------
    ValueError
        Other shapes, or no unit vectors.
    """
    lights, views = paired(light, view)
    for name, array in (("light", lights), ("view", views)):
        unit = np.abs(np.linalg.norm(array, axis=1) - 1) <= UNIT_LENGTH_TOLERANCE
        if not unit.all():
            row = int(np.argmin(unit))
            raise ValueError(f"{name} direction {row} = {array[row].tolist()} is no unit vector")
    return lights, views
