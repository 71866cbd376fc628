"""The simplest model that explains a scan: simulated truths, real materials, and time series.

Rates of wrong choices are counted over scenes with fixed seeds; the rate stated is the upper end
of a one-sided 99 % binomial interval (Clopper and Pearson).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

from tvbrdf_fitting import CommonErrors, FitError, Observations, get_model
from tvbrdf_fitting.choice.choose import ModelChoice, choose_for_series, choose_model
from tvbrdf_fitting.choice.ladder import DEFAULT_LADDER, Candidate, as_ladder, find
from tvbrdf_fitting.choice.rule import DECISIVE, HIGHLIGHT, MATTERS, SWITCH
from tvbrdf_fitting.time_varying import DryingPaint

Simulate = Callable[..., Observations]
Material = Callable[[str], Observations]

LAMBERT = "lambert"
ROUGH = "oren_nayar"
LOBE = "torrance_sparrow"
COLOURED = "torrance_sparrow(coloured)"
TRUTHS: dict[str, tuple[str, list[float]]] = {
    "matte": (LAMBERT, [0.3, 0.5, 0.7]),
    "rough": (ROUGH, [0.3, 0.5, 0.7, 0.4]),
    "glossy": (f"{LAMBERT}+{LOBE}", [0.3, 0.5, 0.7, 0.3, 8.0]),
    "satin": (f"{ROUGH}+{LOBE}", [0.3, 0.5, 0.7, 0.4, 0.8, 6.0]),
    "broad": (f"{ROUGH}+{LOBE}", [0.6, 0.55, 0.5, 0.9, 0.15, 2.0]),
    "coloured": (f"{ROUGH}+{COLOURED}", [0.3, 0.5, 0.7, 0.4, 0.4, 0.8, 1.0, 6.0]),
    "metal": (f"{LAMBERT}+{COLOURED}", [0.03, 0.02, 0.05, 1.0, 2.0, 4.0, 12.0]),
}
NOISES = (0.002, 0.01, 0.03)
SCENES = 15
"""Of each truth and noise: 7 x 3 x 15 = 315 in all."""
GAINS, OFFSET_DEG = 0.005, 0.02


def choose(observations: Observations, **options: Any) -> ModelChoice:
    """Choose with the fast solver, and check what holds for every choice."""
    choice = choose_model(observations, **({"method": "separable"} | options))
    check(choice)
    return choice


def check(choice: ModelChoice) -> None:
    plain = json.loads(json.dumps(choice.as_dict(), allow_nan=False))
    assert plain["model"] == choice.model
    assert choice.model in choice.reason
    kept = [rung for rung in choice.rungs if not rung.rejected]
    assert [rung.model for rung in kept] == [choice.model]
    assert kept[0].chi_square == choice.result.chi_square
    assert kept[0].parameters == len(choice.result.values) - len(choice.result.fixed)
    assert choice.solve_time_s == pytest.approx(sum(r.solve_time_s for r in choice.rungs))
    assert 1 <= choice.effective_values <= choice.values
    assert choice.weights[choice.model] == max(choice.weights.values())
    assert sum(choice.weights.values()) == pytest.approx(1.0)
    for name, deviation in zip(
        choice.result.parameter_names, choice.standard_deviations, strict=True
    ):
        stated = choice.result.standard_deviation(name)
        assert np.isfinite(deviation) == np.isfinite(stated)
        assert (deviation == 0) == (stated == 0)


def specular(model: str) -> bool:
    return "torrance" in model


def disturbed(simulate: Simulate, name: str, noise: float, seed: int) -> Observations:
    """A scan with gains and light offsets that its variances know nothing of."""
    rng = np.random.default_rng(seed)
    model, values = TRUTHS[name]
    gains = 1 + GAINS * rng.normal(size=(4, 3))
    offsets = OFFSET_DEG * rng.normal(size=3)
    return simulate(
        values, model, noise=noise, step=6, seed=seed, gains=gains, light_offset_deg=offsets
    )


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def random_material(rng: np.random.Generator) -> tuple[str, list[float]]:
    """A model with published values: rough or not; no lobe, a shared or a coloured one."""
    model, values = LAMBERT, [log_uniform(rng, 0.02, 0.9) for _ in range(3)]
    if rng.random() < 0.5:
        model = ROUGH
        values.append(float(np.sqrt(rng.uniform(0.02, 0.8))))
    lobe = ("", LOBE, COLOURED)[rng.integers(3)]
    if lobe:
        model += f"+{lobe}"
        ks = log_uniform(rng, 0.01, 20.0)
        values += [ks] if lobe == LOBE else [ks * log_uniform(rng, 0.5, 2.0) for _ in range(3)]
        values.append(1 / log_uniform(rng, 0.01, 0.8))
    return model, values


def at_most(wrong: int, scenes: int) -> float:
    interval = binomtest(wrong, scenes, alternative="less").proportion_ci(0.99)
    return float(interval.high)


class TestSimulatedTruth:
    @pytest.mark.parametrize("name", TRUTHS)
    @pytest.mark.parametrize("noise", NOISES)
    def test_the_truth_is_found(self, simulate: Simulate, name: str, noise: float) -> None:
        model, values = TRUTHS[name]
        choice = choose(simulate(values, model, noise=noise, step=4))
        assert choice.model == model
        kept = next(rung for rung in choice.rungs if not rung.rejected)
        assert kept.explains
        assert not kept.undetermined
        # noise is independent: nearly all values count
        assert choice.effective_values > 0.8 * choice.values

    def test_rate_of_wrong_choices(self, simulate: Simulate) -> None:
        """Over- or under-fitted: none of 315, so at most 1.5 % (99 %)."""
        wrong = []
        for model, values in TRUTHS.values():
            for noise in NOISES:
                for seed in range(SCENES):
                    scan = simulate(values, model, noise=noise, step=8, seed=100 + seed)
                    chosen = choose_model(scan, method="separable").model
                    wrong += [(model, noise, seed, chosen)] if chosen != model else []
        assert at_most(len(wrong), len(TRUTHS) * len(NOISES) * SCENES) <= 0.015, wrong

    def test_rate_over_random_materials(self, simulate: Simulate) -> None:
        """No scene of 150 over-fitted (at most 3.1 %), and few under-fitted (99 %).

        Albedos, lobes and noise over one to three decades, so that some lobes, and differences
        of colours, are below what can be seen.
        """
        over: list[object] = []
        under: list[object] = []
        for seed in range(150):
            rng = np.random.default_rng((7, seed))
            model, values = random_material(rng)
            noise, step = log_uniform(rng, 0.002, 0.02), int(rng.integers(5, 9))
            scan = simulate(values, model, noise=noise, step=step, seed=seed)
            choice = choose_model(scan, method="separable")
            richness = len(choice.result.values) - len(choice.result.fixed)
            if choice.model != model:
                (over if richness >= len(values) else under).append((seed, model, choice.model))
        assert at_most(len(over), 150) <= 0.031, over
        assert at_most(len(under), 150) <= 0.08, under

    def test_two_steps_at_once(self, simulate: Simulate) -> None:
        """Neither a shared broad lobe nor roughness explains this: the climb must go on."""
        model, values = f"{LAMBERT}+{COLOURED}", [0.05, 0.03, 0.06, 3.5, 2.2, 2.6, 1.6]
        assert choose(simulate(values, model, noise=0.01, step=6)).model == model

    def test_dominant_broad_lobe(self, simulate: Simulate) -> None:
        """Not explained within the noise, and no highlight, but most of what is seen."""
        values = [0.1, 0.08, 0.02, 0.7, 5.6, 8.0, 5.3, 1.7]
        gains = 1 + 0.02 * np.random.default_rng(0).normal(size=(4, 3))
        model = f"{ROUGH}+{COLOURED}"
        choice = choose(simulate(values, model, noise=0.002, step=6, gains=gains))
        kept = next(rung for rung in choice.rungs if not rung.rejected)
        assert not kept.explains
        assert kept.highlight < HIGHLIGHT
        assert specular(choice.model)

    @pytest.mark.parametrize("name", ["matte", "rough", "satin", "metal"])
    def test_known_common_errors_are_no_structure(self, simulate: Simulate, name: str) -> None:
        errors = CommonErrors(OFFSET_DEG, GAINS)
        for seed in range(5):
            choice = choose(disturbed(simulate, name, 0.005, seed), common_errors=errors)
            assert choice.model == TRUTHS[name][0]

    @pytest.mark.parametrize("name", ["matte", "rough"])
    def test_unknown_common_errors_make_no_lobe(self, simulate: Simulate, name: str) -> None:
        for seed in range(5):
            assert choose(disturbed(simulate, name, 0.005, seed)).model == TRUTHS[name][0]

    def test_facets_with_a_long_tail(self, simulate: Simulate) -> None:
        model = "oren_nayar+cook_torrance(ggx)"
        scan = simulate([0.3, 0.5, 0.7, 0.4, 1.0, 0.15, 1.5], model, noise=0.005, step=6)
        choice = choose(scan)
        assert choice.model == Candidate(model, (("eta", 1.5),)).label
        assert choice.result.fixed == ("eta",)
        assert choice.result.value("alpha") == pytest.approx(0.15, rel=0.02)

    def test_two_lobes(self, simulate: Simulate) -> None:
        model = f"{LAMBERT}+{COLOURED}+{COLOURED}"
        values = [0.1, 0.1, 0.1, 0.1, 0.3, 0.6, 4.0, 2.0, 3.0, 4.0, 20.0]
        choice = choose(simulate(values, model, noise=0.005, step=6))
        assert choice.model == model

    def test_stray_values(self, simulate: Simulate) -> None:
        model, values = TRUTHS["satin"]
        scan = simulate(values, model, noise=0.005, step=12)
        stray = np.random.default_rng(0).random(scan.radiance.shape) < 0.1
        spoilt = replace(scan, radiance=scan.radiance * (1 + stray))
        assert choose(spoilt, loss="cauchy").model == model

    @pytest.mark.parametrize("metric", ["cosine_weighted", "relative", "log"])
    def test_metrics_agree_where_noise_explains(self, simulate: Simulate, metric: str) -> None:
        model, values = TRUTHS["satin"]
        assert choose(simulate(values, model, noise=0.005, step=6), metric=metric).model == model

    def test_dead_channel(self, simulate: Simulate) -> None:
        model, values = TRUTHS["glossy"]
        scan = simulate(values, model, noise=0.005, step=6)
        alive = scan.valid & np.array([True, False, True])
        choice = choose_model(replace(scan, valid=alive), method="separable")
        assert choice.model == model
        assert not next(rung for rung in choice.rungs if not rung.rejected).undetermined

    def test_stated_noise_too_small(self, simulate: Simulate) -> None:
        """A variance five times as large as stated: the criterion estimates it."""
        for name in ("matte", "satin"):
            model, values = TRUTHS[name]
            scan = simulate(values, model, noise=0.01, step=6)
            choice = choose(replace(scan, variance=scan.variance / 5))
            assert choice.model == model
            kept = next(rung for rung in choice.rungs if not rung.rejected)
            assert not kept.explains
            assert kept.noise == pytest.approx(5**0.5, rel=0.05)


class TestCost:
    def test_climb_is_short(self, simulate: Simulate) -> None:
        """Explained and without structure: one more effect, or another shape of lobe, is tried."""
        for name, most in (("matte", 3), ("rough", 4), ("satin", 6), ("coloured", 7)):
            model, values = TRUTHS[name]
            choice = choose(simulate(values, model, noise=0.01, step=6, seed=1))
            assert len(choice.rungs) <= most, [rung.model for rung in choice.rungs]
            assert all(rung.solve_time_s > 0 for rung in choice.rungs)


class TestRealMaterials:
    """Smooth curves of RGL's materials, at 0.1 % of white noise: no model explains them."""

    @staticmethod
    def at_noise(observations: Observations, deviation: float = 1e-3) -> Observations:
        variance = np.full(observations.radiance.shape, deviation**2)
        return replace(observations, variance=variance)

    @pytest.mark.parametrize("metric", ["radiance", "log"])
    @pytest.mark.parametrize("deviation", [1e-3, 1e-2])
    def test_matte_paper(self, real_material: Material, metric: str, deviation: float) -> None:
        scan = self.at_noise(real_material("paper_white"), deviation)
        choice = choose(scan, metric=metric)
        assert not specular(choice.model)
        assert "highlight" in choice.reason

    @pytest.mark.parametrize("metric", ["radiance", "log"])
    @pytest.mark.parametrize("name", ["vch_golden_yellow", "cc_ibiza_sunset", "satin_rosaline"])
    def test_glossy(self, real_material: Material, name: str, metric: str) -> None:
        choice = choose(self.at_noise(real_material(name)), metric=metric)
        lobes = choice.model.split("+")[1:]
        assert 1 <= len(lobes) <= 2
        assert all("coloured" in lobe for lobe in lobes)
        assert not choice.result.undetermined
        # residuals of a wrong model go together
        assert choice.effective_values < 0.2 * choice.values
        # one shared lobe of Gaussian facets leaves at least twice the error
        errors = {rung.model: rung.error for rung in choice.rungs}
        assert errors[choice.model] < 0.5 * errors[f"{LAMBERT}+{LOBE}"]


class TestSeries:
    """Choices over a time series, scan by scan and together."""

    @staticmethod
    def drying(simulate: Simulate, *, scans: int = 12, ks_dry: float = 0.0) -> list[Observations]:
        paint = DryingPaint(
            kd_surface=(0.5, 0.5, 0.5),
            kd_paint=(0.1, 0.2, 0.6),
            ks_wet=1.5,
            ks_dry=ks_dry,
            sigma_s_wet=0.08,
            sigma_s_dry=0.3,
            rate_per_min=0.25,
        )
        series = []
        for scan in range(scans):
            values = list(paint.parameters_at(180.0 * scan).values())
            series.append(simulate(values, paint.model, noise=0.01, step=6, seed=scan))
        return series

    @staticmethod
    def changes(choices: Sequence[ModelChoice]) -> int:
        return sum(one.model != other.model for one, other in pairwise(choices))

    @pytest.mark.parametrize("ks_dry", [0.0, 0.01, 0.1])
    def test_drying_paint_together(self, simulate: Simulate, ks_dry: float) -> None:
        choices = choose_for_series(self.drying(simulate, ks_dry=ks_dry), method="separable")
        assert {choice.model for choice in choices} == {f"{LAMBERT}+{LOBE}"}
        for choice in choices:
            check(choice)
            assert "together" in choice.reason
        if not ks_dry:
            # the lobe has gone, and the model says so instead of changing
            assert "inverse_sigma_s" in choices[-1].result.undetermined

    @pytest.mark.parametrize("ks_dry", [0.0, 0.01, 0.1])
    def test_drying_paint_scan_by_scan(self, simulate: Simulate, ks_dry: float) -> None:
        series = self.drying(simulate, ks_dry=ks_dry)
        choices = choose_for_series(series, mode="per_scan", method="separable")
        assert choices[0].model == f"{LAMBERT}+{LOBE}"
        assert self.changes(choices) <= 1
        if not ks_dry:
            assert choices[-1].model == LAMBERT

    @pytest.mark.parametrize("ks", [0.007, 0.008, 0.009, 0.01])
    def test_no_flicker_at_the_noise(self, simulate: Simulate, ks: float) -> None:
        """A lobe of 4 to 7 deviations: alone the choice changes again and again, here once."""
        values = [0.3, 0.5, 0.7, ks, 8.0]
        series = [
            simulate(values, f"{LAMBERT}+{LOBE}", noise=0.02, step=12, seed=seed)
            for seed in range(60)
        ]
        alone = [choose_model(scan, method="separable") for scan in series]
        assert self.changes(alone) > 8
        held = choose_for_series(series, mode="per_scan", method="separable")
        assert self.changes(held) <= 1
        together = choose_for_series(series[:20], method="separable")
        assert self.changes(together) == 0

    def test_together_sees_more_than_each(self, simulate: Simulate) -> None:
        values = [0.3, 0.5, 0.7, 0.008, 8.0]
        model = f"{LAMBERT}+{LOBE}"
        series = [simulate(values, model, noise=0.02, step=12, seed=s) for s in range(20)]
        assert choose_for_series(series, method="separable")[0].model == model

    def test_clear_evidence_changes_the_choice(self, simulate: Simulate) -> None:
        matte, glossy = (
            simulate(TRUTHS[name][1], TRUTHS[name][0], noise=0.01, step=6)
            for name in ("matte", "glossy")
        )
        assert choose(glossy, previous=LAMBERT).model == f"{LAMBERT}+{LOBE}"
        assert choose(matte, previous=f"{LAMBERT}+{LOBE}").model == LAMBERT
        assert choose(matte, previous="ON+TS").model == LAMBERT

    def test_previous_stays_in_doubt(self, simulate: Simulate) -> None:
        values = [0.3, 0.5, 0.7, 0.01, 8.0]
        stayed = 0
        for seed in range(10):
            scan = simulate(values, f"{LAMBERT}+{LOBE}", noise=0.02, step=12, seed=seed)
            criteria = {r.model: r.criterion for r in choose(scan).rungs}
            gain = criteria[LAMBERT] - criteria[f"{LAMBERT}+{LOBE}"]
            if DECISIVE < gain < SWITCH:
                stayed += 1
                choice = choose(scan, previous=LAMBERT)
                assert choice.model == LAMBERT
                assert "previous" in choice.reason
        assert stayed > 3

    def test_one_scan_is_like_none_before(self, simulate: Simulate) -> None:
        scan = self.drying(simulate, scans=1)
        alone = choose(scan[0])
        for mode in ("joint", "per_scan"):
            series = choose_for_series(scan, mode=mode, method="separable")
            assert series[0].model == alone.model
            np.testing.assert_array_equal(series[0].result.values, alone.result.values)


class TestRequests:
    def test_a_sequence_is_fitted_whole(self, simulate: Simulate) -> None:
        scan = simulate([0.3, 0.5, 0.7], LAMBERT, noise=0.01, step=12)
        ladder = ("ON+TS", ROUGH, LAMBERT)
        choice = choose(scan, ladder=ladder)
        assert [rung.model for rung in choice.rungs] == list(ladder)
        assert choice.model == LAMBERT

    def test_own_graph(self, simulate: Simulate) -> None:
        model, values = TRUTHS["satin"]
        scan = simulate(values, model, noise=0.01, step=12)
        choice = choose(scan, ladder={ROUGH: ["oren_nayar+phong"], "oren_nayar+phong": ["ON+TS"]})
        assert choice.model == "ON+TS"

    def test_confounded_parameters_count_twice(self, simulate: Simulate) -> None:
        """A free index can't be told from Ks, so that a determined rung as good is kept."""
        model = "lambert+cook_torrance(ggx)"
        scan = simulate([0.3, 0.5, 0.7, 1.0, 0.1, 1.5], model, noise=0.01, step=12)
        choice = choose(scan, ladder=(LAMBERT, Candidate(model, (("eta", 1.5),)), model))
        assert choice.model == f"{model} with eta = 1.5"
        free = next(rung for rung in choice.rungs if rung.model == model)
        assert "eta" in free.undetermined
        # but it is kept where the rest is far worse
        assert choose(scan, ladder=(LAMBERT, model)).model == model

    def test_rungs_that_cannot_be_fitted(self, simulate: Simulate) -> None:
        # anisotropy can't be seen with all lights in one plane
        scan = simulate([0.3, 0.5, 0.7], LAMBERT, noise=0.01, step=12)
        choice = choose(scan, ladder=("lambert+ward(anisotropic)", LAMBERT))
        assert choice.model == LAMBERT
        assert "cannot be fitted" in choice.rungs[0].rejected
        with pytest.raises(FitError, match=r"no model of the ladder can be fitted; .*directions"):
            choose_model(scan, ladder=["lambert+ward(anisotropic)"])

    def test_nothing_to_fit(self, simulate: Simulate) -> None:
        scan = simulate([0.3, 0.5, 0.7], LAMBERT, step=12)
        with pytest.raises(FitError, match=r"no model of the ladder.*0 usable values"):
            choose_model(replace(scan, valid=np.zeros_like(scan.valid)))

    def test_wrong_requests(self, simulate: Simulate) -> None:
        scan = simulate([0.3, 0.5, 0.7], LAMBERT, step=30)
        with pytest.raises(ValueError, match="unknown model 'paint'"):
            choose_model(scan, ladder=["paint"])
        with pytest.raises(ValueError, match="no rungs"):
            choose_model(scan, ladder=[])
        with pytest.raises(ValueError, match=r"'phong' is no rung of the ladder: lambert, "):
            choose_model(scan, previous="phong")
        with pytest.raises(ValueError, match=r"unknown mode 'each'; known modes: joint, per_scan"):
            choose_for_series([scan], mode="each")  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="no scans"):
            choose_for_series([])
        with pytest.raises(ValueError, match="has no parameter 'eta'"):
            choose_model(scan, ladder=[Candidate(LAMBERT, (("eta", 1.5),))])
        with pytest.raises(FitError, match="unknown metric 'colour'"):
            choose_model(scan, metric="colour")


class TestLadder:
    def test_rungs_exist_and_grow(self) -> None:
        for candidate, richer in DEFAULT_LADDER.items():
            assert get_model(candidate.model).name == candidate.model
            for other in richer:
                assert other in DEFAULT_LADDER
                assert other.size >= candidate.size

    def test_all_is_reached_from_lambert(self) -> None:
        reached, waiting = set(), [next(iter(DEFAULT_LADDER))]
        assert waiting[0].model == LAMBERT
        while waiting:
            candidate = waiting.pop()
            reached.add(candidate)
            waiting += [c for c in DEFAULT_LADDER[candidate] if c not in reached]
        assert reached == set(DEFAULT_LADDER)

    def test_labels_lead_back(self) -> None:
        for candidate in DEFAULT_LADDER:
            assert find(DEFAULT_LADDER, candidate.label) == candidate
        assert find(DEFAULT_LADDER, "ON+TS").model == "oren_nayar+torrance_sparrow"

    def test_names_of_a_graph(self) -> None:
        ladder = as_ladder({LAMBERT: ["ON+TS"]})
        assert ladder == {Candidate(LAMBERT): (Candidate("ON+TS"),), Candidate("ON+TS"): ()}

    def test_held_in_every_lobe(self) -> None:
        two = Candidate("lambert+cook_torrance+cook_torrance", (("eta", 1.5),))
        assert two.fixed() == {"eta": 1.5, "eta_2": 1.5}
        assert two.size == 3 + 2 * 2

    def test_thresholds(self) -> None:
        assert 0 < MATTERS < HIGHLIGHT < 1 < DECISIVE < SWITCH
