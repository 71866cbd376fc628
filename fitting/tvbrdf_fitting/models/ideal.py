"""Ideal mirror and ideal refraction: all light goes into one direction.

Sources: Fresnel and Snell as in `optics`; the eta^2 of radiance as in E. Veach, "Robust Monte Carlo
Methods for Light Transport Simulation", 1997, section 5.2.

Parameters: reflectance or transmittance, one a channel, 1 for a surface that absorbs nothing; eta,
the refractive index of below over above::

    ideal_mirror              BRDF = reflectance delta(v - mirror(l)) / cos(theta_i)
    ideal_mirror(dielectric)  the same times Fresnel's F(theta_i, eta)
    ideal_refraction          BTDF = transmittance (1 - F) eta^2 delta(v - refracted(l)) / cos,
                              1 / eta^2 from below; nothing where the light is totally reflected

The sum ``ideal_mirror(dielectric)+ideal_refraction`` is the smooth surface of glass or water.

A delta function has no value: `evaluate` gives 0 in every direction, as a camera would see but for
a set of directions of measure 0, and a fit refuses these models. A renderer takes `scattered` (from
the light on) or `gathered` (from the eye back), and `delta_lobes` for those in a sum.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import FloatArray
from .base import LOG, Parameter, ReflectanceModel
from .combination import SumModel
from .optics import fresnel_dielectric, radiance_scale, reflect, refract, transmittance_dielectric
from .registry import Registration, label

_REFLECTANCE = Parameter("reflectance", "1", 0.0, 1.0, typical=0.7).one_a_channel()
_TRANSMITTANCE = Parameter("transmittance", "1", 0.0, 1.0, typical=0.7).one_a_channel()
_ETA = Parameter("eta", "1", 0.25, 4.0, transform=LOG, typical=1.5)


class Scattering(NamedTuple):
    """Where the light goes or comes from, and what is left of it.

    Attributes
    ----------
    direction
        (n, 3) unit vectors away from the surface; (0, 0, 0) where there is none.
    throughput
        (n, 3) radiance out over radiance in, channels B, G, R; no cosine is to be applied.
    """

    direction: FloatArray
    throughput: FloatArray


class DeltaLobe(ReflectanceModel):
    """A BSDF that is a delta function of the direction."""

    delta = True
    terms = ()

    def scattered(self, light: ArrayLike, parameters: ArrayLike) -> Scattering:
        """Return where light goes, and its radiance then.

        Parameters
        ----------
        light
            (n, 3) or (3,) unit vectors to where light comes from; z < 0: from below.
        parameters
            (p,) published values.
        """
        return self._scattering(light, parameters, backward=False)

    def gathered(self, view: ArrayLike, parameters: ArrayLike) -> Scattering:
        """Return from where the light comes that goes to `view` (n, 3), and what is left of it.

        The path of `scattered` the other way round: its throughput is the same number.
        """
        return self._scattering(view, parameters, backward=True)

    def prepare(self, light: FloatArray, view: FloatArray) -> FloatArray:
        """Return zeros (1, n)."""
        return np.zeros((1, light.shape[0]))

    def value(self, prepared: FloatArray, internal: FloatArray) -> FloatArray:
        """0 (1, n): what the delta function is in all directions but one."""
        return np.zeros_like(prepared)

    def add_jacobian(self, prepared: FloatArray, internal: FloatArray, out: FloatArray) -> None:
        """Leave the zeros."""

    def _scattering(
        self, direction: ArrayLike, parameters: ArrayLike, *, backward: bool
    ) -> Scattering:
        vectors = np.atleast_2d(np.asarray(direction, dtype=np.float64))
        if vectors.ndim != 2 or vectors.shape[1] != 3:
            raise ValueError(f"{self.name}: directions have shape {vectors.shape}, expected (n, 3)")
        values = self._values(parameters)
        other, share = self._path(vectors, values, backward)
        return Scattering(other, share[:, None] * values[:3])

    @abstractmethod
    def _path(
        self, direction: FloatArray, values: FloatArray, backward: bool
    ) -> tuple[FloatArray, FloatArray]:
        """Return the other end (n, 3) of each path, and the throughput (n,) of white."""


class IdealMirror(DeltaLobe):
    """A mirror on both sides; parameters `reflectance_b, reflectance_g, reflectance_r`.

    `dielectric`: the smooth surface of a dielectric, times Fresnel's reflectance; and `eta`.
    """

    def __init__(self, *, dielectric: bool = False) -> None:
        self._dielectric = dielectric
        self.parameters = (*_REFLECTANCE, _ETA) if dielectric else _REFLECTANCE
        self.name = label("ideal_mirror", *(["dielectric"] if dielectric else []))

    def _path(
        self, direction: FloatArray, values: FloatArray, backward: bool
    ) -> tuple[FloatArray, FloatArray]:
        cosine = direction[:, 2]
        share = fresnel_dielectric(cosine, values[3]) if self._dielectric else np.ones_like(cosine)
        return reflect(direction), share


class IdealRefraction(DeltaLobe):
    """The smooth surface of a dielectric, seen through.

    Parameters `transmittance_b, transmittance_g, transmittance_r, eta`.
    """

    name = "ideal_refraction"
    parameters = (*_TRANSMITTANCE, _ETA)

    def _path(
        self, direction: FloatArray, values: FloatArray, backward: bool
    ) -> tuple[FloatArray, FloatArray]:
        eta = float(values[3])
        other, _ = refract(direction, eta)
        source = other if backward else direction
        share = transmittance_dielectric(direction[:, 2], eta)
        return other, share * radiance_scale(source[:, 2], eta)


def delta_lobes(
    model: ReflectanceModel, parameters: ArrayLike
) -> Iterator[tuple[DeltaLobe, FloatArray]]:
    """Yield the delta lobes of a model or a sum, each with its own published values."""
    values = np.asarray(parameters, dtype=np.float64)
    if isinstance(model, DeltaLobe):
        yield model, values
    elif isinstance(model, SumModel):
        for part, where in zip(model.parts, model.slices, strict=True):
            yield from delta_lobes(part, values[where])


REGISTERED = (
    Registration(
        "ideal_mirror",
        "delta: mirror, or the smooth surface of a dielectric; for rendering, not for fits",
        IdealMirror,
        options=("dielectric",),
    ),
    Registration(
        "ideal_refraction",
        "delta: seen through a smooth surface; for rendering, not for fits",
        IdealRefraction,
    ),
)
