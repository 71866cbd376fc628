"""The general solver: known minima, its end, units, models that are not defined everywhere."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.fitting.least_squares_functions import (
    KNOWN,
    Array,
    Function,
    Known,
    bard,
    brown_badly_scaled,
    brown_dennis,
    complex_step,
    freudenstein_roth,
    helical_valley,
    jennrich_sampson,
    powell_singular,
    rosenbrock,
    slope,
    solve,
    wood,
)
from tvbrdf_fitting.solve.levenberg_marquardt import LeastSquaresError, levenberg_marquardt

# from ten times as far: Beale's, Bard's and Box's functions then fall to infinity, and Jennrich's
# and Sampson's loses all digits of its data
FAR = {rosenbrock, freudenstein_roth, brown_badly_scaled, helical_valley, powell_singular}
STARTS = [(k, 1) for k in KNOWN]
STARTS += [(k, f) for k in KNOWN if k.residual in FAR | {wood, brown_dennis} for f in (10, 100)]


@pytest.mark.parametrize(
    ("known", "factor"), STARTS, ids=[f"{k.residual.__name__}-{f}" for k, f in STARTS]
)
def test_known_minima(known: Known, factor: int) -> None:
    solution = solve(known.residual, factor * np.array(known.start))
    assert solution.converged, solution.reason
    if known.squares:
        assert 2 * solution.cost == pytest.approx(known.squares, rel=5e-6)
        # rounding, 1e-16, of terms up to a hundred times as large as the residual
        assert np.abs(slope(solution)).max() < 1e-13
    else:
        # residuals vanish to rounding, that of 1e6 for Brown's badly scaled function
        size = 1e6 if known.residual is brown_badly_scaled else 1.0
        assert 2 * solution.cost < (1e-14 * size) ** 2


@pytest.mark.parametrize("residual", [freudenstein_roth, jennrich_sampson])
def test_singular_jacobian_at_the_minimum(residual: Function) -> None:
    known = next(k for k in KNOWN if k.residual is residual)
    solution = solve(residual, known.start)
    # a cost test, or Gauss-Newton steps, which are endless there, stall at 1e-8
    assert np.abs(slope(solution)).max() < 1e-14
    assert "rank 1 of 2" in solution.reason


def test_large_residual_is_followed_to_the_last_digit() -> None:
    # Gauss-Newton steps alone diverge from this minimum: the second derivatives are three times
    # the first ones squared
    def residual(x: Array) -> Array:
        return np.array([x[0], 1 + 1.5 * x[0] ** 2, x[1] - 3])

    solution = solve(residual, [0.4, 1.0])
    assert solution.converged
    assert abs(solution.x[0]) < 1e-14
    assert solution.x[1] == 3
    # a trust region alone halves its way down
    assert solution.evaluations < 20


# ---- the end of a search


def test_residual_zero() -> None:
    a = np.array([[2.0, 1.0], [1.0, 3.0], [0.0, 4.0]])
    solution = levenberg_marquardt(lambda x: a @ x, lambda _: a, [0.0, 0.0])
    assert (solution.converged, solution.reason) == (True, "the residual is zero")
    assert (solution.evaluations, solution.iterations) == (1, 1)
    exact = solve(rosenbrock, [-1.2, 1.0])
    assert exact.cost == 0
    assert exact.x.tolist() == [1, 1]


# Powell's answer tends to 0 and is never there
@pytest.mark.parametrize(
    "known",
    [k for k in KNOWN if k.residual is not powell_singular],
    ids=lambda k: k.residual.__name__,
)
def test_start_at_the_solution(known: Known) -> None:
    first = solve(known.residual, known.start)
    again = solve(known.residual, first.x)
    assert again.converged
    # one step to see that it does not shrink, and a second where that one was shorter by chance
    assert again.evaluations <= 4
    assert again.cost <= first.cost * (1 + 1e-12) + 1e-28
    assert again.x == pytest.approx(first.x, rel=1e-11, abs=1e-14)


def test_tolerance_ends_earlier() -> None:
    full, loose = (solve(bard, [1.0, 1.0, 1.0], tolerance=t) for t in (0.0, 1e-3))
    assert loose.evaluations < full.evaluations
    assert loose.reason == "the next step is within the tolerance"
    # Bates and Watts: what is left to gain is the square of it
    assert loose.cost <= full.cost * (1 + 1e-6)


def test_budget() -> None:
    for budget in range(1, 12):
        calls: list[Array] = []

        def residual(x: Array, calls: list[Array] = calls) -> Array:
            calls.append(x)
            return wood(x)

        solution = levenberg_marquardt(
            residual, complex_step(wood), [-3, -1, -3, -1], max_evaluations=budget
        )
        assert not solution.converged
        assert str(budget) in solution.reason
        assert solution.evaluations == len(calls) == budget


def test_counts() -> None:
    count = {"residual": 0, "jacobian": 0}

    def residual(x: Array) -> Array:
        count["residual"] += 1
        return bard(x)

    def jacobian(x: Array) -> Array:
        count["jacobian"] += 1
        return complex_step(bard)(x)

    solution = levenberg_marquardt(residual, jacobian, [1.0, 1.0, 1.0])
    assert solution.evaluations == count["residual"]
    assert solution.iterations == count["jacobian"]
    assert (solution.residual == bard(solution.x)).all()
    assert (solution.jacobian == complex_step(bard)(solution.x)).all()
    assert solution.cost == pytest.approx(0.5 * float(bard(solution.x) @ bard(solution.x)))


def test_wrong_derivatives_are_called_so() -> None:
    solution = levenberg_marquardt(bard, lambda x: -complex_step(bard)(x), [1.0, 1.0, 1.0])
    assert not solution.converged
    assert "derivatives" in solution.reason
    assert solution.x.tolist() == [1, 1, 1]


def test_covariance() -> None:
    solution = solve(bard, [1.0, 1.0, 1.0])
    expected = np.linalg.inv(solution.jacobian.T @ solution.jacobian)
    # the condition of the normal equations here, 1e5, times rounding
    assert solution.covariance() == pytest.approx(expected, rel=1e-9)


# ---- models that are not defined everywhere


def test_steps_out_of_the_domain_are_refused() -> None:
    t = np.linspace(0.1, 2, 20)
    undefined = []

    def residual(x: Array) -> Array:
        value = np.log(x[0] - t * x[1]) - np.log(1.0 - 0.3 * t)
        undefined.append(bool(np.isnan(value).any()))
        return np.asarray(value)

    def jacobian(x: Array) -> Array:
        return np.stack([1 / (x[0] - t * x[1]), -t / (x[0] - t * x[1])], axis=1)

    # the first Gauss-Newton step lands where the logarithm has no value
    solution = levenberg_marquardt(residual, jacobian, [30.0, 1.0])
    assert any(undefined)
    assert solution.converged
    assert solution.x == pytest.approx([1.0, 0.3], rel=1e-13)


def test_a_derivative_out_of_the_domain_is_refused() -> None:
    refused = []

    def jacobian(x: Array) -> Array:
        columns = complex_step(rosenbrock)(x)
        if x[1] < -0.1:
            refused.append(x)
            columns[0, 1] = np.nan
        return columns

    solution = levenberg_marquardt(rosenbrock, jacobian, [-1.2, 1.0])
    assert refused
    assert solution.x == pytest.approx([1, 1], abs=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_start_out_of_the_domain_is_named(bad: float) -> None:
    with pytest.raises(LeastSquaresError, match=r"residual 2 is .* at the start \(1 of 4"):
        levenberg_marquardt(lambda _: np.array([1.0, 2.0, bad, 3.0]), lambda _: np.eye(4), [0.0])
    with pytest.raises(LeastSquaresError, match="derivative by parameter 1 is not finite"):
        levenberg_marquardt(lambda x: x, lambda _: np.array([[1.0, bad], [0.0, 1.0]]), [1.0, 2.0])


def test_warnings_stay_off_only_during_the_search() -> None:
    before = np.geterr()
    seen = []

    def residual(x: Array) -> Array:
        seen.append(np.exp(x))
        return np.asarray(seen[-1] - 1)

    # the first Gauss-Newton step goes to 3000
    solution = levenberg_marquardt(residual, lambda x: np.diag(np.exp(x)), [-8.0], first_radius=1e3)
    assert np.isinf(seen).any()
    assert solution.x == pytest.approx([0], abs=1e-14)
    assert np.geterr() == before
    with pytest.raises(LeastSquaresError, match="too large to square"):
        levenberg_marquardt(residual, lambda x: np.diag(np.exp(x)), [700.0])


# ---- units


@pytest.mark.parametrize("known", KNOWN, ids=lambda k: k.residual.__name__)
@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_units_of_the_residual(known: Known, factor: float) -> None:
    plain = solve(known.residual, known.start)
    scaled = solve(lambda x: factor * known.residual(x), known.start)
    # the same steps until rounding decides
    assert abs(scaled.evaluations - plain.evaluations) <= 3
    assert scaled.x == pytest.approx(plain.x, rel=1e-11, abs=1e-13)


@pytest.mark.parametrize("known", KNOWN, ids=lambda k: k.residual.__name__)
def test_units_of_the_parameters(known: Known) -> None:
    # powers of two, so that the path is the same to the last bit wherever the algorithm is
    unit = 2.0 ** np.array([20, -17, 9, -30])[: len(known.start)]
    plain = solve(known.residual, known.start)
    scaled = solve(lambda x: known.residual(x / unit), np.array(known.start) * unit)
    assert abs(scaled.evaluations - plain.evaluations) <= 3
    assert scaled.x / unit == pytest.approx(plain.x, rel=1e-11, abs=1e-13)


def test_given_scale_shapes_the_trust_region() -> None:
    first: list[Array] = []

    def residual(x: Array) -> Array:
        first.append(x)
        return np.array([x[0] - 100, x[1] - 100, 1e-3 * x[0] * x[1]])

    solve_options: dict[str, Any] = {"scale": [1.0, 10.0], "first_radius": 1.0}
    solution = levenberg_marquardt(
        residual, complex_step(residual), np.array([1.0, 10.0]), **solve_options
    )
    assert solution.converged
    way = next(x for x in first if x.dtype == float and (x != [1, 10]).any()) - [1, 10]
    # |way / scale| is the length of the start so scaled, sqrt(2), to the tenth that More allows
    assert np.linalg.norm(way / [1, 10]) == pytest.approx(math.sqrt(2), rel=0.11)


# ---- arguments


def test_arguments_are_checked() -> None:
    def run(start: Any = (1.0, 2.0), **options: Any) -> None:
        levenberg_marquardt(lambda x: x, lambda x: np.eye(x.size), start, **options)

    with pytest.raises(LeastSquaresError, match="start must be finite"):
        run([1.0, np.nan])
    with pytest.raises(LeastSquaresError, match="start must be finite"):
        run([[1.0]])
    with pytest.raises(LeastSquaresError, match="start must be finite"):
        run([])
    with pytest.raises(LeastSquaresError, match="parameter 1 leave nothing: lower 3"):
        run(lower=[0, 3], upper=2)
    with pytest.raises(LeastSquaresError, match="parameter 0 leave nothing: lower nan"):
        run(lower=[np.nan, 3])
    with pytest.raises(LeastSquaresError, match="upper must be a number or 2"):
        run(upper=[1, 2, 3])
    with pytest.raises(LeastSquaresError, match="scale must be positive"):
        run(scale=[1.0, 0.0])
    with pytest.raises(LeastSquaresError, match=r"residual must return \(m,\)"):
        levenberg_marquardt(lambda _: np.eye(2), lambda _: np.eye(2), [1.0, 2.0])
    with pytest.raises(LeastSquaresError, match=r"jacobian must return shape \(2, 2\)"):
        levenberg_marquardt(lambda x: x, lambda _: np.eye(3), [1.0, 2.0])
    with pytest.raises(LeastSquaresError, match=r"residual returned shape \(1,\)"):
        levenberg_marquardt(
            lambda x: x if x[0] == 1 else x[:1], lambda x: np.eye(x.size), [1.0, 2.0]
        )
