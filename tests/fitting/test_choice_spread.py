"""Deviations after a choice of model: within the kept rung and between rungs as good."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.fitting.scans import SATIN, Simulate
from tvbrdf_fitting import CommonErrors, Observations, fit_scan, get_model
from tvbrdf_fitting.choice.choose import ModelChoice, choose_for_series, choose_model
from tvbrdf_fitting.choice.rule import DECISIVE
from tvbrdf_fitting.choice.spread import deviations_over, weights_of

SMOOTH, ROUGH = "lambert+torrance_sparrow", "oren_nayar+torrance_sparrow"
GGX = "oren_nayar+cook_torrance(ggx)"
TWO = "oren_nayar+torrance_sparrow(coloured)+torrance_sparrow(coloured)"
HARDLY_ROUGH = [0.225, 0.27, 0.21, 0.07, 0.48, 3.0]


def hardly_rough(simulate: Simulate, seed: int = 0) -> Observations:
    """A roughness of some 4 deviations, less than decides against a smooth surface."""
    return simulate(HARDLY_ROUGH, noise=0.015, step=10, seed=seed)


def criteria_of(choice: ModelChoice) -> dict[str, float]:
    return {rung.model: rung.criterion for rung in choice.rungs}


class TestWeights:
    def test_by_the_criterion(self) -> None:
        weights = weights_of({"kept": 0.0, "near": 2.0, "far": DECISIVE})
        total = 1 + math.exp(-1)
        assert weights == pytest.approx({"kept": 1 / total, "near": math.exp(-1) / total})

    def test_what_is_better_but_not_decisively_counts_the_same(self) -> None:
        assert weights_of({"kept": 0.0, "lower": -6.0}) == {"kept": 0.5, "lower": 0.5}


class TestSpread:
    def test_a_clear_choice_adds_nothing(self, simulate: Simulate) -> None:
        scan = simulate(SATIN, noise=0.01, step=12)
        choice = choose_model(scan, ladder=("lambert", "oren_nayar", SMOOTH, ROUGH))
        assert choice.weights == {ROUGH: 1.0}
        result = choice.result
        np.testing.assert_allclose(choice.standard_deviations, result.standard_deviations)
        internal = np.sqrt(np.diag(result.internal_covariance))
        np.testing.assert_allclose(choice.internal_deviations, internal)

    @pytest.mark.parametrize("errors", [None, CommonErrors(0.02, 0.005)], ids=["plain", "common"])
    def test_it_is_the_sum_within_and_between(
        self, simulate: Simulate, errors: CommonErrors | None
    ) -> None:
        scan = hardly_rough(simulate)
        choice = choose_model(scan, ladder=(SMOOTH, ROUGH), common_errors=errors)
        assert choice.model == SMOOTH
        criteria = criteria_of(choice)
        above = max(criteria[ROUGH] - criteria[SMOOTH], 0.0)
        weight = 1 / (1 + math.exp(-0.5 * above))
        assert choice.weights == pytest.approx({SMOOTH: weight, ROUGH: 1 - weight})
        kept, rival = (fit_scan(scan, model, common_errors=errors) for model in (SMOOTH, ROUGH))
        for name in kept.parameter_names:
            i, j = kept.index(name), rival.index(name)
            off = rival.internal_values[j] - kept.internal_values[i]
            variance = weight * kept.internal_covariance[i, i]
            variance += (1 - weight) * (rival.internal_covariance[j, j] + off**2)
            assert choice.internal_deviations[i] == pytest.approx(math.sqrt(variance), rel=1e-9)
            slope = get_model(SMOOTH).slopes(kept.values)[i]
            assert choice.standard_deviations[i] * slope == pytest.approx(
                choice.internal_deviations[i], rel=1e-9
            )

    def test_a_model_that_is_too_simple_says_so(self, simulate: Simulate) -> None:
        """Where the smooth surface was kept, albedos are off by what the roughness would add."""
        model, alone, wide = get_model(SMOOTH), [], []
        truth = model.to_internal([*HARDLY_ROUGH[:3], *HARDLY_ROUGH[4:]])
        for seed in range(40):
            choice = choose_model(hardly_rough(simulate, seed), ladder=(SMOOTH, ROUGH))
            if choice.model == SMOOTH:
                error = np.abs(choice.result.internal_values - truth)
                alone.append(error / np.sqrt(np.diag(choice.result.internal_covariance)))
                wide.append(error / choice.internal_deviations)
        assert len(alone) >= 10
        # scores are 1 (root mean square) where deviations are true; those of a fit that is certain
        # of its model are twice as large for the albedos, and are made less by a quarter and more
        by_fit, with_spread = (
            np.sqrt(np.mean(np.square(scores), axis=0)) for scores in (alone, wide)
        )
        assert by_fit.max() > 2.0
        assert with_spread.max() < 0.75 * by_fit.max()

    def test_lobes_of_another_shape_have_other_parameters(self, simulate: Simulate) -> None:
        scan = simulate(SATIN, noise=0.01, step=12)
        kept, other = fit_scan(scan, ROUGH), fit_scan(scan, GGX, fixed={"eta": 1.5})
        fits, weights = {"kept": kept, "other": other}, {"kept": 0.5, "other": 0.5}
        internal, published = deviations_over(kept, fits, weights)
        own = np.sqrt(np.diag(kept.internal_covariance))
        np.testing.assert_allclose(internal[4:], own[4:])
        np.testing.assert_allclose(published[4:], kept.standard_deviations[4:])
        # Gaussian facets for others: albedos and roughness differ
        assert (internal[:4] > 1.05 * own[:4]).all()

    def test_a_width_is_shared_by_lobes_with_and_without_colours(self, simulate: Simulate) -> None:
        scan = simulate(SATIN, noise=0.01, step=12)
        coloured = "oren_nayar+torrance_sparrow(coloured)"
        kept, other = fit_scan(scan, ROUGH), fit_scan(scan, coloured)
        internal, _ = deviations_over(kept, {"a": kept, "b": other}, {"a": 0.5, "b": 0.5})
        off = other.internal_values[7] - kept.internal_values[5]
        variance = 0.5 * kept.internal_covariance[5, 5]
        variance += 0.5 * (other.internal_covariance[7, 7] + off**2)
        assert internal[5] == pytest.approx(math.sqrt(variance))
        # there is no one amplitude to compare with
        assert internal[4] == pytest.approx(math.sqrt(kept.internal_covariance[4, 4]))

    def test_which_of_two_lobes_is_which_is_not_asked(self, simulate: Simulate) -> None:
        values = [0.1, 0.1, 0.1, 0.3, 0.1, 0.3, 0.6, 4.0, 2.0, 3.0, 4.0, 20.0]
        scan = simulate(values, TWO, noise=0.005, step=12)
        kept, other = fit_scan(scan, TWO), fit_scan(scan, TWO.replace("oren_nayar", "lambert"))
        internal, _ = deviations_over(kept, {"a": kept, "b": other}, {"a": 0.5, "b": 0.5})
        own = np.sqrt(np.diag(kept.internal_covariance))
        np.testing.assert_allclose(internal[4:], own[4:])
        assert (internal[:3] > own[:3]).all()

    def test_fixed_and_unmeasured_parameters_stay_so(self, simulate: Simulate) -> None:
        scan = simulate(SATIN, noise=0.01, step=12)
        dead = scan.valid & np.array([True, False, True])
        scan = Observations(**{**scan.__dict__, "valid": dead})
        kept, other = (fit_scan(scan, m, fixed={"sigma_d": 0.4}) for m in (ROUGH, "oren_nayar"))
        internal, published = deviations_over(kept, {"a": kept, "b": other}, {"a": 0.9, "b": 0.1})
        assert internal[3] == published[3] == 0.0
        assert math.isnan(internal[1])
        assert math.isnan(published[1])
        assert np.isfinite(internal[[0, 2, 4, 5]]).all()

    def test_a_series_is_weighed_as_a_whole(self, simulate: Simulate) -> None:
        scans = [hardly_rough(simulate, seed) for seed in range(3)]
        choices = choose_for_series(scans, ladder=(SMOOTH, ROUGH))
        sums = [criteria_of(choice) for choice in choices]
        assert sums[0] == sums[1] == sums[2]
        above = {name: value - sums[0][choices[0].model] for name, value in sums[0].items()}
        assert all(choice.weights == weights_of(above) for choice in choices)
