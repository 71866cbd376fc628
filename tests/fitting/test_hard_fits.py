"""Hard cases, for every solver: the right answer, a parameter named as undetermined, or an error.

Where a scan has noise, "right" is within 5 of the stated deviations: one of the few hundred values
compared here would be outside by chance in 5000 runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.fitting.scans import DUSTY, ROUGH, SATIN, Simulate, sound
from tvbrdf_fitting import CommonErrors, FitError, FitResult, Observations, fit_scan, get_model
from tvbrdf_fitting.fit import SOLVERS
from tvbrdf_fitting.geometry import light_world_angle_deg

Fit = Callable[..., FitResult]

SHARP = [0.3, 0.5, 0.7, 0.4, 3.0, 30.0]
FAR = 5.0


def assert_right(
    result: FitResult, truth: Sequence[float], but_for: Collection[str] = (), far: float = FAR
) -> None:
    """Every parameter is determined and within its deviations of the truth, but for some."""
    lost = set(result.undetermined) - set(but_for)
    assert not lost, f"{lost} undetermined: {result.parameters}"
    off = np.abs(result.values - truth) / result.standard_deviations
    for name, score in zip(result.parameter_names, off, strict=True):
        assert name in but_for or score < far, f"{name} off by {score:.1f}: {result.parameters}"


@pytest.fixture(params=list(SOLVERS))
def method(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def fit(method: str) -> Fit:
    def run(observations: Observations, *args: Any, **options: Any) -> FitResult:
        return sound(fit_scan(observations, *args, method=method, **options))

    return run


class TestNoLobeOrOnlyALobe:
    def test_no_lobe(self, simulate: Simulate, fit: Fit) -> None:
        truth = [0.3, 0.5, 0.7, 0.4, 0.0, 6.0]
        result = fit(simulate(truth, noise=0.01, step=3))
        assert "inverse_sigma_s" in result.undetermined
        assert_right(result, truth, but_for=["inverse_sigma_s"])

    def test_no_lobe_without_noise(self, simulate: Simulate, fit: Fit) -> None:
        result = fit(simulate([0.3, 0.5, 0.7, 0.4, 0.0, 6.0], step=3))
        np.testing.assert_allclose(result.values[:4], [0.3, 0.5, 0.7, 0.4], rtol=1e-5)
        assert result.value("ks") == pytest.approx(0.0, abs=1e-6)
        assert "inverse_sigma_s" in result.undetermined

    def test_no_lobe_and_no_roughness(self, simulate: Simulate, fit: Fit) -> None:
        truth = [0.3, 0.5, 0.7, 0.0, 0.0, 6.0]
        result = fit(simulate(truth, noise=0.01, step=6))
        assert "inverse_sigma_s" in result.undetermined
        assert_right(result, truth, but_for=["sigma_d", "inverse_sigma_s"])
        # 3 deviations of sigma_d cover what 3 of its square do
        reached = "sigma_d" in result.at_bound
        assert reached or result.value("sigma_d") < FAR * result.standard_deviation("sigma_d")

    def test_only_a_lobe(self, simulate: Simulate, fit: Fit) -> None:
        truth = [0.0, 0.0, 0.0, 0.4, 2.0, 8.0]
        result = fit(simulate(truth, noise=0.01, step=3))
        assert "sigma_d" in result.undetermined
        assert_right(result, truth, but_for=["sigma_d"])


class TestSharpLobes:
    """The light's step is `step` / 2 degrees, of the half angle half of that, in three sweeps."""

    def test_narrower_than_the_step(self, simulate: Simulate, fit: Fit) -> None:
        # sigma_s is 0.38 degrees, a step of the half angle 0.5: a few values see the lobe
        truth = [0.3, 0.5, 0.7, 0.4, 20.0, 150.0]
        result = fit(simulate(truth, noise=0.005, step=2))
        assert_right(result, truth)

    @pytest.mark.parametrize("seed", range(3))
    def test_seen_by_hardly_a_value(self, simulate: Simulate, fit: Fit, seed: int) -> None:
        truth = [0.3, 0.5, 0.7, 0.4, 20.0, 150.0]
        result = fit(simulate(truth, noise=0.005, step=8, seed=seed))
        assert_right(result, truth, but_for=["ks", "inverse_sigma_s"])
        # named, or right
        for name, value in (("ks", 20.0), ("inverse_sigma_s", 150.0)):
            off = abs(result.value(name) - value)
            assert name in result.undetermined or off < FAR * result.standard_deviation(name)

    def test_missed_between_two_lights(self, simulate: Simulate, fit: Fit) -> None:
        truth = [0.3, 0.5, 0.7, 0.4, 20.0, 199.0]
        result = fit(simulate(truth, noise=0.005, step=20))
        assert "inverse_sigma_s" in result.undetermined
        assert_right(result, truth, but_for=["ks", "inverse_sigma_s"])

    def test_narrower_than_the_bound(self, simulate: Simulate, fit: Fit) -> None:
        result = fit(simulate([0.3, 0.5, 0.7, 0.4, 20.0, 400.0]))
        assert "inverse_sigma_s" in result.at_bound
        assert result.model_error_std > 0

    def test_peak_hidden_by_the_arm(self, simulate: Simulate, fit: Fit) -> None:
        observations = simulate(SATIN, noise=0.005, step=2)
        angle = light_world_angle_deg(observations.light_direction)
        hidden = (observations.camera == 1) & (np.abs(angle - 24) < 10)
        assert_right(fit(observations.select(~hidden)), SATIN)

    def test_whole_lobe_hidden(self, simulate: Simulate, fit: Fit) -> None:
        # 3.3 sigma_s and more are left: exp(-11) of the peak, below the noise
        observations = simulate(SHARP, noise=0.005, step=2)
        angle = light_world_angle_deg(observations.light_direction)
        hidden = (observations.camera == 1) & (np.abs(angle - 24) < 13)
        result = fit(observations.select(~hidden))
        assert "inverse_sigma_s" in result.undetermined
        assert_right(result, SHARP, but_for=["ks", "inverse_sigma_s"])
        # no lobe is claimed
        lost = "ks" in result.undetermined
        assert lost or result.value("ks") < 3 * result.standard_deviation("ks")

    @pytest.mark.parametrize("truth", [SATIN, SHARP])
    def test_saturated_peak(self, simulate: Simulate, fit: Fit, truth: list[float]) -> None:
        observations = simulate(truth, noise=0.005, step=2)
        dim = observations.radiance < 0.8
        assert observations.radiance.max() > 1.1
        assert_right(fit(replace(observations, valid=observations.valid & dim)), truth)


class TestFewData:
    @pytest.mark.parametrize("camera", [1, 2, 3, 4])
    def test_one_camera_only(self, simulate: Simulate, fit: Fit, camera: int) -> None:
        observations = simulate(ROUGH, noise=0.002, step=3)
        result = fit(observations.select(observations.camera == camera))
        assert result.chi_square < 1.2 * result.degrees_of_freedom
        assert_right(result, ROUGH)

    @pytest.mark.parametrize("camera", [3, 4])
    def test_one_camera_that_does_not_see_the_lobe(
        self,
        simulate: Simulate,
        fit: Fit,
        camera: int,
    ) -> None:
        observations = simulate(SATIN, noise=0.005, step=3)
        result = fit(observations.select(observations.camera == camera))
        assert "inverse_sigma_s" in result.undetermined
        assert_right(result, SATIN, but_for=["ks", "inverse_sigma_s"])
        # no lobe is claimed
        lost = "ks" in result.undetermined
        assert lost or result.value("ks") < 3 * result.standard_deviation("ks")

    @pytest.mark.parametrize("noise", [0.0, 0.005])
    def test_ten_lights_only(self, simulate: Simulate, fit: Fit, noise: float) -> None:
        observations = simulate(SATIN, noise=noise, step=40)
        one_sweep = observations.select(observations.sweep == 2)
        assert len(np.unique(one_sweep.time_s)) <= 10
        result = fit(one_sweep)
        assert_right(result, SATIN)
        if not noise:
            np.testing.assert_allclose(result.values, SATIN, rtol=1e-6)

    @pytest.mark.parametrize("model", ["ON+TS", "dust"])
    def test_dead_channel(self, simulate: Simulate, fit: Fit, model: str) -> None:
        truth = DUSTY if model == "dust" else SATIN
        observations = simulate(truth, model, noise=0.005, step=6)
        alive = observations.valid.copy()
        alive[:, 1] = False
        radiance = np.where(alive, observations.radiance, np.nan)
        result = fit(replace(observations, valid=alive, radiance=radiance), model)
        lost = [n for n in result.parameter_names if n.endswith("_g")]
        assert set(lost) <= set(result.undetermined)
        assert all(math.isnan(result.value(n)) for n in lost)
        assert all(math.isnan(result.standard_deviation(n)) for n in lost)
        assert_right(result, truth, but_for=lost)
        assert result.errors.count_g == 0

    def test_fewer_values_than_parameters(self, simulate: Simulate, method: str) -> None:
        few = simulate(SATIN, step=30).select(slice(0, 3))
        message = r"9 usable values cannot determine 11 free parameters of dust.* of 3 rows 3 have"
        with pytest.raises(FitError, match=message):
            fit_scan(few, "dust", method=method)
        with pytest.raises(FitError, match=r"0 usable values .*check masks and the horizon"):
            fit_scan(replace(few, valid=np.zeros((3, 3), dtype=bool)), method=method)

    def test_as_many_values_as_parameters(self, simulate: Simulate, fit: Fit) -> None:
        assert fit(simulate(SATIN, step=30).select(slice(0, 2))).degrees_of_freedom == 0


class TestWrongData:
    def test_outliers_are_flagged(self, simulate: Simulate, fit: Fit) -> None:
        observations = simulate(SATIN, noise=0.005, step=6)
        stray = np.random.default_rng(0).random((len(observations), 3)) < 0.2
        spoilt = replace(observations, radiance=observations.radiance * (1 + stray))
        result = fit(spoilt)
        assert result.chi_square > 100 * result.degrees_of_freedom
        assert result.model_error_std > 0.05

    @pytest.mark.parametrize("seed", range(3))
    def test_outliers_let_go(self, simulate: Simulate, fit: Fit, seed: int) -> None:
        observations = simulate(SATIN, noise=0.005, step=6, seed=seed)
        stray = np.random.default_rng(seed).random((len(observations), 3)) < 0.2
        spoilt = replace(observations, radiance=observations.radiance * (1 + stray))
        result = fit(spoilt, loss="cauchy")
        assert_right(result, SATIN)
        assert result.model_error_std == 0.0

    @pytest.mark.parametrize("loss", ["least_squares", "huber", "cauchy"])
    @pytest.mark.parametrize("model", ["ON+TS", "dust"])
    def test_all_zeros(self, simulate: Simulate, fit: Fit, model: str, loss: str) -> None:
        observations = simulate(SATIN, step=12)
        dark = replace(observations, radiance=np.zeros((len(observations), 3)))
        result = fit(dark, model, loss=loss, common_errors=CommonErrors(0.02, 0.005))
        # a trust region stays inside its bounds, if only just
        np.testing.assert_allclose(result.values[[0, 1, 2, 4]], 0.0, atol=1e-9)
        assert {"sigma_d", "inverse_sigma_s"} <= set(result.undetermined)
        assert math.isnan(result.errors.rms_percent)

    @pytest.mark.parametrize("model", ["ON+TS", "dust"])
    def test_constant_data(self, simulate: Simulate, fit: Fit, model: str) -> None:
        """No surface has a radiance without a cosine: the model's error says so."""
        observations = simulate(SATIN, step=12)
        flat = replace(observations, radiance=np.full((len(observations), 3), 0.5))
        result = fit(flat, model, common_errors=CommonErrors(0.02, 0.005))
        assert result.chi_square > 100 * result.degrees_of_freedom
        # the best fit of the default model leaves 0.18 of 0.5
        assert 0.0 < result.model_error_std < 0.2
        assert result.model_error_std == pytest.approx(result.errors.rms_absolute, rel=0.02)

    @pytest.mark.parametrize("loss", ["least_squares", "huber", "cauchy"])
    def test_negative_data(self, simulate: Simulate, fit: Fit, loss: str) -> None:
        observations = simulate(SATIN, step=12)
        result = fit(replace(observations, radiance=-observations.radiance), loss=loss)
        # a trust region stays inside its bounds, if only just
        np.testing.assert_allclose(result.values[[0, 1, 2, 4]], 0.0, atol=1e-9)
        assert {"kd_b", "kd_g", "kd_r", "ks"} <= set(result.at_bound)
        assert {"sigma_d", "inverse_sigma_s"} <= set(result.undetermined)

    @pytest.mark.parametrize("wrong", [math.nan, math.inf])
    def test_not_a_number_is_refused_with_its_place(
        self, simulate: Simulate, fit: Fit, wrong: float
    ) -> None:
        observations = simulate(SATIN, step=12)
        radiance = observations.radiance.copy()
        radiance[7, 2] = wrong
        with pytest.raises(
            ValueError, match=r"radiance\[7, 2\] = .* \(camera 1, sweep 1, channel r\) is not fin"
        ):
            replace(observations, radiance=radiance)
        valid = observations.valid.copy()
        valid[7, 2] = False
        kept = replace(observations, radiance=radiance, valid=valid)
        np.testing.assert_allclose(fit(kept).values, SATIN, rtol=1e-6)

    def test_rows_below_the_horizon_are_left_out(self, simulate: Simulate, fit: Fit) -> None:
        observations = simulate(SATIN, step=6)
        low = observations.select(slice(0, 5))
        below = replace(low, light_direction=np.tile([-0.8, 0.0, -0.6], (5, 1)))
        result = fit(Observations.concatenate([observations, below]))
        np.testing.assert_allclose(result.values, SATIN, rtol=1e-7)
        assert result.errors.count == int(observations.valid.sum())


class TestScales:
    @pytest.mark.parametrize("scale", [1e-6, 1e6])
    def test_linear_models_scale(self, simulate: Simulate, fit: Fit, scale: float) -> None:
        observations = simulate(
            [0.3, 0.5, 0.7, 0.8, 6.0], "lambert+torrance_sparrow", noise=0.01, step=6
        )
        scaled = replace(
            observations,
            radiance=observations.radiance * scale,
            variance=observations.variance * scale**2,
        )
        one = fit(observations, "lambert+torrance_sparrow")
        other = fit(scaled, "lambert+torrance_sparrow")
        # solvers stop at a relative change of the cost of 1e-10 or less: 1e-5 deviations
        moved = np.abs(other.values / [scale, scale, scale, scale, 1.0] - one.values)
        assert (moved < 1e-3 * one.standard_deviations).all()
        assert other.chi_square == pytest.approx(one.chi_square, rel=1e-9)

    @pytest.mark.parametrize("scale", [1e-6, 1e6])
    def test_lobe_of_the_default_model_scales(
        self, simulate: Simulate, fit: Fit, scale: float
    ) -> None:
        # Ks is linear; Kd is not (Kd^2), so a black colour isolates it
        observations = simulate([0.0, 0.0, 0.0, 0.0, 2.0, 8.0], step=3)
        scaled = replace(
            observations,
            radiance=observations.radiance * scale,
            variance=observations.variance * scale**2,
        )
        np.testing.assert_allclose(fit(scaled).values[4:], [2.0 * scale, 8.0], rtol=1e-6)

    def test_weights_of_any_size(self, simulate: Simulate, fit: Fit) -> None:
        observations = simulate(SATIN, noise=0.01, step=6)
        values = [
            fit(replace(observations, variance=observations.variance * f), model_error=False).values
            for f in (1e-20, 1.0, 1e20)
        ]
        np.testing.assert_allclose(values[0], values[1], rtol=1e-6)
        np.testing.assert_allclose(values[2], values[1], rtol=1e-6)


class TestNearlyEqualColumns:
    def test_second_lobe_that_is_not_there(self, simulate: Simulate, fit: Fit) -> None:
        model = "oren_nayar+torrance_sparrow+torrance_sparrow"
        result = fit(simulate(SATIN, noise=0.005, step=6), model)
        lobes = {"ks", "inverse_sigma_s", "ks_2", "inverse_sigma_s_2"}
        assert set(result.undetermined) & lobes
        assert_right(result, [*SATIN, 0.0, 6.0], but_for=lobes)

    def test_two_lobes_that_look_like_one(self, simulate: Simulate, fit: Fit) -> None:
        """Widths 1/6 and 1/6.1: what comes out predicts the same, and says what it can't tell."""
        model = "oren_nayar+torrance_sparrow+torrance_sparrow"
        truth = [*SATIN, 0.8, 6.1]
        observations = simulate(truth, model, noise=0.005, step=6)
        result = fit(observations, model)
        lobes = {"ks", "inverse_sigma_s", "ks_2", "inverse_sigma_s_2"}
        assert set(result.undetermined) & lobes
        light, view = observations.light_direction, observations.view_direction
        true = np.pi * light[:, 2:] * get_model(model).evaluate(light, view, truth)
        # 8 parameters from 2000 values: the noise of a prediction is a sixteenth of a value's
        off = (result.radiance(light, view) - true) / np.sqrt(observations.variance)
        assert np.sqrt(np.mean(off[observations.valid] ** 2)) < 3 * math.sqrt(8 / 2000)

    def test_two_diffuse_parts(self, simulate: Simulate, fit: Fit) -> None:
        """Lambert's part and Oren-Nayar's are nearly parallel; only their sum is known."""
        model = "lambert+oren_nayar+torrance_sparrow"
        result = fit(simulate(SATIN, noise=0.005, step=6), model)
        both = [result.value(f"kd_{c}") + result.value(f"kd_{c}_2") for c in "bgr"]
        np.testing.assert_allclose(both, SATIN[:3], rtol=0.1)
        names = result.parameter_names
        for one, other in (("kd_b", "kd_b_2"), ("kd_r", "kd_r_2")):
            assert result.correlations[names.index(one), names.index(other)] < -0.9
        # the truth has nothing of the first: within its deviation, which is large
        assert result.value("kd_b") < FAR * result.standard_deviation("kd_b")
        assert result.standard_deviation("kd_b") > 0.02


class TestDust:
    @pytest.mark.parametrize("tau", [0.0, 1e-3])
    def test_too_little_to_know_its_colour(self, simulate: Simulate, fit: Fit, tau: float) -> None:
        truth = [*DUSTY[:-1], tau]
        result = fit(simulate(truth, "dust", noise=0.01, step=6), "dust")
        lost = ["w_b", "w_g", "w_r", "g"]
        assert set(lost) <= set(result.undetermined)
        # tau itself is only seen through the surface's attenuation, which Kd can imitate
        assert_right(result, truth, but_for=[*lost, "tau"])
        assert result.value("tau") < 0.02

    def test_moderate(self, simulate: Simulate, fit: Fit) -> None:
        assert_right(fit(simulate(DUSTY, "dust", noise=0.005, step=6), "dust"), DUSTY)

    def test_so_much_that_it_hides_the_surface(self, simulate: Simulate, fit: Fit) -> None:
        """At tau = 3 the diffuse part is seen through exp(-6) at best."""
        truth = [*DUSTY[:-1], 3.0]
        result = fit(simulate(truth, "dust", noise=0.005, step=6), "dust")
        hidden = ["kd_b", "kd_g", "kd_r", "sigma_d"]
        assert set(hidden) <= set(result.undetermined)
        assert_right(result, truth, but_for=[*hidden, "tau"])
        assert "tau" in result.undetermined or abs(
            result.value("tau") - 3.0
        ) < FAR * result.standard_deviation("tau")

    @pytest.mark.parametrize("tau", [0.0, 1e-3, 0.6, 3.0, 3.5])
    def test_by_the_papers_procedure(self, simulate: Simulate, fit: Fit, tau: float) -> None:
        """w and g from pure dust, Kd and sigma_d from the clean surface are known."""
        truth = [*DUSTY[:-1], tau]
        known = get_model("dust").as_mapping(truth)
        fixed = {n: v for n, v in known.items() if n not in {"ks", "inverse_sigma_s", "tau"}}
        result = fit(simulate(truth, "dust", noise=0.005, step=6), "dust", fixed=fixed)
        for name in ("ks", "inverse_sigma_s", "tau"):
            off = abs(result.value(name) - known[name])
            thin = name == "tau" and tau < 1e-3
            assert thin or name not in result.undetermined
            assert off < FAR * result.standard_deviation(name), (name, result.parameters)
