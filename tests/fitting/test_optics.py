"""Fresnel, Snell, total reflection and the radiance of refracted light."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import pytest
from mpmath import mp, mpf
from scipy.integrate import quad

from tvbrdf_fitting.models.optics import (
    eta_of_normal_reflectance,
    fresnel_conductor,
    fresnel_conductor_slopes,
    fresnel_dielectric,
    fresnel_dielectric_slopes,
    normal_reflectance,
    radiance_scale,
    reflect,
    refract,
    transmittance_dielectric,
)

EPS = float(np.finfo(np.float64).eps)
COSINES = (1.0, 1 - 1e-9, 0.99, 0.9, 0.7, 0.5, 0.3, 0.1, 1e-2, 1e-4, 1e-8, 1e-12)
GLASS, WATER = 1.5, 1.333


def directions(cosine: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    sine = np.sqrt((1 - cosine) * (1 + cosine))
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=1)


# ---- references in 50 digits, from the printed formulas


def exact_dielectric(cos: mpf, eta: mpf) -> mpf:
    """Fresnel's formulas with Snell's law, from either side."""
    n, c = (eta, cos) if cos >= 0 else (1 / eta, -cos)
    inside = 1 - (1 - c * c) / n**2
    if inside <= 0:
        return mpf(1)
    t = mp.sqrt(inside)
    r_s, r_p = (c - n * t) / (c + n * t), (n * c - t) / (n * c + t)
    return (r_s**2 + r_p**2) / 2


def exact_conductor(cos: mpf, eta: mpf, k: mpf) -> mpf:
    n = mp.mpc(eta, k)
    t = mp.sqrt(1 - (1 - cos * cos) / n**2)
    r_s, r_p = (cos - n * t) / (cos + n * t), (n * cos - t) / (n * cos + t)
    return (abs(r_s) ** 2 + abs(r_p) ** 2) / 2


def derivative(function: Callable[..., mpf], index: int, *inputs: mpf) -> mpf:
    step = mpf(10) ** -16 * inputs[index]
    sides = []
    for sign in (1, -1):
        moved = list(inputs)
        moved[index] += sign * step
        sides.append(function(*moved))
    return (sides[0] - sides[1]) / (2 * step)


def errors_in_eps(
    function: Callable[..., mpf], got: Sequence[np.ndarray], inputs: Sequence[float]
) -> list[float]:
    """Errors of value and slopes over eps (|wanted| + sum |input x derivative by it|)."""
    exact = [mpf(x) for x in inputs]
    count = len(exact)
    derivatives: tuple[Callable[..., mpf], ...] = (
        function,
        *(partial(derivative, function, i) for i in range(count)),
    )
    errors = []
    for number, wanted in zip(got, derivatives, strict=True):
        here = wanted(*exact)
        terms = [abs(here), *(abs(exact[i] * derivative(wanted, i, *exact)) for i in range(count))]
        scale = mp.fsum(terms)
        errors.append(float(abs(mpf(float(number)) - here) / scale) / EPS if scale else 0.0)
    return errors


class TestAgainstFiftyDigits:
    """|error| <= 16 eps (|wanted| + sum |input x derivative|), value and derivatives."""

    @pytest.mark.parametrize("eta", [1 + 1e-9, 1.05, WATER, GLASS, 3.0, 1 - 1e-9, 0.7])
    @pytest.mark.parametrize("side", [1, -1])
    def test_dielectric(self, eta: float, side: int) -> None:
        with mp.workdps(50):
            for c in COSINES:
                got = fresnel_dielectric_slopes(side * c, eta)
                assert max(errors_in_eps(exact_dielectric, got, (side * c, eta))) <= 16

    @pytest.mark.parametrize("eta", [0.05, 0.2, 1 + 1e-9, 1.1, GLASS, 6.0])
    @pytest.mark.parametrize("k", [1e-6, 0.1, 1.0, 4.0, 12.0])
    def test_conductor(self, eta: float, k: float) -> None:
        with mp.workdps(50):
            for c in COSINES:
                got = fresnel_conductor_slopes(c, eta, k)
                assert max(errors_in_eps(exact_conductor, got, (c, eta, k))) <= 16

    @pytest.mark.parametrize("eta", [1 + 1e-9, WATER, 3.0])
    def test_nearly_equal_media_keep_relative_accuracy(self, eta: float) -> None:
        # F is (eta - 1)^2 / 4 = 2.5e-19 at 1 + 1e-9; 40 eps leave room for a factor of two in
        # sensitivity to eta - 1 at each square
        with mp.workdps(50):
            for c in (1.0, 0.9, 0.5, 0.1):
                wanted = exact_dielectric(mpf(c), mpf(eta))
                assert abs(mpf(float(fresnel_dielectric(c, eta))) / wanted - 1) < 40 * EPS

    @pytest.mark.parametrize("eta", [1.05, GLASS, 3.0])
    @pytest.mark.parametrize("side", [1, -1])
    def test_transmittance_keeps_relative_accuracy_at_grazing(self, eta: float, side: int) -> None:
        with mp.workdps(50):
            for c in COSINES:
                wanted = 1 - exact_dielectric(side * mpf(c), mpf(eta))
                got = mpf(float(transmittance_dielectric(side * c, eta)))
                # g^2 = c^2 + m has up to 20 times their relative error at 1.05 from below
                assert abs(got - wanted) <= 40 * EPS * wanted


# ---- what is known


def test_glass_reflects_four_percent() -> None:
    assert fresnel_dielectric(1.0, GLASS) == pytest.approx(0.04, rel=1e-15)
    assert fresnel_dielectric(-1.0, GLASS) == pytest.approx(0.04, rel=1e-15)
    assert normal_reflectance(GLASS) == pytest.approx(0.04, rel=1e-15)


def test_diffuse_light_on_glass() -> None:
    """D. B. Judd, "Fresnel Reflection of Diffusely Incident Light", 1942: 0.092 and 0.596."""
    above = quad(lambda c: 2 * c * float(fresnel_dielectric(c, GLASS)), 0, 1, epsabs=1e-9)[0]
    critical = math.sqrt(1 - 1 / GLASS**2)
    below = quad(lambda c: 2 * c * float(fresnel_dielectric(-c, GLASS)), critical, 1, epsabs=1e-9)
    assert above == pytest.approx(0.092, abs=5e-4)
    assert below[0] + critical**2 == pytest.approx(0.596, abs=5e-4)
    # what crosses is the same both ways, but for the solid angles' eta^2
    assert (1 - below[0] - critical**2) * GLASS**2 == pytest.approx(1 - above, abs=1e-7)


@pytest.mark.parametrize("eta", [WATER, GLASS, 2.42])
def test_parallel_light_is_not_reflected_at_brewsters_angle(eta: float) -> None:
    cos = 1 / math.sqrt(1 + eta**2)
    g = math.sqrt(cos**2 + eta**2 - 1)
    perpendicular = ((cos - g) / (cos + g)) ** 2
    # all that is left of the mean is the perpendicular half
    assert fresnel_dielectric(cos, eta) == pytest.approx(0.5 * perpendicular, rel=1e-14)
    assert perpendicular == pytest.approx(((eta**2 - 1) / (eta**2 + 1)) ** 2, rel=1e-14)


def test_figures_of_another_implementation() -> None:
    """As computed by Mitsuba 3.9.1 in single precision (`mi.fresnel`, `mi.fresnel_conductor`)."""
    cosines = [1.0, 0.7, 0.3, 0.05, -0.9, -0.8, -0.5]
    glass = [0.0400000, 0.0509169, 0.2077564, 0.7521305, 0.0463326, 0.1141411, 1.0]
    np.testing.assert_allclose(fresnel_dielectric(cosines, GLASS), glass, atol=2e-7)
    silver, other = [0.9519520, 0.9499415, 0.9419649, 0.9793397], [0.7844194, 0.7780019]
    np.testing.assert_allclose(fresnel_conductor(cosines[:4], 0.2, 3.9), silver, atol=2e-7)
    np.testing.assert_allclose(fresnel_conductor(cosines[:2], 1.1, 4.0), other, atol=2e-7)


def test_conductor_without_absorption_is_a_dielectric() -> None:
    for eta in (1.05, GLASS, 3.0):
        got = fresnel_conductor_slopes(COSINES, eta, 0.0)
        wanted = fresnel_dielectric_slopes(COSINES, eta)
        for one, other in zip(got[:3], wanted, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(got.by_k, 0.0, atol=1e-300)


def test_grazing_light_is_all_reflected_and_equal_media_reflect_nothing() -> None:
    assert fresnel_dielectric(0.0, GLASS) == 1.0
    assert fresnel_conductor(0.0, 1.1, 4.0) == pytest.approx(1.0, rel=1e-15)
    np.testing.assert_array_equal(fresnel_dielectric([0.0, 1e-12, 0.5, -0.3], 1.0), 0.0)
    np.testing.assert_allclose(transmittance_dielectric([1e-12, 0.5, -0.3], 1.0), 1.0, rtol=EPS)


# ---- total reflection, Snell


def test_total_reflection_begins_at_the_critical_angle() -> None:
    critical = math.sqrt(1 - 1 / GLASS**2)
    assert math.degrees(math.acos(critical)) == pytest.approx(41.810, abs=1e-3)
    inside = np.array([critical * 0.999999, critical * 0.5, 1e-12])
    slopes = fresnel_dielectric_slopes(-inside, GLASS)
    np.testing.assert_array_equal(slopes.reflectance, 1.0)
    np.testing.assert_array_equal(slopes.by_cos, 0.0)
    np.testing.assert_array_equal(slopes.by_eta, 0.0)
    np.testing.assert_array_equal(transmittance_dielectric(-inside, GLASS), 0.0)
    assert fresnel_dielectric(-critical * 1.0001, GLASS) < 1.0
    bundle = directions(-inside, 0 * inside)
    refraction = refract(bundle, GLASS)
    assert not refraction.transmitted.any()
    np.testing.assert_array_equal(refraction.direction, 0.0)


@pytest.mark.parametrize("eta", [1 + 1e-9, GLASS, 0.7])
def test_refraction_obeys_snell(eta: float) -> None:
    rng = np.random.default_rng(0)
    incident = directions(rng.uniform(-1, 1, 500), rng.uniform(-np.pi, np.pi, 500))
    onward, transmitted = refract(incident, eta)
    n = np.where(incident[:, 2] > 0, eta, 1 / eta)
    np.testing.assert_array_equal(transmitted, np.hypot(*incident.T[:2]) < n)
    incident, onward, n = incident[transmitted], onward[transmitted], n[transmitted]
    assert (incident[:, 2] * onward[:, 2] < 0).all()
    # unit vectors of float64, and n of 1 + 1e-9 from below
    np.testing.assert_allclose(np.linalg.norm(onward, axis=1), 1.0, atol=4 * EPS)
    np.testing.assert_allclose(-onward[:, :2] * n[:, None], incident[:, :2], atol=2 * EPS)
    back = refract(onward, eta)
    assert back.transmitted.all()
    # near the critical angle cos is the root of a small difference
    np.testing.assert_allclose(back.direction[:, :2], incident[:, :2], atol=1e-15)
    np.testing.assert_allclose(back.direction, incident, atol=1e-7)


def test_reflectance_is_the_same_from_both_ends_of_a_path() -> None:
    """Stokes's reversibility."""
    cos = np.linspace(0.02, 1, 50)
    incident = directions(cos, 0 * cos)
    onward, _ = refract(incident, GLASS)
    np.testing.assert_allclose(
        fresnel_dielectric(onward[:, 2], GLASS), fresnel_dielectric(cos, GLASS), rtol=1e-12
    )


def test_refracted_beam_keeps_its_power() -> None:
    """d(power) = L cos(theta) d(omega): radiance grows by eta^2 as solid angles shrink."""
    cos, step = np.linspace(0.05, 0.95, 40), 1e-6

    def inside(c: np.ndarray) -> np.ndarray:
        return -refract(directions(c, 0 * c), GLASS).direction[:, 2]

    squeezed = (inside(cos + step) - inside(cos - step)) / (2 * step)  # d(omega) ratio
    power = radiance_scale(cos, GLASS) * inside(cos) / cos * squeezed
    np.testing.assert_allclose(power, 1.0, atol=1e-8)
    np.testing.assert_allclose(radiance_scale(-cos, GLASS) * GLASS**2, 1.0, rtol=1e-15)


def test_mirror_direction() -> None:
    np.testing.assert_array_equal(reflect([0.6, 0.0, 0.8]), [-0.6, 0.0, 0.8])
    np.testing.assert_array_equal(reflect([[0.0, 0.6, -0.8]]), [[0.0, -0.6, -0.8]])


def test_index_of_a_normal_reflectance_and_back() -> None:
    assert eta_of_normal_reflectance(0.04) == pytest.approx(GLASS, rel=1e-15)
    eta = np.array([1.0, 1 + 1e-9, WATER, GLASS, 4.0])
    again = eta_of_normal_reflectance(normal_reflectance(eta))
    np.testing.assert_allclose(again - 1, eta - 1, rtol=1e-6, atol=0)
    np.testing.assert_allclose(again, eta, rtol=4 * EPS)
    assert normal_reflectance(0.2, 3.9) == pytest.approx(float(fresnel_conductor(1.0, 0.2, 3.9)))


def test_an_undefined_direction_gives_an_undefined_reflectance() -> None:
    assert np.isnan(fresnel_dielectric([math.nan, -math.nan], GLASS)).all()
    assert np.isnan(transmittance_dielectric(math.nan, 1 / GLASS))


def test_impossible_media_are_refused() -> None:
    with pytest.raises(ValueError, match=r"eta must be finite and > 0, got -1\.5"):
        fresnel_dielectric([0.5, 0.6], [1.2, -1.5])
    with pytest.raises(ValueError, match="eta must be finite and > 0, got nan"):
        refract([0.0, 0.0, 1.0], math.nan)
    with pytest.raises(ValueError, match=r"k must be finite and >= 0, got -0\.1"):
        fresnel_conductor(0.5, 1.0, -0.1)
    with pytest.raises(
        ValueError, match=r"cos_theta of a conductor must be finite and >= 0, got -0\.5"
    ):
        fresnel_conductor(-0.5, 1.0, 1.0)
    with pytest.raises(ValueError, match=r"f0 must be in \[0, 1\), got 1\.0"):
        eta_of_normal_reflectance([0.0, 1.0])
    with pytest.raises(ValueError, match="three components"):
        refract([[0.0, 1.0]], GLASS)
