"""The benchmark of coverage counts what its header says."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import coverage
from benchmarks.coverage import Seen, counterparts, figures_of, look, summarise
from benchmarks.coverage_scenes import ERRORS, Scene, cramer_rao, random_scene, weak_scene
from tvbrdf_fitting import fit_scan

SEEN = Seen("kd_b", "determined", 1.0, 2.0, False, True, False)


def scene_with(lobe: bool, number: int = 0) -> Scene:
    """A rough random scene, with or without a lobe."""
    for turn in range(1000):
        scene = random_scene(np.random.default_rng((number, turn)))
        if scene.truth[3] > 0 and (scene.truth[4] > 0) == lobe:
            return scene
    raise AssertionError("no such scene")


@pytest.mark.parametrize(
    ("model", "name", "expected"),
    [
        ("lambert", "kd_g", ["kd_g"]),
        ("lambert", "sigma_d", []),
        ("lambert", "ks", []),
        ("oren_nayar+torrance_sparrow", "inverse_sigma_s", ["inverse_sigma_s"]),
        ("lambert+torrance_sparrow(coloured)", "ks", ["ks_b", "ks_g", "ks_r"]),
        ("lambert+torrance_sparrow(coloured)", "inverse_sigma_s", ["inverse_sigma_s"]),
        ("oren_nayar+cook_torrance(ggx)", "ks", []),
        ("oren_nayar+cook_torrance(ggx)", "sigma_d", ["sigma_d"]),
        ("lambert+torrance_sparrow(coloured)+torrance_sparrow(coloured)", "ks", []),
    ],
)
def test_parameters_that_mean_the_same(model: str, name: str, expected: list[str]) -> None:
    result = fit_scan(scene_with(True).observations, model)
    assert counterparts(name, result) == expected


def test_what_the_chosen_model_lacks_is_counted_apart() -> None:
    scene, known = scene_with(True), [True] * 6
    result = fit_scan(scene.observations, "lambert")
    found = look(scene, result, np.sqrt(np.diag(result.internal_covariance)), known)
    assert [s.name for s in found if s.state == "lacking"] == ["sigma_d", "ks", "inverse_sigma_s"]
    f = summarise(found)
    assert (f["lacking"], f["lost"], f["well_known"]) == (3, 3, 6)
    assert f["determined"] == 3


def test_what_the_truth_lacks_too_is_not_lost() -> None:
    scene = scene_with(False)
    result = fit_scan(scene.observations, "oren_nayar")
    found = look(scene, result, np.sqrt(np.diag(result.internal_covariance)), [True] * 6)
    assert {s.name for s in found} == {"kd_b", "kd_g", "kd_r", "sigma_d"}
    assert scene.rung == "oren_nayar"
    # a lobe where there is none: its amplitude should be 0
    lobe = fit_scan(scene.observations)
    found = look(scene, lobe, np.sqrt(np.diag(lobe.internal_covariance)), [True] * 6)
    assert [s.name for s in found][-1] == "ks"


def test_a_score_is_the_error_in_deviations() -> None:
    scene = scene_with(True, 3)
    result = fit_scan(scene.observations, common_errors=ERRORS)
    own = np.sqrt(np.diag(result.internal_covariance))
    found = look(scene, result, 2 * own, [False] * 6)
    error = result.internal_values[0] - scene.truth[0]
    assert found[0].score == pytest.approx(abs(error) / (2 * own[0]))
    assert found[0].score_alone == pytest.approx(abs(error) / own[0])


def test_shares_are_of_what_they_say() -> None:
    outside = replace(SEEN, score=3.1, score_alone=6.0, beside_a_bound=True)
    at_bound = replace(SEEN, state="at a bound", score=math.nan, inside=True)
    lost = replace(SEEN, state="undetermined", score=math.nan)
    lacking = replace(SEEN, state="lacking", score=math.nan, well_known=False)
    f = summarise([SEEN, SEEN, SEEN, outside, at_bound, lost, lacking])
    assert (f["determined"], f["outside"], f["coverage"]) == (4, 1, 0.75)
    assert f["coverage_alone"] == 0.75
    assert (f["beside_a_bound"], f["coverage_beside_a_bound"]) == (1, 0.0)
    assert (f["at_bound"], f["coverage_at_bound"]) == (1, 1.0)
    assert (f["undetermined"], f["lacking"]) == (1, 1)
    assert (f["well_known"], f["lost"]) == (6, 1)
    assert f["root_mean_square_score"] == pytest.approx(math.sqrt((3 + 3.1**2) / 4))
    assert math.isnan(summarise([])["coverage"])


def test_weak_effects_are_weak() -> None:
    """The lobe or the roughness is at most 8 of its deviations, found anew at the truth.

    They change with the amplitude: by shot noise and gains of 0.5 %, hardly for such small ones.
    """
    for number in range(12):
        scene = weak_scene(np.random.default_rng((1, number)))
        relative = cramer_rao(scene)
        assert 1 / relative[[3, 4]].max() < 9.0
        assert scene.rung == "oren_nayar+torrance_sparrow"


def test_figures_of_some_scenes() -> None:
    """Plain types, and few outside: of 200 parameters 0.5 are expected, 7 in one run of 10^6."""
    outcomes = coverage.try_scenes(36)
    figures = json.loads(json.dumps(figures_of(outcomes)))
    assert figures["scenes"] == 36
    assert sum(count for *_, count in figures["rungs"]) == 36
    for when in ("plain", "chosen"):
        assert figures[when]["determined"] > 180
        assert figures[when]["outside"] < 7
        assert figures[when]["share_lost"] < coverage.TARGET_MISSED
    again = coverage.try_scene(5)
    assert again.plain == outcomes[5].plain


def test_it_prints_every_target(capsys: pytest.CaptureFixture[str]) -> None:
    figures = figures_of(coverage.try_scenes(2))
    coverage.report_plain(figures)
    coverage.report_chosen(figures, targets=True)
    out = capsys.readouterr().out
    assert out.count("target") == 7
    assert "99.0% to 99.9%" in out
