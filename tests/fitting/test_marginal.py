"""Common errors far larger than the noise: found, and told from a model that is wrong."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.fitting.scans import Simulate
from tvbrdf_fitting import CommonErrors, FitResult, Observations, fit_scan, get_model
from tvbrdf_fitting.inference.nuisances import make_nuisances
from tvbrdf_fitting.inference.posterior import Posterior, maximise
from tvbrdf_fitting.problem import make_problem

GAIN_STD, OFFSET_STD_DEG, NOISE = 0.03, 0.03, 0.0005
ERRORS = CommonErrors(OFFSET_STD_DEG, GAIN_STD)
TRUTHS = {
    "matte": [0.3, 0.5, 0.7, 0.0, 0.8, 6.0],
    "satin": [0.3, 0.5, 0.7, 0.4, 0.8, 6.0],
    "weak": [0.77, 0.053, 0.48, 0.65, 0.012, 32.0],
    "broad": [0.9, 0.27, 0.43, 0.64, 0.028, 1.8],
    "glossy": [0.05, 0.12, 0.4, 0.1, 3.0, 25.0],
}


def disturbed(simulate: Simulate, truth: list[float], seed: int) -> Observations:
    """A scan with gains and light offsets a hundred times what the noise lets one see."""
    rng = np.random.default_rng((3, seed))
    gains = 1 + GAIN_STD * rng.normal(size=(4, 3))
    offsets = OFFSET_STD_DEG * rng.normal(size=3)
    return simulate(truth, noise=NOISE, seed=seed, step=8, gains=gains, light_offset_deg=offsets)


def assert_explained(result: FitResult, truth: list[float]) -> None:
    assert result.model_error_std == 0.0
    assert "did not settle" not in result.reason
    # nuisances count as values and as unknowns: chi-square's mean and deviation, 5 deviations
    freedom = result.degrees_of_freedom
    assert result.chi_square == pytest.approx(freedom, abs=5 * math.sqrt(2 * freedom))
    error = result.internal_values - get_model("ON+TS").to_internal(truth)
    score = np.abs(error) / np.sqrt(np.diag(result.internal_covariance))
    # six normal numbers in each of 40 scenes: beyond 4.5 in 1 of 600 runs
    assert score.max() < 4.5, score


@pytest.mark.parametrize("name", TRUTHS)
@pytest.mark.parametrize("seed", range(8))
def test_they_are_found_wherever_the_plain_fit_ended(
    simulate: Simulate, name: str, seed: int
) -> None:
    scan = disturbed(simulate, TRUTHS[name], seed)
    plain = fit_scan(scan)
    assert plain.model_error_std > 0
    assert plain.chi_square > 100 * plain.degrees_of_freedom
    assert_explained(fit_scan(scan, common_errors=ERRORS), TRUTHS[name])


@pytest.mark.parametrize(
    ("name", "seed", "bound"),
    [("matte", 3, "sigma_d"), ("glossy", 4, "sigma_d"), ("weak", 3, "inverse_sigma_s"),
     ("broad", 3, "inverse_sigma_s")],
)  # fmt: skip
def test_a_bound_that_only_they_led_to_is_left(
    simulate: Simulate, name: str, seed: int, bound: str
) -> None:
    """The lobe that the gains seemed to be is at a bound of its width, the true one elsewhere."""
    scan = disturbed(simulate, TRUTHS[name], seed)
    assert bound in fit_scan(scan).at_bound
    assert_explained(fit_scan(scan, common_errors=ERRORS), TRUTHS[name])


@pytest.mark.parametrize(("name", "seed"), [("weak", 4), ("broad", 2), ("broad", 4)])
def test_albedo_against_gain_is_no_crawl(simulate: Simulate, name: str, seed: int) -> None:
    """Amplitudes up and gains down is a bent valley: its bottom is reached all the same."""
    scan = disturbed(simulate, TRUTHS[name], seed)
    problem = make_problem(scan, get_model("ON+TS"), {}, {})
    posterior = Posterior(problem, make_nuisances(problem, scan, ERRORS))
    from_truth = maximise(posterior, posterior.point(problem.model.to_internal(TRUTHS[name])))
    result = fit_scan(scan, common_errors=ERRORS)
    # a hundredth of a deviation's square
    assert result.chi_square <= 2 * from_truth.point.cost + 1e-2


def test_a_robust_loss_finds_them_too(simulate: Simulate) -> None:
    """One value in 50 half as bright again, among gains that the noise alone can't explain."""
    scan = disturbed(simulate, TRUTHS["satin"], 1)
    stray = np.random.default_rng(7).random(scan.radiance.shape) < 0.02
    spoilt = replace(scan, radiance=scan.radiance * (1 + 0.5 * stray))
    result = fit_scan(spoilt, loss="cauchy", common_errors=ERRORS)
    assert result.model_error_std == 0.0
    assert result.down_weighted >= stray[scan.usable].sum()
    error = result.internal_values - get_model("ON+TS").to_internal(TRUTHS["satin"])
    assert (np.abs(error) / np.sqrt(np.diag(result.internal_covariance))).max() < 4.5


def test_the_log_metric_finds_them_too(simulate: Simulate) -> None:
    scan = disturbed(simulate, TRUTHS["satin"], 0)
    result = fit_scan(scan, metric="log", common_errors=ERRORS)
    assert_explained(result, TRUTHS["satin"])


@pytest.mark.parametrize("seed", range(6))
def test_a_wrong_model_is_not_taken_for_them(simulate: Simulate, seed: int) -> None:
    """Lambert fitted to a gloss: no gains that one would state explain it."""
    scan = disturbed(simulate, TRUTHS["satin"], seed)
    plain = fit_scan(scan, "lambert")
    stated = fit_scan(scan, "lambert", common_errors=ERRORS)
    assert stated.model_error_std == plain.model_error_std > 0
    np.testing.assert_array_equal(stated.values, plain.values)
    assert all(value == 0.0 for value, _ in stated.nuisances.values())


def test_priors_that_would_have_to_be_far_off_are_refused(simulate: Simulate) -> None:
    """The same gains, stated as a thirtieth of what they are: rather the model's error."""
    scan = disturbed(simulate, TRUTHS["satin"], 1)
    errors = CommonErrors(OFFSET_STD_DEG, GAIN_STD / 30)
    assert fit_scan(scan, common_errors=errors).model_error_std > 0
