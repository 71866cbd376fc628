"""What a fit counts as equal misfit: definitions, bias, and agreement where noise decides."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from tests.fitting.scans import METAL, SATIN, Simulate
from tvbrdf_fitting import FitError, FitResult, Observations, fit_scan, get_model
from tvbrdf_fitting.error_measures import LOG_LARGEST_ANGLE_DEG, LOG_SMALLEST_VALUE
from tvbrdf_fitting.fit import METRICS, SOLVERS
from tvbrdf_fitting.problem import Problem, make_problem

COLOURED = "oren_nayar+torrance_sparrow(coloured)"
"""One Ks for all channels, which the default model has, cannot explain it."""
GLOSSY = [0.05, 0.12, 0.4, 0.2, 3.0, 25.0]


def exact(observations: Observations) -> Observations:
    """Noise that plays no part beside what a model can't explain."""
    return replace(observations, variance=np.full(observations.radiance.shape, 1e-14))


@pytest.fixture(scope="module")
def metal(simulate: Simulate) -> Observations:
    return exact(simulate(METAL, COLOURED, step=6))


def misfits(observations: Observations, result: FitResult) -> dict[str, float]:
    """Root mean square misfit of a fit as each metric sees it, by definition."""
    light, view = observations.light_direction, observations.view_direction
    used = observations.usable
    predicted, measured = result.radiance(light, view)[used], observations.radiance[used]
    cosine = np.broadcast_to(light[:, 2:], used.shape)[used]
    residual = predicted - measured
    return {
        "radiance": float(np.sqrt(np.mean(residual**2))),
        "cosine_weighted": float(np.sqrt(np.mean(cosine * residual**2))),
        "relative": float(np.sqrt(np.mean((residual / measured) ** 2))),
        "log": result.errors.rms_log,
    }


def problem_of(observations: Observations, metric: str, model: str = "ON+TS") -> Problem:
    return make_problem(observations, get_model(model), {}, {}, metric=metric)


class TestDefinitions:
    @pytest.mark.parametrize("method", list(SOLVERS))
    def test_each_fit_is_the_best_in_its_own_metric(self, metal: Observations, method: str) -> None:
        found = {m: misfits(metal, fit_scan(metal, metric=m, method=method)) for m in METRICS}
        for metric in METRICS:
            # "relative" divides by the mean of neighbours, the misfit here by the value itself
            slack = 1.01 if metric == "relative" else 1 + 1e-6
            assert found[metric][metric] <= slack * min(m[metric] for m in found.values())
        # and they are different fits
        assert found["radiance"]["log"] > 1.05 * found["log"]["log"]
        assert found["log"]["radiance"] > 1.05 * found["radiance"]["radiance"]

    def test_cosine_weighted(self, metal: Observations) -> None:
        """Squared residuals weighted by cos(theta_i): as with a variance of its inverse."""
        weighted = fit_scan(metal, metric="cosine_weighted")
        variance = np.repeat(1 / metal.cosine_light[:, None], 3, axis=1)
        same = fit_scan(replace(metal, variance=variance), model_error=False)
        np.testing.assert_allclose(weighted.values, same.values, rtol=1e-5, atol=1e-6)

    def test_relative(self, metal: Observations) -> None:
        relative = fit_scan(metal, metric="relative")
        same = fit_scan(replace(metal, variance=metal.radiance**2), model_error=False)
        # the mean of neighbours differs from the value where the radiance is curved
        np.testing.assert_allclose(relative.values, same.values, rtol=0.03, atol=0.01)

    def test_log(self, metal: Observations) -> None:
        """As scipy minimises the plain residuals ln(predicted) - ln(measured)."""
        result = fit_scan(metal, metric="log")
        model = get_model("ON+TS")
        largest = math.radians(LOG_LARGEST_ANGLE_DEG)
        steep = (metal.light_direction[:, 2] > math.cos(largest)) & (
            metal.view_direction[:, 2] > math.cos(largest)
        )
        kept = metal.usable & steep[:, None] & (metal.radiance > LOG_SMALLEST_VALUE)

        def residual(internal: np.ndarray) -> np.ndarray:
            brdf = model.evaluate(
                metal.light_direction, metal.view_direction, model.to_published(internal)
            )
            predicted = np.pi * metal.cosine_light[:, None] * brdf
            return np.log(predicted[kept] / metal.radiance[kept])

        lower, upper = model.internal_bounds
        start = np.clip(result.internal_values * 1.02, lower + 1e-9, upper)
        answer = least_squares(residual, start, bounds=(lower, upper), x_scale="jac", xtol=1e-12)
        assert 2 * answer.cost == pytest.approx(kept.sum() * result.errors.rms_log**2, rel=1e-7)
        np.testing.assert_allclose(result.internal_values, answer.x, rtol=1e-4, atol=1e-5)
        assert result.degrees_of_freedom == kept.sum() - 6
        assert result.errors.log_count == kept.sum()

    @pytest.mark.parametrize("metric", METRICS)
    def test_model_error_is_in_the_metric(self, metal: Observations, metric: str) -> None:
        result = fit_scan(metal, metric=metric)
        # of 2000 values, 6 are spent on parameters; "relative" as above
        rtol = 0.02 if metric == "relative" else 0.005
        assert result.model_error_std == pytest.approx(misfits(metal, result)[metric], rel=rtol)

    @pytest.mark.parametrize("metric", METRICS)
    def test_model_error_makes_the_residuals_as_large_as_stated(
        self, simulate: Simulate, metric: str
    ) -> None:
        """Also where noise and the model's error are of one size, and of many."""
        noisy = simulate(METAL, COLOURED, noise=0.03, step=6)
        result = fit_scan(noisy, metric=metric)
        assert result.model_error_std > 0
        problem = problem_of(noisy, metric)
        z = (problem.residual(result.internal_values) ** 2).reshape(problem.weight.shape)
        share = 1 + (result.model_error_std * problem.metric.unit * problem.weight) ** 2
        # rounds end when e changes by less than 2 %
        assert float((z / share).sum()) == pytest.approx(result.degrees_of_freedom, rel=0.04)

    @pytest.mark.parametrize("method", list(SOLVERS))
    def test_real_material(self, real_material: Callable[[str], Observations], method: str) -> None:
        measured = exact(real_material("vch_golden_yellow"))
        plain = fit_scan(measured, method=method)
        log = fit_scan(measured, metric="log", method=method)
        assert log.errors.rms_log < 0.3 * plain.errors.rms_log
        assert plain.errors.rms_percent < log.errors.rms_percent
        assert log.errors.rms_log == pytest.approx(log.model_error_std, rel=0.01)


class TestWhereNoiseDecides:
    @pytest.mark.parametrize("metric", METRICS)
    @pytest.mark.parametrize("method", list(SOLVERS))
    def test_exact_data_give_the_truth(self, simulate: Simulate, metric: str, method: str) -> None:
        result = fit_scan(simulate(SATIN, step=6), metric=metric, method=method)
        np.testing.assert_allclose(result.values, SATIN, rtol=1e-5)
        assert result.model_error_std == 0.0

    @pytest.mark.parametrize("metric", ["cosine_weighted", "relative"])
    def test_linear_metrics_change_nothing(self, simulate: Simulate, metric: str) -> None:
        noisy = simulate(SATIN, noise=0.01, step=6)
        one, other = fit_scan(noisy), fit_scan(noisy, metric=metric)
        np.testing.assert_array_equal(one.values, other.values)
        np.testing.assert_array_equal(one.covariance, other.covariance)

    def test_log_is_not_biased(self, simulate: Simulate) -> None:
        """Against the same scans fitted in radiance: the mean shift of 12 scans.

        The shift's own scatter is that of the 6 % of values that "log" leaves out, 0.25 deviations
        a scan and 0.07 of their mean. Weights by each value alone would shift Kd by 0.9.
        """
        model = get_model("ON+TS")
        shifts = []
        for seed in range(12):
            noisy = simulate(GLOSSY, noise=0.005, step=3, seed=seed)
            one, log = fit_scan(noisy), fit_scan(noisy, metric="log")
            assert log.model_error_std == 0.0
            deviation = np.sqrt(np.diag(one.internal_covariance))
            shifts.append((log.internal_values - one.internal_values) / deviation)
            # what is left tells nearly as much, least of Ks, which grazing light knows too
            ratio = np.sqrt(np.diag(log.internal_covariance)) / deviation
            assert (ratio > 0.95).all()
            assert (ratio < 1.5).all()
        assert np.abs(np.mean(shifts, axis=0)).max() < 0.3, model.internal_names


class TestLogCurve:
    def test_derivatives(self, metal: Observations) -> None:
        problem = problem_of(metal, "log")
        scale = replace(problem, weight=np.where(problem.weight > 0, 1.0, 0.0))
        # a wide dark lobe and a sharp one: predictions above and below the smallest value
        for point in ([0.1, 0.0, 0.2, 0.1, 0.5, 0.5], [0.0, 1e-4, 0.05, 0.3, 2.0, 3.0]):
            internal = np.array(point)
            analytic = scale.jacobian(internal)
            assert (scale.predict(internal) < LOG_SMALLEST_VALUE).any()
            for column, index in zip(analytic.T, scale.free, strict=True):
                step = np.zeros(6)
                step[index] = 1e-7
                there = (scale.residual(internal + step) - scale.residual(internal - step)) / 2e-7
                # a step of 1e-7 crosses the kink of the second derivative at a few values
                off = np.abs(there - column) > 1e-4 * np.abs(column).max(initial=1e-3)
                assert off.mean() < 0.002

    def test_what_predicts_nothing_has_a_slope_that_leads_back(self, metal: Observations) -> None:
        problem = problem_of(metal, "log")
        kept = problem.weight > 0
        for level in (1e-3, 1e-4, 1e-5, 0.0, -1.0):
            radiance = np.full(problem.weight.shape, level)
            residual, slope = problem.residual_of(radiance), problem.slope_of(radiance)
            assert np.isfinite(residual).all()
            assert (slope[kept] > 0).all()
            assert (residual[~kept] == 0).all()
            assert (residual[kept] < 0).mean() > 0.9
        curve = problem.metric.curve
        assert curve is not None
        ends = [
            curve.residual(np.full((1, 1), LOG_SMALLEST_VALUE * f)) for f in (1 - 1e-9, 1 + 1e-9)
        ]
        np.testing.assert_allclose(ends[0], ends[1], atol=1e-8)

    def test_linear_starts_agree_to_first_order(self, simulate: Simulate) -> None:
        """`radiance` and `weight` are the linear problem that a coarse search needs."""
        noisy = simulate(SATIN, noise=0.01, step=6)
        problem = problem_of(noisy, "log")
        internal = get_model("ON+TS").to_internal(SATIN)
        predicted = problem.predict(internal)
        linear = (predicted - problem.radiance) * problem.weight
        exactly = problem.residual(internal).reshape(linear.shape)
        bright = problem.weight * problem.radiance > 30
        # second order: the noise of the reference and of the value, 1/30 each, times 3.5 deviations
        np.testing.assert_allclose(exactly[bright], linear[bright], atol=3.5**2 / 30)
        assert not problem.separable
        assert problem_of(noisy, "relative").separable

    def test_it_says_what_it_needs(self, simulate: Simulate) -> None:
        dim = simulate(SATIN, step=12)
        dim = replace(dim, radiance=dim.radiance * 1e-6, variance=dim.variance * 1e-12)
        count = int(dim.valid.sum())
        with pytest.raises(FitError, match=f"metric 'log' leaves out {count} values"):
            fit_scan(dim, metric="log")

    def test_a_channel_without_logarithms_is_not_measured(self, simulate: Simulate) -> None:
        black = simulate([0.3, 0.5, 0.7, 0.4, 0.0, 6.0], noise=0.01, step=6)
        radiance = black.radiance.copy()
        radiance[:, 1] = -1e-3
        result = fit_scan(replace(black, radiance=radiance), metric="log")
        assert math.isnan(result.value("kd_g"))
        assert "kd_g" in result.undetermined
        assert result.value("kd_r") == pytest.approx(0.7, rel=0.02)


class TestReference:
    def test_relative_errors_are_taken_of_the_signal_not_of_its_noise(
        self, simulate: Simulate
    ) -> None:
        noisy, clean = (simulate(SATIN, noise=n, step=2, seed=1) for n in (0.05, 0.0))
        problem, truth = problem_of(noisy, "relative"), problem_of(clean, "radiance").radiance
        seen = (problem.weight > 0) & (truth > 0.05)
        each = np.abs(problem.radiance / truth - 1)[seen]
        smooth = np.abs(problem.metric.unit / truth - 1)[seen]
        # the nearest nine have a weight as five do or more, since exposures differ
        assert np.sqrt(np.mean(smooth**2)) < 0.5 * np.sqrt(np.mean(each**2))
        assert np.median(smooth) < 0.05

    def test_it_scales(self, metal: Observations) -> None:
        unit = problem_of(metal, "relative").metric.unit
        dim = replace(metal, radiance=1e-6 * metal.radiance, variance=1e-12 * metal.variance)
        np.testing.assert_allclose(problem_of(dim, "relative").metric.unit, 1e-6 * unit, rtol=1e-9)

    def test_row_order_does_not_matter(self, metal: Observations) -> None:
        order = np.random.default_rng(0).permutation(len(metal))
        one, two = (problem_of(o, "relative") for o in (metal, metal.select(order)))
        assert isinstance(one.metric.unit, np.ndarray)
        # neighbours at exactly equal distances may be exchanged
        off = np.abs(two.metric.unit / one.metric.unit[:, order] - 1)
        assert np.quantile(off, 0.95) < 0.01
