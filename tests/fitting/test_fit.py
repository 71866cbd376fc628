"""Fits of one scan: recovery, real materials, hard data, uncertainties, bad requests."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import tvbrdf_fitting
from tvbrdf_fitting import CommonErrors, FitError, FitResult, Observations, fit_scan, get_model
from tvbrdf_fitting.fit import SOLVERS
from tvbrdf_fitting.geometry import light_world_angle_deg
from tvbrdf_fitting.problem import make_problem
from tvbrdf_fitting.solvers import solve_trust_region

Simulate = Callable[..., Observations]

GLOSSY = [0.05, 0.12, 0.4, 0.1, 3.0, 25.0]
SATIN = [0.3, 0.5, 0.7, 0.4, 0.8, 6.0]
ROUGH = [0.6, 0.55, 0.5, 0.9, 0.15, 2.0]
MIRROR = [0.02, 0.3, 0.1, 0.3, 20.0, 120.0]
BROAD = [0.2, 0.2, 0.2, 0.3, 0.3, 1.2]
LAMBERT = [0.3, 0.5, 0.7, 0.0, 0.8, 6.0]
DUSTY = [*SATIN, 0.05, 0.06, 0.07, 0.35, 0.6]
THIN_DUST = [*GLOSSY, 0.08, 0.09, 0.1, -0.3, 0.08]


def plain(result: FitResult) -> FitResult:
    """Check what holds for every result, and return it."""
    assert json.loads(json.dumps(result.as_dict(), allow_nan=False))["model"] == result.model
    lower, upper = get_model(result.model).bounds
    seen = np.isfinite(result.values)
    slack = 1e-9 * np.abs(result.values[seen])
    assert (result.values[seen] >= lower[seen] - slack).all()
    assert (result.values[seen] <= upper[seen] + slack).all()
    variance = np.diag(result.covariance)
    assert (variance[np.isfinite(variance)] >= 0).all()
    unknown = ~np.isfinite(result.standard_deviations)
    assert set(np.array(result.parameter_names)[unknown]) <= set(result.undetermined)
    return result


class TestRecovery:
    """Without noise the parameters come back; 1e-3 is asked for, rounding is what is left."""

    @pytest.mark.parametrize("method", list(SOLVERS))
    @pytest.mark.parametrize("truth", [GLOSSY, SATIN, ROUGH, MIRROR, BROAD])
    def test_surface(self, simulate: Simulate, truth: list[float], method: str) -> None:
        result = plain(fit_scan(simulate(truth, step=3), method=method))
        np.testing.assert_allclose(result.values, truth, rtol=1e-7)
        assert result.at_bound == ()
        assert result.undetermined == ()

    @pytest.mark.parametrize("truth", [DUSTY, THIN_DUST])
    def test_dust_with_everything_free(self, simulate: Simulate, truth: list[float]) -> None:
        result = plain(fit_scan(simulate(truth, "dust", step=3), "dust"))
        np.testing.assert_allclose(result.values, truth, rtol=1e-6)

    @pytest.mark.parametrize("form", ["paper", "blinn"])
    def test_printed_forms_of_dust(self, simulate: Simulate, form: Any) -> None:
        model = get_model("dust", form=form)
        result = plain(fit_scan(simulate(DUSTY, model.name, step=3), model))
        np.testing.assert_allclose(result.values, DUSTY, rtol=1e-6)
        assert result.model == model.name

    @pytest.mark.parametrize("truth", [DUSTY, THIN_DUST])
    def test_dust_by_the_papers_procedure(self, simulate: Simulate, truth: list[float]) -> None:
        known = get_model("dust").as_mapping(truth)
        free = {"tau", "ks", "inverse_sigma_s"}
        fixed = {name: value for name, value in known.items() if name not in free}
        result = plain(fit_scan(simulate(truth, "dust", step=3), "dust", fixed=fixed))
        np.testing.assert_allclose(result.values, truth, rtol=1e-9)
        assert set(result.fixed) == set(fixed)
        assert [result.standard_deviation(n) for n in fixed] == [0.0] * len(fixed)
        assert all(result.standard_deviation(n) > 0 for n in free)

    def test_lambert_ends_at_the_bound_of_sigma_d(self, simulate: Simulate) -> None:
        result = plain(fit_scan(simulate(LAMBERT, step=3)))
        np.testing.assert_allclose(result.values, LAMBERT, rtol=1e-7, atol=1e-4)
        assert result.at_bound == ("sigma_d",)
        # three published deviations reach as far as three of sigma_d^2
        reach = math.sqrt(3 * math.sqrt(result.internal_covariance[3, 3]))
        assert 3 * result.standard_deviation("sigma_d") == pytest.approx(reach, rel=1e-4)

    def test_with_noise_each_method_finds_the_same_minimum(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, noise=0.01, step=3)
        one, two = (fit_scan(observations, method=m) for m in SOLVERS)
        assert one.chi_square == pytest.approx(two.chi_square, rel=1e-9)
        np.testing.assert_allclose(one.values, two.values, rtol=1e-4)

    def test_row_order_does_not_matter(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, noise=0.01, step=6)
        order = np.random.default_rng(0).permutation(len(observations))
        one, two = fit_scan(observations), fit_scan(observations.select(order))
        np.testing.assert_allclose(one.values, two.values, rtol=1e-6)

    def test_same_input_same_bits(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, noise=0.01, step=6)
        one, two = fit_scan(observations), fit_scan(observations)
        np.testing.assert_array_equal(one.values, two.values)
        np.testing.assert_array_equal(one.covariance, two.covariance)


@pytest.mark.parametrize(
    ("name", "orientation"),
    [
        ("paper_white", 2.10),
        ("satin_rosaline", 2.32),
        ("vch_golden_yellow", 4.31),
        ("cc_ibiza_sunset", 3.15),
    ],
)
def test_real_materials_fit_as_well_as_elsewhere(
    real_material: Callable[[str], Observations], name: str, orientation: float
) -> None:
    # figures of a fit made apart from this project, given with two decimals
    result = plain(fit_scan(real_material(name)))
    assert result.errors.rms_percent <= orientation + 0.005
    assert "sigma_d" in result.at_bound


def test_a_model_that_cannot_explain_the_data_fits_them_all_alike(
    real_material: Callable[[str], Observations],
) -> None:
    """Noise that follows the signal must not make a fit miss the peak of a real material."""
    measured = real_material("satin_rosaline")
    plain_fit = fit_scan(measured)
    noisy = replace(measured, variance=(1e-3 * measured.radiance) ** 2 + 1e-10)
    careful, naive = fit_scan(noisy), fit_scan(noisy, model_error=False)
    assert careful.model_error_std == pytest.approx(plain_fit.errors.rms_absolute, rel=0.05)
    assert careful.errors.rms_percent < 1.02 * plain_fit.errors.rms_percent
    assert naive.errors.rms_percent > 1.5 * plain_fit.errors.rms_percent
    assert naive.model_error_std == 0.0


def test_a_model_that_explains_the_data_is_given_no_error(simulate: Simulate) -> None:
    result = fit_scan(simulate([0.1, 0.2, 0.6, 0.3, 0.4, 6.0], noise=0.01, seed=3, step=8))
    assert result.model_error_std == 0.0


def test_global_minimum_of_random_scenes(simulate: Simulate) -> None:
    """Within 1e-6 of the cost of a multi-start trust region, on determined and dull scenes."""
    rng = np.random.default_rng(11)
    for seed in range(25):
        truth = [
            *rng.uniform(0.02, 0.9, 3),
            rng.choice([0.0, rng.uniform(0.05, 1.4)]),
            10 ** rng.uniform(-1.5, 1.2),
            1 / math.exp(rng.uniform(math.log(0.006), math.log(1.2))),
        ]
        gains = 1 + 0.02 * rng.normal(size=(4, 3)) * (seed % 2)
        observations = simulate(truth, noise=0.01, seed=seed, step=8, gains=gains)
        result = plain(fit_scan(observations, model_error=False))
        problem = make_problem(observations, get_model("ON+TS"), {}, {})
        best = problem.cost(solve_trust_region(problem).internal)
        assert 0.5 * result.chi_square <= best * (1 + 1e-6)


class TestHardData:
    """Nothing crashes, and what is not known is said."""

    def test_no_lobe(self, simulate: Simulate) -> None:
        truth = [0.3, 0.5, 0.7, 0.4, 0.0, 6.0]
        result = plain(fit_scan(simulate(truth, noise=0.01, step=3)))
        assert "inverse_sigma_s" in result.undetermined
        deviation = np.abs(result.values[:4] - truth[:4]) / result.standard_deviations[:4]
        assert deviation.max() < 4

    def test_no_lobe_without_noise(self, simulate: Simulate) -> None:
        result = plain(fit_scan(simulate([0.3, 0.5, 0.7, 0.4, 0.0, 6.0], step=3)))
        np.testing.assert_allclose(result.values[:4], [0.3, 0.5, 0.7, 0.4], rtol=1e-5)
        assert result.value("ks") == pytest.approx(0.0, abs=1e-6)
        assert "inverse_sigma_s" in result.undetermined

    def test_black_body_colour(self, simulate: Simulate) -> None:
        truth = [0.0, 0.0, 0.0, 0.4, 2.0, 8.0]
        result = plain(fit_scan(simulate(truth, noise=0.01, step=3)))
        assert "sigma_d" in result.undetermined
        np.testing.assert_allclose(result.values[4:], truth[4:], rtol=0.01)

    @pytest.mark.parametrize("level", [0.0, 0.5])
    @pytest.mark.parametrize("model", ["ON+TS", "dust"])
    def test_constant_data(self, simulate: Simulate, level: float, model: str) -> None:
        observations = simulate(SATIN, step=6)
        flat = replace(observations, radiance=np.full((len(observations), 3), level))
        result = plain(fit_scan(flat, model, common_errors=CommonErrors(0.02, 0.005)))
        if level == 0.0:
            np.testing.assert_array_equal(result.values[[0, 1, 2, 4]], 0.0)
            assert {"sigma_d", "inverse_sigma_s"} <= set(result.undetermined)
            assert math.isnan(result.errors.rms_percent)

    def test_negative_data(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, step=6)
        result = plain(fit_scan(replace(observations, radiance=-observations.radiance)))
        np.testing.assert_array_equal(result.values[[0, 1, 2, 4]], 0.0)

    @pytest.mark.parametrize("camera", [1, 2, 3, 4])
    def test_one_camera_only(self, simulate: Simulate, camera: int) -> None:
        observations = simulate(ROUGH, step=3)
        result = plain(fit_scan(observations.select(observations.camera == camera)))
        assert result.chi_square < 1e-9 * result.degrees_of_freedom

    def test_ten_lights_only(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, step=40)
        assert len(np.unique(observations.time_s)) < 30
        one_sweep = observations.select(observations.sweep == 2)
        assert len(np.unique(one_sweep.time_s)) <= 10
        np.testing.assert_allclose(plain(fit_scan(one_sweep)).values, SATIN, rtol=1e-6)

    @pytest.mark.parametrize("model", ["ON+TS", "dust"])
    def test_dead_channel(self, simulate: Simulate, model: str) -> None:
        truth = DUSTY if model == "dust" else SATIN
        observations = simulate(truth, model, noise=0.005, step=3)
        dead = observations.valid.copy()
        dead[:, 1] = False
        radiance = np.where(dead, observations.radiance, np.nan)
        result = plain(fit_scan(replace(observations, valid=dead, radiance=radiance), model))
        lost = [n for n in result.parameter_names if n.endswith("_g")]
        assert set(lost) <= set(result.undetermined)
        assert all(math.isnan(result.value(n)) for n in lost)
        assert all(math.isnan(result.standard_deviation(n)) for n in lost)
        kept = [i for i, n in enumerate(result.parameter_names) if n not in lost]
        deviation = np.abs(result.values - truth) / result.standard_deviations
        assert deviation[kept].max() < 5
        assert result.errors.count_g == 0

    def test_hidden_peak(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, step=2)
        angle = light_world_angle_deg(observations.light_direction)
        hidden = (observations.camera == 1) & (np.abs(angle - 24) < 10)
        np.testing.assert_allclose(
            plain(fit_scan(observations.select(~hidden))).values, SATIN, rtol=1e-6
        )

    def test_lobe_narrower_than_the_bound(self, simulate: Simulate) -> None:
        result = plain(fit_scan(simulate([0.3, 0.5, 0.7, 0.4, 20.0, 400.0])))
        assert "inverse_sigma_s" in result.at_bound

    def test_outliers(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, step=3)
        stray = np.random.default_rng(0).random((len(observations), 3)) < 0.2
        result = plain(
            fit_scan(replace(observations, radiance=observations.radiance * (1 + stray)))
        )
        assert result.chi_square > 100 * result.degrees_of_freedom

    @pytest.mark.parametrize("scale", [1e-6, 1e6])
    def test_lobe_scales_with_the_radiance(self, simulate: Simulate, scale: float) -> None:
        # Ks is linear; Kd is not (Kd^2), so a black colour isolates it
        observations = simulate([0.0, 0.0, 0.0, 0.0, 2.0, 8.0], step=3)
        scaled = replace(
            observations,
            radiance=observations.radiance * scale,
            variance=observations.variance * scale**2,
        )
        values = plain(fit_scan(scaled)).values
        np.testing.assert_allclose(values[4:], [2.0 * scale, 8.0], rtol=1e-6)

    def test_weights_of_any_size(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, noise=0.01, step=6)
        values = [
            fit_scan(
                replace(observations, variance=observations.variance * f), model_error=False
            ).values
            for f in (1e-20, 1.0, 1e20)
        ]
        np.testing.assert_allclose(values[0], values[1], rtol=1e-6)
        np.testing.assert_allclose(values[2], values[1], rtol=1e-6)

    def test_dust_too_thin_to_know_its_colour_is_marked(self, simulate: Simulate) -> None:
        truth = [*SATIN, 0.05, 0.06, 0.07, 0.35, 0.002]
        result = plain(fit_scan(simulate(truth, "dust", noise=0.01, step=3), "dust"))
        assert {"w_b", "w_g", "w_r"} <= set(result.undetermined)

    def test_rows_below_the_horizon_are_left_out(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, step=6)
        low = observations.select(slice(0, 5))
        below = replace(low, light_direction=np.tile([-0.8, 0.0, -0.6], (5, 1)))
        both = Observations.concatenate([observations, below])
        result = plain(fit_scan(both))
        np.testing.assert_allclose(result.values, SATIN, rtol=1e-7)
        assert result.errors.count == int(observations.valid.sum())


class TestUncertainty:
    def test_random_covariance_is_the_inverse_of_the_information(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, noise=0.01, step=4)
        result = fit_scan(observations)
        jacobian = get_model("ON+TS").jacobian(
            observations.light_direction, observations.view_direction, result.values
        )
        jacobian *= np.pi * observations.light_direction[:, 2][:, None, None]
        weight = np.where(observations.valid, 1 / observations.variance, 0.0)
        information = np.einsum("nci,nc,ncj->ij", jacobian, weight, jacobian)
        # sigma_d's deviation is stretched to cover the interval of its square: by 3 sd / (4 s),
        # and terms of second order in sd / s
        square = result.internal_values[3]
        stretch = 1 + 1.5 * math.sqrt(result.internal_covariance[3, 3]) / square
        np.testing.assert_allclose(
            result.covariance_random, np.linalg.inv(information), rtol=1.05 * (stretch - 1)
        )
        np.testing.assert_allclose(
            np.delete(np.delete(result.covariance_random, 3, 0), 3, 1),
            np.delete(np.delete(np.linalg.inv(information), 3, 0), 3, 1),
            rtol=1e-6,
        )
        np.testing.assert_array_equal(result.covariance_common, 0.0)

    def test_common_errors_predict_what_a_shared_error_does(self, simulate: Simulate) -> None:
        # one shared error of one standard deviation moves the parameters by the stated column
        gains = np.ones((4, 3))
        gains[2, 1] += 0.001
        moved = fit_scan(simulate(SATIN, step=4, gains=gains)).values - SATIN
        every = fit_scan(
            simulate(SATIN, step=4), common_errors=CommonErrors(gain_relative_std=0.001)
        )
        total = np.zeros(6)
        for camera in range(4):
            for channel in range(3):
                gains = np.ones((4, 3))
                gains[camera, channel] += 0.001
                total += (fit_scan(simulate(SATIN, step=4, gains=gains)).values - SATIN) ** 2
        # to first order: an error of 0.1 % leaves second-order terms of that size
        np.testing.assert_allclose(np.diag(every.covariance_common), total, rtol=0.02)
        assert (np.abs(moved) <= 1.01 * np.sqrt(np.diag(every.covariance_common))).all()

    def test_light_offset_of_each_sweep(self, simulate: Simulate) -> None:
        total = np.zeros(6)
        for sweep, deviation in enumerate((0.01, 0.02, 0.005)):
            offset = np.zeros(3)
            offset[sweep] = deviation
            observations = simulate(SATIN, step=2, light_offset_deg=offset)
            total += (fit_scan(observations).values - SATIN) ** 2
        stated = fit_scan(
            simulate(SATIN, step=2),
            common_errors=CommonErrors(light_angle_std_deg={1: 0.01, 2: 0.02, 3: 0.005}),
        )
        # second order in the offset, and the few rows that an offset moves over the horizon
        np.testing.assert_allclose(np.diag(stated.covariance_common), total, rtol=0.05)
        assert stated.covariance_random.shape == (6, 6)
        assert (stated.standard_deviations > np.sqrt(np.diag(stated.covariance_random))).all()

    def test_noise_of_twice_the_size_doubles_the_deviations(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, step=6)
        one = fit_scan(observations)
        two = fit_scan(replace(observations, variance=4 * observations.variance))
        ratio = two.standard_deviations / one.standard_deviations
        np.testing.assert_allclose(np.delete(ratio, 3), 2.0, rtol=1e-6)
        # sigma_d's is stretched by 3 sd / (4 s) of its square, 0.1 % here
        assert 2.0 < ratio[3] < 2.005

    def test_common_errors_must_be_sensible(self, simulate: Simulate) -> None:
        with pytest.raises(ValueError, match="gain_relative_std = -1"):
            CommonErrors(gain_relative_std=-1)
        with pytest.raises(ValueError, match="no light_angle_std_deg for sweep 3"):
            fit_scan(simulate(SATIN, step=30), common_errors=CommonErrors({1: 0.1, 2: 0.1}))


class TestRequests:
    def test_fixed_values_stay(self, simulate: Simulate) -> None:
        result = plain(fit_scan(simulate(SATIN, step=6), fixed={"sigma_d": 0.2, "kd_b": 0.25}))
        assert result.value("sigma_d") == 0.2
        assert result.value("kd_b") == 0.25
        assert result.fixed == ("kd_b", "sigma_d")
        assert result.degrees_of_freedom == result.errors.count - 4

    def test_everything_fixed_only_measures_the_error(self, simulate: Simulate) -> None:
        fixed = get_model("ON+TS").as_mapping(SATIN)
        result = plain(fit_scan(simulate(SATIN, step=6), fixed=fixed))
        assert result.errors.rms_absolute < 1e-12
        assert result.errors.count == result.degrees_of_freedom

    def test_initial_values_lead_to_the_same_minimum(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, noise=0.01, step=6)
        found = fit_scan(observations)
        near = {n: 1.05 * v for n, v in found.parameters.items()}
        again = fit_scan(observations, initial=near)
        np.testing.assert_allclose(again.values, found.values, rtol=1e-5)
        assert again.evaluations < found.evaluations
        partly = fit_scan(observations, initial={"inverse_sigma_s": 5.0})
        np.testing.assert_allclose(partly.values, found.values, rtol=1e-5)

    @pytest.mark.parametrize(
        ("request_", "message"),
        [
            ({"method": "newton"}, "unknown method 'newton'; known methods: paper, trust_region"),
            ({"fixed": {"kd": 0.3}}, "fixed: .* has no parameter 'kd'; it has kd_b, kd_g"),
            ({"initial": {"tau": 0.3}}, "initial: .* has no parameter 'tau'"),
            ({"fixed": {"sigma_d": 2.0}}, r"sigma_d = 2.0 is outside \[0, 1.5\] rad"),
            ({"fixed": {"ks": math.nan}}, "ks = nan is outside"),
        ],
    )
    def test_bad_requests(self, simulate: Simulate, request_: dict[str, Any], message: str) -> None:
        with pytest.raises(FitError, match=message):
            fit_scan(simulate(SATIN, step=30), **request_)

    def test_unknown_model(self, simulate: Simulate) -> None:
        with pytest.raises(ValueError, match="known models: "):
            fit_scan(simulate(SATIN, step=30), "lafortune")

    def test_too_few_values(self, simulate: Simulate) -> None:
        few = simulate(SATIN, step=30).select(slice(0, 3))
        with pytest.raises(FitError, match="9 usable values cannot determine 11 free parameters"):
            fit_scan(few, "dust")
        none = replace(few, valid=np.zeros((3, 3), dtype=bool))
        with pytest.raises(FitError, match="0 usable values"):
            fit_scan(none)

    def test_as_many_values_as_parameters(self, simulate: Simulate) -> None:
        result = plain(fit_scan(simulate(SATIN, step=30).select(slice(0, 2))))
        assert result.degrees_of_freedom == 0


class TestResult:
    def test_values_by_name_and_predictions(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, step=6)
        result = fit_scan(observations)
        assert result.value("ks") == pytest.approx(0.8)
        assert list(result.parameters) == list(result.parameter_names)
        light, view = observations.light_direction, observations.view_direction
        np.testing.assert_allclose(result.radiance(light, view), observations.radiance, rtol=1e-6)
        np.testing.assert_allclose(np.diag(result.correlations), 1.0)
        with pytest.raises(KeyError, match="no parameter 'kx'"):
            result.value("kx")

    def test_it_says_what_ran_and_why_it_stopped(self, simulate: Simulate) -> None:
        began = time.perf_counter()
        result = fit_scan(simulate(SATIN, noise=0.01, step=6))
        assert 0 < result.solve_time_s <= time.perf_counter() - began
        assert "Levenberg-Marquardt" in result.solver
        assert "satisfied" in result.reason
        assert result.evaluations > 3

    def test_results_cannot_be_replace(self, simulate: Simulate) -> None:
        result = fit_scan(simulate(SATIN, step=30))
        with pytest.raises(ValueError, match="read-only"):
            result.values[0] = 1.0

    def test_public_names(self) -> None:
        assert all(hasattr(tvbrdf_fitting, name) for name in tvbrdf_fitting.__all__)
        with pytest.raises(AttributeError, match="no attribute 'fit_everything'"):
            tvbrdf_fitting.fit_everything  # noqa: B018
