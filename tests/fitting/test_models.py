"""What all reflectance models promise: derivatives, limits, symmetries, bounds and names.

Their printed formulas are checked in test_precision_*.py.
"""

from __future__ import annotations

import numpy as np
import pytest

from tvbrdf_fitting.geometry import light_direction, view_direction
from tvbrdf_fitting.models import DustForm, ReflectanceModel, catalogue, get_model

SURFACE_VALUES = [0.3, 0.5, 0.7, 0.4, 0.8, 6.0]
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


def values_of(model: ReflectanceModel, seed: int | None = None) -> np.ndarray:
    """Typical values, channels unlike each other; with a seed, at random around them."""
    tilt = {None: 1.0, 0: 0.6, 1: 1.0, 2: 1.4}
    values = np.array([p.typical * tilt[p.channel] for p in model.parameters])
    if seed is not None:
        rng = np.random.default_rng(seed)
        values *= rng.uniform(0.5, 1.3, len(values))
        values[[p.lower == -p.upper for p in model.parameters]] *= rng.choice([-1, 1])
    lower, upper = (model.typical + 0.99 * (bound - model.typical) for bound in model.bounds)
    return np.asarray(np.clip(values, lower, upper))


@pytest.mark.parametrize(
    "name", ["oren_nayar", "oren_nayar_short", "oren_nayar_short(interreflection)"]
)
def test_sigma_d_zero_is_lambert(name: str) -> None:
    light, view = random_directions(3, 100), random_directions(4, 100)
    got = get_model(name).evaluate(light, view, [0.2, 0.5, 0.9, 0.0])
    wanted = get_model("lambert").evaluate(light, view, [0.2, 0.5, 0.9])
    np.testing.assert_allclose(got, wanted, rtol=1e-15)


def test_short_form_leaves_out_inter_reflection_and_c3() -> None:
    # C3 vanishes in the plane of incidence and C2's bracket is sin(alpha) on the light's side:
    # there the two forms differ by rho_2 alone, which is quadratic in Kd
    light = direction(0.7, 0.3)
    view = np.array([direction(theta, 0.3) for theta in (0.1, 0.5, 0.9, 1.4)])
    full, short = get_model("oren_nayar"), get_model("oren_nayar_short")

    def difference(kd: float) -> np.ndarray:
        values = [kd, kd, kd, 0.5]
        return full.evaluate(light, view, values) - short.evaluate(light, view, values)

    assert (difference(0.2) > 0).all()
    np.testing.assert_allclose(difference(0.4), 4 * difference(0.2), rtol=1e-12)


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


@pytest.mark.parametrize("name", [n for n in catalogue() if get_model(n).reciprocal])
def test_reciprocity(name: str) -> None:
    model = get_model(name)
    light, view = random_directions(7, 2000, 1e-3), random_directions(8, 2000, 1e-3)
    there = model.evaluate(light, view, values_of(model))
    np.testing.assert_allclose(there, model.evaluate(view, light, values_of(model)), rtol=1e-12)


@pytest.mark.parametrize("name", [n for n in catalogue() if not get_model(n).reciprocal])
def test_some_are_not_reciprocal_and_say_so(name: str) -> None:
    model = get_model(name)
    light, view = random_directions(7, 500), random_directions(8, 500)
    values = values_of(model)
    there, back = (model.evaluate(a, b, values) for a, b in ((light, view), (view, light)))
    assert (np.abs(there - back) > 0.1 * np.maximum(there, back)).any()


@pytest.mark.parametrize("name", [n for n in catalogue() if get_model(n).nonnegative])
def test_nowhere_negative(name: str) -> None:
    model = get_model(name)
    light, view = random_directions(50, 500, 1e-6), random_directions(51, 500, 1e-6)
    for seed in range(20):
        assert (model.evaluate(light, view, values_of(model, seed)) >= 0).all()


@pytest.mark.parametrize("name", catalogue())
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_jacobian_is_the_derivative(name: str, seed: int) -> None:
    model = get_model(name)
    light, view = random_directions(10 + seed, 200, 0.02), random_directions(20 + seed, 200, 0.02)
    values = values_of(model, seed)
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
    for i in np.flatnonzero(model.internal_bounds[0] == 0):
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
def test_finite_at_special_directions_and_at_all_bounds(name: str) -> None:
    model = get_model(name)
    special = [
        direction(theta, phi)
        for theta in (0.0, 1e-8, 0.5, np.arccos(1e-3), np.arccos(1e-8), np.arccos(1e-12))
        for phi in (0.0, 1e-9, np.pi / 2, np.pi)
    ]
    light = np.repeat(special, len(special), axis=0)
    view = np.tile(special, (len(special), 1))
    for bound in model.bounds:
        for i in np.flatnonzero(np.isfinite(bound)):
            values = values_of(model)
            values[i] = bound[i]
            assert np.isfinite(model.evaluate(light, view, values)).all()
            assert np.isfinite(model.jacobian(light, view, values)).all()


@pytest.mark.parametrize("name", catalogue())
def test_typical_values_are_within_the_bounds(name: str) -> None:
    model = get_model(name)
    lower, upper = model.bounds
    assert ((lower <= model.typical) & (model.typical <= upper)).all()
    assert np.isfinite(model.typical).all()


def test_below_the_horizon_there_is_nothing() -> None:
    model = get_model("ON+TS")
    light = np.array([[0.6, 0.0, -0.8], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    view = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, -0.8], [0.0, 0.0, 1.0]])
    assert not model.evaluate(light, view, SURFACE_VALUES).any()
    assert not model.jacobian(light, view, SURFACE_VALUES).any()


@pytest.mark.parametrize("name", [n for n in catalogue() if get_model(n).isotropic])
def test_only_the_difference_of_azimuths_matters(name: str) -> None:
    light, view = random_directions(40, 300), random_directions(41, 300)
    turn = np.array([[np.cos(2), -np.sin(2), 0], [np.sin(2), np.cos(2), 0], [0, 0, 1]])
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
    for i, slope in enumerate(model.slopes(values)):
        up, down = values.copy(), values.copy()
        step = 1e-6 * abs(values[i])
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


@pytest.mark.parametrize(
    ("name", "full"),
    [
        ("ON", "oren_nayar"),
        ("ON+TS(coloured)", "oren_nayar+torrance_sparrow(coloured)"),
        ("lambert+TS+TS", "lambert+torrance_sparrow+torrance_sparrow"),
        ("ON + TS( coloured )", "oren_nayar+torrance_sparrow(coloured)"),
        ("dust+ON+TS(coloured)", "dust+oren_nayar+torrance_sparrow(coloured)"),
        ("dust(paper)+lambert+TS", "dust(paper)+lambert+torrance_sparrow"),
        ("dust(blinn)", "dust(blinn)+oren_nayar+torrance_sparrow"),
        ("cook_torrance(coloured,ggx)", "cook_torrance(ggx,coloured)"),
    ],
)
def test_aliases_work_in_sums(name: str, full: str) -> None:
    assert get_model(name).name == full
    assert get_model(name) is get_model(full)


@pytest.mark.parametrize("name", ["on+ts", "ON+TS(shiny)", "TS+dust", "ON TS", "ON+", ""])
def test_what_is_no_name_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="model"):
        get_model(name)


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
