"""Reflectance models against their printed formulas, differences, limits and symmetries."""

from __future__ import annotations

import numpy as np
import pytest

from tvbrdf_fitting.geometry import light_direction, view_direction
from tvbrdf_fitting.models import DustForm, ReflectanceModel, catalogue, get_model

SURFACE_VALUES = [0.3, 0.5, 0.7, 0.4, 0.8, 6.0]
DUST_VALUES = [*SURFACE_VALUES, 0.05, 0.06, 0.07, 0.35, 0.6]
FORMS: tuple[DustForm, ...] = ("reciprocal", "paper", "blinn")


def random_directions(seed: int, count: int, lowest: float = 0.05) -> np.ndarray:
    """Return unit vectors whose cosine to the normal is at least `lowest`, uniform in it."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(lowest, 1.0, count)
    azimuth = rng.uniform(-np.pi, np.pi, count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def direction(theta: float, phi: float) -> np.ndarray:
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def values_of(model: ReflectanceModel) -> np.ndarray:
    """Typical values, amplitudes of channels unlike each other."""
    tilt = {None: 1.0, 0: 0.6, 1: 1.0, 2: 1.4}
    return np.array([p.typical * tilt[p.channel] for p in model.parameters])


def oren_nayar_as_printed(
    light: np.ndarray, view: np.ndarray, kd: float, sigma_d: float
) -> np.ndarray:
    """1994 form with angles and azimuths, in extended precision."""
    light, view = light.astype(np.longdouble), view.astype(np.longdouble)
    theta_i, theta_r = np.arccos(light[:, 2]), np.arccos(view[:, 2])
    c = np.cos(np.arctan2(view[:, 1], view[:, 0]) - np.arctan2(light[:, 1], light[:, 0]))
    alpha, beta = np.maximum(theta_i, theta_r), np.minimum(theta_i, theta_r)
    s, pi = np.longdouble(sigma_d) ** 2, np.longdouble(np.pi)
    c1 = 1 - s / (s + np.longdouble("0.33")) / 2
    c2 = np.longdouble("0.45") * s / (s + np.longdouble("0.09"))
    c2 = c2 * (np.sin(alpha) - np.where(c < 0, (2 * beta / pi) ** 3, 0))
    c3 = np.longdouble("0.125") * s / (s + np.longdouble("0.09")) * (4 * alpha * beta / pi**2) ** 2
    single = c1 + c * c2 * np.tan(beta) + (1 - np.abs(c)) * c3 * np.tan((alpha + beta) / 2)
    multiple = np.longdouble("0.17") * s / (s + np.longdouble("0.13"))
    multiple = multiple * (1 - c * (2 * beta / pi) ** 2)
    return np.asarray(kd / pi * single + kd**2 / pi * multiple)


def torrance_sparrow_as_printed(
    light: np.ndarray, view: np.ndarray, ks: float, sigma_s: float
) -> np.ndarray:
    light, view = light.astype(np.longdouble), view.astype(np.longdouble)
    half = light + view
    half = half / np.sqrt((half * half).sum(axis=1))[:, None]
    n_h, v_h = half[:, 2], (half * view).sum(axis=1)
    cos_i, cos_r = light[:, 2], view[:, 2]
    g = np.minimum(1, np.minimum(2 * n_h * cos_i / v_h, 2 * n_h * cos_r / v_h))
    return np.asarray(ks * np.exp(-((np.arccos(n_h) / sigma_s) ** 2)) * g / (4 * cos_i * cos_r))


def dust_as_printed(
    light: np.ndarray, view: np.ndarray, values: list[float], form: str
) -> np.ndarray:
    kd, sigma_d, ks, inverse_sigma_s = values[:3], values[3], values[4], values[5]
    w, g, tau = np.array(values[6:9]), values[9], values[10]
    cos_i, cos_r = light[:, 2], view[:, 2]
    t = np.exp(-tau * (1 / cos_i + 1 / cos_r))[:, None]
    cos_gamma = -(light * view).sum(axis=1)
    phase = (1 - g * g) / (1 + g * g - 2 * g * cos_gamma) ** 1.5
    diffuse = np.stack([oren_nayar_as_printed(light, view, k, sigma_d) for k in kd], axis=1)
    specular = torrance_sparrow_as_printed(light, view, ks, 1 / inverse_sigma_s)[:, None]
    dust = (phase / (cos_i + cos_r))[:, None] * w
    if form != "reciprocal":
        dust = dust * cos_i[:, None]
    if form == "blinn":
        return np.asarray((1 - t) * dust + np.exp(-tau / cos_r)[:, None] * (diffuse + specular))
    return np.asarray((1 - t) * dust + t * diffuse + specular)


class TestAgainstPrintedFormulas:
    """Cosines above 0.05, where the printed forms keep at least 12 digits."""

    light, view = random_directions(1, 3000), random_directions(2, 3000)

    @pytest.mark.parametrize("sigma_d", [0.0, 0.1, 0.4, 0.9, 1.5])
    def test_oren_nayar(self, sigma_d: float) -> None:
        kd = [0.2, 0.5, 0.9]
        got = get_model("oren_nayar").evaluate(self.light, self.view, [*kd, sigma_d])
        for channel in range(3):
            wanted = oren_nayar_as_printed(self.light, self.view, kd[channel], sigma_d)
            # float64 inputs are rounded unit vectors: a few ulp of the largest term
            np.testing.assert_allclose(got[:, channel], wanted.astype(float), atol=2e-14)

    @pytest.mark.parametrize("sigma_s", [0.01, 0.05, 0.3, 1.5])
    def test_torrance_sparrow(self, sigma_s: float) -> None:
        got = get_model("torrance_sparrow").evaluate(self.light, self.view, [1.7, 1 / sigma_s])
        wanted = torrance_sparrow_as_printed(self.light, self.view, 1.7, sigma_s).astype(float)
        # an error of eps in theta_h is 2 theta_h/sigma_s^2 eps in the lobe, largest for 0.01
        np.testing.assert_allclose(got[:, 0], wanted, rtol=1e-11, atol=1e-290)
        np.testing.assert_array_equal(got[:, 0], got[:, 2])

    @pytest.mark.parametrize("form", FORMS)
    @pytest.mark.parametrize("g", [-0.6, 0.0, 0.35, 0.8])
    def test_dust(self, form: DustForm, g: float) -> None:
        values = [*DUST_VALUES[:9], g, DUST_VALUES[10]]
        got = get_model("dust", form=form).evaluate(self.light, self.view, values)
        wanted = dust_as_printed(self.light, self.view, values, form).astype(float)
        np.testing.assert_allclose(got, wanted, rtol=1e-12)


def test_oren_nayar_keeps_its_digits_at_grazing() -> None:
    # textbook forms in 64-bit precision lose 11 digits here; in 80 bits some 8 are left
    for cos_i, cos_r, phi in [
        (1e-4, 0.5, 2.5),
        (1e-4, 1e-4, 3.0),
        (3e-5, 0.2, 0.3),
        (0.9, 1e-4, 2),
    ]:
        light = direction(np.arccos(cos_i), 0.0)[None, :]
        view = direction(np.arccos(cos_r), phi)[None, :]
        got = get_model("oren_nayar").evaluate(light, view, [0.5, 0.5, 0.5, 0.6])[0, 0]
        wanted = float(oren_nayar_as_printed(light, view, 0.5, 0.6)[0])
        assert got == pytest.approx(wanted, rel=1e-10)


def test_sigma_d_zero_is_lambert() -> None:
    got = get_model("oren_nayar").evaluate(
        random_directions(3, 100), random_directions(4, 100), [0.2, 0.5, 0.9, 0.0]
    )
    np.testing.assert_allclose(
        got, np.tile(np.array([0.2, 0.5, 0.9]) / np.pi, (100, 1)), rtol=1e-15
    )


def test_torrance_sparrow_peak() -> None:
    # along the normal D = G = 1, so the BRDF is Ks / 4
    normal = [[0.0, 0.0, 1.0]]
    got = get_model("torrance_sparrow").evaluate(normal, normal, [2.0, 30.0])
    np.testing.assert_allclose(got, 0.5, rtol=1e-15)
    # at camera 1's mirror direction theta_h = 0 and both cosines are cos 12 degrees
    light, view = light_direction([24.0]), view_direction(0.0)
    got = get_model("torrance_sparrow").evaluate(light, view, [2.0, 200.0])
    np.testing.assert_allclose(got, 0.5 / np.cos(np.deg2rad(12)) ** 2, rtol=1e-12)


def test_dust_phase_function_is_normalised() -> None:
    # thick dust lit along the normal shows Phi itself; the hemisphere that the view cannot reach
    # is that of -g. Gauss-Legendre with 200 points is exact to rounding for |g| = 0.5.
    nodes, weights = np.polynomial.legendre.leggauss(200)
    cosine = 0.5 * (nodes + 1)
    view = np.stack([np.sqrt(1 - cosine**2), np.zeros(200), cosine], axis=1)
    total = 0.0
    for g in (0.5, -0.5):
        values = [0, 0, 0, 0, 0, 1.0, 1.0, 1.0, 1.0, g, 50.0]
        brdf = get_model("dust").evaluate([[0.0, 0.0, 1.0]], view, values)[:, 0]
        total += 0.5 * float(0.5 * weights @ (brdf * (1 + cosine)))
    assert total == pytest.approx(1.0, rel=1e-12)


def test_g_above_zero_scatters_forward() -> None:
    light = direction(1.3, 0.0)
    forward, back = direction(1.3, np.pi)[None, :], direction(1.3, 0.0)[None, :]
    values = [0, 0, 0, 0, 0, 1.0, 0.1, 0.1, 0.1, 0.6, 1.0]
    model = get_model("dust")
    assert model.evaluate(light, forward, values)[0, 0] > model.evaluate(light, back, values)[0, 0]


def test_thin_dust_is_linear_in_tau() -> None:
    # 1 - T keeps its digits: at tau = 1e-12 the scattered part is tau m w Phi/(cos + cos) to 1e-11
    light, view = random_directions(5, 50), random_directions(6, 50)
    values = np.array([0, 0, 0, 0, 0, 1.0, 0.1, 0.1, 0.1, 0.3, 1e-12])
    thin = get_model("dust").evaluate(light, view, values)
    values[-1] = 2e-12
    np.testing.assert_allclose(get_model("dust").evaluate(light, view, values), 2 * thin, rtol=1e-9)


@pytest.mark.parametrize("name", [n for n in catalogue() if get_model(n).reciprocal])
def test_reciprocity(name: str) -> None:
    model = get_model(name)
    light, view = random_directions(7, 2000, 1e-3), random_directions(8, 2000, 1e-3)
    there = model.evaluate(light, view, values_of(model))
    np.testing.assert_allclose(there, model.evaluate(view, light, values_of(model)), rtol=1e-12)


@pytest.mark.parametrize("form", ["paper", "blinn"])
def test_printed_dust_is_not_reciprocal(form: DustForm) -> None:
    model = get_model("dust", form=form)
    light, view = random_directions(7, 10), random_directions(8, 10)
    there, back = (model.evaluate(a, b, DUST_VALUES) for a, b in ((light, view), (view, light)))
    assert np.abs(there / back - 1).max() > 0.1


@pytest.mark.parametrize("name", catalogue())
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_jacobian_is_the_derivative(name: str, seed: int) -> None:
    model = get_model(name)
    rng = np.random.default_rng(seed)
    light, view = random_directions(10 + seed, 200, 0.02), random_directions(20 + seed, 200, 0.02)
    values = values_of(model) * rng.uniform(0.5, 1.3, len(model.parameters))
    if "g" in model.parameter_names and seed == 1:
        values[model.parameter_names.index("g")] *= -1
    got = model.jacobian(light, view, values)
    assert got.shape == (200, 3, len(values))
    for i in range(len(values)):
        step = 1e-5 * abs(values[i])
        sides = []
        for sign in (1, -1):
            moved = values.copy()
            moved[i] += sign * step
            sides.append(model.evaluate(light, view, moved))
        central = (sides[0] - sides[1]) / (2 * step)
        # step^2 truncation (1e-10 relative to the curvature) plus eps/step rounding (2e-11)
        scale = max(np.abs(central).max(), np.abs(sides[0]).max() / abs(values[i]) * 1e-3)
        np.testing.assert_allclose(got[..., i], central, atol=2e-8 * scale)


@pytest.mark.parametrize("name", catalogue())
def test_derivatives_go_on_smoothly_outside_the_bounds(name: str) -> None:
    # an unbounded solver may step there: value and slope must not jump at the bound
    model = get_model(name)
    light, view = random_directions(31, 50, 0.2), random_directions(32, 50, 0.2)
    prepared = model.prepare(light, view)
    internal = model.to_internal(values_of(model))
    for i in range(len(internal)):
        lower = model.internal_bounds[0][i]
        if lower != 0:
            continue
        sides = []
        for offset in (1e-9, -1e-9):
            x = internal.copy()
            x[i] = offset
            jacobian = np.zeros((len(internal), 3, 50))
            model.add_jacobian(prepared, x, jacobian)
            sides.append((np.broadcast_to(model.value(prepared, x), (3, 50)), jacobian))
        # offsets of 1e-9 times slopes and curvatures up to a few hundred
        np.testing.assert_allclose(sides[0][0], sides[1][0], atol=1e-6)
        np.testing.assert_allclose(sides[0][1], sides[1][1], atol=1e-5)


@pytest.mark.parametrize("name", catalogue())
def test_finite_at_grazing_and_special_directions(name: str) -> None:
    model = get_model(name)
    special = [
        direction(theta, phi)
        for theta in (0.0, 1e-8, 0.5, np.arccos(1e-3), np.arccos(1e-8), np.arccos(1e-12))
        for phi in (0.0, 1e-9, np.pi / 2, np.pi)
    ]
    light = np.repeat(special, len(special), axis=0)
    view = np.tile(special, (len(special), 1))
    for sigma_d, inverse_sigma_s in ((0.0, 1e4), (1.5, 0.1), (0.3, 30.0)):
        values = values_of(model)
        for i, parameter in enumerate(model.parameter_names):
            if parameter == "sigma_d":
                values[i] = sigma_d
            if parameter == "inverse_sigma_s":
                values[i] = inverse_sigma_s
        assert np.isfinite(model.evaluate(light, view, values)).all()
        assert np.isfinite(model.jacobian(light, view, values)).all()


def test_below_the_horizon_there_is_nothing() -> None:
    model = get_model("ON+TS")
    light = np.array([[0.6, 0.0, -0.8], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    view = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, -0.8], [0.0, 0.0, 1.0]])
    assert not model.evaluate(light, view, SURFACE_VALUES).any()
    assert not model.jacobian(light, view, SURFACE_VALUES).any()


def test_only_the_difference_of_azimuths_matters() -> None:
    light, view = random_directions(40, 300), random_directions(41, 300)
    turn = np.array([[np.cos(2), -np.sin(2), 0], [np.sin(2), np.cos(2), 0], [0, 0, 1]])
    for name in catalogue():
        model = get_model(name)
        plain = model.evaluate(light, view, values_of(model))
        turned = model.evaluate(light @ turn.T, view @ turn.T, values_of(model))
        np.testing.assert_allclose(turned, plain, rtol=1e-11)


@pytest.mark.parametrize("name", catalogue())
def test_internal_coordinates_go_there_and_back(name: str) -> None:
    model = get_model(name)
    values = values_of(model)
    internal = model.to_internal(values)
    np.testing.assert_allclose(model.to_published(internal), values, rtol=1e-14)
    step = 1e-6
    for i, slope in enumerate(model.slopes(values)):
        up, down = values.copy(), values.copy()
        up[i] += step
        down[i] -= step
        change = (model.to_internal(up) - model.to_internal(down))[i] / (2 * step)
        assert slope == pytest.approx(change, rel=1e-7)


def test_published_order_units_and_bounds() -> None:
    surface, dust = get_model("ON+TS"), get_model("dust")
    assert surface.parameter_names == ("kd_b", "kd_g", "kd_r", "sigma_d", "ks", "inverse_sigma_s")
    assert dust.parameter_names[6:] == ("w_b", "w_g", "w_r", "g", "tau")
    assert surface.units["sigma_d"] == "rad"
    assert surface.units["inverse_sigma_s"] == "1/rad"
    lower, upper = surface.bounds
    np.testing.assert_allclose(1 / lower[5], 1.5)
    np.testing.assert_allclose(1 / upper[5], 0.005)
    assert (lower[3], upper[3]) == (0.0, 1.5)
    assert surface.internal_names[3:] == ("sigma_d^2", "ks", "log(inverse_sigma_s)")


def test_names_aliases_and_forms() -> None:
    assert get_model("ON+TS").name == "oren_nayar+torrance_sparrow"
    assert get_model("dust").name == "dust+oren_nayar+torrance_sparrow"
    for form in FORMS:
        model = get_model("dust", form=form)
        assert get_model(model.name) is model
    for name in catalogue():
        assert get_model(name).name == name
    with pytest.raises(ValueError, match=r"unknown model 'velvet'; known models: .*ON\+TS"):
        get_model("velvet")
    with pytest.raises(ValueError, match="has no forms"):
        get_model("ON+TS", form="paper")


def test_wrong_shapes_and_values_are_refused() -> None:
    model = get_model("ON+TS")
    light = random_directions(1, 4)
    with pytest.raises(ValueError, match=r"parameters have shape \(5,\), expected \(6,\)"):
        model.evaluate(light, light, SURFACE_VALUES[:5])
    with pytest.raises(ValueError, match="4 light directions but 3 view directions"):
        model.evaluate(light, light[:3], SURFACE_VALUES)
    with pytest.raises(ValueError, match=r"expected \(n, 3\)"):
        model.evaluate(light[:, :2], light, SURFACE_VALUES)
    with pytest.raises(ValueError, match="outside the model's domain"):
        model.evaluate(light, light, [*SURFACE_VALUES[:5], -1.0])
    named = model.as_mapping(SURFACE_VALUES)
    named["kx"] = named.pop("ks")
    with pytest.raises(ValueError, match=r"missing: \['ks'\], unknown: \['kx'\]"):
        model.from_mapping(named)
