"""The adaptive integrals: exact rules, true errors, an end when it is told."""

from __future__ import annotations

import numpy as np
import pytest

from tvbrdf_fitting.geometry import FloatArray, IntArray
from tvbrdf_fitting.properties.quadrature import RULE_7, RULE_15, Integral, Rule, integrate


@pytest.mark.parametrize(("rule", "kronrod", "gauss"), [(RULE_7, 11, 5), (RULE_15, 23, 13)])
def test_rules_are_exact_for_polynomials(rule: Rule, kronrod: int, gauss: int) -> None:
    for degree in range(kronrod + 3):
        exact = (1 - (-1) ** (degree + 1)) / (degree + 1)
        power = rule.nodes**degree
        # sums of some ten terms of at most 1
        assert (abs(rule.kronrod @ power - exact) < 1e-15) == (degree <= kronrod or degree % 2 == 1)
        assert (abs(rule.gauss @ power - exact) < 1e-15) == (degree <= gauss or degree % 2 == 1)


def test_integrals_of_one_call_are_each_exact() -> None:
    centre = np.array([0.3, 0.7, 0.123])
    width = np.array([1e-3, 0.1, 10.0])

    def function(x: FloatArray, owner: IntArray) -> Integral:
        near = (x - centre[owner, None]) / width[owner, None]
        value = np.stack([1 / (1 + near**2), np.abs(near), np.sqrt(x)], axis=-1)
        return Integral(value, np.zeros_like(value))

    breaks = np.tile([0.0, 0.5, 0.5, 1.0], (3, 1))  # an empty panel is left out
    found = integrate(function, breaks, 1e-10)
    upper, lower = (1 - centre) / width, -centre / width
    exact = np.stack(
        [
            width * (np.arctan(upper) - np.arctan(lower)),
            0.5 * width * (upper**2 + lower**2),
            np.full(3, 2 / 3),
        ],
        axis=1,
    )
    assert (np.abs(found.value - exact) <= found.error).all()
    assert (found.error <= 1e-10 * exact).all()


def test_errors_of_the_integrand_are_handed_on() -> None:
    def function(x: FloatArray, _: IntArray) -> Integral:
        value = np.repeat(np.cos(x)[..., None], 3, axis=-1)
        return Integral(value, np.full_like(value, 1e-3))

    found = integrate(function, np.array([[0.0, 2.0]]), 1e-10)
    np.testing.assert_allclose(found.value[0], np.sin(2.0), rtol=1e-12)
    np.testing.assert_allclose(found.error[0], 2e-3, rtol=1e-6)


def test_stop_ends_the_work_and_the_error_says_so() -> None:
    calls = []

    def function(x: FloatArray, _: IntArray) -> Integral:
        calls.append(x.size)
        value = np.repeat(np.abs(x - 0.1234)[..., None], 3, axis=-1)
        return Integral(value, np.zeros_like(value))

    found = integrate(function, np.array([[0.0, 1.0]]), 1e-12, stop=lambda: len(calls) >= 3)
    assert len(calls) == 3
    exact = 0.5 * (0.1234**2 + 0.8766**2)
    assert abs(found.value[0, 0] - exact) <= found.error[0, 0]
    assert found.error[0, 0] > 1e-6
