"""The map of where the rig is blind: what it shows is what was predicted and measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from tests.rendering.labels import texts_on_the_page
from tvbrdf_fitting import FitResult, Observations, fit_scan, get_model
from tvbrdf_fitting.choice.choose import choose_model
from tvbrdf_fitting.design.fisher_information import Rig
from tvbrdf_fitting.half_angle import from_half_angles
from tvbrdf_fitting.prediction import predict
from tvbrdf_rendering.blind_map import (
    LARGEST,
    BlindMap,
    blind_map,
    blind_map_figure,
    draw_blind_map,
)

SATIN = [0.30, 0.50, 0.70, 0.40, 0.80, 6.0]


def observe(
    values: list[float], model: str = "ON+TS", cameras: tuple[int, ...] = (1, 2, 3, 4)
) -> Observations:
    """A noisy scan of 60 lights at two exposures."""
    rig = Rig()
    scan = rig.observe(
        get_model(model), np.array(values), cameras=cameras, exposures_ms=(0.2, 4.0), lights=60
    )
    noise = 5 * np.random.default_rng(1).normal(size=scan.radiance.shape)
    return replace(
        scan, radiance=scan.radiance + noise * np.sqrt(scan.variance), variance=25 * scan.variance
    )


@pytest.fixture(scope="module")
def scan() -> Observations:
    return observe(SATIN)


@pytest.fixture(scope="module")
def fit(scan: Observations) -> FitResult:
    return fit_scan(scan)


@pytest.fixture(scope="module")
def found(fit: FitResult, scan: Observations) -> BlindMap:
    return blind_map(fit, scan)


def texts(figure: Figure) -> list[str]:
    return [text for text, _ in texts_on_the_page(figure)]


def test_the_numbers_are_the_predictions(found: BlindMap, fit: FitResult) -> None:
    assert found.relative.shape == (10, 90, 90)
    assert found.models == (fit.model,)
    for f, d, h in ((0, 20, 30), (9, 70, 10), (4, 5, 60)):
        angles = (found.theta_h_deg[h], found.theta_d_deg[d], found.phi_d_deg[f])
        expected = predict(fit, *from_half_angles(*np.radians(angles))).relative[0]
        assert found.relative[f, d, h] == pytest.approx(expected, rel=1e-9)
    np.testing.assert_array_equal(found.at(90.0), found.relative[-1])
    # below the horizon in the plane of incidence: theta_h + theta_d > 90 degrees
    below = found.theta_h_deg[None, :] + found.theta_d_deg[:, None] > 90
    edge = np.abs(found.theta_h_deg[None, :] + found.theta_d_deg[:, None] - 90) < 1e-6
    np.testing.assert_array_equal(np.isnan(found.at(0.0))[~edge], below[~edge])
    assert np.isfinite(found.at(90.0)).all()
    assert (found.worst >= found.at(90.0)).all()


def test_the_points_are_the_measured_directions(found: BlindMap, scan: Observations) -> None:
    assert len(found.camera) == int(scan.usable.any(axis=1).sum())
    smallest = [found.measured_deg[found.camera == c, 0].min() for c in (1, 2, 3, 4)]
    # as on the facts page; lights are 2.8 degrees apart, half angles half of it at the most
    np.testing.assert_allclose(smallest, [0.0, 12.7, 25.3, 37.6], atol=0.75)
    assert found.measured_deg.min() >= 0
    assert found.measured_deg.max() <= 90
    # camera 1 measures in the plane of incidence
    assert found.measured_deg[found.camera == 1, 2].max() < 1e-6


def test_the_rig_is_blind_where_it_does_not_look(found: BlindMap) -> None:
    h, d, f = (np.searchsorted(edges, found.measured_deg[:, i]) for i, edges in enumerate(
        (found.theta_h_deg, found.theta_d_deg, found.phi_d_deg)))  # fmt: skip
    last = len(found.theta_h_deg) - 1
    seen = found.relative[np.clip(f, 0, 9), np.clip(d, 0, last), np.clip(h, 0, last)]
    assert np.nanmedian(seen) < np.median(found.worst[80:, 20:60]) / 3


def test_the_picture_is_written(fit: FitResult, scan: Observations, tmp_path: Path) -> None:
    path = draw_blind_map(fit, scan, tmp_path / "blind.png")
    assert path == tmp_path / "blind.png"
    assert imread(path).shape[:2] == (int(4.55 * 150), int(12.6 * 150))
    assert [p.name for p in tmp_path.iterdir()] == ["blind.png"]


def test_everything_is_labelled(found: BlindMap) -> None:
    figure = blind_map_figure(found)
    labels = texts(figure)
    for label in ("1", "2", "3", "4", "half angle θh / °", "difference angle θd / °",
                  "in the plane of incidence, φd = 0°", "across it, φd = 90°", "worst over φd",
                  "standard deviation / value", "below the horizon"):  # fmt: skip
        assert label in labels, label
    assert "unknown" not in labels
    assert not any("No model" in label for label in labels)
    assert len(figure.axes) == 4


def test_what_is_unknown_is_said() -> None:
    """One camera far from the mirror direction, a sharp lobe of known width: nobody sees it."""
    scan = observe([0.1, 0.2, 0.3, 0.2, 2.0, 40.0], cameras=(4,))
    fit = fit_scan(scan, fixed={"inverse_sigma_s": 40.0})
    found = blind_map(fit, scan)
    assert np.isinf(found.at(90.0)[20, 0])
    assert (found.at(90.0)[20, 40:80] < LARGEST).all()
    assert "unknown" in texts(blind_map_figure(found))


def test_a_choice_brings_its_contenders() -> None:
    """A lobe of GGX facets that Gaussian ones explain as well."""
    truth = [0.3, 0.5, 0.7, 0.4, 0.1, 0.3, 1.5]
    scan = observe(truth, "oren_nayar+cook_torrance(ggx)", cameras=(1, 2))
    noisy = np.random.default_rng(2).normal(size=scan.radiance.shape) * 0.01
    scan = replace(scan, radiance=scan.radiance + noisy, variance=scan.variance + 1e-4)
    choice = choose_model(scan)
    found = blind_map(choice, scan)
    assert len(found.models) > 1
    assert choice.result.model in found.models
    one = blind_map(choice.result, scan)
    # somewhere the models differ by more than each one's deviation
    assert np.nanmax(found.relative / one.relative) > 2


def test_a_wrong_model_is_said() -> None:
    truth = [0.05, 0.1, 0.2, 0.2, 0.8, 0.1, 1.5]
    scan = observe(truth, "oren_nayar+cook_torrance(ggx)")
    found = blind_map([fit_scan(scan)], scan)
    assert found.model_error
    assert any("No model explains these data" in label for label in texts(blind_map_figure(found)))


def test_a_model_without_reciprocity_has_both_halves() -> None:
    truth = [0.3, 0.5, 0.7, 0.4, 0.8, 6.0, 0.05, 0.06, 0.07, 0.35, 0.5]
    name = "dust(paper)+oren_nayar+torrance_sparrow"
    fixed = {"w_b": 0.05, "w_g": 0.06, "w_r": 0.07, "g": 0.35}
    scan = observe(truth, name)
    found = blind_map(fit_scan(scan, name, fixed=fixed), scan)
    assert found.phi_d_deg[-1] == 180
    assert found.measured_deg[:, 2].max() > 90


def test_a_model_that_turns_with_the_sample_has_no_map(fit: FitResult, scan: Observations) -> None:
    with pytest.raises(ValueError, match="isotropic"):
        blind_map(replace(fit, model="ward(anisotropic)"), scan)
