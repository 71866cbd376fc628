"""The compiled solver against numpy, against many starts, and against the other solvers."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tvbrdf_fitting import Observations
from tvbrdf_fitting.batch import fit_parameters
from tvbrdf_fitting.models import COLOURED, SURFACE, get_model
from tvbrdf_fitting.problem import FitError, Problem, make_problem
from tvbrdf_fitting.solve import separable
from tvbrdf_fitting.solve.separable import elementary, equations, nearby, products, search
from tvbrdf_fitting.solve.separable.layout import data_of, layout_of
from tvbrdf_fitting.solve.solvers import SOLVERS

Simulate = Callable[..., Observations]

FITTED = (
    SURFACE,
    COLOURED,
    "lambert+torrance_sparrow",
    "oren_nayar_short+torrance_sparrow",
    "oren_nayar_short(interreflection)+torrance_sparrow(coloured)",
    "lambert",
    "oren_nayar",
    "oren_nayar_short",
    "torrance_sparrow",
)
NOT_FITTED = (
    "dust",
    "oren_nayar+torrance_sparrow+torrance_sparrow",
    "lambert+oren_nayar",
    "oren_nayar+phong",
)


def random_scene(rng: np.random.Generator) -> tuple[list[float], float, int]:
    """Parameters of ON+TS, noise and step: also lobes that vanish or are narrower than a step."""
    kd = np.exp(rng.uniform(np.log(0.01), np.log(0.95), 3))
    sigma_d = rng.uniform(0, 1.2) * (rng.random() > 0.15)
    ks = np.exp(rng.uniform(np.log(0.01), np.log(20))) * (rng.random() > 0.1)
    sigma_s = np.exp(rng.uniform(np.log(0.006), np.log(1.2)))
    noise = float(np.exp(rng.uniform(np.log(1e-3), np.log(0.05))))
    return [*kd, sigma_d, ks, 1 / sigma_s], noise, int(rng.choice([3, 8, 30]))


def searched(problem: Problem) -> products.Scan:
    """Return what the search makes of a problem."""
    layout = layout_of(problem.model)
    assert layout is not None
    vectors, f, q, radiance, weight = data_of(problem, layout)
    scan: products.Scan = products.new_scan(
        layout.form, vectors, f, q, radiance, elementary.squared(weight)
    )
    products.write_diffuse_products(scan)
    return scan


def descended(problem: Problem, starts: np.ndarray) -> float:
    """Lowest cost that the descent reaches from given coordinates."""
    layout = layout_of(problem.model)
    assert layout is not None
    lower, upper = separable.limits(problem, layout)
    scan = searched(problem)
    columns, costs = np.empty((3, len(scan.f))), []
    for start in starts:
        x = np.clip(start, lower, upper)
        costs.append(search.descend(x, scan, lower, upper, columns, 1e-11, 300)[0])
    return float(min(costs))


def test_exponential_is_exact_to_one_and_a_half_units() -> None:
    x = np.concatenate([np.linspace(0, 50, 20_001), np.geomspace(1e-300, 700, 5001)])
    got = np.array([elementary.exp_negative(v) for v in x])
    np.testing.assert_allclose(got, np.exp(-x), rtol=3.4e-16, atol=0)
    assert elementary.exp_negative(1e300) < 1e-300


@pytest.mark.parametrize("name", [SURFACE, COLOURED])
def test_normal_equations_are_those_of_the_model(simulate: Simulate, name: str) -> None:
    model = get_model(name)
    problem = make_problem(simulate(model.typical, name, noise=0.02, step=9), model, {}, {})
    layout = layout_of(model)
    assert layout is not None
    assert sorted(layout.where) == list(range(len(model.parameters)))
    internal = model.to_internal(model.typical * 1.1)
    x = internal[list(layout.where)]
    size = len(x)
    gradient, matrix, hessian = np.empty(size), np.empty((size, size)), np.empty((size, size))
    scan = searched(problem)
    columns = np.empty((3, len(scan.f)))

    def equations_at(x: np.ndarray) -> float:
        return float(equations.normal_equations(x, scan, False, columns, gradient, matrix, hessian))

    cost = equations_at(x)
    jacobian = problem.jacobian(internal)[:, list(layout.where)]
    residual = problem.residual(internal)
    # sums of some thousand products: relative errors of a few hundred units in the last place
    assert cost == pytest.approx(problem.cost(internal), rel=1e-13)
    np.testing.assert_allclose(gradient, jacobian.T @ residual, rtol=1e-10)
    np.testing.assert_allclose(matrix, jacobian.T @ jacobian, rtol=1e-10, atol=1e-9)
    alone = np.empty(size)
    assert equations.cost_and_gradient(x, scan, columns[0], alone) == pytest.approx(cost, rel=1e-14)
    np.testing.assert_allclose(alone, gradient, rtol=1e-10)
    # the full second derivatives, by differences of the gradient
    second = hessian.copy()
    for k in range(size):
        step, sides = 1e-6, []
        for sign in (1, -1):
            moved = x.copy()
            moved[k] += sign * step
            equations_at(moved)
            sides.append(gradient.copy())
        slope = (sides[0] - sides[1]) / (2 * step)
        np.testing.assert_allclose(second[:, k], slope, rtol=1e-5, atol=2e-3)


@pytest.mark.parametrize("name", [SURFACE, COLOURED])
@pytest.mark.parametrize("u", [-0.3, 0.9, 2.0, 3.8])
def test_polynomials_give_the_normal_equations(simulate: Simulate, name: str, u: float) -> None:
    model = get_model(name)
    problem = make_problem(simulate(model.typical, name, noise=0.02, step=3), model, {}, {})
    layout, scan = layout_of(model), searched(problem)
    assert layout is not None
    x = model.to_internal(model.typical * 1.1)[list(layout.where)]
    x[-1], size = u, len(x)
    exact = np.empty(size), np.empty((size, size)), np.empty((size, size))
    equations.normal_equations(x, scan, False, np.empty((3, len(scan.f))), *exact)
    us = np.array([u - 0.17, u + 0.2])  # the nearest width is as far as it can be
    near = nearby.new_nearby(len(us), len(scan.f))
    nearby._write_polynomials(near, 0, us[0], scan)
    lobe, slope, bend = np.empty((3, 5)), np.empty((3, 5)), np.empty((3, 5))
    nearby._write_products((u - us[0]) / nearby._REACH, near.products[0], lobe, slope, bend)
    found = np.empty(size), np.empty((size, size)), np.empty((size, size))
    nearby._write_equations(x, scan, lobe, slope, bend, np.empty(16), *found)
    scale = np.sqrt(np.diag(exact[1]))
    # errors beside what the data weigh: the polynomials' own, 1e-9 and more for each derivative
    whole = np.sqrt((scan.squares * scan.radiance**2).sum())
    np.testing.assert_allclose(found[0] / scale, exact[0] / scale, atol=1e-8 * whole)
    for ours, theirs in zip(found[1:], exact[1:], strict=True):
        np.testing.assert_allclose(
            ours / np.outer(scale, scale), theirs / np.outer(scale, scale), atol=1e-5
        )


@pytest.mark.parametrize("name", FITTED)
def test_agrees_with_the_paper_s_solver(simulate: Simulate, name: str) -> None:
    model = get_model(name)
    problem = make_problem(simulate(model.typical, name, noise=0.01, step=6), model, {}, {})
    assert separable.fits(problem)
    ours, theirs = separable.solve(problem), SOLVERS["paper"](problem)
    # MINPACK stops at relative steps of 1e-10, scaled by the parameters' effect
    np.testing.assert_allclose(ours.internal, theirs.internal, rtol=1e-6, atol=1e-8)
    assert problem.cost(ours.internal) <= problem.cost(theirs.internal) * (1 + 1e-12)


@pytest.mark.parametrize("name", NOT_FITTED)
def test_leaves_other_models_alone(simulate: Simulate, name: str) -> None:
    problem = make_problem(simulate([0.3] * 3, "lambert", step=20), get_model(name), {}, {})
    assert not separable.fits(problem)


def test_fixed_parameters_stay(simulate: Simulate) -> None:
    model = get_model(SURFACE)
    observations = simulate(model.typical, noise=0.01, step=6)
    fixed = {"sigma_d": 0.3, "kd_g": 0.45}
    problem = make_problem(observations, model, fixed, {})
    ours, theirs = separable.solve(problem), SOLVERS["trust_region"](problem)
    assert model.to_published(ours.internal)[[1, 3]].tolist() == [0.45, 0.3]
    np.testing.assert_allclose(ours.internal, theirs.internal, rtol=1e-4)
    everything = make_problem(observations, model, model.as_mapping(model.typical), {})
    np.testing.assert_allclose(
        model.to_published(separable.solve(everything).internal), model.typical
    )


def test_finds_what_forty_starts_find(simulate: Simulate) -> None:
    """200 scenes with vanishing, hidden and needle lobes, twelve lights to 120, up to 5 % noise."""
    rng = np.random.default_rng(11)
    model = get_model(SURFACE)
    worse = []
    for seed in range(200):
        truth, noise, step = random_scene(rng)
        observations = simulate(truth, noise=noise, seed=seed, step=step)
        problem = make_problem(observations.select(observations.sweep == 2), model, {}, {})
        starts = np.column_stack(
            [
                rng.uniform(0, 1, (40, 3)),
                rng.uniform(0, 2.25, 40),
                np.exp(rng.uniform(-4, 3, 40)),
                rng.uniform(problem.lower[5], problem.upper[5], 40),
            ]
        )
        cost = problem.cost(separable.solve(problem).internal)
        if cost > descended(problem, starts) * (1 + 1e-6):
            worse.append((truth, cost))
    assert not worse


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_noise_free_parameters_come_back(simulate: Simulate, scale: float) -> None:
    name = "lambert+torrance_sparrow"  # linear in its amplitudes, so a scale goes through exactly
    model = get_model(name)
    observations = simulate(model.typical, name, step=9)
    scaled = replace(
        observations,
        radiance=observations.radiance * scale,
        variance=observations.variance * scale**2,
    )
    problem = make_problem(scaled, model, {}, {})
    values = model.to_published(separable.solve(problem).internal)
    values[:4] /= scale
    np.testing.assert_allclose(values, model.typical, rtol=1e-8)


class TestBatch:
    """Many scans that share their directions."""

    def batch(self, simulate: Simulate, name: str = SURFACE) -> tuple[Observations, np.ndarray]:
        observations = simulate(get_model(name).typical, name, noise=0.01, step=9)
        rng = np.random.default_rng(5)
        noise = np.sqrt(observations.variance) * rng.normal(size=(20, *observations.radiance.shape))
        return observations, observations.radiance + noise

    @pytest.mark.parametrize("jobs", [1, 3])
    def test_is_what_single_fits_give(self, simulate: Simulate, jobs: int) -> None:
        model = get_model(SURFACE)
        observations, radiance = self.batch(simulate)
        light, view = observations.light_direction, observations.view_direction
        variance = np.where(observations.valid, observations.variance, np.inf)
        alike = fit_parameters(light, view, radiance, variance, jobs=jobs)
        each = fit_parameters(light, view, radiance, np.tile(variance, (20, 1, 1)), jobs=jobs)
        np.testing.assert_allclose(alike.values, each.values, rtol=1e-9)
        np.testing.assert_allclose(alike.chi_square, each.chi_square, rtol=1e-9)
        assert alike.converged.all()
        single = make_problem(replace(observations, radiance=radiance[7]), model, {}, {})
        found = SOLVERS["separable"](single).internal
        np.testing.assert_allclose(alike.values[7], model.to_published(found), rtol=1e-9)
        assert alike.chi_square[7] == pytest.approx(2 * single.cost(found), rel=1e-9)

    def test_layout_and_unused_values_do_not_matter(self, simulate: Simulate) -> None:
        observations, radiance = self.batch(simulate)
        light, view = observations.light_direction, observations.view_direction
        variance = np.where(observations.valid, observations.variance, np.inf)
        variance[50, 1] = np.inf
        whole = fit_parameters(light, view, radiance, variance)
        other = np.asfortranarray(radiance)
        other[:, 50, 1] = [np.nan, np.inf, 1e300, -9999.0] * 5
        for variances in (variance, np.asfortranarray(np.tile(variance, (20, 1, 1)))):
            found = fit_parameters(light, view, other, variances)
            np.testing.assert_allclose(found.values, whole.values, rtol=1e-9)

    @pytest.mark.parametrize("name", [SURFACE, COLOURED])
    def test_is_as_low_as_single_fits_everywhere(self, simulate: Simulate, name: str) -> None:
        """Scenes with vanishing, hidden and needle lobes that share directions and weights."""
        model, rng = get_model(name), np.random.default_rng(3)
        coloured = len(model.parameters) - 6
        observations = simulate(model.typical, name, noise=0.01, step=9)
        light, view = observations.light_direction, observations.view_direction
        noise = np.sqrt(observations.variance)
        scans = []
        for _ in range(150):
            truth, _, _ = random_scene(rng)
            truth[4:5] = truth[4] * np.exp(rng.uniform(-1, 1, coloured + 1))
            value = np.pi * model.evaluate(light, view, truth) * light[:, 2:]
            scans.append(value + noise * rng.normal(size=value.shape))
        variance = np.where(observations.valid, observations.variance, np.inf)
        batch = fit_parameters(light, view, np.array(scans), variance, name)
        for k, values in enumerate(scans):
            single = make_problem(replace(observations, radiance=values), model, {}, {})
            cost = single.cost(separable.solve(single).internal)
            assert batch.chi_square[k] == pytest.approx(2 * cost, rel=1e-9)
            reached = single.cost(model.to_internal(batch.values[k]))
            assert reached == pytest.approx(cost, rel=1e-9)

    def test_other_models_go_the_long_way(self, simulate: Simulate) -> None:
        name = "lambert+phong"
        observations, radiance = self.batch(simulate, name)
        variance = np.where(observations.valid, observations.variance, np.inf)
        light, view = observations.light_direction, observations.view_direction
        batch = fit_parameters(light, view, radiance[:3], variance, name)
        np.testing.assert_allclose(batch.values.mean(0), get_model(name).typical, rtol=0.01)

    def test_wrong_shapes_and_values_are_named(self, simulate: Simulate) -> None:
        observations, radiance = self.batch(simulate)
        light, view = observations.light_direction, observations.view_direction
        variance = observations.variance
        with pytest.raises(ValueError, match=r"radiance has shape .*, expected \(m, "):
            fit_parameters(light, view, radiance[0], variance)
        with pytest.raises(ValueError, match="variance has shape"):
            fit_parameters(light, view, radiance, variance[:-1])
        radiance[3, 4, 1] = np.nan
        with pytest.raises(ValueError, match=r"radiance\[3, 4, 1\] is nan; .*infinite variance"):
            fit_parameters(light, view, radiance, variance)
        with pytest.raises(FitError, match="0 usable values"):
            fit_parameters(light, view, radiance[:1], np.full_like(variance, np.inf))


def test_loading_the_solver_loads_no_general_optimiser() -> None:
    """A fitter's start is a part of a run's."""
    code = (
        "import sys, tvbrdf_fitting.fit; from tvbrdf_fitting.solve import separable;"
        "separable.compile_all(); print('scipy.optimize' in sys.modules)"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout == "False\n"


def test_a_given_start_leads_into_its_own_valley(simulate: Simulate) -> None:
    model = get_model(SURFACE)
    observations = simulate([0.3, 0.5, 0.7, 0.3, 0.05, 40.0], noise=0.002, step=3)
    best = SOLVERS["separable"](make_problem(observations, model, {}, {}))
    near = model.as_mapping(model.to_published(best.internal) * 1.05)
    again = SOLVERS["separable"](make_problem(observations, model, {}, near))
    np.testing.assert_allclose(again.internal, best.internal, rtol=1e-7)
    assert again.evaluations < 10
    # only a width far off is given: the other coordinates are its best ones, then all descend
    wide = make_problem(observations, model, {}, {"inverse_sigma_s": 0.8})
    assert wide.cost(SOLVERS["separable"](wide).internal) >= wide.cost(best.internal) * (1 - 1e-12)


def test_stale_compiled_code_is_removed_before_it_is_read(tmp_path: Path) -> None:
    """numba would read what an old index names, and fail where that has moved."""
    where = (
        "from tvbrdf_fitting.solve import separable; from tvbrdf_fitting.solve.separable import "
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}

    def run(code: str) -> str:
        command = [sys.executable, "-c", where + code]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    folder = Path(run("search; print(search.solve.stats.cache_path)"))
    folder.mkdir(parents=True, exist_ok=True)
    stale, new = folder / "search.solve-1.py311.nbi", folder / "search.refine-1.py311.nbi"
    for index in (stale, new):
        index.write_bytes(b"no index")
    os.utime(stale, (1, 1))
    run("search; separable.forget_stale_code()")
    assert not stale.exists()
    assert new.exists()
