"""Phong, Ward and Lafortune: facts from the papers, limits, refusal, and fits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from tests.fitting.scans import Simulate
from tvbrdf_fitting.fit import FitError, fit_scan
from tvbrdf_fitting.geometry import (
    CAMERA_ANGLES_DEG,
    FloatArray,
    light_direction,
    view_direction,
)
from tvbrdf_fitting.models import get_model
from tvbrdf_fitting.observations import Observations

NORMAL = np.array([0.0, 0.0, 1.0])
DIFFUSE = [0.3, 0.5, 0.7, 0.3]
WARD_FORMS = ("ward", "ward(duer)", "ward(balanced)")


def random_directions(seed: int, count: int, lowest: float = 0.05) -> FloatArray:
    rng = np.random.default_rng(seed)
    z, azimuth = rng.uniform(lowest, 1.0, count), rng.uniform(-np.pi, np.pi, count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def in_plane(theta: FloatArray | float) -> FloatArray:
    theta = np.atleast_1d(theta)
    return np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=1)


def one_channel(name: str, light: FloatArray, view: FloatArray, values: list[float]) -> FloatArray:
    return get_model(name).evaluate(light, view, values)[:, 1]


def albedo_at_normal_incidence(name: str, values: list[float], upto: float) -> float:
    """Directional albedo of an isotropic model, its lobe being nil beyond `upto` rad.

    400 Gauss nodes: exact to rounding for lobes a twentieth of the interval wide and smooth in it.
    """
    nodes, weights = np.polynomial.legendre.leggauss(400)
    theta = 0.5 * upto * (nodes + 1)
    brdf = one_channel(name, in_plane(theta), NORMAL, values)
    return float(np.pi * upto * weights @ (brdf * np.cos(theta) * np.sin(theta)))


def albedo_over_slopes(name: str, values: list[float], view: FloatArray) -> float:
    """Directional albedo of Ward's model by the slopes of its half vectors, (p, q) = alpha (u, w).

    With l = 2 (v.h) h - v the light's solid angle is 4 (v.h) h_z^3 dp dq. The trapezoidal rule is
    exact to rounding for Gaussians, and errs by about a step where the light's horizon cuts them.
    """
    step, reach = 0.05, 7.0
    u, w = np.meshgrid(*[np.arange(-reach, reach + step / 2, step)] * 2)
    if len(values) == 4:
        alpha_x, alpha_y, phi = values[1:]
        p = alpha_x * u * math.cos(phi) - alpha_y * w * math.sin(phi)
        q = alpha_x * u * math.sin(phi) + alpha_y * w * math.cos(phi)
    else:
        alpha_x = alpha_y = values[1]
        p, q = alpha_x * u, alpha_y * w
    half = np.stack([p.ravel(), q.ravel(), np.ones(p.size)], axis=1)
    half /= np.linalg.norm(half, axis=1)[:, None]
    cosine = half @ view
    light = 2 * cosine[:, None] * half - view
    seen = (light[:, 2] > 0) & (cosine > 0)
    brdf = one_channel(name, light[seen], view, values)
    weight = light[seen][:, 2] * 4 * cosine[seen] * half[seen][:, 2] ** 3
    return float(brdf @ weight * step * step * alpha_x * alpha_y)


class TestPhong:
    light, view = random_directions(1, 500), random_directions(2, 500)

    def test_original_is_the_shading_model(self) -> None:
        # what leaves is Ks cos^n times the light that arrives on a surface facing it
        mirrored = self.light * (-1, -1, 1)
        cosine = np.maximum(np.einsum("ij,ij->i", mirrored, self.view), 0.0)
        radiance = one_channel("phong", self.light, self.view, [0.7, 5.0]) * self.light[:, 2]
        np.testing.assert_allclose(radiance, 0.7 * cosine**5, rtol=1e-12, atol=1e-300)

    def test_original_is_reciprocal_but_for_the_cosine(self) -> None:
        there = one_channel("phong", self.light, self.view, [0.7, 5.0])
        back = one_channel("phong", self.view, self.light, [0.7, 5.0])
        ratio = self.view[:, 2] / self.light[:, 2]
        np.testing.assert_allclose(there, back * ratio, rtol=1e-13)
        assert not get_model("phong").reciprocal
        assert get_model("phong(energy_conserving)").reciprocal

    @pytest.mark.parametrize("exponent", [1.0, 7.5, 40.0, 1e3])
    def test_albedo_at_normal_incidence_is_ks(self, exponent: float) -> None:
        # exp(-40) of the lobe is left out; a power of a cosine is smooth over the interval
        upto = min(math.pi / 2, math.sqrt(80 / exponent))
        got = albedo_at_normal_incidence("phong(energy_conserving)", [0.6, exponent], upto)
        assert got == pytest.approx(0.6, rel=1e-10)

    def test_energy_is_conserved_at_every_angle(self) -> None:
        # the horizon only cuts the lobe, and cos(theta_i) falls away from the normal
        cosines, weights = np.polynomial.legendre.leggauss(60)
        z, azimuth = np.meshgrid(
            0.5 * (cosines + 1), np.linspace(0, 2 * np.pi, 120, endpoint=False)
        )
        radius = np.sqrt(1 - z * z)
        lights = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], -1).reshape(
            -1, 3
        )
        measure = np.broadcast_to(0.5 * weights * 2 * np.pi / 120, z.shape).ravel() * lights[:, 2]
        for exponent in (1.0, 10.0, 60.0):
            for theta in (0.0, 0.5, 1.0, 1.3, 1.5):
                view = in_plane(theta)[0]
                brdf = one_channel("phong(energy_conserving)", lights, view, [1.0, exponent])
                # the kink at r.v = 0 costs the product rule up to 1e-3 for exponent 1
                assert brdf @ measure <= 1 + 1e-3

    def test_width(self) -> None:
        # 1/e at sqrt(2/n) from the mirror direction, to 1/(3 n); as wide as sigma_s = 1/sqrt(2 n)
        exponent = 1e4
        theta = np.array([0.4, 0.4 + math.sqrt(2 / exponent)])
        mirrored = in_plane(0.4) * (-1, 1, 1)
        name = "phong(energy_conserving)"
        peak, edge = one_channel(name, in_plane(theta), mirrored, [1.0, exponent])
        assert edge / peak == pytest.approx(math.exp(-1), rel=1 / exponent)
        torrance_sparrow = [1.0, math.sqrt(2 * exponent)]
        along_normal = in_plane(np.array([0.0, math.sqrt(2 / exponent)]))
        peak, edge = one_channel("torrance_sparrow", along_normal, NORMAL, torrance_sparrow)
        # the cosines in the denominator differ by theta^2 / 2 = 1/n
        assert edge / peak == pytest.approx(math.exp(-1), rel=3 / exponent)


class TestWard:
    light, view = random_directions(3, 500), random_directions(4, 500)

    def test_values_at_the_mirror_direction_and_at_one_width(self) -> None:
        alpha, theta = 0.2, 0.7
        light, mirrored = in_plane(theta), in_plane(-theta)
        peak = 0.3 / (4 * math.pi * alpha**2)
        wanted = (peak / math.cos(theta), *[peak / math.cos(theta) ** 2] * 2)
        for name, value in zip(WARD_FORMS, wanted, strict=True):
            got = one_channel(name, light, mirrored, [0.3, alpha])[0]
            assert got == pytest.approx(value, rel=1e-14)
        # half vector at atan(alpha) from the normal, so exp(-1)
        tilt = math.atan(alpha)
        light, view = in_plane(theta + tilt), in_plane(tilt - theta)
        cosines = float(light[0, 2] * view[0, 2])
        got = one_channel("ward", light, view, [0.3, alpha])[0]
        assert got == pytest.approx(peak * math.exp(-1) / math.sqrt(cosines), rel=1e-13)

    def test_forms_differ_by_their_denominators(self) -> None:
        # small light-view angle, so that exp(-e) is not nil
        light = random_directions(5, 200, 0.3)
        view = light * (-1, -1, 1) + random_directions(6, 200) * 0.05
        view /= np.linalg.norm(view, axis=1)[:, None]
        original, duer, balanced = (one_channel(n, light, view, [0.3, 0.3]) for n in WARD_FORMS)
        cosines, half = light[:, 2] * view[:, 2], light + view
        # digits: exp(-e) is the same number in all
        np.testing.assert_allclose(duer, original / np.sqrt(cosines), rtol=1e-13)
        factor = 4 * np.einsum("ij,ij->i", half, half) / half[:, 2] ** 4
        np.testing.assert_allclose(balanced, original * np.sqrt(cosines) * factor, rtol=1e-13)

    @pytest.mark.parametrize("alpha", [0.05, 0.2, 0.6])
    def test_albedo_at_normal_incidence(self, alpha: float) -> None:
        # with t = tan^2(theta_h), of density exp(-t / alpha^2) / alpha^2, the papers' weights of
        # importance sampling are sqrt((1 - t) / (1 + t)) / (1 + t)^2, 1 / (1 + t)^2 and 1 - t
        weights = {
            "ward": lambda t: math.sqrt((1 - t) / (1 + t)) / (1 + t) ** 2,
            "ward(duer)": lambda t: (1 + t) ** -2,
            "ward(balanced)": lambda t: 1 - t,
        }
        square = alpha * alpha
        for name, weight in weights.items():
            # the integral is to the horizon of the light: t = 1, and at most 40 alpha^2
            upto = min(1.0, 40 * square)
            wanted = quad(lambda t, w=weight: w(t) * math.exp(-t / square) / square, 0, upto)[0]
            got = albedo_at_normal_incidence(name, [1.0, alpha], 2 * math.atan(math.sqrt(upto)))
            # quad's own 1e-8; the square root at the horizon costs 400 nodes about 1e-7
            assert got == pytest.approx(wanted, rel=1e-6)
        closed = 1 - square * (1 - math.exp(-1 / square))
        assert got == pytest.approx(closed, rel=1e-10)

    @pytest.mark.parametrize("alpha", [0.02, 0.05])
    def test_first_order_of_smooth_surfaces(self, alpha: float) -> None:
        # next terms are 11 alpha^4, 6 alpha^4 and none
        upto = 2 * math.atan(6.3 * alpha)
        for name, slope in zip(WARD_FORMS, (3, 2, 1), strict=True):
            got = albedo_at_normal_incidence(name, [1.0, alpha], upto)
            assert got == pytest.approx(1 - slope * alpha**2, abs=12 * alpha**4)

    @pytest.mark.parametrize("shape", [[0.05], [0.3], [1.0], [0.1, 0.6, 0.5], [0.9, 0.05, 0.0]])
    def test_balanced_form_conserves_energy(self, shape: list[float]) -> None:
        name = "ward(balanced)" if len(shape) == 1 else "ward(anisotropic,balanced)"
        albedos = [
            albedo_over_slopes(name, [1.0, *shape], in_plane(math.radians(degrees))[0])
            for degrees in (0, 40, 70, 80, 85, 89, 89.9)
        ]
        # the rule's error at the horizon, which cuts a 0.05 grid
        assert max(albedos) <= 1 + 5e-3
        assert min(albedos) > 0.2

    def test_the_older_forms_pass_every_bound_at_grazing(self) -> None:
        view = in_plane(math.radians(89.99))[0]
        original, duer = (albedo_over_slopes(n, [1.0, 0.2], view) for n in WARD_FORMS[:2])
        # 2.09 and 290 by the same integral in polar coordinates
        assert original == pytest.approx(2.09, rel=0.02)
        assert duer == pytest.approx(290, rel=0.02)
        # and a smooth surface loses the cosine in the original form, nothing in Dür's
        view = in_plane(math.radians(60))[0]
        original, duer = (albedo_over_slopes(n, [1.0, 0.01], view) for n in WARD_FORMS[:2])
        assert original == pytest.approx(0.5, rel=1e-3)
        assert duer == pytest.approx(1.0, rel=1e-3)

    def test_anisotropic_normalisation(self) -> None:
        # 1 - t averages to 1 - (alpha_x^2 + alpha_y^2) / 2; the Gaussians end long before t = 1
        got = albedo_over_slopes("ward(anisotropic,balanced)", [0.8, 0.02, 0.07, 0.6], NORMAL)
        assert got == pytest.approx(0.8 * (1 - (0.02**2 + 0.07**2) / 2), rel=1e-10)

    def test_equal_alphas_are_isotropic(self) -> None:
        plain = one_channel("ward", self.light, self.view, [0.3, 0.25])
        for phi in (0.0, 1.0, -2.5):
            got = one_channel("ward(anisotropic)", self.light, self.view, [0.3, 0.25, 0.25, phi])
            # e of up to 700 is rounded differently
            np.testing.assert_allclose(got, plain, rtol=1e-12, atol=1e-300)

    def test_phi_x_turns_the_sample(self) -> None:
        turn = np.array([[np.cos(0.6), -np.sin(0.6), 0], [np.sin(0.6), np.cos(0.6), 0], [0, 0, 1]])
        name = "ward(anisotropic)"
        plain = one_channel(name, self.light, self.view, [0.3, 0.2, 0.5, 0.1])
        turned = one_channel(name, self.light @ turn.T, self.view @ turn.T, [0.3, 0.2, 0.5, 0.7])
        np.testing.assert_allclose(turned, plain, rtol=1e-11, atol=1e-300)

    def test_the_same_lobe_has_several_names(self) -> None:
        name = "ward(anisotropic)"
        plain = one_channel(name, self.light, self.view, [0.3, 0.2, 0.5, 0.4])
        for values in ([0.2, 0.5, 0.4 - np.pi], [0.5, 0.2, 0.4 + np.pi / 2]):
            got = one_channel(name, self.light, self.view, [0.3, *values])
            np.testing.assert_allclose(got, plain, rtol=1e-11, atol=1e-300)

    def test_brushed_along_x_is_broad_across(self) -> None:
        values = [0.3, 0.05, 0.5, 0.0]
        tilted = in_plane(0.3)
        across = tilted[:, [1, 0, 2]]
        along_x, along_y = (
            one_channel("ward(anisotropic)", v, NORMAL, values)[0] for v in (tilted, across)
        )
        assert along_y > 100 * along_x

    def test_both_denominators_are_refused(self) -> None:
        with pytest.raises(ValueError, match="choose one of duer, balanced"):
            get_model("ward(duer,balanced)")
        assert (
            get_model("ward(coloured, duer,anisotropic)").name == "ward(anisotropic,duer,coloured)"
        )


class TestRefusal:
    """Anisotropy cannot be seen with all lights in one plane through the normal."""

    lights = light_direction(np.linspace(-77.0, 89.0, 50))
    view = view_direction(25.0)

    @pytest.mark.parametrize("model", ["ward(anisotropic)", "oren_nayar+ward(anisotropic,duer)"])
    def test_the_rig_is_refused(self, model: str) -> None:
        lights = np.concatenate([self.lights] * 4)
        views = np.repeat([view_direction(a) for a in CAMERA_ANGLES_DEG], 50, axis=0)
        reason = get_model(model).refuse(lights, views)
        assert reason is not None
        assert "all lights lie in one plane through the normal" in reason
        assert "fit the isotropic 'ward'" in reason

    def test_a_fit_of_the_rig_is_refused(self, simulate: Simulate) -> None:
        scan = simulate([0.3, 0.5, 0.7, 0.3, 0.3, 0.2], "oren_nayar+ward", step=8)
        with pytest.raises(FitError, match="all lights lie in one plane"):
            fit_scan(scan, "oren_nayar+ward(anisotropic)")

    @pytest.mark.parametrize("model", ["ward", "ward(balanced)", "phong", "lafortune"])
    def test_isotropic_models_are_not(self, model: str) -> None:
        assert get_model(model).refuse(self.lights, self.view) is None

    def test_what_counts_as_one_plane(self) -> None:
        model = get_model("ward(anisotropic)")
        rng = np.random.default_rng(3)
        turn = np.array([[0.5, -np.sqrt(0.75), 0], [np.sqrt(0.75), 0.5, 0], [0, 0, 1]])
        # near field over the tray: 3.3 degrees to either side
        spread = self.lights + [0, 1, 0] * np.deg2rad(rng.uniform(-3.3, 3.3, (50, 1)))
        in_one_plane = {
            "turned about the normal": self.lights @ turn.T,
            "turned in the plane": light_direction(np.linspace(-82.0, 84.0, 50)),
            "spread of the near field": spread / np.linalg.norm(spread, axis=1)[:, None],
            "one direction": np.repeat(self.lights[:1], 9, axis=0),
            "the normal": np.repeat(NORMAL[None, :], 9, axis=0),
        }
        for what, lights in in_one_plane.items():
            assert model.refuse(lights, self.view) is not None, what

    def test_lights_out_of_the_plane_are_accepted(self) -> None:
        model = get_model("ward(anisotropic)")
        second = light_direction(np.linspace(-60.0, 60.0, 20), tilt_deg=0.0)[:, [1, 0, 2]]
        for lights in (random_directions(7, 60), np.concatenate([self.lights, second])):
            assert model.refuse(lights, self.view) is None


class TestLafortune:
    light, view = random_directions(8, 500), random_directions(9, 500)

    def test_general_form(self) -> None:
        # rho_s (C_xy (l_x v_x + l_y v_y) + C_z l_z v_z)^n, in the scale of this model
        rho, c_xy, c_z, n = 0.4, -0.86, 0.77, 12.0
        across = np.einsum("ij,ij->i", self.light[:, :2], self.view[:, :2])
        product = c_xy * across + c_z * self.light[:, 2] * self.view[:, 2]
        got = one_channel("lafortune", self.light, self.view, [rho * c_z**n, c_xy / c_z, n])
        wanted = rho * np.maximum(product, 0.0) ** n
        # where the product nearly cancels n times its loss of digits is left
        np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-18)

    def test_minus_one_is_phong(self) -> None:
        phong = one_channel("phong(energy_conserving)", self.light, self.view, [0.3, 8.0])
        got = one_channel("lafortune", self.light, self.view, [0.3 * 10 / (2 * np.pi), -1.0, 8.0])
        np.testing.assert_allclose(got, phong, rtol=1e-11, atol=1e-300)

    def test_ks_is_the_brdf_along_the_normal(self) -> None:
        for cxy in (-1.4, -1.0, 0.0, 1.3):
            assert one_channel("lafortune", NORMAL[None], NORMAL, [0.7, cxy, 300.0])[0] == 0.7

    def test_zero_is_a_power_of_the_cosines_and_one_faces_the_light(self) -> None:
        got = one_channel("lafortune", self.light, self.view, [0.5, 0.0, 3.0])
        np.testing.assert_allclose(got, 0.5 * (self.light[:, 2] * self.view[:, 2]) ** 3, rtol=1e-13)
        retro = one_channel("lafortune", self.light, self.light, [0.5, 1.0, 20.0])
        np.testing.assert_allclose(retro, 0.5, rtol=1e-12)

    @pytest.mark.parametrize(("cxy", "side"), [(-1.3, 1), (-0.8, -1)])
    def test_where_the_lobe_leans(self, cxy: float, side: int) -> None:
        view = in_plane(-0.7)[0]
        theta = np.linspace(0.0, 1.5, 3001)
        peak = theta[np.argmax(one_channel("lafortune", in_plane(theta), view, [1.0, cxy, 30.0]))]
        assert peak == pytest.approx(math.atan(-cxy * math.tan(0.7)), abs=1e-3)
        assert side * (peak - 0.7) > 0.1

    def test_lobes_that_outgrow_all_numbers_stay_finite(self) -> None:
        model = get_model("lafortune")
        grazing = in_plane(1.55), in_plane(-1.55)[0]
        for values in ([1.0, -2.0, 1e5], [1.0, 2.0, 1e5], [1.0, -1.5, 1e3]):
            assert np.isfinite(model.evaluate(*grazing, values)).all()
            assert np.isfinite(model.jacobian(*grazing, values)).all()


@pytest.mark.parametrize("name", [*WARD_FORMS, "phong", "lafortune", "ward(anisotropic)"])
def test_a_solver_may_step_far_outside_the_bounds(name: str) -> None:
    model = get_model(name)
    light = np.concatenate([random_directions(10, 40, 1e-12), in_plane(np.array([0.0, 1e-9]))])
    view = np.concatenate([random_directions(11, 41, 1e-12), [NORMAL]])
    prepared = model.prepare(light, view)
    start = model.to_internal(model.typical)
    for index, parameter in enumerate(model.parameters):
        if parameter.name == "ks":
            continue
        for far in (-1e3, -50.0, 50.0, 1e3):
            internal = start.copy()
            internal[index] = far
            out = np.zeros((len(internal), 3, len(light)))
            model.add_jacobian(prepared, internal, out)
            assert np.isfinite(out).all(), (parameter.name, far)
            assert np.isfinite(model.value(prepared, internal)).all(), (parameter.name, far)


FITS = {
    "ward": [[0.3, 0.15], [0.05, 0.03], [0.5, 0.6]],
    "ward(duer)": [[0.3, 0.15]],
    "ward(balanced)": [[0.02, 0.02]],
    "ward(coloured)": [[0.1, 0.2, 0.3, 0.1]],
    "phong": [[0.2, 3.0], [0.2, 500.0]],
    "phong(energy_conserving)": [[0.2, 40.0], [0.03, 2e4]],
    "lafortune": [[0.5, -0.9, 20.0], [0.5, -1.1, 60.0], [0.5, -0.97, 3e3], [0.3, 0.7, 10.0]],
    "lafortune(coloured)": [[0.2, 0.5, 0.3, -0.95, 30.0]],
}


@pytest.mark.parametrize(("name", "lobe"), [(name, lobe) for name in FITS for lobe in FITS[name]])
def test_noise_free_scans_give_their_parameters(
    simulate: Simulate, name: str, lobe: list[float]
) -> None:
    model, wanted = f"oren_nayar+{name}", [*DIFFUSE, *lobe]
    result = fit_scan(simulate(wanted, model, step=2), model)
    np.testing.assert_allclose(result.values, wanted, rtol=1e-6)
    assert not result.undetermined


@pytest.mark.parametrize("shape", [[0.08, 0.3, 0.5], [0.4, 0.15, -0.2], [0.1, 0.25, 1.5]])
def test_anisotropic_fit_with_lights_all_around(shape: list[float]) -> None:
    model = get_model("oren_nayar+ward(anisotropic)")
    wanted = np.array([*DIFFUSE, 0.3, *shape])
    light = np.concatenate([random_directions(seed, 300, 0.1) for seed in (12, 13, 14)])
    view = np.repeat([view_direction(angle) for angle in (0.0, 25.0, 50.0)], 300, axis=0)
    radiance = np.pi * model.evaluate(light, view, wanted) * light[:, 2:]
    n = len(light)
    scan = Observations(
        light_direction=light,
        view_direction=view,
        radiance=radiance,
        variance=np.full((n, 3), 1e-6),
        valid=np.ones((n, 3), dtype=bool),
        camera=np.repeat([1, 2, 3], 300),
        sweep=np.ones(n, dtype=int),
        exposure_ms=np.full(n, 4.0),
        time_s=np.zeros(n),
    )
    got = np.array(fit_scan(scan, model).values)
    # the same lobe by its other name: alphas exchanged, a quarter turn; and half turns
    if (got[5] < got[6]) != (wanted[5] < wanted[6]):
        got[5], got[6], got[7] = got[6], got[5], got[7] + np.pi / 2
    got[7] -= np.pi * np.round((got[7] - wanted[7]) / np.pi)
    np.testing.assert_allclose(got, wanted, rtol=1e-6)
