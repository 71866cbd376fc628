"""Are stated deviations true? Share of parameters within 3 of them, over many simulated scans."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import binomtest, norm

from tvbrdf_fitting import CommonErrors, FitResult, Observations, fit_scan, get_model

Simulate = Callable[..., Observations]

SCENES = [
    [0.30, 0.50, 0.70, 0.40, 0.80, 6.0],
    [0.05, 0.12, 0.40, 0.20, 3.00, 25.0],
    [0.60, 0.55, 0.50, 0.60, 0.15, 3.0],
    [0.10, 0.10, 0.10, 0.30, 1.50, 12.0],
    [0.80, 0.60, 0.30, 0.30, 6.00, 40.0],
]
WITHIN_3 = norm.cdf(3) - norm.cdf(-3)
"""0.9973."""


class Tally:
    """Counts parameters within 3 stated deviations of the truth; bounds are counted apart."""

    def __init__(self) -> None:
        self.inside = 0
        self.total = 0
        self.at_bound: Counter[str] = Counter()
        self.undetermined: Counter[str] = Counter()
        self.scores: list[np.ndarray] = []

    def add(self, result: FitResult, truth: list[float]) -> None:
        left_out = {*result.at_bound, *result.undetermined, *result.fixed}
        self.at_bound.update(result.at_bound)
        self.undetermined.update(result.undetermined)
        keep = [i for i, n in enumerate(result.parameter_names) if n not in left_out]
        off = result.values - truth
        scores = off[keep] / result.standard_deviations[keep]
        self.inside += int((np.abs(scores) <= 3 + 1e-9).sum())
        self.total += len(keep)
        self.scores.append(scores)

    def check(self) -> None:
        """The exact binomial 99.9 % interval of the share must contain that of a normal."""
        interval = binomtest(self.inside, self.total).proportion_ci(0.999, method="exact")
        share = self.inside / self.total
        excluded = f"at a bound {dict(self.at_bound)}, undetermined {dict(self.undetermined)}"
        report = f"{self.inside} of {self.total} ({share:.4%}); excluded: {excluded}"
        assert interval.low <= WITHIN_3 <= interval.high, report


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_thousand_scans_with_random_errors(simulate: Simulate) -> None:
    tally = Tally()
    for seed in range(1000):
        truth = SCENES[seed % len(SCENES)]
        tally.add(fit_scan(simulate(truth, noise=0.005, seed=seed, step=6)), truth)
    tally.check()
    # the scenes are chosen so that next to nothing is at a bound or undetermined
    assert tally.total >= 5940, (tally.at_bound, tally.undetermined)
    # deviations that are too large would hide in the share: the scores' spread shows them.
    # 6000 scores, correlated within a scan: 1 / sqrt(2 x 1000) is the largest standard error
    spread = np.concatenate(tally.scores).std()
    assert spread == pytest.approx(1.0, abs=4 / np.sqrt(2000))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_scans_at_a_bound(simulate: Simulate) -> None:
    """Lambert: half of the fits end at sigma_d = 0; the deviations of the others must not lie."""
    tally = Tally()
    truth = [0.30, 0.50, 0.70, 0.0, 0.80, 6.0]
    for seed in range(300):
        tally.add(fit_scan(simulate(truth, noise=0.005, seed=seed, step=6)), truth)
    # estimates of sigma_d^2 scatter around 0: at the bound in half of the scans (binomial, 99.9 %)
    assert 121 <= tally.at_bound["sigma_d"] <= 179
    # the bound's knowledge narrows the others: the stated deviations may only be too large
    interval = binomtest(tally.inside, tally.total).proportion_ci(0.999, method="exact")
    assert interval.high >= WITHIN_3


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_scans_with_common_errors(simulate: Simulate) -> None:
    rng = np.random.default_rng(17)
    common = CommonErrors(light_angle_std_deg=0.02, gain_relative_std=0.005)
    tally, off, plain_off = Tally(), [], []
    for seed in range(300):
        truth = SCENES[seed % len(SCENES)]
        scan = simulate(
            truth,
            noise=0.005,
            seed=seed,
            step=6,
            gains=1 + 0.005 * rng.normal(size=(4, 3)),
            light_offset_deg=0.02 * rng.normal(size=3),
        )
        result = fit_scan(scan, common_errors=common)
        tally.add(result, truth)
        off.append(result.values / truth - 1)
        plain_off.append(fit_scan(scan).values / truth - 1)
    tally.check()
    # the nuisances bring every parameter nearer to the truth: by 1.2 to 5 times in these scenes
    nearer = np.sqrt(np.mean(np.square(plain_off), axis=0) / np.mean(np.square(off), axis=0))
    assert (nearer > 1.2).all(), nearer


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_intervals_at_a_bound(simulate: Simulate) -> None:
    """Profiles: a truth at the bound is missed on one side only, so half as often."""
    common = CommonErrors(light_angle_std_deg=0.02, gain_relative_std=0.005)
    rng = np.random.default_rng(23)
    truth, scans, sigmas = [0.30, 0.50, 0.70, 0.0, 0.80, 6.0], 150, 2.0
    missed = at_bound = 0
    for seed in range(scans):
        scan = simulate(
            truth, noise=0.005, seed=seed, step=8, gains=1 + 0.005 * rng.normal(size=(4, 3))
        )
        result = fit_scan(scan, common_errors=common)
        low, high = result.interval("sigma_d", sigmas)
        at_bound += "sigma_d" in result.at_bound
        assert low <= result.value("sigma_d") < high
        missed += low > 0.0
    assert at_bound > 0.3 * scans
    interval = binomtest(missed, scans).proportion_ci(0.999, method="exact")
    assert interval.low <= norm.sf(sigmas) <= interval.high


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_without_the_common_part_the_deviations_would_be_wrong(simulate: Simulate) -> None:
    """The same errors unstated: the check above can fail."""
    rng = np.random.default_rng(17)
    tally = Tally()
    for seed in range(50):
        gains = 1 + 0.003 * rng.normal(size=(4, 3))
        truth = SCENES[seed % len(SCENES)]
        tally.add(fit_scan(simulate(truth, noise=0.005, seed=seed, step=6, gains=gains)), truth)
    with pytest.raises(AssertionError, match="excluded"):
        tally.check()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_dust_by_the_papers_procedure(simulate: Simulate) -> None:
    truth = [0.3, 0.5, 0.7, 0.4, 0.8, 6.0, 0.05, 0.06, 0.07, 0.35, 0.3]
    known = get_model("dust").as_mapping(truth)
    fixed = {n: v for n, v in known.items() if n not in {"ks", "inverse_sigma_s", "tau"}}
    tally = Tally()
    for seed in range(300):
        scan = simulate(truth, "dust", noise=0.005, seed=seed, step=6)
        tally.add(fit_scan(scan, "dust", fixed=fixed), truth)
    assert tally.total == 900
    tally.check()
