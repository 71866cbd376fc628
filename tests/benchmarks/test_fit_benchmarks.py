"""The benchmarks of the fit are fair: peers solve our problem, references are kept as found."""

from __future__ import annotations

import itertools
import math
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import fit_optimum
from benchmarks.fit_optimum import Outcome, Reference, append_cache, digest_of, read_cache, starts
from benchmarks.fit_peers import contenders, missing, reference
from benchmarks.fit_residuals import Residuals
from benchmarks.fit_scenes import HARD, TRUE, WRONGS, hard_scenes, make_scene
from benchmarks.fit_speed import a_scan
from benchmarks.fit_starts import summary
from benchmarks.fit_timing import take_turns
from tvbrdf_fitting.models import SURFACE, get_model
from tvbrdf_fitting.problem import make_problem
from tvbrdf_fitting.solve.solvers import SOLVERS

SATIN = (0.3, 0.5, 0.7, 0.4, 0.8, 6.0)
FOUND = Reference("abc", (2.0, 1.0, 3.0), (0.5, 0.2, 1e9), 1.5, 0.25)


@pytest.fixture(scope="module")
def residuals() -> Residuals:
    return Residuals(make_problem(a_scan(SATIN, 0), get_model(SURFACE), {}, {}))


def test_the_scan_is_that_of_the_target(residuals: Residuals) -> None:
    assert residuals.problem.value_count == 4 * 336 * 3
    assert len(residuals.problem.free) == 6


@pytest.mark.parametrize(
    "x",
    [
        [0.31, 0.5, 0.7, 0.16, 0.8, 1.8],
        [0.0, 0.5, -0.1, -0.02, -0.3, 5.0],  # where an unbounded peer may step
        [2.0, 0.01, 0.3, 2.2, 30.0, -0.4],
    ],
)
def test_peers_get_the_models_residuals_and_derivatives(
    residuals: Residuals, x: list[float]
) -> None:
    at, problem = np.array(x), residuals.problem
    value, jacobian = problem.residual(at), problem.jacobian(at)
    near = {"rtol": 1e-11, "atol": 1e-11 * np.abs(value).max()}
    np.testing.assert_allclose(residuals.residual(at), value, **near)
    np.testing.assert_allclose(residuals.compiled_residual(at), value, **near)
    size = {"rtol": 1e-11, "atol": 1e-11 * np.abs(jacobian).max()}
    np.testing.assert_allclose(residuals.jacobian(at), jacobian, **size)
    np.testing.assert_allclose(residuals.compiled_jacobian(at), jacobian, **size)


@pytest.mark.filterwarnings("default")  # of other people's libraries
def test_every_peer_that_is_there_finds_the_optimum_of_an_easy_scan(residuals: Residuals) -> None:
    best = residuals.problem.cost(SOLVERS["separable"](residuals.problem).internal)
    careful = [c for c in contenders(residuals) if c.careful]
    names = {c.peer.split()[0] for c in careful}
    assert names == {"scipy", "lmfit", "pyceres", "optimistix"} - set(missing())
    for contender in (reference(residuals), *careful):
        cost = residuals.cost(contender.run(residuals.start))
        assert cost == pytest.approx(best, rel=1e-9), contender


def test_a_peer_that_is_not_installed_is_skipped_with_how_to_get_it(
    residuals: Residuals, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("lmfit", "pyceres", "optimistix"):
        monkeypatch.setitem(sys.modules, name, None)  # importing it fails
    assert set(missing()) == {"lmfit", "pyceres", "optimistix"}
    assert all("pip install 'tvbrdf[bench]'" in reason for reason in missing().values())
    assert {c.peer.split()[0] for c in contenders(residuals)} == {"scipy"}


def test_an_answer_outside_the_bounds_is_none(residuals: Residuals) -> None:
    x = residuals.start.copy()
    assert math.isfinite(residuals.cost(x))
    x[3] = -1e-3
    assert residuals.cost(x) == math.inf


@pytest.mark.parametrize("kind", [TRUE, *WRONGS])
def test_scenes_are_made_again_by_their_keys(kind: str) -> None:
    for key in (f"random 5 {kind}", f"hard hidden peak|0.005|{kind}"):
        one, other = make_scene(key), make_scene(key)
        np.testing.assert_array_equal(one.observations.radiance, other.observations.radiance)
        assert (one.truth is not None) == (kind == TRUE)
    different = [make_scene(f"random 5 {k}").observations for k in (TRUE, *WRONGS)]
    sums = {float(o.radiance.sum()) for o in different}
    assert len(sums) == len(different)


def test_every_hard_scene_can_be_fitted() -> None:
    keys = [*hard_scenes((TRUE,))]
    assert len(keys) == len(HARD) * 4
    for key in keys[2::4]:
        problem, truth, noise_free = fit_optimum.problem_of(key)
        assert noise_free == ("zeros" in key)
        assert math.isfinite(problem.cost(SOLVERS["separable"](problem).internal))
        if truth is not None:
            # half the squares of as many normal numbers, to 6 deviations
            n = problem.value_count
            assert problem.cost(truth) == pytest.approx(n / 2, abs=6 * math.sqrt(n / 2)), key


def test_starts_are_stratified_and_within_the_bounds() -> None:
    problem, _, _ = fit_optimum.problem_of("hard dead blue|0.005|true")
    points = np.array([*starts(problem, np.random.default_rng(0))])
    assert (points >= problem.lower).all()
    assert (points <= problem.upper).all()
    low, high = problem.lower[5], problem.upper[5]
    strata = np.floor((points[:, 5] - low) / (high - low) * len(points))
    assert sorted(strata.tolist()) == [*range(len(points))]
    assert (points[:, 0] == problem.values[0]).all()  # not measured
    costs = [problem.cost(x) for x in points]
    assert np.median(costs[::2]) < np.median(costs[1::2])  # the best amplitudes help


def test_a_descent_ends_lower_than_it_began() -> None:
    problem, truth, _ = fit_optimum.problem_of("hard ten lights|0.005|true")
    assert truth is not None
    cost, lobe = fit_optimum.descend(problem, truth)
    assert 0 < cost < problem.cost(truth)
    assert lobe == pytest.approx(0.8, rel=0.1)


def outcome(cost: float, *, allowed: float = 1e-6) -> Outcome:
    return Outcome("random 1 true", cost, 1e-4, allowed, 10.0, FOUND)


def test_what_counts_as_the_optimum() -> None:
    assert outcome(1.0).within
    assert outcome(1.0 + 9e-7).within
    assert not outcome(1.0 + 2e-6).within
    assert outcome(0.9).better
    assert not outcome(1.0 - 9e-7).better
    assert outcome(2.0).truth_is_lower
    assert outcome(1.0 + 2e-6).excess == pytest.approx(2e-6)
    unseen = replace(FOUND, lobes=(0.5, 1e200, 0.1))
    far = replace(outcome(2.0), reference=unseen)
    assert not far.within
    assert far.within_in_sight
    figures = fit_optimum.summarise([outcome(1.0), outcome(2.0), far])
    assert (figures["within"], figures["within_in_sight"], figures["scenes"]) == (1, 2, 3)
    assert figures["missed"] == ["random 1 true"] * 2


@pytest.mark.parametrize(("failures", "count"), [(0, 2000), (3, 100), (5, 5)])
def test_bound_on_the_share_of_failures(failures: int, count: int) -> None:
    bound = fit_optimum.upper_bound(failures, count)
    if failures == count:
        assert bound == 1.0
        return
    # so few failures or fewer have a probability of 5 % at the bound
    terms = (
        math.comb(count, k) * bound**k * (1 - bound) ** (count - k) for k in range(failures + 1)
    )
    assert sum(terms) == pytest.approx(0.05, rel=1e-9)


def test_the_cache_gives_back_what_was_found(tmp_path: Path) -> None:
    path = tmp_path / "new" / "cache.jsonl"
    assert read_cache(path) == read_cache(None) == {}
    append_cache(path, [outcome(1.0)])
    lost = replace(FOUND, from_truth=math.inf)
    append_cache(path, [replace(outcome(1.0), key="random 2 true", reference=lost)])
    assert read_cache(path) == {"random 1 true": FOUND, "random 2 true": lost}
    path.write_text(path.read_text().replace("scenes 1", "scenes 0", 1) + '{"what": "cut o')
    assert read_cache(path) == {"random 2 true": lost}


def test_a_known_reference_is_used_for_its_own_data_only(monkeypatch: pytest.MonkeyPatch) -> None:
    key = "hard ten lights|0.005|true"
    problem, _, _ = fit_optimum.problem_of(key)
    known = replace(FOUND, digest=digest_of(problem))
    monkeypatch.setattr(fit_optimum, "look_up", lambda *_: FOUND)
    assert fit_optimum.try_scene(key, known).reference is known
    assert fit_optimum.try_scene(key, replace(known, digest="of others")).reference is FOUND
    assert fit_optimum.try_scene(key, None).reference is FOUND
    noisy = fit_optimum.try_scene(key, known)
    exact = fit_optimum.try_scene("hard ten lights|0|true", None)
    assert noisy.allowed == pytest.approx(1e-6 * 1.0)
    assert exact.allowed == pytest.approx(1e-6 * (1.0 + exact.half_freedom))


def test_shares_of_scenes_that_are_right() -> None:
    # generic start, then three random ones; the second scene is found by the third
    costs = np.array([[1.0, 1.0, 5.0, 5.0], [2.0, 9.0, 9.0, 1.0]])
    costs = np.concatenate([costs, np.full((2, 17), 9.0)], axis=1)
    row = summary(costs, np.full(costs.shape, 1e-3), np.array([1.0, 1.0]))
    assert row["generic"] == 0.5
    assert row["after"] == {1: 0.5, 5: 1.0, 20: 1.0}
    assert row["starts_for_all"] == 3
    assert row["all_starts_ms"] == pytest.approx(20.0)


def test_calls_take_turns_and_the_least_counts() -> None:
    order: list[str] = []
    clock = itertools.count()

    def call(name: str, seconds: float) -> None:
        order.append(name)
        end = time.perf_counter() + seconds * (2 if next(clock) % 2 else 1)
        while time.perf_counter() < end:
            pass

    times = take_turns(
        {"fast": lambda: call("fast", 2e-4), "slow": lambda: call("slow", 4e-3)}, rounds=4
    )
    turns = [name for name, _ in itertools.groupby(order[2:])]
    assert turns == ["fast", "slow"] * 4
    assert 2e-4 <= times.least("fast") <= times.rounds["fast"].max()
    ratio, low, high = times.ratio("slow", "fast")
    assert ratio == times.least("slow") / times.least("fast")
    assert low <= high
