"""Where the climb of a ladder leads: other shapes of lobes, structure, and each scan's errors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.fitting.scans import SATIN, Simulate
from tvbrdf_fitting import CommonErrors, fit_scan
from tvbrdf_fitting.choice.choose import choose_for_series, choose_model
from tvbrdf_fitting.choice.ladder import clear_coat

LAMBERT, ROUGH, LOBE = "lambert", "oren_nayar", "torrance_sparrow"


@pytest.mark.parametrize("seed", range(4))
def test_another_shape_of_lobe(simulate: Simulate, seed: int) -> None:
    """Gaussian facets would leave noise without structure, and a roughness 5 deviations off."""
    model = f"{ROUGH}+cook_torrance(ggx,coloured)"
    values = [0.42, 0.84, 0.42, 0.26, 0.48, 0.23, 0.08, 0.22, 1.5]
    choice = choose_model(simulate(values, model, noise=0.011, step=6, seed=seed))
    assert choice.model == clear_coat(model).label


def test_structure_leads_on_where_noise_seems_to_explain(simulate: Simulate) -> None:
    """A broad coloured lobe, hardly more than albedo: residuals of Lambert are 1.2 deviations.

    No single step up from Lambert is worth its parameters.
    """
    model = f"{LAMBERT}+cook_torrance(ggx,coloured)"
    values = [0.71, 0.62, 0.42, 0.79, 0.84, 0.038, 0.64, 1.5]
    choice = choose_model(simulate(values, model, noise=0.005, step=7))
    lambert = next(rung for rung in choice.rungs if rung.model == LAMBERT)
    assert lambert.explains
    assert choice.model == clear_coat(model).label


def test_of_two_shapes_as_good_the_ladders_first(simulate: Simulate) -> None:
    """A lobe of some deviations: noise must not decide on its shape."""
    values = [0.3, 0.5, 0.7, 0.012, 8.0]
    tried = better = 0
    for seed in range(20):
        scan = simulate(values, f"{LAMBERT}+{LOBE}", noise=0.02, step=12, seed=seed)
        choice = choose_model(scan)
        criteria = {rung.model: rung.criterion for rung in choice.rungs}
        other = criteria.get(clear_coat(f"{LAMBERT}+cook_torrance(ggx)").label)
        if other is not None:
            tried += 1
            better += other < criteria[f"{LAMBERT}+{LOBE}"]
            assert choice.model == f"{LAMBERT}+{LOBE}"
    assert tried > 10
    assert better > 0


@pytest.mark.parametrize("mode", ["joint", "per_scan"])
def test_each_scan_has_its_own_common_errors(simulate: Simulate, mode: Any) -> None:
    """As a merge of sweeps estimates them scan by scan, with the sweeps' own numbers."""
    model, values = f"{ROUGH}+{LOBE}", SATIN
    one, other = (simulate(values, model, noise=0.01, step=12, seed=seed) for seed in (1, 2))
    other = replace(other, sweep=other.sweep + 3)
    errors = [
        CommonErrors(dict.fromkeys((1, 2, 3), 0.02), 0.005),
        CommonErrors(dict.fromkeys((4, 5, 6), 0.05), 0.01),
    ]
    choices = choose_for_series([one, other], mode=mode, method="separable", common_errors=errors)
    for scan, own, choice in zip((one, other), errors, choices, strict=True):
        expected = fit_scan(scan, choice.model, common_errors=own)
        np.testing.assert_array_equal(choice.result.values, expected.values)
        assert choice.result.nuisances == expected.nuisances
    with pytest.raises(ValueError, match="no light_angle_std_deg for sweep 4"):
        choose_for_series([one, other], mode=mode, common_errors=errors[0])
    with pytest.raises(ValueError, match="common errors of 1 scans for 2: give one for all"):
        choose_for_series([one, other], mode=mode, common_errors=errors[:1])
    # a scan without any, such as a published grid among kept frames
    mixed = choose_for_series(
        [one, other], mode=mode, method="separable", common_errors=[None, errors[1]]
    )
    assert mixed[0].result.nuisances == {}
    assert mixed[1].result.nuisances.keys() == choices[1].result.nuisances.keys()
