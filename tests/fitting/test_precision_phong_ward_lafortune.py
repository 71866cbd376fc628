"""Phong, Ward and Lafortune against their printed formulas in 110 digits."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.fitting.hard_directions import direction, every, hard_directions
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
from tvbrdf_fitting.geometry import FloatArray
from tvbrdf_fitting.models import get_model
from tvbrdf_fitting.models.phong import EXPONENT_BOUNDS
from tvbrdf_fitting.models.ward import ALPHA_BOUNDS

KS = 0.37
EXPONENTS = (EXPONENT_BOUNDS[0], 1.7, 40.0, 3e3, EXPONENT_BOUNDS[1])
ALPHAS = (ALPHA_BOUNDS[0], 0.03, 0.15, 0.5, ALPHA_BOUNDS[1])
WARD_FORMS = ("ward", "ward(duer)", "ward(balanced)")
ANISOTROPIC = {
    "nearly isotropic": (0.2, 0.2 * (1 + 1e-9), 0.3),
    "isotropic": (0.2, 0.2, -0.7),
    "brushed": (0.05, 0.4, 0.9),
    "very brushed": (1.5, 0.005, -2.0),
    "sharp": (0.005, 0.007, 0.0),
}


def mirror_cosine(light: Vector, view: Vector) -> Number:
    """r.v with r = 2 (n.l) n - l, as the papers have it."""
    return 2 * light[2] * view[2] - mp.fsum(a * b for a, b in zip(light, view, strict=True))


def phong(light: Vector, view: Vector, parameters: list[Number], channel: int) -> list[Number]:
    """Form of 1975; one Ks, or one a channel."""
    ks, exponent = parameters[0 if len(parameters) == 2 else channel], parameters[-1]
    return [ks * max(mpf(0), mirror_cosine(light, view)) ** exponent / light[2]]


def phong_energy_conserving(
    light: Vector, view: Vector, parameters: list[Number], _channel: int
) -> list[Number]:
    """Form of 1994."""
    ks, exponent = parameters
    power = max(mpf(0), mirror_cosine(light, view)) ** exponent
    return [ks * (exponent + 2) / (2 * mp.pi) * power]


def lafortune(light: Vector, view: Vector, parameters: list[Number], channel: int) -> list[Number]:
    """One lobe with C_z = 1; one Ks, or one a channel."""
    ks = parameters[0 if len(parameters) == 3 else channel]
    cxy, exponent = parameters[-2:]
    product = cxy * (light[0] * view[0] + light[1] * view[1]) + light[2] * view[2]
    return [ks * max(mpf(0), product) ** exponent]


def ward(name: str) -> Terms:
    """Return the printed form of a name; one Ks, or one a channel."""

    def terms(light: Vector, view: Vector, parameters: list[Number], channel: int) -> list[Number]:
        at = angles(light, view)
        half = [a + b for a, b in zip(light, view, strict=True)]
        if "anisotropic" in name:
            alpha_x, alpha_y, phi_x = parameters[-3:]
            phi_h = mp.atan2(half[1], half[0]) - phi_x
            spread = (mp.cos(phi_h) / alpha_x) ** 2 + (mp.sin(phi_h) / alpha_y) ** 2
        else:
            alpha_x = alpha_y = parameters[-1]
            spread = 1 / alpha_x**2
        lobe = mp.exp(-(mp.tan(at.theta_h) ** 2) * spread) / (4 * mp.pi * alpha_x * alpha_y)
        cosines = mp.cos(at.theta_i) * mp.cos(at.theta_r)
        if "duer" in name:
            lobe /= cosines
        elif "balanced" in name:
            lobe *= 4 * mp.fsum(c * c for c in half) / half[2] ** 4
        else:
            lobe /= mp.sqrt(cosines)
        return [parameters[channel if "coloured" in name else 0] * lobe]

    return terms


def around_mirror(width: float) -> tuple[FloatArray, FloatArray]:
    """Return pairs whose half vector is 0 to about 26 widths (slope) off the normal, any side."""
    rng = np.random.default_rng(5)
    pairs = []
    for cosine in (1.0, 1 - 1e-9, 0.97, 0.6, 0.1, 1e-3, 1e-7):
        for off in (0.0, 1e-7, 1e-2, 0.4, 1.0, 3.0, 9.0, 18.0, 25.5):
            light = direction(cosine, rng.uniform(-3, 3))
            turn = rng.uniform(-np.pi, np.pi)
            half = np.array([off * width * np.cos(turn), off * width * np.sin(turn), 1.0])
            half /= np.linalg.norm(half)
            view = 2 * (light @ half) * half - light
            if view[2] > 0:
                pairs.append((light, view / np.linalg.norm(view)))
    assert len(pairs) > 20
    light, view = (np.array(vectors) for vectors in zip(*pairs, strict=True))
    return light, view


def both(name: str, reference: Terms, values: list[float], width: float, step: int = 1) -> None:
    """Check value and Jacobian, near the peak in all directions and at the hard directions.

    The Jacobian's share is a `step`-th: its references take a hundred evaluations each.
    """
    light, view = around_mirror(width)
    check_value(name, reference, values, light, view)
    check_jacobian(name, reference, values, light[::step], view[::step])
    check_value(name, reference, values, *hard_directions())
    check_jacobian(name, reference, values, *every(6 * step))


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_phong(exponent: float) -> None:
    width = 1 / math.sqrt(2 * exponent)
    both("phong", phong, [KS, exponent], width)
    both("phong(energy_conserving)", phong_energy_conserving, [KS, exponent], width)


@pytest.mark.parametrize("exponent", EXPONENTS)
@pytest.mark.parametrize("cxy", [-1.3, -1.001, -1.0, -0.8, 1e-6, 0.7])
def test_lafortune(cxy: float, exponent: float) -> None:
    if exponent * math.log(max(abs(cxy), 1.0)) < 200:  # above, the model caps what grows past 1e86
        both("lafortune", lafortune, [KS, cxy, exponent], 1 / math.sqrt(2 * exponent), step=2)


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("name", WARD_FORMS)
def test_ward(name: str, alpha: float) -> None:
    both(name, ward(name), [KS, alpha], alpha)


@pytest.mark.parametrize("case", ANISOTROPIC)
@pytest.mark.parametrize("name", ["ward(anisotropic)", "ward(anisotropic,balanced)"])
def test_ward_anisotropic(name: str, case: str) -> None:
    values = ANISOTROPIC[case]
    both(name, ward(name), [KS, *values], min(values[:2]), step=4)


def test_coloured() -> None:
    names: dict[str, tuple[Terms, list[float]]] = {
        "phong(coloured)": (phong, [30.0]),
        "lafortune(coloured)": (lafortune, [-0.9, 30.0]),
        "ward(coloured)": (ward("ward(coloured)"), [0.2]),
        "ward(anisotropic,coloured)": (ward("ward(anisotropic,coloured)"), [0.2, 0.4, 0.3]),
    }
    for name, (reference, shapes) in names.items():
        for check in (check_value, check_jacobian):
            check(name, reference, [0.3, 0.7, 1.9, *shapes], *every(15), channels=(0, 1, 2))


def test_cxy_zero() -> None:
    # value only: a step of 1e-30 in a parameter that is 0 is no small step beside l_z v_z = 1e-24
    for exponent in EXPONENTS:
        check_value("lafortune", lafortune, [KS, 0.0, exponent], *hard_directions())


@pytest.mark.parametrize(
    ("name", "reference", "values", "width"),
    [
        ("phong", phong, [KS, 40.0], 0.11),
        ("phong(energy_conserving)", phong_energy_conserving, [KS, 3e3], 0.013),
        ("lafortune", lafortune, [KS, -0.9, 40.0], 0.11),
        ("ward", ward("ward"), [KS, 0.15], 0.15),
        ("ward", ward("ward"), [KS, 0.03], 0.03),
        ("ward(anisotropic)", ward("ward(anisotropic)"), [KS, 0.05, 0.4, 0.9], 0.05),
    ],
)
def test_float32_inputs_cost_their_rounding(
    name: str, reference: Terms, values: list[float], width: float
) -> None:
    # half an eps32 of every input, and as much of the vectors' lengths, which are 1 no longer
    light, view = around_mirror(width)
    seen = (light[:, 2] > 0.05) & (view[:, 2] > 0.05)
    seen[seen] = get_model(name).evaluate(light[seen], view[seen], values)[:, 0] > 1e-30
    cost = float32_cost(name, reference, values, light[seen], view[seen])
    assert cost.largest_eps <= 2
    assert cost.median < 1e-6
