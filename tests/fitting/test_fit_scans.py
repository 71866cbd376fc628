"""Many scans at once give what each gives alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.fitting.scans import Simulate
from tvbrdf_fitting import FitError, fit_scan, fit_scans

SATIN = [0.3, 0.5, 0.7, 0.3, 0.8, 8.0]


@pytest.mark.parametrize("jobs", [1, 2])
def test_each_scan_is_fitted_as_alone(simulate: Simulate, jobs: int) -> None:
    scans = [simulate(SATIN, noise=0.01, seed=seed, step=10) for seed in range(5)]
    results = fit_scans(scans, jobs=jobs, loss="huber")
    assert len(results) == len(scans)
    for scan, result in zip(scans, results, strict=True):
        alone = fit_scan(scan, loss="huber")
        np.testing.assert_array_equal(result.values, alone.values)
        np.testing.assert_array_equal(result.covariance, alone.covariance)
        assert result.loss == "huber"


def test_the_scan_that_cannot_be_fitted_is_named(simulate: Simulate) -> None:
    good = simulate(SATIN, noise=0.01, step=30)
    blind = replace(good, valid=np.zeros_like(good.valid))
    with pytest.raises(FitError, match="0 usable values") as caught:
        fit_scans([good, blind, good])
    assert "scan 1 of" in caught.value.__notes__[0]
    with pytest.raises(ValueError, match="unknown model"):
        fit_scans([good], "velvet")


def test_nothing_to_fit() -> None:
    assert fit_scans([]) == []
