"""Albedos against closed forms and other integrals, and what holds for every model."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from tvbrdf_fitting.geometry import FloatArray, IntArray
from tvbrdf_fitting.models import Lambert, ReflectanceModel, catalogue, get_model
from tvbrdf_fitting.properties.albedo import directional_albedo, spread, symmetries, unit
from tvbrdf_fitting.properties.bihemispherical import hemispherical_reflectance
from tvbrdf_fitting.properties.quadrature import Integral, integrate

ANGLES = np.deg2rad([0.0, 20.0, 50.0, 75.0, 88.0])
PURE_DUST = "dust+lambert+torrance_sparrow"


def dust_values(w: float, tau: float = 50.0) -> list[float]:
    """Pure isotropic dust, nothing seen of what is below: Kd, Ks, 1/sigma_s, w, g, tau."""
    return [0, 0, 0, 0, 6, w, w, w, 0, tau]


def gauss_legendre(lower: float, upper: float, count: int) -> tuple[FloatArray, FloatArray]:
    x, weight = np.polynomial.legendre.leggauss(count)
    half = 0.5 * (upper - lower)
    return lower + half * (x + 1), half * weight


def albedo_in_directions(
    model: ReflectanceModel,
    parameters: list[float],
    theta_i: float,
    theta_breaks: list[float],
    phi_breaks: list[float],
    count: int,
) -> FloatArray:
    """The integral over views in angles and azimuths, both sides of the plane of incidence."""
    total = np.zeros(3)
    for lower, upper in pairwise(theta_breaks):
        theta, theta_weight = gauss_legendre(lower, upper, count)
        for first, last in pairwise(phi_breaks):
            phi, phi_weight = gauss_legendre(first, last, count)
            views = unit(theta[:, None], phi[None, :]).reshape(-1, 3)
            value = model.evaluate(unit(theta_i, 0.0), views, parameters)
            weight = np.outer(theta_weight * np.sin(theta) * np.cos(theta), phi_weight).ravel()
            total += 2 * weight @ value
    return total


# -- directional albedos with closed forms


def test_lambert_is_kd() -> None:
    found = directional_albedo(get_model("lambert"), [0.2, 0.5, 1.0], ANGLES)
    np.testing.assert_allclose(found.value, np.tile([0.2, 0.5, 1.0], (5, 1)), rtol=1e-13)
    assert (found.error <= 1e-8 * found.value).all()


@pytest.mark.parametrize("exponent", [1.0, 40.0, 1e3, 1e5])
def test_phong_at_its_closed_forms(exponent: float) -> None:
    original, conserving = get_model("phong"), get_model("phong(energy_conserving)")
    found = directional_albedo(conserving, [0.7, exponent], 0.0)
    np.testing.assert_allclose(found.value, 0.7, rtol=1e-8)
    found = directional_albedo(original, [0.7, exponent], 0.0)
    np.testing.assert_allclose(found.value, 2 * np.pi * 0.7 / (exponent + 2), rtol=1e-8)
    # seen along the normal under uniform light the cosine that it is divided by is gone
    found = directional_albedo(original, [0.7, exponent], 0.0, kind="hemispherical-directional")
    np.testing.assert_allclose(found.value, 2 * np.pi * 0.7 / (exponent + 1), rtol=1e-8)


@pytest.mark.parametrize("alpha", [0.005, 0.05, 0.5, 1.5])
def test_balanced_ward_at_normal_incidence(alpha: float) -> None:
    found = directional_albedo(get_model("ward(balanced)"), [0.9, alpha], 0.0)
    exact = 0.9 * (1 - alpha**2 * (1 - np.exp(-1 / alpha**2)))
    np.testing.assert_allclose(found.value, exact, rtol=1e-8)


@pytest.mark.parametrize("sigma_s", [1e-4, 0.005, 0.02])
def test_narrow_torrance_sparrow_is_ks_pi_sigma_squared(sigma_s: float) -> None:
    found = directional_albedo(get_model("torrance_sparrow"), [1.3, 1 / sigma_s], ANGLES[:4])
    # the next term of the expansion in sigma_s is -2/3 sigma_s^2 of it
    expected = 1.3 * np.pi * sigma_s**2
    np.testing.assert_allclose(found.value, expected, rtol=sigma_s**2 + 1e-8)
    assert (np.abs(found.value[0] / expected - 1 + 2 / 3 * sigma_s**2) < sigma_s**4 + 2e-8).all()


@pytest.mark.parametrize("theta_deg", [0.0, 30.0, 60.0, 85.0, 89.9])
def test_thick_dust_at_every_angle(theta_deg: float) -> None:
    # exp(-100), what the dust of tau = 50 lets through at most, is nothing
    found = directional_albedo(get_model(PURE_DUST), dust_values(0.1), np.deg2rad(theta_deg))
    mu = np.cos(np.deg2rad(theta_deg))
    exact = 2 * np.pi * 0.1 * (1 - mu * np.log((1 + mu) / mu))
    np.testing.assert_allclose(found.value, exact, rtol=1e-8)


def test_oren_nayar_creates_energy_where_it_is_known_to() -> None:
    found = directional_albedo(get_model("oren_nayar"), [1, 1, 1, 0.3], np.deg2rad([75.0, 89.0]))
    # published to three digits
    np.testing.assert_allclose(found.value[:, 0], [1.005, 1.044], atol=5e-4)


def test_ideal_surfaces_count_with_their_weight() -> None:
    glass = get_model("ideal_mirror(dielectric)+ideal_refraction")
    for eta in (1.5, 0.7):  # from outside, and from inside: totally reflected beyond 44 degrees
        values = [1, 1, 1, eta, 1, 1, 1, eta]
        found = directional_albedo(glass, values, ANGLES)
        np.testing.assert_allclose(found.value, 1.0, rtol=1e-9)
        whole = hemispherical_reflectance(glass, values)
        np.testing.assert_allclose(whole.value, 1.0, rtol=1e-6)
    sum_ = get_model("lambert+ideal_mirror")
    found = directional_albedo(sum_, [0.2, 0.3, 0.4, 0.1, 0.2, 0.3], ANGLES)
    np.testing.assert_allclose(found.value, np.tile([0.3, 0.5, 0.7], (5, 1)), rtol=1e-12)


# -- against integrals over directions


@pytest.mark.parametrize("theta_deg", [10.0, 45.0, 80.0])
def test_oren_nayar_against_an_integral_over_directions(theta_deg: float) -> None:
    # smooth between theta_r = theta_i and a difference of azimuth of 90 degrees
    theta_i, values = np.deg2rad(theta_deg), [0.3, 0.6, 1.0, 0.5]
    model = get_model("oren_nayar")
    breaks = [0.0, theta_i, np.pi / 2], [0.0, np.pi / 2, np.pi]
    expected = albedo_in_directions(model, values, theta_i, *breaks, 40)
    found = directional_albedo(model, values, theta_i)
    np.testing.assert_allclose(found.value, expected, rtol=1e-8)


@pytest.mark.parametrize("theta_deg", [20.0, 55.0])
@pytest.mark.parametrize("sigma_s", [0.005, 0.02])
def test_narrow_lobe_against_an_integral_around_it(theta_deg: float, sigma_s: float) -> None:
    # the lobe is some 2 sigma_s wide in theta_r, and 2 sigma_s / tan(theta_i) in azimuth; beyond
    # 8 of these it is below exp(-60)
    theta_i, model = np.deg2rad(theta_deg), get_model("torrance_sparrow")
    near, turn = 16 * sigma_s, 16 * sigma_s / np.tan(theta_i)
    breaks = [theta_i - near, theta_i, theta_i + near], [np.pi - turn, np.pi]
    expected = albedo_in_directions(model, [1, 1 / sigma_s], theta_i, *breaks, 120)
    found = directional_albedo(model, [1, 1 / sigma_s], theta_i)
    np.testing.assert_allclose(found.value, expected, rtol=1e-8)


@pytest.mark.parametrize(
    ("name", "values", "theta_deg", "centre_deg", "phi"),
    [
        # retro-reflecting dust, 0.01 rad wide; a lobe that leans off the mirror direction
        (PURE_DUST, [0, 0, 0, 0, 6, 0.1, 0.1, 0.1, -0.99, 50], 40.0, 40.0, 0.0),
        ("lafortune", [1.0, -1.1, 3000.0], 40.0, np.rad2deg(np.arctan(1.1 * np.tan(0.698))), np.pi),
        ("lafortune", [1.0, 0.9, 3000.0], 40.0, np.rad2deg(np.arctan(0.9 * np.tan(0.698))), 0.0),
    ],
)
def test_narrow_peaks_off_the_mirror_direction(
    name: str, values: list[float], theta_deg: float, centre_deg: float, phi: float
) -> None:
    theta_i, model = np.deg2rad(theta_deg), get_model(name)
    centre = np.deg2rad(centre_deg)
    # panels that shrink towards the peak, over the whole hemisphere
    steps = np.array([0.003, 0.01, 0.03, 0.1, 0.3])
    thetas = np.concatenate([[0], centre - steps, [centre], centre + steps, [np.pi / 2]])
    phis = np.abs(phi - np.concatenate([[0], steps, [1.0, np.pi]]))
    expected = albedo_in_directions(
        model, values, theta_i, sorted(thetas.tolist()), sorted(phis.tolist()), 24
    )
    found = directional_albedo(model, values, theta_i)
    np.testing.assert_allclose(found.value, expected, rtol=1e-7)


class Ridge(Lambert):
    """A lobe so narrow along one tangent, at an odd azimuth, that it is a blade; albedo 1.

    Its normalised Gaussian slopes lie within the visible half angles at normal incidence but for
    exp(-(1 / 0.2)^2), and the factors of the Jacobian are divided by.
    """

    isotropic = False
    reciprocal = False
    widths = (0.005, 0.2)
    azimuth = 0.61

    def prepare(self, light: FloatArray, view: FloatArray) -> FloatArray:
        half = light + view
        half /= np.linalg.norm(half, axis=1)[:, None]
        cosine, sine = np.cos(self.azimuth), np.sin(self.azimuth)
        p = (cosine * half[:, 0] + sine * half[:, 1]) / half[:, 2] / self.widths[0]
        q = (cosine * half[:, 1] - sine * half[:, 0]) / half[:, 2] / self.widths[1]
        slopes = np.exp(-p * p - q * q) / (np.pi * self.widths[0] * self.widths[1])
        jacobian = 4 * view[:, 2] * np.einsum("ij,ij->i", light, half) * half[:, 2] ** 3
        return np.asarray(slopes / jacobian)


def test_a_blade_is_caught_at_every_azimuth() -> None:
    phi = np.linspace(0, np.pi, 7)
    found = directional_albedo(Ridge(), [1, 1, 1], 0.0, phi_i=phi)
    np.testing.assert_allclose(found.value, 1.0, rtol=1e-8)
    assert found.value.shape == (7, 3)
    tilted = directional_albedo(Ridge(), [1, 1, 1], 0.3, phi_i=phi)
    # the cut half angles hold exp(-(0.7 / 0.2)^2) of it at most
    np.testing.assert_allclose(tilted.value, 1.0, rtol=1e-5)


# -- properties of every model


@pytest.mark.parametrize("name", catalogue())
def test_stated_errors_hold_and_reciprocity_is_one_albedo(name: str) -> None:
    model = get_model(name)
    theta = np.deg2rad([0.0, 40.0, 80.0, 89.5])
    exact = directional_albedo(model, model.typical, theta, tolerance=1e-10)
    for tolerance in (1e-2, 1e-5):
        found = directional_albedo(model, model.typical, theta, tolerance=tolerance)
        assert (np.abs(found.value - exact.value) <= found.error + exact.error).all()
        assert (found.error <= tolerance * found.value).all()
    other = directional_albedo(
        model, model.typical, theta, tolerance=1e-10, kind="hemispherical-directional"
    )
    same = np.allclose(exact.value, other.value, rtol=1e-9, atol=0)
    assert same == model.reciprocal


@pytest.mark.parametrize("name", catalogue())
def test_bihemispherical_is_the_mean_albedo(name: str) -> None:
    """Two integrals that share neither coordinates nor order."""
    model = get_model(name)
    isotropic = symmetries(model, model.typical).isotropic
    tolerance = 1e-5 if isotropic else 1e-2
    whole = hemispherical_reflectance(model, model.typical, tolerance=tolerance)
    assert (whole.error <= tolerance * whole.value).all()
    turns = np.array([0.0]) if isotropic else np.linspace(0, np.pi, 9)[:-1]

    def albedo(theta: FloatArray, _: IntArray) -> Integral:
        found = directional_albedo(
            model, model.typical, theta[..., None], phi_i=turns, tolerance=0.1 * tolerance
        )
        weight = np.sin(2 * theta)[..., None]
        return Integral(weight * found.value.mean(axis=-2), weight * found.error.mean(axis=-2))

    mean = integrate(albedo, np.array([[0.0, 0.8, 1.4, np.pi / 2]]), tolerance)
    # eight azimuths of the half turn are enough but for the last degrees
    slack = 0.0 if isotropic else 1e-3
    difference = np.abs(whole.value - mean.value[0])
    assert (difference <= whole.error + mean.error[0] + slack * whole.value).all()


def test_symmetries() -> None:
    for name in catalogue():
        model = get_model(name)
        found = symmetries(model, model.typical)
        assert found.isotropic == model.isotropic
        assert found.exchange == model.reciprocal or model.delta
        assert found.half_turn
    assert not symmetries(Ridge(), [1, 1, 1]).isotropic


def test_shapes_and_errors() -> None:
    model = get_model("lambert")
    assert directional_albedo(model, [1, 1, 1], 0.1).value.shape == (3,)
    assert directional_albedo(model, [1, 1, 1], np.zeros((2, 4))).error.shape == (2, 4, 3)
    assert directional_albedo(model, [1, 1, 1], np.zeros(0)).value.shape == (0, 3)
    for angle in (-0.1, np.pi / 2, np.nan):
        with pytest.raises(ValueError, match="theta_i must lie in"):
            directional_albedo(model, [1, 1, 1], angle)
    with pytest.raises(ValueError, match="known kinds: directional-hemispherical"):
        directional_albedo(model, [1, 1, 1], 0.1, kind="bidirectional")  # type: ignore[arg-type]
    functions: tuple[Callable[..., object], ...] = (
        lambda **k: directional_albedo(model, [1, 1, 1], 0.1, **k),
        lambda **k: hemispherical_reflectance(model, [1, 1, 1], **k),
    )
    for function in functions:
        with pytest.raises(ValueError, match="tolerance is 1e-14, expected at least 1e-12"):
            function(tolerance=1e-14)
    with pytest.raises(ValueError, match="parameters have shape"):
        directional_albedo(model, [1, 1], 0.1)


def test_points_fill_the_cube_evenly() -> None:
    points = spread(4096, 3)
    assert ((points >= 0) & (points < 1)).all()
    for box in ([0.0, 0.5], [0.2, 0.3], [0.9, 1.0]):
        for axis in range(3):
            inside = (points[:, axis] >= box[0]) & (points[:, axis] < box[1])
            # a random set would miss by up to 3 deviations, 2 % of all
            assert abs(inside.mean() - (box[1] - box[0])) < 2e-3
