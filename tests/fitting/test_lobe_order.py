"""Of several lobes of one kind the broader comes first, in all that a result says."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fitting.scans import SATIN, simulate, sound
from tvbrdf_fitting import FitResult, fit_scan, get_model
from tvbrdf_fitting.batch import fit_parameters
from tvbrdf_fitting.inference.lobe_order import in_order, lobe_order
from tvbrdf_fitting.inference.nuisances import CommonErrors
from tvbrdf_fitting.models import Lobe, SumModel, catalogue
from tvbrdf_fitting.prediction import predict
from tvbrdf_fitting.problem import make_problem

TWO = "lambert+torrance_sparrow(coloured)+torrance_sparrow(coloured)"
BODY = [0.1, 0.15, 0.2]
BROAD, NARROW = [0.3, 0.35, 0.4, 3.0], [0.8, 0.7, 0.9, 20.0]
LACQUER = {"eta": 1.5, "eta_2": 1.5}


def narrow_first(result: FitResult) -> list[str]:
    """Return the parameters' names with the two lobes' exchanged."""
    return [
        n.removesuffix("_2") if n.endswith("_2") else f"{n}_2" if f"{n}_2" in names else n
        for names in [result.parameter_names]
        for n in names
    ]


@pytest.mark.parametrize(
    ("model", "truth", "fixed"),
    [
        (TWO, [*BODY, *BROAD, *NARROW], None),
        (TWO, [*BODY, *NARROW, *BROAD], None),
        ("lambert+phong+phong", [*BODY, 0.3, 5.0, 0.8, 60.0], None),
        (
            "lambert+cook_torrance(ggx)+cook_torrance(ggx)",
            [*BODY, 0.8, 0.05, 1.5, 0.3, 0.5, 1.5],
            LACQUER,
        ),
    ],
)
def test_order_does_not_change_in_a_series(
    model: str, truth: list[float], fixed: dict[str, float] | None
) -> None:
    """The solver ends with either lobe first in some of these scans."""
    built = get_model(model)
    broad, narrow = built.twins[0]
    for seed in range(8):
        observations = simulate(truth, model, noise=0.01, seed=seed, step=8)
        result = sound(fit_scan(observations, model, fixed=fixed))
        assert broad.sharpness(result.internal_values) < narrow.sharpness(result.internal_values)


@pytest.mark.parametrize("common", [None, CommonErrors(0.02, 0.005)])
def test_everything_in_a_result_changes_places_together(common: CommonErrors | None) -> None:
    observations = simulate([*BODY, *BROAD, *NARROW], TWO, noise=0.01, seed=1, step=6)
    asked = {"inverse_sigma_s": 20.0, "inverse_sigma_s_2": 3.0}
    kept = fit_scan(observations, TWO, initial=asked, common_errors=common)
    assert kept.value("inverse_sigma_s") > kept.value("inverse_sigma_s_2")
    problem = make_problem(observations, get_model(TWO), {}, {})
    turned = in_order(kept, problem, ())
    assert turned.value("inverse_sigma_s") < turned.value("inverse_sigma_s_2")
    assert in_order(turned, problem, ()) is turned
    names = narrow_first(kept)
    for i, one in enumerate(names):
        assert turned.value(one) == kept.values[i]
        assert turned.standard_deviation(one) == kept.standard_deviations[i]
        assert (one in turned.undetermined) == (kept.parameter_names[i] in kept.undetermined)
        assert (one in turned.at_bound) == (kept.parameter_names[i] in kept.at_bound)
        for k, other in enumerate(names):
            j = turned.index(one), turned.index(other)
            assert turned.correlations[j] == kept.correlations[i, k]
            assert turned.internal_covariance[j] == kept.internal_covariance[i, k]
    # the profiles and predictions look at the data again: sums in another order
    for name in ("ks_g", "inverse_sigma_s_2"):
        other = kept.parameter_names[names.index(name)]
        np.testing.assert_allclose(turned.interval(name), kept.interval(other), rtol=1e-6)
    light, view = observations.light_direction[::40], observations.view_direction[::40]
    here, there = predict(turned, light, view), predict(kept, light, view)
    np.testing.assert_allclose(here.value, there.value, rtol=1e-12)
    np.testing.assert_allclose(here.standard_deviation, there.standard_deviation, rtol=1e-6)
    # and the fit that was free to choose ends at the same optimum
    free = fit_scan(observations, TWO, common_errors=common)
    assert (np.abs(free.values - turned.values) < 0.01 * turned.standard_deviations).all()
    deviations = turned.standard_deviations
    np.testing.assert_allclose(free.standard_deviations, deviations, rtol=1e-2)


def test_lobes_that_are_asked_for_differently_stay_where_they_are() -> None:
    observations = simulate([*BODY, *BROAD, *NARROW], TWO, noise=0.01, step=8)

    def narrow_first(**asked: object) -> bool:
        result = fit_scan(observations, TWO, **asked)  # type: ignore[arg-type]
        return result.value("inverse_sigma_s") > result.value("inverse_sigma_s_2")

    assert narrow_first(fixed={"inverse_sigma_s": 20.0})
    assert narrow_first(bounds={"inverse_sigma_s": (10.0, np.inf)})
    assert narrow_first(initial={"inverse_sigma_s": 20.0, "inverse_sigma_s_2": 3.0})
    start = {"inverse_sigma_s": 20.0, "inverse_sigma_s_2": 3.0, "ks_b": 0.8}
    assert narrow_first(tied={"ks_g": "ks_b", "ks_r": "ks_b"}, initial=start)
    # the same for both is no difference
    both = {"inverse_sigma_s": (1.0, 50.0), "inverse_sigma_s_2": (1.0, 50.0)}
    assert not narrow_first(bounds=both)


@pytest.mark.parametrize("seed", range(4))
def test_a_lobe_that_is_not_there_comes_last(seed: int) -> None:
    """Its width is whatever noise makes of it, often the broader one."""
    model = "oren_nayar+torrance_sparrow+torrance_sparrow"
    result = fit_scan(simulate(SATIN, noise=0.005, seed=seed, step=6), model)
    assert "inverse_sigma_s" not in result.undetermined
    assert "inverse_sigma_s_2" in result.undetermined


def test_a_dark_or_undetermined_lobe_comes_last_whatever_its_width() -> None:
    observations = simulate([*BODY, *BROAD, *NARROW], TWO, step=30)
    model = get_model(TWO)
    problem = make_problem(observations, model, {}, {})
    turned = [0, 1, 2, 7, 8, 9, 10, 3, 4, 5, 6]
    internal = model.to_internal([*BODY, *BROAD, *NARROW])
    assert lobe_order(problem, internal) is None
    order = lobe_order(problem, internal, lost={6})
    assert order is not None
    assert order.tolist() == turned
    assert lobe_order(problem, internal, lost={6, 10}) is None
    dark = model.to_internal([*BODY, 0.0, np.nan, 0.0, 3.0, *NARROW])
    order = lobe_order(problem, dark)
    assert order is not None
    assert order.tolist() == turned


def test_three_lobes_and_lobes_below_dust_are_in_order_too() -> None:
    three = "dust+lambert+torrance_sparrow+phong+torrance_sparrow+torrance_sparrow"
    model = get_model(three)
    observations = simulate([*BODY, *BROAD, *NARROW], TWO, step=30)
    problem = make_problem(observations, model, {}, {})
    lobes = [0.5, 9.0, 0.1, 30.0, 0.5, 20.0, 0.5, 2.0]
    internal = model.to_internal([*BODY, *lobes, 0.05, 0.05, 0.05, 0.3, 0.5])
    order = lobe_order(problem, internal)
    assert order is not None
    assert model.to_published(internal[order])[3:11].tolist() == pytest.approx(
        [0.5, 2.0, 0.1, 30.0, 0.5, 9.0, 0.5, 20.0]
    )
    assert order.tolist()[11:] == list(range(11, 16))


def test_parameters_of_many_scans_are_in_the_order_of_single_fits() -> None:
    truth = [*BODY, *BROAD, *NARROW]
    first = simulate(truth, TWO, noise=0.01, step=16)
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(6, *first.radiance.shape)) * np.sqrt(first.variance)
    light, view = first.light_direction, first.view_direction
    exact = np.pi * light[:, 2:] * get_model(TWO).evaluate(light, view, truth)
    variance = np.where(first.valid, first.variance, np.inf)
    batch = fit_parameters(light, view, exact + noise, variance, TWO)
    broad, narrow = (batch.parameter_names.index(f"inverse_sigma_s{n}") for n in ("", "_2"))
    assert (batch.values[:, broad] < batch.values[:, narrow]).all()


@pytest.mark.parametrize("name", catalogue())
def test_sharpness_orders_lobes_by_their_width(name: str) -> None:
    """Of two lobes the sharper is the one that falls more, a few degrees from the mirror."""
    try:
        whole = get_model(name)
    except ValueError:  # an option that wants another one
        pytest.skip(f"{name} alone is no model")
    parts = whole.parts if isinstance(whole, SumModel) else (whole,)
    lobes = [part for part in parts if isinstance(part, Lobe) and part.shapes]
    normal, aside = np.array([[0.0, 0.0, 1.0]]), np.radians(12.0)
    off = np.array([[np.sin(aside), 0.0, np.cos(aside)], [0.0, np.sin(aside), np.cos(aside)]])
    rng = np.random.default_rng(1)
    for lobe in lobes:
        names = [p.name for p in lobe.shapes]
        typical = [p.transform.to_internal(p.typical) for p in lobe.shapes]
        wide = [i for i, n in enumerate(names) if n not in {"eta", "k", "cxy", "phi_x"}]
        assert wide
        for _ in range(20):
            pair = []
            for factor in rng.uniform(-0.7, 0.7, size=2):
                shapes = list(typical)
                for i in wide:
                    shapes[i] += factor
                peak = lobe.lobe(lobe.prepare(normal, normal), shapes)[0]
                fallen = lobe.lobe(lobe.prepare(normal.repeat(2, 0), off), shapes).mean() / peak
                pair.append((lobe.sharpness(shapes), -fallen))
            (one, low), (other, high) = pair
            assert (one < other) == (low < high)
