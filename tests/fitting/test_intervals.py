"""Intervals of parameters: from the covariance, and from profiles of chi-square."""

from __future__ import annotations

import copy
import json
import math
import pickle
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tvbrdf_fitting import CommonErrors, FitResult, Observations, fit_scan, get_model

Simulate = Callable[..., Observations]

SATIN = [0.3, 0.5, 0.7, 0.4, 0.8, 6.0]
LAMBERT = [0.3, 0.5, 0.7, 0.0, 0.8, 6.0]
ALL = CommonErrors(0.02, 0.005, plate_tilt_std_deg=0.03)


def lowest(scan: Observations, name: str, value: float) -> float:
    """Chi-square of a fit with a parameter fixed."""
    return fit_scan(scan, fixed={name: value}, model_error=False).chi_square


class TestIntervals:
    def test_far_from_a_bound_they_are_the_covariances(self, simulate: Simulate) -> None:
        result = fit_scan(simulate(SATIN, noise=0.01, step=6), common_errors=ALL)
        for index, name in enumerate(result.parameter_names):
            reach = 2 * math.sqrt(result.internal_covariance[index, index])
            ends = result.internal_values[index] + np.array([-reach, reach])
            transform = get_model("ON+TS").parameters[index].transform
            expected = [transform.to_published(end) for end in ends]
            np.testing.assert_allclose(result.interval(name, 2), expected, rtol=1e-12)

    @pytest.mark.parametrize("sigmas", [1.0, 2.0, 3.0])
    def test_at_a_bound_chi_square_rises_as_it_should(
        self, simulate: Simulate, sigmas: float
    ) -> None:
        seed = next(s for s in range(20) if "sigma_d" in self.lambert(simulate, s).at_bound)
        result = self.lambert(simulate, seed)
        low, high = result.interval("sigma_d", sigmas)
        assert low == 0.0
        scan = simulate(LAMBERT, noise=0.01, seed=seed, step=8)
        rise = lowest(scan, "sigma_d", high) - result.chi_square
        assert rise == pytest.approx(sigmas**2, rel=0.05)

    def lambert(self, simulate: Simulate, seed: int) -> FitResult:
        return fit_scan(simulate(LAMBERT, noise=0.01, seed=seed, step=8))

    def test_within_reach_of_a_bound(self, simulate: Simulate) -> None:
        scan = simulate([0.3, 0.5, 0.7, 0.4, 0.001, 6.0], noise=0.01, seed=8, step=8)
        result = fit_scan(scan)
        assert 0 < result.value("ks") < 3 * result.standard_deviation("ks")
        low, high = result.interval("ks")
        assert low == 0.0
        assert lowest(scan, "ks", high) - result.chi_square == pytest.approx(9, rel=0.05)
        low, high = result.interval("ks", 0.5)
        assert 0 < low < result.value("ks") < high

    def test_a_width_without_a_lobe_can_be_anything(self, simulate: Simulate) -> None:
        result = fit_scan(simulate([0.3, 0.5, 0.7, 0.4, 0.0, 6.0], noise=0.01, seed=5, step=8))
        assert "inverse_sigma_s" in result.undetermined
        np.testing.assert_allclose(result.interval("inverse_sigma_s"), [1 / 1.5, 200.0])

    def test_narrow_lobes_have_lopsided_intervals(self, simulate: Simulate) -> None:
        """Between two lights a lobe is seen by its foot: narrower and higher is as good."""
        scan = simulate([0.12, 0.09, 0.06, 0.6, 0.02, 97.0], noise=0.005, seed=1, step=8)
        result = fit_scan(scan)
        low, high = result.interval("ks", 2)
        for end in (low, high):
            if 0 < end < math.inf:
                rise = lowest(scan, "ks", end) - result.chi_square
                assert rise == pytest.approx(4, rel=0.1)
        assert high - result.value("ks") > 1.5 * (result.value("ks") - low)

    def test_fixed_and_unmeasured(self, simulate: Simulate) -> None:
        scan = simulate(SATIN, noise=0.01, step=10)
        seen = scan.valid.copy()
        seen[:, 1] = False
        result = fit_scan(replace(scan, valid=seen), fixed={"ks": 0.8})
        assert result.interval("ks") == (0.8, 0.8)
        assert result.interval("kd_g") == (0.0, math.inf)

    def test_narrower_bounds_hold(self, simulate: Simulate) -> None:
        scan = simulate(SATIN, noise=0.01, step=8)
        result = fit_scan(scan, bounds={"kd_b": (0.0, 0.2999)})
        low, high = result.interval("kd_b")
        assert low < 0.2999
        assert high == pytest.approx(0.2999, abs=1e-12)

    def test_with_a_wrong_model_common_errors_widen_them(
        self, real_material: Callable[[str], Observations]
    ) -> None:
        measured = real_material("satin_rosaline")
        scan = replace(measured, variance=(1e-3 * measured.radiance) ** 2 + 1e-10)
        plain = fit_scan(scan)
        result = fit_scan(scan, common_errors=CommonErrors(gain_relative_std=0.05))
        lengths = [np.diff(fit.interval("kd_b"))[0] for fit in (result, plain)]
        ratio = result.standard_deviation("kd_b") / plain.standard_deviation("kd_b")
        assert ratio > 2
        # chi-square is no parabola here: its residuals are as large as the radiance
        assert lengths[0] / lengths[1] == pytest.approx(ratio, rel=0.2)

    @pytest.mark.parametrize("copied", [lambda r: pickle.loads(pickle.dumps(r)), copy.deepcopy])
    def test_copies_travel_without_the_data(
        self, simulate: Simulate, copied: Callable[[FitResult], FitResult]
    ) -> None:
        result = fit_scan(simulate(SATIN, noise=0.01, seed=5, step=8))
        other = copied(result)
        np.testing.assert_array_equal(other.covariance, result.covariance)
        assert other.interval("kd_b") == result.interval("kd_b")
        matte = fit_scan(simulate([0.3, 0.5, 0.7, 0.4, 0.0, 6.0], noise=0.01, seed=5, step=8))
        with pytest.raises(ValueError, match="inverse_sigma_s is near a bound or undetermined"):
            copied(matte).interval("inverse_sigma_s")

    def test_bad_requests(self, simulate: Simulate) -> None:
        result = fit_scan(simulate(SATIN, step=30))
        for sigmas in (0.0, -1.0, math.nan, math.inf):
            with pytest.raises(ValueError, match="give a number > 0"):
                result.interval("ks", sigmas)
        with pytest.raises(KeyError, match="no parameter 'kx'"):
            result.interval("kx")

    def test_everything_is_in_the_dictionary(self, simulate: Simulate) -> None:
        result = fit_scan(simulate(SATIN, noise=0.01, step=10), common_errors=ALL)
        stored = json.loads(json.dumps(result.as_dict(), allow_nan=False))
        assert stored["nuisances"]["plate_tilt_x_deg"] == list(result.nuisances["plate_tilt_x_deg"])
        assert stored["internal_bounds"][0][0] == 0.0
        assert stored["internal_bounds"][1][0] is None
