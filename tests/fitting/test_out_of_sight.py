"""Lobes whose peak no light and camera saw: the optimum may lie at any amplitude at all."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.fit_scenes import make_scene
from tvbrdf_fitting import CommonErrors, choose_model, fit_scan, predict
from tvbrdf_fitting.half_angle import from_half_angles

SCENES = ("random 13 true", "random 248 true", "random 126 ggx", "hard camera 4 only|0.005|true")


@pytest.mark.parametrize("common_errors", [None, CommonErrors(0.02, 0.005)])
@pytest.mark.parametrize("scene", SCENES)
def test_such_a_lobe_is_found_and_named(scene: str, common_errors: CommonErrors | None) -> None:
    """Nothing overflows (warnings are errors), and everything else is as good as without it."""
    observations = make_scene(scene).observations
    found = fit_scan(observations, common_errors=common_errors)
    assert found.parameters["ks"] > 1e100
    assert {"ks", "inverse_sigma_s"} <= set(found.undetermined)
    assert found.interval("ks") == (0.0, math.inf)
    for name in ("kd_b", "kd_g", "kd_r"):
        low, high = found.interval(name)
        assert low <= found.parameters[name] <= high < 1
    light, view = from_half_angles(np.radians([0.5, 50.0]), np.radians(20.0), np.radians(90.0))
    predicted = predict(found, light, view)
    assert not np.isfinite(predicted.standard_deviation[0]).any()
    assert np.isfinite(predicted.standard_deviation[1]).all()


@pytest.mark.parametrize("scene", SCENES)
def test_the_choice_needs_no_such_lobe(scene: str) -> None:
    chosen = choose_model(make_scene(scene).observations)
    assert chosen.result.parameters.get("ks", 0.0) < 1e6
