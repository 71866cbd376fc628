"""Robust losses: definitions, what outliers do to a fit, and whether stated deviations hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import least_squares
from scipy.stats import binomtest, norm

from tests.fitting.scans import METAL, SATIN, Simulate
from tvbrdf_fitting import Observations, fit_scan, get_model
from tvbrdf_fitting.fit import METRICS, SOLVERS
from tvbrdf_fitting.problem import make_problem
from tvbrdf_fitting.solve import losses
from tvbrdf_fitting.solve.losses import CAUCHY, HUBER, LOSSES

COLOURED = "oren_nayar+torrance_sparrow(coloured)"
ROBUST = ("huber", "cauchy")


def factors(kind: str, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Factors that spoil a fifth of the values."""
    stray = rng.random(shape) < 0.2
    if kind == "to both sides":
        return np.where(stray, np.exp(rng.choice([-1, 1], shape) * rng.uniform(0.3, 2, shape)), 1.0)
    if kind == "to one side":
        return np.where(stray, 1 + rng.random(shape), 1.0)
    assert kind == "frames"
    return np.where(rng.random((shape[0], 1)) < 0.2, rng.uniform(0, 3, (shape[0], 1)), 1.0)


def spoilt(observations: Observations, kind: str, seed: int) -> Observations:
    rng = np.random.default_rng(100 + seed)
    factor = factors(kind, observations.radiance.shape, rng)
    return replace(observations, radiance=observations.radiance * factor)


def scores(observations: Observations, truth: list[float], loss: str) -> np.ndarray:
    """Deviations from the truth in stated standard deviations, internal coordinates."""
    result = fit_scan(observations, loss=loss)
    off = result.internal_values - get_model("ON+TS").to_internal(truth)
    return np.asarray(off / np.sqrt(np.diag(result.internal_covariance)))


class TestDefinitions:
    @pytest.mark.parametrize("name", list(LOSSES))
    def test_psi_and_its_slope(self, name: str) -> None:
        loss, z = LOSSES[name], np.linspace(-8, 8, 4001)
        there = np.gradient(loss.weight(z) * z, z)
        smooth = np.abs(np.abs(z) - HUBER) > 0.01
        np.testing.assert_allclose(loss.slope(z)[smooth], there[smooth], atol=1e-4)
        assert loss.weight(np.zeros(1))[0] == 1.0
        assert (np.diff(loss.weight(z[z > 0])) <= 1e-15).all()

    @pytest.mark.parametrize("name", ROBUST)
    def test_five_percent_are_lost_where_nothing_is_wrong(self, name: str) -> None:
        loss = LOSSES[name]

        def mean(function: Callable[[np.ndarray], np.ndarray]) -> float:
            def integrand(z: float) -> float:
                return float(function(np.array([z]))[0] * norm.pdf(z))

            return 2 * float(quad(integrand, 0, HUBER)[0] + quad(integrand, HUBER, 12)[0])

        square = mean(lambda z: np.square(loss.weight(z) * z))
        assert loss.normal_square == pytest.approx(square, rel=1e-4)
        # the textbooks' tuning constants are for 95 % of the efficiency
        assert mean(loss.slope) ** 2 / square == pytest.approx(0.95, abs=0.001)

    @pytest.mark.parametrize("name", ROBUST)
    @pytest.mark.parametrize("scale", [1e-9, 0.5, 1.0, 2.0])
    def test_information(self, name: str, scale: float) -> None:
        z = scale * np.random.default_rng(0).normal(size=20_000)
        z[:2000] = 50.0
        kept = LOSSES[name].information(z, len(z) - 6)
        # noise that turns out less than stated adds no information to what was stated
        assert kept.mean() <= 1.0 + 1e-12
        assert kept[:2000].max() < 0.1
        np.testing.assert_array_equal(LOSSES["least_squares"].information(z, 10), 1.0)

    @pytest.mark.parametrize("name", ROBUST)
    def test_it_is_the_minimum_of_the_loss(self, simulate: Simulate, name: str) -> None:
        """As scipy finds it by its own loss functions, which are the same with these scales."""
        observations = spoilt(simulate(SATIN, noise=0.01, step=6), "to both sides", 0)
        result = fit_scan(observations, loss=name)
        problem = make_problem(observations, get_model("ON+TS"), {}, {})
        answer = least_squares(
            problem.residual,
            result.internal_values,
            jac=problem.jacobian,
            bounds=(problem.lower, problem.upper),
            loss=name,
            f_scale={"huber": HUBER, "cauchy": CAUCHY}[name],
            x_scale="jac",
            ftol=1e-14,
            xtol=1e-12,
        )
        deviation = np.sqrt(np.diag(result.internal_covariance))
        # rounds end when the joint change is 1e-3 deviations; what is left is of that size
        assert (np.abs(answer.x - result.internal_values) < 0.01 * deviation).all()


class TestCleanData:
    @pytest.mark.parametrize("name", ROBUST)
    def test_little_changes(self, simulate: Simulate, name: str) -> None:
        observations = simulate(SATIN, noise=0.005, step=3)
        plain, robust = fit_scan(observations), fit_scan(observations, loss=name)
        ratio = np.sqrt(np.diag(robust.internal_covariance) / np.diag(plain.internal_covariance))
        # 1 / sqrt(0.95); mean squares of 4000 values scatter by 2 %
        np.testing.assert_allclose(ratio, 1.026, rtol=0.03)
        moved = np.abs(robust.internal_values - plain.internal_values)
        # two estimates with 95 % of efficiency to one differ by 0.23 deviations: 4 of these
        assert (moved < 0.92 * np.sqrt(np.diag(plain.internal_covariance))).all()
        assert robust.model_error_std == 0.0
        limit = {"huber": 2 * HUBER, "cauchy": CAUCHY}[name]
        expected = 2 * norm.sf(limit)
        assert binomtest(robust.down_weighted, robust.errors.count, expected).pvalue > 1e-3

    @pytest.mark.parametrize("name", ROBUST)
    def test_exact_data(self, simulate: Simulate, name: str) -> None:
        observations = simulate(SATIN, step=6)
        plain, robust = fit_scan(observations), fit_scan(observations, loss=name)
        np.testing.assert_allclose(robust.values, SATIN, rtol=1e-7)
        assert robust.down_weighted == 0
        assert (robust.standard_deviations >= 0.999 * plain.standard_deviations).all()


class TestOutliers:
    @pytest.mark.parametrize("kind", ["to both sides", "to one side", "frames"])
    @pytest.mark.parametrize("seed", range(4))
    def test_cauchy_lets_go_of_them(self, simulate: Simulate, kind: str, seed: int) -> None:
        observations = spoilt(simulate(SATIN, noise=0.005, seed=seed, step=6), kind, seed)
        result = fit_scan(observations, loss="cauchy")
        off = np.abs(result.values - SATIN) / result.standard_deviations
        assert off.max() < 5.0
        assert result.model_error_std == 0.0
        assert 0.15 < result.down_weighted / result.errors.count < 0.25
        assert "cauchy weights settled" in result.reason

    @pytest.mark.parametrize("seed", range(4))
    def test_huber_where_they_go_both_ways(self, simulate: Simulate, seed: int) -> None:
        observations = simulate(SATIN, noise=0.005, seed=seed, step=6)
        found = scores(spoilt(observations, "to both sides", seed), SATIN, "huber")
        assert np.abs(found).max() < 5.0

    def test_huber_is_pulled_to_one_side_by_what_is_stated(self, simulate: Simulate) -> None:
        """By 1.6 p / (1 - p) deviations of a value, which more values do not average out."""
        observations = spoilt(simulate(SATIN, noise=0.002, step=6), "to one side", 0)
        off = {
            loss: np.abs(fit_scan(observations, loss=loss).values[:3] - SATIN[:3]).mean()
            for loss in LOSSES
        }
        assert off["huber"] < 0.1 * off["least_squares"]
        assert off["cauchy"] < 0.5 * off["huber"]

    @pytest.mark.parametrize(
        ("name", "kind"),
        [("huber", "to both sides"), ("cauchy", "to both sides"), ("cauchy", "frames")],
    )
    def test_stated_deviations_hold(self, simulate: Simulate, name: str, kind: str) -> None:
        found = np.array(
            [
                scores(spoilt(simulate(SATIN, noise=0.005, seed=s, step=8), kind, s), SATIN, name)
                for s in range(24)
            ]
        )
        # correlated within a scan: 1 / sqrt(2 x 24) is the largest error of the spread; stated
        # deviations may be somewhat large: outliers near the noise cost no more than they should
        assert 0.75 < found.std() < 1.0 + 3 / np.sqrt(48)
        assert (np.abs(found) < 3).mean() > 0.985

    @pytest.mark.parametrize("name", ROBUST)
    def test_every_solver_finds_the_same(self, simulate: Simulate, name: str) -> None:
        observations = spoilt(simulate(SATIN, noise=0.005, step=8), "to both sides", 1)
        one, *others = (fit_scan(observations, loss=name, method=m) for m in SOLVERS)
        for other in others:
            moved = np.abs(one.values - other.values)
            assert (moved < 0.01 * one.standard_deviations).all()
            assert abs(one.down_weighted - other.down_weighted) <= 2

    @pytest.mark.parametrize("metric", METRICS)
    def test_in_every_metric(self, simulate: Simulate, metric: str) -> None:
        observations = spoilt(simulate(SATIN, noise=0.005, step=6), "to both sides", 2)
        result = fit_scan(observations, loss="cauchy", metric=metric)
        off = np.abs(result.values - SATIN) / result.standard_deviations
        assert off.max() < 5.0

    def test_few_glints_in_a_sharp_lobe_model(self, simulate: Simulate) -> None:
        truth = [0.05, 0.12, 0.4, 0.2, 3.0, 25.0]
        observations = simulate(truth, noise=0.005, step=3)
        rng = np.random.default_rng(4)
        glint = (rng.random(observations.radiance.shape) < 0.05) * rng.exponential(
            1.0, observations.radiance.shape
        )
        glinting = replace(observations, radiance=observations.radiance + glint)
        assert np.abs(scores(glinting, truth, "cauchy")).max() < 5.0
        # least squares holds the glints for an error of the model, and all values for vague
        assert fit_scan(glinting).model_error_std > 0.1


class TestModelError:
    @pytest.mark.parametrize("name", ROBUST)
    def test_a_wrong_model_still_has_an_error(
        self, real_material: Callable[[str], Observations], name: str
    ) -> None:
        measured = real_material("paper_white")
        exact = replace(measured, variance=np.full(measured.radiance.shape, 1e-10))
        plain, robust = fit_scan(exact), fit_scan(exact, loss=name)
        # a median of normal misfits gives what their mean square does; these have some tails
        assert 0.9 * plain.model_error_std < robust.model_error_std < plain.model_error_std
        assert robust.errors.rms_percent < 1.01 * plain.errors.rms_percent

    def test_what_a_wrong_model_explains_in_most_values_is_believed(
        self, simulate: Simulate
    ) -> None:
        """Half of the cameras and channels see no lobe: there the wrong model is exact."""
        observations = simulate(METAL, COLOURED, step=6)
        exact = replace(observations, variance=1e-6 * observations.variance)
        robust = fit_scan(exact, loss="cauchy")
        assert robust.model_error_std == 0.0
        assert robust.down_weighted > 200
        assert fit_scan(exact).model_error_std > 0.0

    @pytest.mark.parametrize("name", ROBUST)
    def test_not_without_leave(self, simulate: Simulate, name: str) -> None:
        observations = simulate(METAL, COLOURED, noise=0.002, step=12)
        assert fit_scan(observations, loss=name, model_error=False).model_error_std == 0.0


class TestEffort:
    def test_it_says_when_weights_did_not_settle(
        self, simulate: Simulate, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(losses, "ROBUST_ROUNDS", 2)
        observations = spoilt(simulate(SATIN, noise=0.005, step=8), "to one side", 0)
        result = fit_scan(observations, loss="huber", method="paper")
        assert "huber weights did not settle in 2 rounds" in result.reason

    def test_evaluations_are_those_of_all_rounds(self, simulate: Simulate) -> None:
        observations = simulate(SATIN, noise=0.005, step=8)
        plain = fit_scan(observations, method="paper")
        robust = fit_scan(observations, method="paper", loss="huber")
        assert robust.evaluations > 2 * plain.evaluations
