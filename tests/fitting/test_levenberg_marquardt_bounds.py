"""The general solver within bounds, and where columns of the Jacobian depend on each other."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import least_squares, lsq_linear

from tests.fitting.least_squares_functions import (
    Array,
    Function,
    complex_step,
    rosenbrock,
    slope,
    solve,
    wood,
)
from tvbrdf_fitting.solve.levenberg_marquardt import LeastSquaresError, levenberg_marquardt


@dataclass(frozen=True)
class Bounded:
    residual: Function
    jacobian: Function
    start: Array
    lower: Array
    upper: Array


def random_bounded(seed: int) -> Bounded:
    """Return a mildly nonlinear problem, bounded at random, columns of very different lengths."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 9))
    m = n + int(rng.integers(1, 20))
    a, b, y = rng.normal(size=(m, n)), rng.normal(size=(m, n)), 3 * rng.normal(size=m)
    a *= 10 ** rng.uniform(-2, 2, size=n)
    bend = rng.uniform(0, 0.3)
    unit = np.linalg.norm(a, axis=0) / math.sqrt(m)
    width = 1 / unit
    lower = np.where(rng.random(n) < 0.7, (rng.normal(size=n) - 0.5) * width, -np.inf)
    base = np.where(np.isfinite(lower), lower, 0.0)
    upper = np.where(rng.random(n) < 0.7, base + rng.exponential(size=n) * width, np.inf)
    return Bounded(
        lambda x: a @ x + bend * np.sin(b @ (x * unit)) - y,
        lambda x: a + bend * np.cos(b @ (x * unit))[:, None] * b * unit,
        rng.normal(size=n) * width,
        lower,
        upper,
    )


@pytest.mark.parametrize("seed", range(60))
def test_bounded_minima(seed: int) -> None:
    p = random_bounded(seed)
    solution = levenberg_marquardt(p.residual, p.jacobian, p.start, lower=p.lower, upper=p.upper)
    assert solution.converged, solution.reason
    assert ((solution.x >= p.lower) & (solution.x <= p.upper)).all()
    held, cosine = list(solution.held), slope(solution)
    free = [i for i in range(solution.x.size) if i not in held]
    # Karush, Kuhn, Tucker: no slope along what is free, outward slopes at the bounds that hold
    assert np.abs(cosine[free]).max(initial=0.0) < 1e-12
    at_lower = solution.x[held] == p.lower[held]
    assert (at_lower | (solution.x[held] == p.upper[held])).all()
    assert (np.where(at_lower, cosine[held], -cosine[held]) >= 0).all()
    inside = np.clip(p.start, p.lower, p.upper)
    shy = np.where(np.isfinite(p.upper), 1e-8 * (p.upper - np.maximum(p.lower, -1e3)), 1e-8)
    other = least_squares(
        p.residual,
        np.clip(inside, p.lower + np.abs(shy) / 2, p.upper - np.abs(shy) / 2),
        jac=p.jacobian,
        bounds=(p.lower, p.upper),
        x_scale="jac",
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
        max_nfev=1000,
    )
    # a reflective trust region stays inside the bounds: it comes as near as 1e-9 of the cost
    assert solution.cost <= other.cost * (1 + 1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_linear_problems_in_a_box_take_one_step(seed: int) -> None:
    rng = np.random.default_rng(seed)
    m, n = 40, 10
    a, y = rng.normal(size=(m, n)) @ np.diag(10.0 ** rng.uniform(-3, 3, n)), rng.normal(size=m)
    width = 0.1 / np.linalg.norm(a, axis=0)
    lower, upper = -rng.random(n) * width, rng.random(n) * width
    # zero has no length to share, so the first trust region is as long as the undamped step
    solution = levenberg_marquardt(
        lambda x: a @ x - y, lambda _: a, np.zeros(n), lower=lower, upper=upper, max_evaluations=2
    )
    expected = lsq_linear(a, y, (lower, upper), method="bvls", tol=1e-14).x
    # condition of the scaled columns, about 3, times rounding
    assert np.abs((solution.x - expected) / width).max() < 1e-12
    assert solution.held


def test_start_outside_is_moved_in_and_a_bound_is_left_again() -> None:
    seen: list[Array] = []

    def residual(x: Array) -> Array:
        seen.append(x.real)
        return rosenbrock(x)

    solution = levenberg_marquardt(
        residual, complex_step(rosenbrock), [-9.0, 9.0], lower=[-2.0, -1.0], upper=[2.0, 3.0]
    )
    assert solution.converged
    assert (np.array(seen) >= [-2, -1]).all()
    assert (np.array(seen) <= [2, 3]).all()
    assert solution.x == pytest.approx([1, 1], abs=1e-12)
    assert solution.held == ()


def test_rosenbrock_at_a_bound() -> None:
    # x0 at most 0.8: the other then follows the valley to 0.64
    solution = solve(rosenbrock, [-1.2, 1.0], upper=[0.8, np.inf])
    assert solution.converged
    assert solution.x[0] == 0.8
    assert solution.x[1] == pytest.approx(0.64, abs=1e-15)
    assert solution.held == (0,)
    assert solution.covariance()[0] == pytest.approx([0, 0])


def test_equal_bounds_fix_a_parameter() -> None:
    solution = solve(wood, [-3, -1, -3, -1], lower=[-5, 0.5, -5, -5], upper=[5, 0.5, 5, 5])
    reduced = solve(lambda x: wood(np.array([x[0], 0.5, x[1], x[2]])), [-3.0, -3.0, -1.0])
    assert solution.x[1] == 0.5
    assert 1 in solution.held
    assert solution.cost == pytest.approx(reduced.cost, rel=1e-12)


def test_everything_held() -> None:
    solution = solve(lambda x: x - 5, [0.0, 1.0], upper=[1.0, 2.0])
    assert solution.converged
    assert solution.x.tolist() == [1, 2]
    assert solution.held == (0, 1)
    assert "held" in solution.reason
    assert not solution.covariance().any()


# ---- rank


def test_two_equal_columns() -> None:
    t = np.linspace(0, 1, 30)

    def residual(x: Array) -> Array:
        data = np.exp(-2 * t) + 0.1 * np.cos(9 * t)
        return np.asarray(np.exp(-(x[0] + x[1]) * t) + x[2] - data)

    solution = solve(residual, [0.5, 0.2, 0.3])
    single = solve(lambda x: residual(np.array([x[0], 0.0, x[1]])), [0.7, 0.3])
    assert solution.converged
    assert solution.rank == 2
    assert "rank 2 of 3" in solution.reason
    assert solution.cost == pytest.approx(single.cost, rel=1e-13)
    assert solution.x[0] + solution.x[1] == pytest.approx(single.x[0], rel=1e-12)
    # the shortest steps share what the columns cannot tell apart
    assert solution.x[0] - solution.x[1] == pytest.approx(0.3, abs=1e-9)
    with pytest.raises(LeastSquaresError, match="2 combinations of 3"):
        solution.covariance()


def test_a_parameter_without_effect_stays() -> None:
    solution = solve(lambda x: rosenbrock(x[:2]) + 0 * x[2], [-1.2, 1.0, 7.0])
    assert solution.converged
    assert solution.x[:2] == pytest.approx([1, 1], abs=1e-12)
    assert solution.x[2] == 7
    assert "rank 2 of 3" in solution.reason


def test_a_parameter_whose_effect_comes_later() -> None:
    # the width of a lobe of amplitude 0 has no effect at the start
    t = np.linspace(-1, 1, 50)
    truth = 0.7 * np.exp(-4.0 * t**2)
    solution = solve(lambda x: x[0] * np.exp(-x[1] * t**2) - truth, [0.0, 1.0])
    assert solution.x == pytest.approx([0.7, 4.0], rel=1e-12)


def test_fewer_residuals_than_parameters() -> None:
    solution = solve(lambda x: np.array([x[0] * x[1] + x[2] - 3, x[1] - x[2]]), [1.0, 2.0, 0.5])
    assert solution.cost < 1e-28
    assert "rank 2 of 3" in solution.reason
