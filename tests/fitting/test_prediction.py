"""Predicted BRDFs in directions that were not measured: do the stated deviations hold?"""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from tests.fitting.scans import SATIN, Simulate
from tvbrdf_fitting import CommonErrors, FitResult, fit_scan, get_model
from tvbrdf_fitting.choice.choose import choose_model
from tvbrdf_fitting.choice.rule import DECISIVE
from tvbrdf_fitting.half_angle import from_half_angles
from tvbrdf_fitting.prediction import (
    Contender,
    contenders,
    predict,
    predict_over_models,
    weigh,
)

Directions = tuple[np.ndarray, np.ndarray]

MATTE = [0.30, 0.50, 0.70, 0.40, 0.0, 6.0]
SHARP = [0.10, 0.20, 0.30, 0.20, 2.0, 40.0]


@pytest.fixture(scope="module")
def directions() -> Directions:
    """Mirror direction, flank, retro-reflection, grazing, all out of the rig's planes."""
    theta_h = np.radians([0.5, 8.0, 30.0, 60.0, 80.0, 3.0, 45.0])
    theta_d = np.radians([20.0, 20.0, 1.0, 30.0, 40.0, 75.0, 80.0])
    light, view = from_half_angles(theta_h, theta_d, np.radians(85.0))
    assert (light[:, 2] > 0).all()
    assert (view[:, 2] > 0).all()
    return light, view


@pytest.fixture(scope="module")
def satin(simulate: Simulate) -> FitResult:
    return fit_scan(simulate(SATIN, noise=0.01, seed=3, step=6))


def test_values_are_the_fits(satin: FitResult, directions: Directions) -> None:
    found = predict(satin, *directions)
    # the same formula through two sets of coordinates
    np.testing.assert_allclose(found.value, satin.brdf(*directions), rtol=1e-12)
    assert (found.from_models == 0).all()
    assert (found.model_error == 0).all()
    np.testing.assert_array_equal(found.standard_deviation, found.from_parameters)


def test_deviations_are_the_covariances(satin: FitResult, directions: Directions) -> None:
    """J C J^T by central differences of the internal coordinates."""
    model, internal = get_model(satin.model), satin.internal_values
    slopes = []
    for i, deviation in enumerate(np.sqrt(np.diag(satin.internal_covariance))):
        step = np.zeros(len(internal))
        step[i] = 0.01 * deviation
        up, down = (
            model.evaluate(*directions, model.to_published(internal + s)) for s in (step, -step)
        )
        slopes.append((up - down) / (2 * step[i]))
    jacobian = np.stack(slopes, axis=-1)
    expected = np.einsum("nci,ij,ncj->nc", jacobian, satin.internal_covariance, jacobian)
    found = predict(satin, *directions).from_parameters
    # differences over 1 % of a deviation: second order is 1e-4 of it, squared here
    np.testing.assert_allclose(found**2, expected, rtol=1e-4)


@pytest.mark.parametrize("truth", [SATIN, SHARP], ids=["satin", "sharp"])
def test_errors_are_as_large_as_stated(
    simulate: Simulate, directions: Directions, truth: list[float]
) -> None:
    scans, step = 150, 6
    fits = [fit_scan(simulate(truth, noise=0.01, seed=s, step=step)) for s in range(scans)]
    true = get_model("ON+TS").evaluate(*directions, truth)
    scores = np.stack(
        [(p.value - true) / p.standard_deviation for p in (predict(f, *directions) for f in fits)]
    )
    # z^2 summed over the scans is chi-square; 21 values: 99.99 % each
    total = np.square(scores).sum(axis=0)
    assert (total > chi2.ppf(5e-5, scans)).all(), total / scans
    assert (total < chi2.isf(5e-5, scans)).all(), total / scans


def test_common_errors_count(simulate: Simulate, directions: Directions) -> None:
    scan = simulate(SATIN, noise=0.002, seed=5, step=6)
    plain = predict(fit_scan(scan), *directions)
    common = predict(fit_scan(scan, common_errors=CommonErrors(0.02, 0.005)), *directions)
    # Four cameras' gains of 0.5 % leave 0.25 %; where channels share a lobe, which tells their
    # gains from each other, all twelve count: 0.144 %.
    assert (common.relative > 0.99 * 0.005 / np.sqrt(12)).all()
    assert (common.relative > 1.5 * plain.relative).all()


def test_the_unmeasured_is_less_certain(satin: FitResult) -> None:
    seen, unseen = (from_half_angles(*np.radians(a)) for a in ([30, 35, 90], [30, 85, 90]))
    near, far = predict(satin, *seen), predict(satin, *unseen)
    assert far.relative[0] > 5 * near.relative[0]


def test_a_channel_that_was_not_measured(simulate: Simulate, directions: Directions) -> None:
    scan = simulate(SATIN, noise=0.01, seed=4, step=6)
    valid = scan.valid & np.array([True, False, True])
    found = predict(fit_scan(replace(scan, valid=valid)), *directions)
    assert np.isnan(found.value[:, 1]).all()
    assert np.isinf(found.standard_deviation[:, 1]).all()
    assert np.isfinite(found.value[:, [0, 2]]).all()
    assert np.isfinite(found.standard_deviation[:, [0, 2]]).all()
    assert np.isinf(found.relative).all()


def test_what_no_camera_saw_is_infinite(simulate: Simulate) -> None:
    """Camera 4 sees half angles above 37 degrees, where a lobe of 1.4 degrees is exactly 0."""
    scan = simulate(SHARP, noise=0.01, seed=6, step=3)
    only = fit_scan(scan.select(scan.camera == 4), fixed={"inverse_sigma_s": 40.0})
    assert "ks" in only.undetermined
    light, view = from_half_angles(np.radians([0.5, 50.0]), np.radians(20.0), np.radians(90.0))
    found = predict(only, light, view)
    assert np.isinf(found.standard_deviation[0]).all()
    assert np.isinf(found.relative[0])
    assert (found.relative[1:] < 0.01).all()


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_width_that_can_be_anything(simulate: Simulate, noise: float) -> None:
    """The deviation covers every width that the data allow, each fitted on its own."""
    scan = simulate(MATTE, noise=noise, seed=0, step=6)
    fit = fit_scan(scan)
    # without noise the lobe is 0, and no slope says anything of its width
    assert ("ks" in fit.at_bound) == (noise == 0)
    assert "inverse_sigma_s" in fit.undetermined
    light, view = from_half_angles(np.radians([0.3, 10.0, 40.0]), np.radians(30.0), np.pi / 2)
    found = predict(fit, light, view)
    assert np.isfinite(found.standard_deviation).all()
    allowed = 0
    for width in get_model("ON+TS").parameters[5].grid:
        fixed = {"inverse_sigma_s": np.exp(width)}
        other = fit_scan(scan, fixed=fixed, initial=fit_start(fit))
        if other.chi_square < fit.chi_square + 0.99:
            allowed += 1
            conditional = predict(other, light, view).standard_deviation
            # two solvers' optima, to a thousandth of a deviation
            assert (conditional <= found.standard_deviation * 1.001).all()
    assert allowed > 1
    if noise == 0:
        # a lobe of 0.3 degrees is seen by a few lights only
        plain = predict(fit_scan(scan, "oren_nayar"), light, view)
        assert (found.standard_deviation[0] > 3 * plain.standard_deviation[0]).all()
        # without the data nobody knows
        lost = predict(pickle.loads(pickle.dumps(fit)), light, view)
        assert np.isinf(lost.standard_deviation).all()


def fit_start(fit: FitResult) -> dict[str, float]:
    return {n: v for n, v in fit.parameters.items() if n != "inverse_sigma_s"}


def test_below_the_horizon_there_is_nothing(satin: FitResult) -> None:
    found = predict(satin, [[0.6, 0.0, -0.8], [0.6, 0.0, 0.8]], [0.0, 0.0, 1.0])
    assert (found.value[0] == 0).all()
    assert (found.standard_deviation[0] == 0).all()
    assert np.isnan(found.relative[0])
    assert found.relative[1] > 0
    with pytest.raises(ValueError, match=r"light direction 1 = .* is no unit vector"):
        predict(satin, [[0.0, 0.0, 1.0], [np.nan, 0.0, 1.0]], [0.0, 0.0, 1.0])


def test_a_wrong_models_own_error(simulate: Simulate, directions: Directions) -> None:
    """GGX facets fitted with Gaussian ones: one number of radiance, or of the logarithm."""
    truth = [0.05, 0.1, 0.2, 0.2, 0.8, 0.1, 1.5]
    scan = simulate(truth, "oren_nayar+cook_torrance(ggx)", noise=0.001, seed=1, step=4)
    wrong, log = fit_scan(scan), fit_scan(scan, metric="log")
    assert wrong.model_error_std > 0.003
    light, view = directions
    found = predict(wrong, light, view)
    steeper = np.maximum(light[:, 2], view[:, 2])
    expected = wrong.model_error_std / (np.pi * steeper)
    np.testing.assert_allclose(found.model_error, np.tile(expected, (3, 1)).T, rtol=1e-12)
    logarithmic = predict(log, light, view)
    expected = log.model_error_std * logarithmic.value
    np.testing.assert_allclose(logarithmic.model_error, expected)
    # it is no part of the deviation
    assert (found.standard_deviation < found.model_error).any()


def test_models_are_averaged(simulate: Simulate, directions: Directions) -> None:
    scan = simulate(SATIN, noise=0.01, seed=3, step=6)
    one, other = fit_scan(scan), fit_scan(scan, "oren_nayar+phong", model_error=False)
    first, second = predict(one, *directions), predict(other, *directions)
    found = predict_over_models([Contender(one, 0.75), Contender(other, 0.25)], *directions)
    mean = 0.75 * first.value + 0.25 * second.value
    between = 0.75 * (first.value - mean) ** 2 + 0.25 * (second.value - mean) ** 2
    within = 0.75 * first.standard_deviation**2 + 0.25 * second.standard_deviation**2
    np.testing.assert_allclose(found.value, mean, rtol=1e-12)
    np.testing.assert_allclose(found.from_models**2, between, rtol=1e-9, atol=1e-30)
    np.testing.assert_allclose(found.from_parameters**2, within, rtol=1e-12)
    np.testing.assert_allclose(found.standard_deviation**2, between + within, rtol=1e-12)


def test_weights_are_the_criterions(simulate: Simulate) -> None:
    truth = [0.3, 0.5, 0.7, 0.0, 0.8, 6.0]
    scan = simulate(truth, noise=0.01, seed=3, step=6)
    rough = fit_scan(scan)
    flat = fit_scan(scan, "lambert+torrance_sparrow")
    wrong = fit_scan(scan, "lambert", model_error=False)
    count = rough.degrees_of_freedom + 6
    # the other way round from pickled results, which have no data
    found = weigh([pickle.loads(pickle.dumps(fit)) for fit in (rough, flat, wrong)])
    assert [c.result.model for c in found] == [rough.model, flat.model]
    factor = max(1.0, min(f.chi_square / f.degrees_of_freedom for f in (rough, flat)))
    difference = (rough.chi_square - flat.chi_square) / factor + np.log(count)
    assert 0 < difference < DECISIVE
    assert found[0].weight / found[1].weight == pytest.approx(np.exp(-difference / 2), rel=1e-9)
    assert sum(c.weight for c in found) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="different data"):
        weigh([rough, fit_scan(simulate(truth, noise=0.01, seed=3, step=7))])
    with pytest.raises(ValueError, match="different data"):
        weigh([rough, fit_scan(scan, metric="log")])
    with pytest.raises(ValueError, match="huber"):
        weigh([rough, fit_scan(scan, loss="huber")])
    with pytest.raises(ValueError, match="no fits"):
        predict_over_models([], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0])


def test_contenders_of_a_choice(simulate: Simulate, directions: Directions) -> None:
    """A lobe as faint as the noise: with it and without it the data are explained."""
    scan = simulate([0.3, 0.5, 0.7, 0.0, 0.01, 2.0], noise=0.05, seed=2, step=6)
    choice = choose_model(scan)
    found = contenders(choice, scan)
    assert found[0].result is choice.result
    assert sum(c.weight for c in found) == pytest.approx(1.0)
    assert found[0].weight == max(c.weight for c in found)
    names = {c.result.model for c in found}
    assert names >= {"lambert", "lambert+torrance_sparrow"}
    criteria = {r.model: r.criterion for r in choice.rungs}
    for one in found[1:]:
        # those of the same size need not have been tried
        if one.result.model in criteria:
            above = max(criteria[one.result.model] - criteria[choice.model], 0.0)
            assert above < DECISIVE
            weight = found[0].weight * np.exp(-0.5 * above)
            # the criteria are weighed again, with the rungs that were not tried
            assert one.weight == pytest.approx(weight, rel=0.01)
    predicted = predict_over_models(found, *directions)
    # towards grazing incidence on the facets, which no camera sees, a lobe would rise
    blind, seen = 5, 0
    assert predicted.from_models[blind].min() > 5 * predicted.from_models[seen].max()
    assert predicted.from_models[blind].min() > predicted.from_parameters[blind].min()


def test_another_shape_of_lobe_contends(simulate: Simulate) -> None:
    """GGX facets, faint and noisy, which Gaussian ones explain as well: the truth stays within."""
    truth, name = [0.3, 0.5, 0.7, 0.4, 0.2, 0.25, 1.5], "oren_nayar+cook_torrance(ggx)"
    scan = simulate(truth, name, noise=0.02, seed=1, step=12)
    choice = choose_model(scan)
    # the climb ends before: noise explains what the Gaussian lobe leaves
    assert choice.model == "oren_nayar+torrance_sparrow"
    found = contenders(choice, scan)
    assert {c.result.model for c in found} == {choice.model, name}
    light, view = from_half_angles(np.radians([2.0, 10.0, 30.0]), np.radians(70.0), np.pi / 2)
    true = get_model(name).evaluate(light, view, truth)
    one = predict(choice.result, light, view)
    assert (np.abs(one.value - true) > 3 * one.standard_deviation).any()
    both = predict_over_models(found, light, view)
    assert (np.abs(both.value - true) < 3 * both.standard_deviation).all()


def test_a_clear_choice_has_no_contenders(simulate: Simulate) -> None:
    scan = simulate(SHARP, noise=0.002, seed=2, step=2)
    choice = choose_model(scan)
    assert [c.weight for c in contenders(choice, scan)] == [1.0]


def test_dust_without_its_amount(simulate: Simulate, directions: Directions) -> None:
    """Without dust nothing is known of w; where it would matter, the prediction says so."""
    truth = [0.3, 0.5, 0.7, 0.4, 0.8, 6.0, 0.05, 0.06, 0.07, 0.35, 0.0]
    scan = simulate(truth, "dust", noise=0.01, seed=1, step=8)
    fit = fit_scan(scan, "dust", fixed={"tau": 0.0, "g": 0.35})
    assert {"w_b", "w_g", "w_r"} <= set(fit.undetermined)
    # tau is known to be 0: w does not matter
    assert np.isfinite(predict(fit, *directions).standard_deviation).all()
    # tau is known as little as w: some dust may be there
    unsure = replace(fit, internal_covariance=with_variance(fit, "tau", 1e-4))
    assert np.isinf(predict(unsure, *directions).standard_deviation).all()


def with_variance(fit: FitResult, name: str, variance: float) -> np.ndarray:
    covariance = fit.internal_covariance.copy()
    place = fit.parameter_names.index(name)
    covariance[place] = covariance[:, place] = 0.0
    covariance[place, place] = variance
    return covariance
