"""A layer of dust over a surface: single scattering above, attenuation of what is below.

Sources: J. F. Blinn, "Light Reflection Functions for Simulation of Clouds and Dusty Surfaces",
SIGGRAPH 1982; modified by Sun et al., "Time-Varying BRDFs".

Parameters: those of the surface (diffuse rho_d, specular rho_s), and w (one a channel), g, tau.
With mu_i, mu_r the cosines of light and view, T = exp(-tau (1/mu_i + 1/mu_r)) and
Phi = (1 - g^2) / (1 + g^2 - 2 g cos(gamma))^(3/2) (Henyey-Greenstein)::

    form="reciprocal" (default)  (1 - T) w Phi / (mu_i + mu_r)      + T rho_d + rho_s
    form="paper"                 (1 - T) w Phi mu_i / (mu_i + mu_r) + T rho_d + rho_s
    form="blinn"                 (1 - T) w Phi mu_i / (mu_i + mu_r) + T2 (rho_d + rho_s),
                                 T2 = exp(-tau / mu_r)

The printed dust term carries a mu_i, which makes it a radiance and not reciprocal; the default is
the BRDF that belongs to it. Under the first two, Ks and sigma_s belong to the dusty surface: they
change with tau and are fitted on their own. cos(gamma) = -l.v, so that g > 0 scatters forward;
the other convention is g with its sign changed. w is no albedo: w = albedo / (4 pi), and energy is
created above 1 / (2 pi). For small tau only the product w tau is seen.

1 - T is taken as -expm1(-tau m), and Phi's denominator as (1 - |g|)^2 + 2 |g| q with
q = |l + v|^2 / 2 for g >= 0 and |l - v|^2 / 2 for g < 0: no difference of nearly equal numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from ..geometry import FloatArray
from .base import ARTANH, Parameter, ReflectanceModel, Term
from .combination import SumModel, through
from .registry import Registration

DustForm = Literal["reciprocal", "paper", "blinn"]
FORMS: tuple[str, ...] = get_args(DustForm)

_W_FULL_SCALE = 1 / (4 * math.pi)  # single-scattering albedo 1
_W = Parameter(
    "w", "1/sr", 0.0, np.inf, carried_by=(("tau",),), full_scale=_W_FULL_SCALE, typical=0.06
).one_a_channel()
W_NAMES = tuple(p.name for p in _W)
_G = Parameter(
    "g",
    "1",
    -0.999,
    0.999,
    transform=ARTANH,
    carried_by=(W_NAMES, ("tau",)),
    grid=tuple(math.atanh(g) for g in (-0.7, -0.35, 0.0, 0.35, 0.7)),
    full_scale=1.0,
    typical=0.35,
)
_TAU = Parameter(
    "tau", "1", 0.0, 50.0, grid=(0.02, 0.07, 0.2, 0.6, 1.5, 4.0), full_scale=10.0, typical=0.6
)


@dataclass(frozen=True)
class Basis:
    """Functions of the directions (n,): path lengths, view path, dust factor, q for both signs."""

    path: FloatArray
    view_path: FloatArray
    factor: FloatArray
    q_forward: FloatArray
    q_backward: FloatArray


class DustOverSurface(ReflectanceModel):
    """Dust over a diffuse and a specular model.

    Parameters of the model: the diffuse one's, the specular one's, `w_b, w_g, w_r, g, tau`.
    """

    confounded = tuple(("tau", name) for name in W_NAMES)

    def __init__(
        self,
        diffuse: ReflectanceModel,
        specular: ReflectanceModel,
        form: DustForm = "reciprocal",
    ) -> None:
        if form not in FORMS:
            raise ValueError(f"dust has no form {form!r}; known forms: {', '.join(FORMS)}")
        self.below, self.above, self.form = diffuse, specular, form
        label = "dust" if form == "reciprocal" else f"dust({form})"
        self.name = f"{label}+{diffuse.name}+{specular.name}"
        self.reciprocal = form == "reciprocal" and diffuse.reciprocal and specular.reciprocal
        self.nonnegative = diffuse.nonnegative and specular.nonnegative
        self.parameters = (*diffuse.parameters, *specular.parameters, *_W, _G, _TAU)
        diffuse_count = len(diffuse.parameters)
        self._surface = slice(0, diffuse_count + len(specular.parameters))
        self._diffuse = slice(0, diffuse_count)
        self._specular = slice(diffuse_count, self._surface.stop)
        blinn = form == "blinn"
        self.terms = (
            *(self._attenuated(through(term, 0)) for term in diffuse.terms),
            *(
                self._attenuated(through(term, 1)) if blinn else through(term, 1)
                for term in specular.terms
            ),
            Term(W_NAMES, ("g", "tau"), _dust_vector),
        )

    def prepare(self, light: FloatArray, view: FloatArray) -> tuple[Any, Any, Basis]:
        """Return the surface's and the dust's functions of the directions."""
        dust = _basis(light, view, light_weighted=self.form != "reciprocal")
        return self.below.prepare(light, view), self.above.prepare(light, view), dust

    def value(self, prepared: tuple[Any, Any, Basis], internal: FloatArray) -> FloatArray:
        """BRDF (3, n)."""
        w, g, tau = self._dust_values(internal)
        dust = prepared[2]
        diffuse = self.below.value(prepared[0], internal[self._diffuse])
        specular = self.above.value(prepared[1], internal[self._specular])
        scattered = w[:, None] * (_opacity(dust.path, tau) * _phase(dust, g) * dust.factor)
        if self.form == "blinn":
            below = _transmission(dust.view_path, tau) * (diffuse + specular)
        else:
            below = _transmission(dust.path, tau) * diffuse + specular
        return np.asarray(scattered + below)

    def add_jacobian(
        self, prepared: tuple[Any, Any, Basis], internal: FloatArray, out: FloatArray
    ) -> None:
        """Write the derivatives by the surface's coordinates, w, artanh(g) and tau."""
        w, g, tau = self._dust_values(internal)
        dust = prepared[2]
        self.below.add_jacobian(prepared[0], internal[self._diffuse], out[self._diffuse])
        self.above.add_jacobian(prepared[1], internal[self._specular], out[self._specular])
        diffuse = self.below.value(prepared[0], internal[self._diffuse])
        opacity, phase = _opacity(dust.path, tau), _phase(dust, g)
        unit = opacity * phase * dust.factor
        slope = -_transmission_slope(dust.path, tau) * phase * dust.factor
        first = self._surface.stop
        if self.form == "blinn":
            specular = self.above.value(prepared[1], internal[self._specular])
            out[self._surface] *= _transmission(dust.view_path, tau)
            below = _transmission_slope(dust.view_path, tau) * (diffuse + specular)
        else:
            out[self._diffuse] *= _transmission(dust.path, tau)
            below = _transmission_slope(dust.path, tau) * diffuse
        for channel in range(3):
            out[first + channel, channel] = unit
        # d g / d artanh(g) = 1 - g^2
        turn = opacity * dust.factor * _phase_slope(dust, g) * ((1 - g) * (1 + g))
        out[first + 3] = w[:, None] * turn
        out[first + 4] = w[:, None] * slope + below

    def _dust_values(self, internal: FloatArray) -> tuple[FloatArray, float, float]:
        first = self._surface.stop
        return (
            internal[first : first + 3],
            math.tanh(float(internal[first + 3])),
            float(internal[first + 4]),
        )

    def _attenuated(self, term: Term) -> Term:
        """Return a surface term as seen through the dust: tau becomes its last shape."""

        def vector(prepared: Any, shapes: Sequence[float], typical: float) -> FloatArray:
            dust: Basis = prepared[2]
            path = dust.view_path if self.form == "blinn" else dust.path
            below = term.vector(prepared, shapes[:-1], typical)
            return np.asarray(_transmission(path, shapes[-1]) * below)

        return Term(term.amplitudes, (*term.shapes, "tau"), vector)


def _basis(light: FloatArray, view: FloatArray, *, light_weighted: bool) -> Basis:
    cos_light, cos_view = light[:, 2], view[:, 2]
    both, apart = light + view, light - view
    factor = (cos_light if light_weighted else 1.0) / (cos_light + cos_view)
    return Basis(
        path=1 / cos_light + 1 / cos_view,
        view_path=1 / cos_view,
        factor=factor,
        q_forward=0.5 * np.einsum("ij,ij->i", both, both),
        q_backward=0.5 * np.einsum("ij,ij->i", apart, apart),
    )


# For tau < 0, where an unbounded solver may step, the exponentials go on as their tangents.
def _transmission(path: FloatArray, tau: float) -> FloatArray:
    return np.exp(-tau * path) if tau >= 0 else 1 - tau * path


def _opacity(path: FloatArray, tau: float) -> FloatArray:
    return -np.expm1(-tau * path) if tau >= 0 else tau * path


def _transmission_slope(path: FloatArray, tau: float) -> FloatArray:
    return -path * np.exp(-tau * path) if tau >= 0 else -path


def _denominator(dust: Basis, g: float) -> FloatArray:
    q = dust.q_forward if g >= 0 else dust.q_backward
    return np.asarray((1 - abs(g)) ** 2 + 2 * abs(g) * q)


def _phase(dust: Basis, g: float) -> FloatArray:
    return np.asarray((1 - g) * (1 + g) * _denominator(dust, g) ** -1.5)


def _phase_slope(dust: Basis, g: float) -> FloatArray:
    base = _denominator(dust, g)
    turn = dust.q_forward - (1 - g) if g >= 0 else (1 + g) - dust.q_backward
    return np.asarray(base**-1.5 * (-2 * g - 3 * (1 - g) * (1 + g) * turn / base))


def _dust_vector(prepared: Any, shapes: Sequence[float], _typical: float) -> FloatArray:
    dust: Basis = prepared[2]
    return _opacity(dust.path, shapes[1]) * _phase(dust, math.tanh(shapes[0])) * dust.factor


def _over(*surface: ReflectanceModel, paper: bool = False, blinn: bool = False) -> DustOverSurface:
    diffuse = [part for part in surface if part.diffuse]
    specular = [part for part in surface if not part.diffuse]
    if not (diffuse and specular) or list(surface) != diffuse + specular:
        raise ValueError(
            f"dust over {'+'.join(part.name for part in surface)}: below dust there are diffuse "
            f"models, then specular ones, at least one of each, as in 'oren_nayar+torrance_sparrow'"
        )
    below, above = (p[0] if len(p) == 1 else SumModel(p) for p in (diffuse, specular))
    return DustOverSurface(below, above, "paper" if paper else "blinn" if blinn else "reciprocal")


REGISTERED = (
    Registration(
        "dust",
        "layer: single scattering above a surface, which is seen attenuated",
        _over,
        options=("paper", "blinn"),
        exclusive=(("paper", "blinn"),),
        over=True,
    ),
)
