"""Fits of one scan: recovery, real materials, hard data, uncertainties, bad requests."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import tvbrdf_fitting
from tests.fitting.scans import DUSTY, GLOSSY, LAMBERT, ROUGH, SATIN, Simulate, sound
from tvbrdf_fitting import CommonErrors, FitError, Observations, fit_scan, get_model
from tvbrdf_fitting.fit import SOLVERS
from tvbrdf_fitting.problem import make_problem
from tvbrdf_fitting.solve.solvers import solve_trust_region

MIRROR = [0.02, 0.3, 0.1, 0.3, 20.0, 120.0]
BROAD = [0.2, 0.2, 0.2, 0.3, 0.3, 1.2]
THIN_DUST = [*GLOSSY, 0.08, 0.09, 0.1, -0.3, 0.08]


class TestRecovery:
    """Without noise the parameters come back; 1e-3 is asked for, rounding is what is left."""

    @pytest.mark.parametrize("method", list(SOLVERS))
    @pytest.mark.parametrize("truth", [GLOSSY, SATIN, ROUGH, MIRROR, BROAD])
    def test_surface(self, simulate: Simulate, truth: list[float], method: str) -> None:
        result = sound(fit_scan(simulate(truth, step=3), method=method))
        np.testing.assert_allclose(result.values, truth, rtol=1e-7)
        assert result.at_bound == ()
        assert result.undetermined == ()

    @pytest.mark.parametrize("truth", [DUSTY, THIN_DUST])
    def test_dust_with_everything_free(self, simulate: Simulate, truth: list[float]) -> None:
        result = sound(fit_scan(simulate(truth, "dust", step=3), "dust"))
        np.testing.assert_allclose(result.values, truth, rtol=1e-6)

    @pytest.mark.parametrize("form", ["paper", "blinn"])
    def test_printed_forms_of_dust(self, simulate: Simulate, form: Any) -> None:
        model = get_model("dust", form=form)
        result = sound(fit_scan(simulate(DUSTY, model.name, step=3), model))
        np.testing.assert_allclose(result.values, DUSTY, rtol=1e-6)
        assert result.model == model.name

    @pytest.mark.parametrize("truth", [DUSTY, THIN_DUST])
    def test_dust_by_the_papers_procedure(self, simulate: Simulate, truth: list[float]) -> None:
        known = get_model("dust").as_mapping(truth)
        free = {"tau", "ks", "inverse_sigma_s"}
        fixed = {name: value for name, value in known.items() if name not in free}
        result = sound(fit_scan(simulate(truth, "dust", step=3), "dust", fixed=fixed))
        np.testing.assert_allclose(result.values, truth, rtol=1e-9)
        assert set(result.fixed) == set(fixed)
        assert [result.standard_deviation(n) for n in fixed] == [0.0] * len(fixed)
        assert all(result.standard_deviation(n) > 0 for n in free)

    def test_lambert_ends_at_the_bound_of_sigma_d(self, simulate: Simulate) -> None:
        result = sound(fit_scan(simulate(LAMBERT, step=3)))
        np.testing.assert_allclose(result.values, LAMBERT, rtol=1e-7, atol=1e-4)
        assert result.at_bound == ("sigma_d",)
        # three published deviations reach as far as three of sigma_d^2
        reach = math.sqrt(3 * math.sqrt(result.internal_covariance[3, 3]))
        assert 3 * result.standard_deviation("sigma_d") == pytest.approx(reach, rel=1e-4)

    def test_with_noise_each_method_finds_the_same_minimum(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, noise=0.01, step=3)
        one, *others = (fit_scan(observations, method=m) for m in SOLVERS)
        assert others
        for two in others:
            assert one.chi_square == pytest.approx(two.chi_square, rel=1e-9)
            np.testing.assert_allclose(one.values, two.values, rtol=1e-4)

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
    result = sound(fit_scan(real_material(name)))
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
        result = sound(fit_scan(observations, model_error=False))
        problem = make_problem(observations, get_model("ON+TS"), {}, {})
        best = problem.cost(solve_trust_region(problem).internal)
        assert 0.5 * result.chi_square <= best * (1 + 1e-6)


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
        errors = CommonErrors(gain_relative_std=0.001)
        every = fit_scan(simulate(SATIN, step=4), common_errors=errors)
        total = np.zeros(6)
        for camera in range(4):
            for channel in range(3):
                gains = np.ones((4, 3))
                gains[camera, channel] += 0.001
                moved = fit_scan(simulate(SATIN, step=4, gains=gains), common_errors=errors)
                total += (moved.values - SATIN) ** 2
        # to first order: an error of 0.1 % leaves second-order terms of that size
        np.testing.assert_allclose(np.diag(every.covariance_common), total, rtol=0.02)

    def test_light_offset_of_each_sweep(self, simulate: Simulate) -> None:
        errors = CommonErrors(light_angle_std_deg={1: 0.01, 2: 0.02, 3: 0.005})
        total = np.zeros(6)
        for sweep, deviation in enumerate((0.01, 0.02, 0.005)):
            offset = np.zeros(3)
            offset[sweep] = deviation
            moved = fit_scan(simulate(SATIN, step=2, light_offset_deg=offset), common_errors=errors)
            total += (moved.values - SATIN) ** 2
        stated = fit_scan(simulate(SATIN, step=2), common_errors=errors)
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
        result = sound(fit_scan(simulate(SATIN, step=6), fixed={"sigma_d": 0.2, "kd_b": 0.25}))
        assert result.value("sigma_d") == 0.2
        assert result.value("kd_b") == 0.25
        assert result.fixed == ("kd_b", "sigma_d")
        assert result.degrees_of_freedom == result.errors.count - 4

    def test_everything_fixed_only_measures_the_error(self, simulate: Simulate) -> None:
        fixed = get_model("ON+TS").as_mapping(SATIN)
        result = sound(fit_scan(simulate(SATIN, step=6), fixed=fixed))
        assert result.errors.rms_absolute < 1e-12
        assert result.errors.count == result.degrees_of_freedom

    def test_initial_values_lead_to_the_same_minimum(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, noise=0.01, step=6)
        found = fit_scan(observations)
        near = {n: 1.05 * v for n, v in found.parameters.items()}
        again = fit_scan(observations, initial=near)
        np.testing.assert_allclose(again.values, found.values, rtol=1e-5)
        # the search's own start can be nearer than 5 %
        assert again.evaluations <= found.evaluations + 2
        partly = fit_scan(observations, initial={"inverse_sigma_s": 5.0})
        np.testing.assert_allclose(partly.values, found.values, rtol=1e-5)

    @pytest.mark.parametrize(
        ("request_", "message"),
        [
            ({"method": "newton"}, r"unknown method 'newton'; known methods: .*paper"),
            ({"metric": "l1"}, "unknown metric 'l1'; known metrics: radiance, cosine_weighted"),
            ({"loss": "tukey"}, "unknown loss 'tukey'; known losses: least_squares, huber"),
            (
                {"metric": "relative", "model_error": False},
                "metric 'relative' weighs the model's error: it needs model_error=True",
            ),
            ({"fixed": {"kd": 0.3}}, "fixed: .* has no parameter 'kd'; it has kd_b, kd_g"),
            ({"initial": {"tau": 0.3}}, "initial: .* has no parameter 'tau'"),
            ({"fixed": {"sigma_d": 2.0}}, r"sigma_d = 2.0 is outside \[0, 1.5\] rad"),
            ({"fixed": {"ks": math.nan}}, "ks = nan is outside"),
            ({"bounds": {"kd": (0, 1)}}, "bounds: .* has no parameter 'kd'"),
            ({"bounds": {"sigma_d": (0.2, 1.6)}}, r"\[0.2, 1.6\] leaves .* \[0, 1.5\] rad"),
            ({"bounds": {"ks": (0.5, 0.5)}}, "a single value; use fixed"),
            ({"bounds": {"ks": (math.nan, 1.0)}}, "ks in .* leaves the range"),
            (
                {"bounds": {"ks": (0.5, 1.0)}, "fixed": {"ks": 0.4}},
                r"fixed: ks = 0.4 is outside \[0.5, 1\]",
            ),
            ({"tied": {"kd_g": "kd_x"}}, "tied: .* has no parameter 'kd_x'"),
            ({"tied": {"kd_g": "kd_g"}}, "kd_g follows kd_g, which must itself be free"),
            ({"tied": {"kd_g": "kd_r", "kd_r": "kd_b"}}, "kd_g follows kd_r, which must itself"),
            ({"tied": {"kd_g": "sigma_d"}}, "kd_g and sigma_d are not of one kind"),
            (
                {"tied": {"kd_g": "kd_b"}, "fixed": {"kd_g": 0.4}},
                "kd_g follows kd_b; fix, bound or start kd_b instead",
            ),
        ],
    )
    def test_bad_requests(self, simulate: Simulate, request_: dict[str, Any], message: str) -> None:
        with pytest.raises(FitError, match=message):
            fit_scan(simulate(SATIN, step=30), **request_)

    def test_unknown_model(self, simulate: Simulate) -> None:
        with pytest.raises(ValueError, match="known models: "):
            fit_scan(simulate(SATIN, step=30), "velvet")

    @pytest.mark.parametrize(
        ("model", "reason"),
        [
            ("lambert+ward(anisotropic)", "one plane"),
            ("lambert+ideal_mirror", "no BRDF value that a camera could measure"),
        ],
    )
    def test_what_a_model_refuses(self, simulate: Simulate, model: str, reason: str) -> None:
        """The rig's lights lie in one plane; a model says what it cannot see there."""
        message = rf"{re.escape(model)} cannot be fitted to these \d+ directions: .*{reason}"
        with pytest.raises(FitError, match=message + ".*; choose another model"):
            fit_scan(simulate(SATIN, step=30), model)

    @pytest.mark.parametrize("method", list(SOLVERS))
    def test_bounds(self, simulate: Simulate, method: str) -> None:
        observations = simulate(SATIN, noise=0.01, step=6)
        free = fit_scan(observations, method=method)
        loose = {"inverse_sigma_s": (5.0, 7.0), "kd_b": (-math.inf, 0.4), "ks": (0.1, math.inf)}
        same = sound(fit_scan(observations, method=method, bounds=loose))
        np.testing.assert_allclose(same.values, free.values, rtol=1e-5)
        tight = {"inverse_sigma_s": (10.0, 20.0), "kd_b": (0.1, 0.2), "sigma_d": (0.3, 0.35)}
        held = sound(fit_scan(observations, method=method, bounds=tight))
        for name, (low, high) in tight.items():
            assert low * (1 - 1e-6) <= held.value(name) <= high * (1 + 1e-6)
        # each of them pulls towards the free answer
        assert {"inverse_sigma_s", "kd_b"} <= set(held.at_bound)
        assert held.value("kd_b") == pytest.approx(0.2, rel=1e-6)
        assert held.value("inverse_sigma_s") == pytest.approx(10.0, rel=1e-6)

    @pytest.mark.parametrize("method", list(SOLVERS))
    def test_tied_parameters(self, simulate: Simulate, method: str) -> None:
        grey = [0.4, 0.4, 0.4, 0.4, 0.8, 6.0]
        observations = simulate(grey, noise=0.01, step=6)
        free = fit_scan(observations, method=method)
        tied = sound(fit_scan(observations, method=method, tied={"kd_g": "kd_b", "kd_r": "kd_b"}))
        assert tied.tied == {"kd_g": "kd_b", "kd_r": "kd_b"}
        assert tied.value("kd_b") == tied.value("kd_g") == tied.value("kd_r")
        assert tied.degrees_of_freedom == free.degrees_of_freedom + 2
        assert tied.fixed == ()
        # one amplitude for all channels is the free one's weighted mean, and better known
        deviation = tied.standard_deviations
        assert deviation[0] == deviation[1] == deviation[2] < free.standard_deviations[:3].min()
        assert tied.correlations[0, 2] == pytest.approx(1.0)
        np.testing.assert_allclose(tied.values, free.values, atol=4 * deviation.max())
        # two parameters less cost as much as two values of noise do: chi-square of 2, 1e-4 upper
        assert 0 <= tied.chi_square - free.chi_square < 18.4

    def test_a_tied_parameter_follows_a_fixed_one(self, simulate: Simulate) -> None:
        result = sound(
            fit_scan(simulate(SATIN, step=6), tied={"kd_g": "kd_b"}, fixed={"kd_b": 0.45})
        )
        assert result.value("kd_g") == result.value("kd_b") == 0.45
        assert result.standard_deviation("kd_g") == 0.0
        assert result.fixed == ("kd_b", "kd_g")

    def test_a_tied_channel_may_be_dead(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, step=6)
        alive = observations.valid.copy()
        alive[:, 0] = False
        result = sound(fit_scan(replace(observations, valid=alive), tied={"kd_g": "kd_b"}))
        assert result.value("kd_b") == result.value("kd_g") == pytest.approx(0.5)
        assert "kd_b" not in result.undetermined


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

    def test_it_records_how_values_were_weighed(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, noise=0.01, step=6)
        usual = fit_scan(observations)
        assert (usual.metric, usual.loss, usual.down_weighted) == ("radiance", "least_squares", 0)
        other = fit_scan(observations, metric="log", loss="huber", tied={"kd_g": "kd_b"})
        written = json.loads(json.dumps(other.as_dict(), allow_nan=False))
        assert (written["metric"], written["loss"]) == ("log", "huber")
        assert written["tied"] == {"kd_g": "kd_b"}
        assert written["down_weighted"] == other.down_weighted

    def test_it_says_what_ran_and_why_it_stopped(self, simulate: Simulate) -> None:
        began = time.perf_counter()
        result = fit_scan(simulate(SATIN, noise=0.01, step=6), method="paper")
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
