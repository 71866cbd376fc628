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

1 - T is taken as -expm1(-tau m), m the path length 1/mu_i + 1/mu_r, and Phi's denominator as
(1 - |g|)^2 + 2 |g| q with q = |l + v|^2 / 2 for g >= 0 and |l - v|^2 / 2 for g < 0: no difference
of nearly equal numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from ..geometry import FloatArray
from .base import ARTANH, Parameter, ReflectanceModel, Term
from .combination import SumModel, through
from .registry import Registration
from .torrance_sparrow import chords

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
# no thicker: from 4 the first step of an unbounded solver leads to 12, where nothing has a slope
_TAU = Parameter(
    "tau", "1", 0.0, 50.0, grid=(0.02, 0.07, 0.2, 0.6, 1.5, 3.0), full_scale=10.0, typical=0.6
)


@dataclass(frozen=True)
class Basis:
    """Functions of the directions (n,): path lengths, dust factor, q for both signs of g, l.v."""

    path: FloatArray
    view_path: FloatArray
    factor: FloatArray
    q_forward: FloatArray
    q_backward: FloatArray
    cosine: FloatArray


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
        self.isotropic = diffuse.isotropic and specular.isotropic
        self.delta = diffuse.delta or specular.delta
        self.parameters = (*diffuse.parameters, *specular.parameters, *_W, _G, _TAU)
        diffuse_count = len(diffuse.parameters)
        self._surface = slice(0, diffuse_count + len(specular.parameters))
        self._diffuse = slice(0, diffuse_count)
        self._specular = slice(diffuse_count, self._surface.stop)
        self.twins = tuple(
            tuple(replace(twin, first=diffuse_count + twin.first) for twin in kind)
            for kind in specular.twins
        )
        blinn = form == "blinn"
        self.terms = (
            *(self._attenuated(through(term, 0)) for term in diffuse.terms),
            *(
                self._attenuated(through(term, 1)) if blinn else through(term, 1)
                for term in specular.terms
            ),
            Term(W_NAMES, ("g", "tau"), _dust_vector),
        )

    def refuse(self, light: FloatArray, view: FloatArray) -> str | None:
        """Return why these directions cannot determine the surface below, or None."""
        return self.below.refuse(light, view) or self.above.refuse(light, view)

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
            below = _transmitted(diffuse + specular, dust.view_path, tau)
        else:
            below = _transmitted(diffuse, dust.path, tau) + specular
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
        opacity, (phase, phase_slope) = _opacity(dust.path, tau), _phase_and_slope(dust, g)
        thick = w[:, None] * (phase * dust.factor)
        first = self._surface.stop
        if self.form == "blinn":
            specular = self.above.value(prepared[1], internal[self._specular])
            _transmit(out[self._surface], dust.view_path, tau)
            out[first + 4] = _darkening(diffuse + specular, dust.view_path, tau)
            out[first + 4] -= _darkening(thick, dust.path, tau)
        else:
            _transmit(out[self._diffuse], dust.path, tau)
            out[first + 4] = _darkening(diffuse - thick, dust.path, tau)
        dense = opacity * dust.factor
        unit = dense * phase
        for channel in range(3):
            out[first + channel, channel] = unit
        # d g / d artanh(g) = 1 - g^2
        np.multiply(w[:, None], dense * phase_slope * ((1 - g) * (1 + g)), out=out[first + 3])

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
            return _transmitted(below, path, shapes[-1])

        return Term(term.amplitudes, (*term.shapes, "tau"), vector)


def _basis(light: FloatArray, view: FloatArray, *, light_weighted: bool) -> Basis:
    cos_light, cos_view = light[:, 2], view[:, 2]
    factor = (cos_light if light_weighted else 1.0) / (cos_light + cos_view)
    chord = chords(light, view)
    return Basis(
        path=1 / cos_light + 1 / cos_view,
        view_path=1 / cos_view,
        factor=factor,
        q_forward=0.5 * (chord.together + np.square(cos_light + cos_view)),
        q_backward=0.5 * (chord.apart + np.square(cos_light - cos_view)),
        cosine=chord.in_plane + cos_light * cos_view,
    )


# For tau < 0, where an unbounded solver may step, the exponentials go on as their tangents.
def _transmit(values: FloatArray, path: FloatArray, tau: float) -> FloatArray:
    """Multiply values by T in place. In halves: T may be too small for a number, T x value not."""
    if tau < 0:
        values *= 1 - tau * path
        return values
    half = np.exp((-0.5 * tau) * path)
    values *= half
    values *= half
    return values


def _transmitted(values: FloatArray, path: FloatArray, tau: float) -> FloatArray:
    return _transmit(values.copy(), path, tau)


def _darkening(values: FloatArray, path: FloatArray, tau: float) -> FloatArray:
    """Return the derivative of T x values by tau."""
    return _transmit(-path * values, path, max(tau, 0.0))


def _opacity(path: FloatArray, tau: float) -> FloatArray:
    return -np.expm1(-tau * path) if tau >= 0 else tau * path


def _phase(dust: Basis, g: float) -> FloatArray:
    base = _denominator(dust, g)
    return np.asarray((1 - g) * (1 + g) / (base * np.sqrt(base)))


def _phase_and_slope(dust: Basis, g: float) -> tuple[FloatArray, FloatArray]:
    """Phi and its derivative by g."""
    base, both = _denominator(dust, g), (1 - g) * (1 + g)
    # g + l.v, which is also q - (1 - g): the one of the two that has its digits
    if g >= 0:
        turn = np.where(dust.q_forward < 0.5, dust.q_forward - (1 - g), dust.cosine + g)
    else:
        turn = np.where(dust.q_backward < 0.5, (1 + g) - dust.q_backward, dust.cosine + g)
    power = 1 / (base * np.sqrt(base))
    return both * power, power * (-2 * g - 3 * both * turn / base)


def _denominator(dust: Basis, g: float) -> FloatArray:
    q = dust.q_forward if g >= 0 else dust.q_backward
    return np.asarray((1 - abs(g)) ** 2 + 2 * abs(g) * q)


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
