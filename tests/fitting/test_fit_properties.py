"""Properties that models and fits promise, on inputs that hypothesis chooses."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fitting.scans import SATIN, Simulate
from tvbrdf_fitting import FitResult, fit_scan, get_model
from tvbrdf_fitting.fit import SOLVERS
from tvbrdf_fitting.models import Parameter, ReflectanceModel, catalogue

MODELS = tuple(name for name in catalogue() if not get_model(name).delta)
LINEAR = "lambert+torrance_sparrow"
LINEAR_SATIN = [0.3, 0.5, 0.7, 0.8, 6.0]
FEW = settings(max_examples=25, deadline=None, derandomize=True)
VERY_FEW = settings(max_examples=5, deadline=None, derandomize=True)
SOLVED = 0.01
"""Deviations by which two solutions of one problem may differ: solvers stop at 1e-5 to 1e-4."""


@st.composite
def directions(draw: st.DrawFn) -> np.ndarray:
    """Unit vectors (3,) from the normal to 0.06 degrees above the horizon."""
    cosine = draw(st.floats(1e-3, 1.0))
    azimuth = draw(st.floats(0.0, 2 * math.pi))
    sine = math.sqrt((1 - cosine) * (1 + cosine))
    return np.array([sine * math.cos(azimuth), sine * math.sin(azimuth), cosine])


def published(parameter: Parameter) -> st.SearchStrategy[float]:
    """Values within the bounds, as far as they are met in practice."""
    lower = max(parameter.lower, parameter.typical / 100 if parameter.lower > 0 else -math.inf)
    upper = min(parameter.upper, 20 * abs(parameter.typical))
    return st.floats(lower, upper)


@cache
def parameters_of(name: str) -> st.SearchStrategy[np.ndarray]:
    return st.tuples(*(published(p) for p in get_model(name).parameters)).map(np.array)


def turned(vector: np.ndarray, angle: float) -> np.ndarray:
    cosine, sine = math.cos(angle), math.sin(angle)
    x, y, z = vector
    return np.array([cosine * x - sine * y, sine * x + cosine * y, z])


def brdf(model: ReflectanceModel, light: np.ndarray, view: np.ndarray, p: np.ndarray) -> np.ndarray:
    return np.asarray(model.evaluate(light, view, p)[0])


def same(one: FitResult, other: FitResult, scale: np.ndarray | float = 1.0) -> None:
    """Two results are of one minimum, parameters of the second divided by `scale`."""
    assert other.chi_square == pytest.approx(one.chi_square, rel=1e-8)
    moved = np.abs(other.values / scale - one.values)
    assert (moved <= SOLVED * one.standard_deviations).all()
    assert one.undetermined == other.undetermined
    assert one.at_bound == other.at_bound


class TestModels:
    @pytest.mark.parametrize("name", [n for n in MODELS if get_model(n).reciprocal])
    @FEW
    @given(data=st.data(), light=directions(), view=directions())
    def test_reciprocity(
        self, name: str, data: st.DataObject, light: np.ndarray, view: np.ndarray
    ) -> None:
        model, p = get_model(name), data.draw(parameters_of(name))
        one, other = brdf(model, light, view, p), brdf(model, view, light, p)
        # the same operations but for their order; a sharp lobe's exponent is up to 1e3
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13 * np.abs(one).max())

    @pytest.mark.parametrize("name", [n for n in MODELS if not get_model(n).reciprocal])
    def test_what_does_not_promise_reciprocity_has_none(self, name: str) -> None:
        model = get_model(name)
        light, view = np.array([0.6, 0.0, 0.8]), np.array([0.0, -0.28, 0.96])
        one, other = (brdf(model, *d, model.typical) for d in ((light, view), (view, light)))
        assert np.abs(one - other).max() > 1e-6 * np.abs(one).max()

    @pytest.mark.parametrize("name", [n for n in MODELS if get_model(n).nonnegative])
    @FEW
    @given(data=st.data(), light=directions(), view=directions())
    def test_never_negative(
        self, name: str, data: st.DataObject, light: np.ndarray, view: np.ndarray
    ) -> None:
        values = brdf(get_model(name), light, view, data.draw(parameters_of(name)))
        assert np.isfinite(values).all()
        assert (values >= 0).all()

    @pytest.mark.parametrize(
        "name", [n for n in MODELS if getattr(get_model(n), "isotropic", True)]
    )
    @FEW
    @given(data=st.data(), light=directions(), view=directions(), angle=st.floats(0.0, 2 * math.pi))
    def test_rotation_about_the_normal(
        self, name: str, data: st.DataObject, light: np.ndarray, view: np.ndarray, angle: float
    ) -> None:
        model, p = get_model(name), data.draw(parameters_of(name))
        one = brdf(model, light, view, p)
        other = brdf(model, turned(light, angle), turned(view, angle), p)
        # turning rounds each component by 1e-16, an angle to the normal of a lobe 0.005 wide by
        # 1e-13 of its width; where a direction all but points along the normal, an azimuth is lost
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-10 * np.abs(one).max())


class TestFits:
    @pytest.mark.parametrize("loss", ["least_squares", "cauchy"])
    @pytest.mark.parametrize("method", list(SOLVERS))
    @VERY_FEW
    @given(seed=st.integers(0, 2**31))
    def test_row_order(self, simulate: Simulate, method: str, loss: str, seed: int) -> None:
        observations = simulate(SATIN, noise=0.01, step=24, seed=seed % 3)
        order = np.random.default_rng(seed).permutation(len(observations))
        one = fit_scan(observations, method=method, loss=loss)
        other = fit_scan(observations.select(order), method=method, loss=loss)
        same(one, other)

    @pytest.mark.parametrize("method", list(SOLVERS))
    @VERY_FEW
    @given(angle=st.floats(0.0, 2 * math.pi))
    def test_rotation_about_the_normal(self, simulate: Simulate, method: str, angle: float) -> None:
        observations = simulate(SATIN, noise=0.01, step=12)
        other = replace(
            observations,
            light_direction=turned(observations.light_direction.T, angle).T,
            view_direction=turned(observations.view_direction.T, angle).T,
        )
        same(fit_scan(observations, method=method), fit_scan(other, method=method))

    @pytest.mark.parametrize("method", list(SOLVERS))
    @pytest.mark.parametrize(
        ("metric", "loss"),
        [
            ("radiance", "least_squares"),
            ("radiance", "huber"),
            ("cosine_weighted", "least_squares"),
            ("relative", "least_squares"),
        ],
    )
    @VERY_FEW
    @given(exponent=st.floats(-6.0, 6.0), wrong=st.booleans())
    def test_scale_where_the_model_is_linear(
        self,
        simulate: Simulate,
        method: str,
        metric: str,
        loss: str,
        exponent: float,
        wrong: bool,
    ) -> None:
        """All amplitudes scale with the radiance, also with an error of the model."""
        scale = 10.0**exponent
        model = "lambert+torrance_sparrow(coloured)" if wrong else LINEAR
        truth = [0.3, 0.5, 0.7, 0.4, 0.8, 1.6, 6.0] if wrong else LINEAR_SATIN
        observations = simulate(truth, model, noise=0.01, step=12)
        scaled = replace(
            observations,
            radiance=scale * observations.radiance,
            variance=scale**2 * observations.variance,
        )
        one, other = (
            fit_scan(o, LINEAR, method=method, metric=metric, loss=loss)
            for o in (observations, scaled)
        )
        amplitudes = np.array([scale, scale, scale, scale, 1.0])
        unit = 1.0 if metric == "relative" else scale
        # rounds end when the error changes by less than 2 %: the same round in both
        assert other.model_error_std == pytest.approx(unit * one.model_error_std, rel=1e-5)
        assert other.chi_square == pytest.approx(one.chi_square, rel=1e-6)
        moved = np.abs(other.values / amplitudes - one.values)
        assert (moved <= SOLVED * one.standard_deviations).all()
        np.testing.assert_allclose(
            other.standard_deviations / amplitudes, one.standard_deviations, rtol=1e-3
        )

    @pytest.mark.parametrize("method", list(SOLVERS))
    @VERY_FEW
    @given(data=st.data())
    def test_what_is_put_in_comes_out(
        self, simulate: Simulate, method: str, data: st.DataObject
    ) -> None:
        """Without noise, of scenes in which everything is seen."""
        truth = [
            *(data.draw(st.floats(0.05, 0.9)) for _ in range(3)),
            data.draw(st.floats(0.1, 1.2)),
            data.draw(st.floats(0.1, 10.0)),
            data.draw(st.floats(1.5, 30.0)),
        ]
        result = fit_scan(simulate(truth, step=6), method=method)
        np.testing.assert_allclose(result.values, truth, rtol=1e-5)
