"""Noise that the three channels of a frame share: the lamp's flicker."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest, norm

from tests.fitting.scans import Simulate
from tvbrdf_fitting import CommonErrors, Observations, fit_scan

TRUTH = [0.30, 0.50, 0.70, 0.40, 0.80, 6.0]
FLICKER = 0.01
SCANS = 200


def with_flicker(scan: Observations, clean: Observations, rng: np.random.Generator) -> Observations:
    """Add flicker to each frame, in all its channels, and to the stated variances."""
    flicker = FLICKER * rng.standard_normal(len(scan))[:, None]
    return replace(
        scan,
        radiance=scan.radiance + flicker * clean.radiance,
        variance=scan.variance + (FLICKER * clean.radiance) ** 2,
    )


def scores(simulate: Simulate, stated: CommonErrors | None) -> np.ndarray:
    rng = np.random.default_rng(29)
    found = []
    for seed in range(SCANS):
        # the phase of the sweeps is drawn first, so clean and noisy scans see the same lights
        scan = simulate(TRUTH, noise=0.001, seed=seed, step=6)
        clean = simulate(TRUTH, seed=seed, step=6)
        assert np.array_equal(scan.light_direction, clean.light_direction)
        result = fit_scan(with_flicker(scan, clean, rng), common_errors=stated)
        assert not result.at_bound
        found.append((result.values - TRUTH) / result.standard_deviations)
    return np.array(found)


def test_the_deviations_are_true_when_it_is_stated(simulate: Simulate) -> None:
    z = scores(simulate, CommonErrors(frame_relative_std=FLICKER))
    inside = int((np.abs(z) <= 3).sum())
    interval = binomtest(inside, z.size).proportion_ci(0.999, method="exact")
    assert interval.low <= norm.cdf(3) - norm.cdf(-3) <= interval.high
    # each parameter's scores have spread 1, known to 1 / sqrt(2 scans); 4 of these
    np.testing.assert_allclose(z.std(axis=0), 1.0, rtol=0, atol=4 / np.sqrt(2 * SCANS))


def test_unstated_it_makes_the_lobe_look_better_known_than_it_is(simulate: Simulate) -> None:
    z = scores(simulate, None)
    # Ks and sigma_s are the same in all channels: their error is up to sqrt(3) of what is stated
    assert (z[:, 4:].std(axis=0) > 1.3).all()


def test_it_may_be_given_for_each_camera(simulate: Simulate) -> None:
    scan = simulate(TRUTH, noise=0.001, seed=1, step=6)
    one = fit_scan(scan, common_errors=CommonErrors(frame_relative_std=FLICKER))
    each = CommonErrors(frame_relative_std=dict.fromkeys((1, 2, 3, 4), FLICKER))
    assert np.array_equal(
        fit_scan(scan, common_errors=each).standard_deviations, one.standard_deviations
    )
    with pytest.raises(ValueError, match="no frame_relative_std for camera 4"):
        fit_scan(scan, common_errors=CommonErrors(frame_relative_std=dict.fromkeys((1, 2, 3), 0.1)))
    with pytest.raises(ValueError, match="frame_relative_std = -1"):
        CommonErrors(frame_relative_std=-1)


def test_it_never_takes_more_than_all_of_the_noise(simulate: Simulate) -> None:
    """A statement that contradicts the variances leaves a covariance that is one."""
    scan = simulate(TRUTH, noise=0.001, seed=1, step=6)
    covariance = fit_scan(scan, common_errors=CommonErrors(frame_relative_std=10.0)).covariance
    assert np.linalg.eigvalsh(covariance).min() > 0
