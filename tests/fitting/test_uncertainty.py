"""Covariances with common errors, and the nuisances behind them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tvbrdf_fitting import CommonErrors, FitResult, Observations, fit_scan, get_model
from tvbrdf_fitting.inference.nuisances import make_nuisances
from tvbrdf_fitting.inference.posterior import Posterior, linearise_at, maximise
from tvbrdf_fitting.inference.uncertainty import estimate
from tvbrdf_fitting.problem import Problem, make_problem
from tvbrdf_fitting.solve.solvers import SOLVERS

Simulate = Callable[..., Observations]

SATIN = [0.3, 0.5, 0.7, 0.4, 0.8, 6.0]
GLOSSY = [0.05, 0.12, 0.4, 0.1, 3.0, 25.0]
LAMBERT = [0.3, 0.5, 0.7, 0.0, 0.8, 6.0]
ALL = CommonErrors(0.02, 0.005, plate_tilt_std_deg=0.03)


def posterior_of(scan: Observations, errors: CommonErrors, model: str = "ON+TS") -> Posterior:
    problem = make_problem(scan, get_model(model), {}, {})
    return Posterior(problem, make_nuisances(problem, scan, errors))


def dense(posterior: Posterior, internal: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Columns (3 n, m + q) of the weighted residual, one by one by central differences."""
    free, m = list(posterior.problem.free), len(values)

    def residual(x: np.ndarray) -> np.ndarray:
        point = internal.copy()
        point[free] = x[m:]
        return posterior.point(point, x[:m]).residual

    centre, columns = np.concatenate([values, internal[free]]), []
    for i in range(len(centre)):
        step = np.zeros(len(centre))
        step[i] = 1e-2 if i < m else 1e-5
        columns.append((residual(centre + step) - residual(centre - step)) / (2 * step[i]))
    return np.array(columns).T


class TestNuisances:
    def test_names_and_deviations(self, simulate: Simulate) -> None:
        nuisances = posterior_of(simulate(SATIN, step=30), ALL).nuisances
        assert len(nuisances) == 12 + 3 + 2
        assert nuisances.names[:3] == ("gain_camera1_b", "gain_camera1_g", "gain_camera1_r")
        assert nuisances.names[12:] == (
            "light_offset_sweep1_deg",
            "light_offset_sweep2_deg",
            "light_offset_sweep3_deg",
            "plate_tilt_x_deg",
            "plate_tilt_y_deg",
        )
        np.testing.assert_allclose(nuisances.deviations, [0.005] * 12 + [0.02] * 3 + [0.03] * 2)

    def test_only_what_is_seen_and_uncertain(self, simulate: Simulate) -> None:
        scan = simulate(SATIN, step=30)
        dead = scan.valid.copy()
        dead[scan.camera == 2, 1] = False
        scan = replace(scan, valid=dead).select(scan.camera < 3)
        errors = CommonErrors(light_angle_std_deg={1: 0.0, 2: 0.1, 3: 0.0}, gain_relative_std=0.01)
        names = posterior_of(scan, errors).nuisances.names
        assert "gain_camera1_g" in names
        assert "gain_camera2_g" not in names
        assert not any("camera3" in name or "sweep1" in name for name in names)
        assert names[-1] == "light_offset_sweep2_deg"

    @pytest.mark.parametrize("index", [0, 7, 12, 14])
    def test_they_do_to_a_prediction_what_they_do_to_a_scan(
        self, simulate: Simulate, index: int
    ) -> None:
        posterior = posterior_of(simulate(SATIN, step=10), CommonErrors(0.02, 0.005))
        values = np.zeros(15)
        values[index] = 2.0
        gains, offsets = np.ones((4, 3)), np.zeros(3)
        if index < 12:
            gains.flat[index] += 0.01
        else:
            offsets[index - 12] = 0.04
        scan = simulate(SATIN, step=10, gains=gains, light_offset_deg=offsets)
        internal = get_model("ON+TS").to_internal(SATIN)
        predicted = posterior.nuisances.apply(posterior.problem, values).predict(internal)
        np.testing.assert_allclose(predicted.T, scan.radiance, rtol=1e-12)

    @pytest.mark.parametrize(("axis", "index"), [([-1, 0, 0], 15), ([0, 1, 0], 16)])
    def test_a_tilt_turns_light_and_view_together(
        self, simulate: Simulate, axis: list[float], index: int
    ) -> None:
        scan = simulate(SATIN, step=10)
        posterior = posterior_of(scan, ALL)
        values = np.zeros(17)
        values[index] = 1.0
        turn = Rotation.from_rotvec(0.03 * np.array(axis), degrees=True)
        light = turn.apply(scan.light_direction.copy())
        view = turn.apply(scan.view_direction.copy())
        expected = np.pi * get_model("ON+TS").evaluate(light, view, SATIN) * light[:, 2:]
        internal = get_model("ON+TS").to_internal(SATIN)
        predicted = posterior.nuisances.apply(posterior.problem, values).predict(internal)
        np.testing.assert_allclose(predicted.T, expected, rtol=1e-10)

    def test_directions_stay_above_the_horizon(self, simulate: Simulate) -> None:
        scan = simulate(SATIN, step=1)
        posterior = posterior_of(scan, CommonErrors(light_angle_std_deg=1.0))
        predicted = posterior.nuisances.apply(posterior.problem, np.full(3, -3.0))
        assert np.isfinite(predicted.predict(get_model("ON+TS").to_internal(SATIN))).all()

    @pytest.mark.parametrize("metric", ["radiance", "log"])
    def test_columns(self, simulate: Simulate, metric: str) -> None:
        scan = simulate(SATIN, noise=0.01, step=10)
        problem = make_problem(scan, get_model("ON+TS"), {}, {}, metric=metric)
        posterior = Posterior(problem, make_nuisances(problem, scan, ALL))
        internal = get_model("ON+TS").to_internal(SATIN)
        values = 0.5 * np.random.default_rng(0).normal(size=17)
        triangle = linearise_at(posterior, posterior.point(internal, values)).triangle
        columns = dense(posterior, internal, values)
        information = columns.T @ columns + np.diag([1.0] * 17 + [0.0] * 6)
        # differences over 1e-2 of a deviation and of 1e-3 degrees: 1e-5 of the lobe's curvature
        scale = np.sqrt(np.diag(information))
        np.testing.assert_allclose(
            triangle.T @ triangle / np.outer(scale, scale),
            information / np.outer(scale, scale),
            rtol=0,
            atol=1e-6,
        )


class TestMaximum:
    @pytest.mark.parametrize("truth", [SATIN, GLOSSY, LAMBERT])
    def test_it_is_the_one_that_scipy_finds(self, simulate: Simulate, truth: list[float]) -> None:
        gains = np.ones((4, 3))
        gains[1] += 0.01
        scan = simulate(truth, noise=0.01, seed=3, step=8, gains=gains)
        posterior = posterior_of(scan, ALL)
        result = fit_scan(scan, common_errors=ALL)
        problem, m = posterior.problem, len(posterior.nuisances)

        def residual(x: np.ndarray) -> np.ndarray:
            return np.concatenate([posterior.point(x[m:], x[:m]).residual, x[:m]])

        free = np.full(m, np.inf)
        lower, upper = np.append(-free, problem.lower), np.append(free, problem.upper)
        start = np.clip(np.append(np.zeros(m), problem.model.to_internal(truth)), lower, upper)
        start[m + 3] = max(start[m + 3], 1e-4)
        other = least_squares(
            residual, start, bounds=(lower, upper), x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=None
        )
        assert result.chi_square <= 2 * other.cost * (1 + 1e-9)
        deviation = np.sqrt(np.diag(result.internal_covariance))
        # a difference of 1e-4 deviations is what ends a fit; scipy differentiates by differences
        np.testing.assert_allclose(
            (result.internal_values - other.x[m:]) / deviation, 0.0, atol=2e-3
        )
        values = [value for value, _ in result.nuisances.values()]
        np.testing.assert_allclose(
            values / posterior.nuisances.deviations, other.x[:m], rtol=0, atol=2e-3
        )

    def test_a_camera_that_disagrees_is_found(self, simulate: Simulate) -> None:
        gains = np.ones((4, 3))
        gains[2, 1] = 1.02
        scan = simulate(SATIN, noise=0.005, seed=1, step=4, gains=gains)
        errors = CommonErrors(gain_relative_std=0.01)
        result = fit_scan(scan, common_errors=errors)
        value, deviation = result.nuisances["gain_camera3_g"]
        # all gains may be off together, with Kd and Ks the other way: the mean of twelve stays open
        assert deviation == pytest.approx(0.01 / math.sqrt(12), rel=0.1)
        assert value == pytest.approx(0.02 - 0.02 / 12, abs=0.002)
        others = [v for n, (v, _) in result.nuisances.items() if n.endswith(("_b", "_r"))]
        assert np.abs(others).max() < 0.002

    def test_a_light_offset_is_found(self, simulate: Simulate) -> None:
        scan = simulate(GLOSSY, noise=0.005, seed=1, step=4, light_offset_deg=(0.0, 0.05, 0.0))
        errors = CommonErrors(light_angle_std_deg=0.03)
        result = fit_scan(scan, common_errors=errors)
        value, deviation = result.nuisances["light_offset_sweep2_deg"]
        assert abs(value - 0.05) < 4 * deviation
        assert deviation < 0.01
        worse = np.abs(fit_scan(scan).values - GLOSSY)
        assert (np.abs(result.values - GLOSSY) < worse + 3 * result.standard_deviations).all()

    def test_gains_that_one_camera_cannot_tell_from_albedo(self, simulate: Simulate) -> None:
        """The lobe has one Ks for all channels, so their gains can be compared; the mean cannot."""
        scan = simulate(SATIN, noise=0.002, seed=2, step=4)
        alone = scan.select(scan.camera == 1)
        result = fit_scan(alone, common_errors=CommonErrors(gain_relative_std=0.02))
        relative = result.standard_deviations / result.values
        mean = 0.02 / math.sqrt(3)
        np.testing.assert_allclose(relative[[0, 1, 2, 4]], mean, rtol=0.1)
        for _, deviation in result.nuisances.values():
            assert deviation == pytest.approx(mean, rel=0.1)

    def test_chi_square_keeps_its_meaning(self, simulate: Simulate) -> None:
        """Each nuisance adds a square and an unknown: the mean stays the degrees of freedom."""
        rng, ratios = np.random.default_rng(5), []
        for seed in range(40):
            scan = simulate(
                SATIN,
                noise=0.005,
                seed=seed,
                step=12,
                gains=1 + 0.005 * rng.normal(size=(4, 3)),
                light_offset_deg=0.02 * rng.normal(size=3),
            )
            result = fit_scan(scan, common_errors=CommonErrors(0.02, 0.005))
            ratios.append(result.chi_square / result.degrees_of_freedom)
        freedom = 40 * result.degrees_of_freedom
        assert np.mean(ratios) == pytest.approx(1.0, abs=4 * math.sqrt(2 / freedom))

    def test_without_stated_errors_it_is_the_plain_fit(self, simulate: Simulate) -> None:
        scan = simulate(SATIN, noise=0.01, step=8)
        plain = fit_scan(scan)
        for errors in (CommonErrors(), CommonErrors(light_angle_std_deg={1: 0, 2: 0, 3: 0})):
            same = fit_scan(scan, common_errors=errors)
            np.testing.assert_array_equal(same.values, plain.values)
            np.testing.assert_array_equal(same.covariance, plain.covariance)
            assert same.nuisances == {}

    def test_plain_continuation_stays_where_a_solver_ended(self, simulate: Simulate) -> None:
        posterior = posterior_of(simulate(SATIN, noise=0.01, step=8), CommonErrors())
        internal = SOLVERS["paper"](posterior.problem).internal
        assert maximise(posterior, posterior.point(internal)).steps == 0


class TestWrongModel:
    def test_gains_that_look_like_an_error_of_the_model(self, simulate: Simulate) -> None:
        gains = 1 + 0.03 * np.random.default_rng(4).normal(size=(4, 3))
        scan = simulate(SATIN, noise=0.001, seed=2, step=4, gains=gains)
        plain = fit_scan(scan)
        assert plain.model_error_std > 0
        stated = fit_scan(scan, common_errors=CommonErrors(gain_relative_std=0.03))
        assert stated.model_error_std == 0.0
        assert stated.chi_square < 1.2 * stated.degrees_of_freedom
        score = (stated.internal_values - get_model("ON+TS").to_internal(SATIN)) / np.sqrt(
            np.diag(stated.internal_covariance)
        )
        assert np.abs(score).max() < 4

    def test_nuisances_do_not_take_up_what_the_model_gets_wrong(
        self, real_material: Callable[[str], Observations]
    ) -> None:
        measured = real_material("satin_rosaline")
        scan = replace(measured, variance=(1e-3 * measured.radiance) ** 2 + 1e-10)
        plain, stated = fit_scan(scan), fit_scan(scan, common_errors=CommonErrors(0.02, 0.005))
        np.testing.assert_array_equal(stated.values, plain.values)
        # sigma_d's published deviation is that of an interval of all errors together
        one, two = (np.delete(np.delete(r.covariance_random, 3, 0), 3, 1) for r in (stated, plain))
        np.testing.assert_allclose(one, two, rtol=1e-9)
        assert stated.model_error_std == plain.model_error_std > 0
        assert stated.nuisances["gain_camera4_b"] == (0.0, 0.005)
        # first order: the parameters at scans with one gain off, the weights as they are
        total = np.zeros((6, 6))
        for camera in range(1, 5):
            for channel in range(3):
                moved = scan.radiance.copy()
                moved[scan.camera == camera, channel] *= 1.005
                weights = replace(
                    scan, radiance=moved, variance=scan.variance + plain.model_error_std**2
                )
                kept = replace(weights, radiance=scan.radiance)
                fits = [
                    fit_scan(s, model_error=False, initial=plain.parameters)
                    for s in (weights, kept)
                ]
                total += np.outer(*[fits[0].values - fits[1].values] * 2)
        gains = fit_scan(scan, common_errors=CommonErrors(gain_relative_std=0.005))
        free = [i for i, n in enumerate(gains.parameter_names) if n != "sigma_d"]  # at its bound
        # J^T J leaves out the curvature, which counts where residuals are as large as the radiance
        np.testing.assert_allclose(
            np.sqrt(np.diag(gains.covariance_common))[free], np.sqrt(np.diag(total))[free], rtol=0.5
        )

    def test_robust_losses_take_nuisances_too(self, simulate: Simulate) -> None:
        gains = 1 + 0.01 * np.random.default_rng(6).normal(size=(4, 3))
        scan = simulate(SATIN, noise=0.005, seed=2, step=6, gains=gains)
        stray = np.random.default_rng(7).random(scan.radiance.shape) < 0.02
        scan = replace(scan, radiance=scan.radiance * (1 + 0.5 * stray))
        errors = CommonErrors(gain_relative_std=0.01)
        result = fit_scan(scan, loss="cauchy", common_errors=errors)
        assert result.model_error_std == 0.0
        assert any(abs(value) > 0.003 for value, _ in result.nuisances.values())
        score = (result.internal_values - get_model("ON+TS").to_internal(SATIN)) / np.sqrt(
            np.diag(result.internal_covariance)
        )
        assert np.abs(score).max() < 4


class TestCovariance:
    def information(self, posterior: Posterior, result: FitResult) -> np.ndarray:
        values = [v for v, _ in result.nuisances.values()] / posterior.nuisances.deviations
        columns = dense(posterior, np.array(result.internal_values), values)
        return np.asarray(columns.T @ columns + np.diag([1.0] * len(values) + [0.0] * 6))

    def test_total_is_the_block_of_the_inverse_information(self, simulate: Simulate) -> None:
        scan = simulate(SATIN, noise=0.01, step=8)
        result, posterior = fit_scan(scan, common_errors=ALL), posterior_of(scan, ALL)
        inverse = np.linalg.inv(self.information(posterior, result))
        m = len(posterior.nuisances)
        scale = np.sqrt(np.diag(inverse))[m:]
        difference = (result.internal_covariance - inverse[m:, m:]) / np.outer(scale, scale)
        np.testing.assert_allclose(difference, 0.0, atol=1e-4)
        deviations = [d for _, d in result.nuisances.values()] / posterior.nuisances.deviations
        np.testing.assert_allclose(deviations, np.sqrt(np.diag(inverse))[:m], rtol=1e-4)

    @pytest.mark.parametrize("flicker", [0.0, 0.002])
    def test_both_parts_are_what_their_errors_do(self, simulate: Simulate, flicker: float) -> None:
        """Covariances of the estimator, written out: noise with shared parts, and priors."""
        scan = simulate(SATIN, noise=0.01, step=8)
        errors = replace(ALL, frame_relative_std=flicker)
        posterior = posterior_of(scan, errors)
        internal = get_model("ON+TS").to_internal(SATIN)
        point = posterior.point(internal)
        known = estimate(posterior.problem, posterior.nuisances, linearise_at(posterior, point))
        m, n = len(posterior.nuisances), posterior.problem.radiance.shape[1]
        columns = dense(posterior, internal, np.zeros(m))
        inverse = np.linalg.inv(columns.T @ columns + np.diag([1.0] * m + [0.0] * 6))
        part = (flicker * np.abs(posterior.problem.radiance) * posterior.problem.weight).ravel()
        assert part.max() < 1  # of a value's noise
        noise = np.eye(3 * n)
        for one in range(3):
            for two in range(3):
                if one != two:
                    rows, others = np.arange(n) + one * n, np.arange(n) + two * n
                    noise[rows, others] = part[rows] * part[others]
        gain = (inverse @ columns.T)[m:]
        for found, expected in (
            (known.random, gain @ noise @ gain.T),
            (known.common, inverse[m:, :m] @ inverse[:m, m:]),
        ):
            scale = np.sqrt(np.diag(expected))
            np.testing.assert_allclose(
                found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-4
            )

    @pytest.mark.parametrize("truth", [SATIN, GLOSSY, LAMBERT, [0.3, 0.5, 0.7, 0.4, 0.0, 6.0]])
    def test_both_parts_are_positive_semidefinite(
        self, simulate: Simulate, truth: list[float]
    ) -> None:
        errors = replace(ALL, gain_relative_std=0.1, frame_relative_std=0.003)
        result = fit_scan(simulate(truth, noise=0.005, step=8), common_errors=errors)
        kept = np.isfinite(np.diag(result.covariance))
        for matrix in (result.covariance_random, result.covariance_common):
            chosen = matrix[np.ix_(kept, kept)]
            scale = np.sqrt(np.diag(result.covariance))[kept]
            assert np.linalg.eigvalsh(chosen / np.outer(scale, scale)).min() > -1e-12

    def test_errors_that_are_not_stated_more_narrowly_never_help(self, simulate: Simulate) -> None:
        scan = simulate(SATIN, noise=0.01, step=8)
        deviations = [
            np.sqrt(np.diag(fit_scan(scan, common_errors=errors).internal_covariance))
            for errors in (None, CommonErrors(0.01), CommonErrors(0.02), CommonErrors(0.02, 0.005))
        ]
        for smaller, larger in pairwise(deviations):
            assert (larger > smaller * (1 - 1e-3)).all()

    def test_dust_with_tied_parameters(self, simulate: Simulate) -> None:
        truth = [*SATIN, 0.06, 0.06, 0.06, 0.35, 0.6]
        scan = simulate(truth, "dust", noise=0.005, seed=4, step=8)
        result = fit_scan(
            scan, "dust", tied={"w_g": "w_b", "w_r": "w_b"}, common_errors=CommonErrors(0.02, 0.005)
        )
        score = (result.values - truth) / result.standard_deviations
        assert np.abs(score).max() < 4
        assert result.value("w_g") == result.value("w_b")
        assert result.interval("w_r") == result.interval("w_b")

    def test_common_errors_must_be_sensible(self) -> None:
        with pytest.raises(ValueError, match="plate_tilt_std_deg = -1 must be finite and >= 0"):
            CommonErrors(plate_tilt_std_deg=-1)


def test_a_column_without_effect_is_without_information(simulate: Simulate) -> None:
    scan = simulate([0.3, 0.5, 0.7, 0.4, 0.0, 6.0], step=10)
    posterior = posterior_of(scan, ALL)
    internal = get_model("ON+TS").to_internal([0.3, 0.5, 0.7, 0.4, 0.0, 6.0])
    linearised = linearise_at(posterior, posterior.point(internal))
    known = estimate(posterior.problem, posterior.nuisances, linearised)
    assert known.uninformed == (5,)
    assert np.isnan(known.random[5]).all()
    assert np.isfinite(known.random[:5, :5]).all()
    problem: Problem = posterior.problem
    without = replace(problem, free=problem.free[:5], fixed=frozenset({5}))
    alone = Posterior(without, posterior.nuisances)
    same = estimate(without, alone.nuisances, linearise_at(alone, alone.point(internal)))
    np.testing.assert_allclose(known.random[:5, :5], same.random[:5, :5], rtol=1e-8)
    np.testing.assert_allclose(known.common[:5, :5], same.common[:5, :5], rtol=1e-8)
