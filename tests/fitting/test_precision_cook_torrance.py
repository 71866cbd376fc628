"""Cook-Torrance against its printed formulas in 110 digits, and what microfacets must satisfy."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.integrate import quad

from tests.fitting.hard_directions import direction, every, hard_directions
from tests.fitting.precision import (
    Number,
    Terms,
    Vector,
    angles,
    check_jacobian,
    check_value,
    mp,
    mpf,
)
from tvbrdf_fitting.geometry import FloatArray
from tvbrdf_fitting.models import Lobe, get_model
from tvbrdf_fitting.models.facets import GGX, Beckmann

ALPHAS = (1e-4, 5e-3, 0.3, 10.0)
METALS = ((1.1, 4.0), (0.05, 12.0), (6.0, 0.1))


def beckmann(tan_h: Number, alpha: Number) -> Number:
    """D cos^4(theta_h)."""
    return mp.exp(-((tan_h / alpha) ** 2)) / (mp.pi * alpha**2)


def ggx(tan_h: Number, alpha: Number) -> Number:
    """D cos^4(theta_h)."""
    return alpha**2 / (mp.pi * (alpha**2 + tan_h**2) ** 2)


def beckmann_masking(tan: Number, alpha: Number) -> Number:
    if tan == 0:
        return mpf(1)
    a = 1 / (alpha * tan)
    return 2 / (1 + mp.erf(a) + mp.exp(-(a**2)) / (a * mp.sqrt(mp.pi)))


def ggx_masking(tan: Number, alpha: Number) -> Number:
    return 2 / (1 + mp.sqrt(1 + (alpha * tan) ** 2))


def dielectric(c: Number, eta: Number) -> Number:
    """Fresnel's reflectance as Cook and Torrance print it."""
    g = mp.sqrt(eta**2 + c**2 - 1)
    ratio = (c * (g + c) - 1) / (c * (g - c) + 1)
    return ((g - c) / (g + c)) ** 2 * (1 + ratio**2) / 2


def conductor(c: Number, eta: Number, k: Number) -> Number:
    """Mean square of Fresnel's two complex amplitudes."""
    n = mp.mpc(eta, k)
    inside = mp.sqrt(1 - (1 - c**2) / n**2)
    r_s, r_p = (c - n * inside) / (c + n * inside), (n * c - inside) / (n * c + inside)
    return (abs(r_s) ** 2 + abs(r_p) ** 2) / 2


def cook_torrance(name: str) -> Terms:
    """Return the reference of a model's name."""
    density, masking = (ggx, ggx_masking) if "ggx" in name else (beckmann, beckmann_masking)
    fresnel, indices = (conductor, 2) if "conductor" in name else (dielectric, 1)

    def terms(light: Vector, view: Vector, parameters: list[Number], channel: int) -> list[Number]:
        at = angles(light, view)
        ks = parameters[channel if "coloured" in name else 0]
        alpha, *index = parameters[-1 - indices :]
        d = density(mp.tan(at.theta_h), alpha) / mp.cos(at.theta_h) ** 4
        g = masking(mp.tan(at.theta_i), alpha) * masking(mp.tan(at.theta_r), alpha)
        f = fresnel(mp.cos(at.theta_d), *index)
        return [ks * d * f * g / (4 * mp.cos(at.theta_i) * mp.cos(at.theta_r))]

    return terms


def across_the_lobe(alpha: float) -> tuple[FloatArray, FloatArray]:
    """Return pairs in and out of a plane whose half vectors are 0 to 26 alpha off the normal."""
    rng = np.random.default_rng(5)
    lights, views = [], []
    for cosine in (1.0, 0.97, 0.5, 0.1, 3e-3):
        for off in (0.0, 1e-3, 0.5, 1.0, 3.0, 12.0, 25.5):
            azimuth = rng.uniform(-3, 3)
            theta = np.arccos(cosine) + 2 * off * alpha * rng.uniform(0.5, 1)
            if theta < np.pi / 2:
                turn = np.pi + off * alpha * rng.uniform(-1, 1)
                lights.append(direction(cosine, azimuth))
                views.append(direction(float(np.cos(theta)), azimuth + turn))
    return np.array(lights), np.array(views)


CASES: list[tuple[str, float, tuple[float, ...]]] = [
    *(("cook_torrance", alpha, (1.5,)) for alpha in ALPHAS),
    *(("cook_torrance(ggx)", alpha, (1.5,)) for alpha in ALPHAS),
    *(("cook_torrance(ggx)", 0.3, (eta,)) for eta in (1.05, 3.0)),
    ("cook_torrance", 1.0, (1 + 1e-9,)),
    *(("cook_torrance(conductor)", 0.3, index) for index in METALS[:2]),
    ("cook_torrance(ggx,conductor)", 1e-4, METALS[0]),
    ("cook_torrance(ggx,conductor)", 10.0, METALS[2]),
]


@pytest.mark.parametrize(("name", "alpha", "index"), CASES)
def test_value_and_derivatives(name: str, alpha: float, index: tuple[float, ...]) -> None:
    reference, values = cook_torrance(name), [0.8, alpha, *index]
    check_value(name, reference, values, *hard_directions())
    light, view = across_the_lobe(alpha)
    check_value(name, reference, values, light, view)
    # sensitivities of derivatives take a hundred evaluations of the reference: fewer directions
    check_jacobian(name, reference, values, *every(8))
    check_jacobian(name, reference, values, light[::2], view[::2])


@pytest.mark.parametrize("options", ["coloured", "ggx,conductor,coloured"])
def test_coloured(options: str) -> None:
    name = f"cook_torrance({options})"
    values = [0.3, 0.6, 0.9, 0.25, *((1.1, 4.0) if "conductor" in options else (1.5,))]
    light, view = every(20, 7)
    check_value(name, cook_torrance(name), values, light, view, channels=(0, 1, 2))
    check_jacobian(name, cook_torrance(name), values, light, view, channels=(0, 1, 2))


# ---- what microfacets must satisfy


NAMES = ("cook_torrance", "cook_torrance(ggx)")
FACETS = {"beckmann": Beckmann(), "ggx": GGX()}
FULL_MIRROR = (1.0, 1e7)
"""eta and k of a metal that absorbs 4e-14."""


@pytest.mark.parametrize("facets", FACETS)
@pytest.mark.parametrize("alpha", [0.005, 0.1, 0.7, 1.5])
def test_facets_cover_the_surface_once(facets: str, alpha: float) -> None:
    """Walter et al., equation 4 for the normal: the integral of D cos over the hemisphere is 1."""

    def integrand(x: float) -> float:
        tan = alpha * np.tan(x)  # spreads the lobe over the range of x
        theta = np.arctan(tan)
        d = FACETS[facets].density(np.array([tan**2]), alpha)[0] / np.cos(theta) ** 4
        spread = alpha / np.cos(x) ** 2 / (1 + tan**2)
        return float(2 * np.pi * d * np.cos(theta) * np.sin(theta) * spread)

    assert quad(integrand, 0, np.pi / 2, epsabs=1e-11)[0] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("facets", FACETS)
@pytest.mark.parametrize("alpha", [0.1, 0.7, 1.5])
@pytest.mark.parametrize("cosine", [0.97, 0.5, 0.1, 0.01])
def test_visible_facets_have_the_surfaces_visible_area(
    facets: str, alpha: float, cosine: float
) -> None:
    """Walter et al., equation 4: G1 integral of D max(0, v.h) is cos(theta_v)."""
    sine = np.sqrt(1 - cosine**2)

    def around(tan: float) -> float:
        """Integral of max(0, v.h) / cos(theta_h) over azimuths."""
        a, b = cosine, sine * tan
        if b <= a:
            return 2 * np.pi * a
        first = np.arccos(-a / b)
        return float(2 * (a * first + b * np.sin(first)))

    def integrand(x: float) -> float:
        tan = alpha * np.tan(x)
        p = FACETS[facets].density(np.array([tan**2]), alpha)[0]
        return float(p * tan * around(tan) * alpha / np.cos(x) ** 2)

    kink = np.arctan(cosine / sine / alpha)
    total = quad(integrand, 0, kink, epsabs=1e-11)[0]
    total += quad(integrand, kink, np.pi / 2, epsabs=1e-11)[0]
    masking = FACETS[facets].masking(np.array([sine / cosine]), alpha)[0]
    assert masking * total == pytest.approx(cosine, rel=1e-8)


def test_walters_approximation_of_beckmanns_masking() -> None:
    """Walter et al. state 0.35 % for their rational form (after equation 27)."""
    a = np.linspace(0.01, 1.599, 400)
    rational = (3.535 * a + 2.181 * a**2) / (1 + 2.276 * a + 2.577 * a**2)
    exact = Beckmann().masking(1 / a, 1.0)
    assert np.abs(rational / exact - 1).max() < 0.0036
    np.testing.assert_allclose(Beckmann().masking(1 / np.linspace(1.6, 9, 50), 1.0), 1, atol=0.006)


@pytest.mark.parametrize("options", ["conductor", "ggx,conductor"])
@pytest.mark.parametrize("alpha", [0.2, 0.6, 1.5])
def test_no_light_is_made(options: str, alpha: float) -> None:
    """Facets that reflect everything once: albedo 1 less what is hidden, 7 % for GGX at 0.2."""
    nodes, weights = np.polynomial.legendre.leggauss(300)
    cosine, azimuth = 0.5 * (nodes + 1), 0.5 * np.pi * (nodes + 1)
    grid = [a.ravel() for a in np.meshgrid(cosine, azimuth, indexing="ij")]
    sine = np.sqrt(1 - grid[0] ** 2)
    view = np.stack([sine * np.cos(grid[1]), sine * np.sin(grid[1]), grid[0]], axis=1)
    model = get_model(f"cook_torrance({options})")
    for light_cosine in (1.0, 0.8, 0.4, 0.1):
        light = direction(light_cosine, np.pi)
        brdf = model.evaluate(light, view, [1.0, alpha, *FULL_MIRROR])[:, 0].reshape(300, 300)
        albedo = np.pi * 0.5 * (weights * cosine) @ brdf @ weights
        assert albedo < 1
        if alpha == 0.2 and light_cosine > 0.5:
            assert albedo > 0.93


@pytest.mark.parametrize("name", [*NAMES, "cook_torrance(conductor)"])
def test_reciprocity_to_the_last_bit(name: str) -> None:
    light, view = hard_directions()
    model = get_model(name)
    there = model.evaluate(light, view, model.typical)
    np.testing.assert_array_equal(there, model.evaluate(view, light, model.typical))


@pytest.mark.parametrize("name", [*NAMES, "cook_torrance(ggx,conductor)"])
def test_finite_wherever_a_solver_steps(name: str) -> None:
    light, view = hard_directions()
    model = get_model(name)
    assert isinstance(model, Lobe)
    prepared = model.prepare(light, view)
    ends = (-1e3, -45.0, -10.0, 0.0, 10.0, 45.0, 1e3)
    for shapes in product(ends, repeat=len(model.shapes)):
        lobe, slopes = model.lobe_slopes(prepared, shapes)
        np.testing.assert_allclose(lobe, model.lobe(prepared, shapes), rtol=1e-13)
        assert np.isfinite(lobe).all()
        assert all(np.isfinite(slope).all() for slope in slopes)


_LIGHT = direction(0.8, 0.0)
_VIEWS = np.array(
    [direction(z, turn) for z, turn in ((0.8, 3.1), (0.5, 2.8), (0.1, 3), (0.9, 0.3))]
)
_MITSUBA = {
    "cook_torrance": (
        (0.2, (0.135671, 0.0446882, 0.0153995, 2.33894e-05)),
        (0.8, (0.00852793, 0.0158577, 0.0537926, 0.00727838)),
    ),
    "cook_torrance(conductor)": ((0.8, (0.151894, 0.229802, 0.451838, 0.142718)),),
    "cook_torrance(ggx)": (
        (0.2, (0.133357, 0.0347097, 0.0531667, 0.00200553)),
        (0.8, (0.00726683, 0.010493, 0.0240732, 0.00465543)),
    ),
    "cook_torrance(ggx,conductor)": ((0.2, (2.37528, 0.502994, 0.446581, 0.0393255)),),
}


@pytest.mark.parametrize("name", _MITSUBA)
def test_figures_of_another_implementation(name: str) -> None:
    """As computed by Mitsuba 3.9.1 in single precision (`roughdielectric`, `roughconductor`).

    Its Beckmann masking is the rational approximation, 0.35 % off for each direction.
    """
    index = METALS[0] if "conductor" in name else (1.5,)
    tolerance = 5e-6 if "ggx" in name else 0.007
    for alpha, wanted in _MITSUBA[name]:
        got = get_model(name).evaluate(_LIGHT, _VIEWS, [1.0, alpha, *index])[:, 0]
        np.testing.assert_allclose(got, wanted, rtol=tolerance)
