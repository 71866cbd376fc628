"""Dust over a surface, its three forms, against the printed formulas in 110 digits."""

from __future__ import annotations

import pytest

from tests.fitting.hard_directions import every, ordinary_directions
from tests.fitting.precision import (
    Number,
    Terms,
    Vector,
    angles,
    check_jacobian,
    check_value,
    float32_cost,
    mp,
    mpf,
)
from tests.fitting.test_precision_oren_nayar import lambert, oren_nayar
from tests.fitting.test_precision_torrance_sparrow import torrance_sparrow
from tvbrdf_fitting.models import get_model


def dust_over(below: Terms, below_count: int, form: str) -> Terms:
    """Return dust over a diffuse reference with its number of parameters, and Torrance-Sparrow."""

    def terms(light: Vector, view: Vector, parameters: list[Number], channel: int) -> list[Number]:
        at = angles(light, view)
        diffuse = below(light, view, parameters[:below_count], channel)
        specular = torrance_sparrow(light, view, parameters[below_count : below_count + 2], channel)
        w, (g, tau) = parameters[below_count + 2 + channel], parameters[-2:]
        cos_i, cos_r = at.cos_i, at.cos_r
        path = 1 / cos_i + 1 / cos_r
        cos_gamma = -sum(a * b for a, b in zip(light, view, strict=True))
        phase = (1 - g**2) / (1 + g**2 - 2 * g * cos_gamma) ** 1.5
        dust = w * phase * (1 if form == "reciprocal" else cos_i) / (cos_i + cos_r)
        # 1 - T: for T near 1 as expm1, for T = 1e-300 as two terms, or its digits are lost here too
        thin = tau * path < 1
        opacity = [-mp.expm1(-tau * path)] if thin else [mpf(1), -mp.exp(-tau * path)]
        scattered = [dust * part for part in opacity]
        if form == "blinn":
            seen = mp.exp(-tau / cos_r)
            return scattered + [seen * term for term in diffuse + specular]
        return scattered + [mp.exp(-tau * path) * term for term in diffuse] + specular

    return terms


FORMS = {"reciprocal": "dust", "paper": "dust(paper)", "blinn": "dust(blinn)"}

G_AND_TAU = (
    (0.35, 0.6),
    (-0.35, 1e-300),
    (1 - 1e-9, 0.6),
    (-1 + 1e-9, 0.6),
    (0.9, 50.0),
    (-0.6, 0.0),
    (0.5, 1e-100),
    (0.0, 1e-8),
    (1e-9, 3.0),
    (-1e-200, 1e-3),
    (0.999, 1e-12),
    (-0.999, 7e-10),
)
W = (0.05, 0.06, 0.07)


@pytest.mark.parametrize(("g", "tau"), G_AND_TAU)
@pytest.mark.parametrize("form", FORMS)
def test_dust(form: str, g: float, tau: float) -> None:
    # over Lambert, whose reference is quick; without a surface too, which would hide thin dust
    name, reference = f"{FORMS[form]}+lambert+torrance_sparrow", dust_over(lambert, 3, form)
    start = G_AND_TAU.index((g, tau))
    step = 16 if form == "reciprocal" else 32
    for surface in ((0.2, 0.5, 0.9, 0.8), (0.0, 0.0, 0.0, 0.0)):
        values = [*surface, 6.0, *W, g, tau]
        check_value(name, reference, values, *every(4, start % 4))
        check_jacobian(name, reference, values, *every(step, (5 * start) % step))


@pytest.mark.parametrize("form", FORMS)
def test_dust_over_oren_nayar(form: str) -> None:
    name, reference = f"{FORMS[form]}+oren_nayar+torrance_sparrow", dust_over(oren_nayar, 4, form)
    values = [0.2, 0.5, 0.9, 0.4, 0.8, 6.0, *W, 0.35, 0.6]
    check_value(name, reference, values, *every(4))
    check_jacobian(name, reference, values, *every(24, 3))


def test_cost_of_float32() -> None:
    reference = dust_over(oren_nayar, 4, "reciprocal")
    pairs = ordinary_directions()
    typical = get_model("dust").typical
    cost = float32_cost("dust+oren_nayar+torrance_sparrow", reference, typical, *pairs)
    # of the order of float32's eps, 1.2e-7: nothing here magnifies it
    assert cost.largest < 3e-7
    assert cost.largest_eps <= 1.0
