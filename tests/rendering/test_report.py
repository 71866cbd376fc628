"""Pictures: what they show is what was measured, and every label can be read."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread

from tests.rendering.labels import check_labels
from tvbrdf_fitting.published.database import (
    DatabaseError,
    StoredDatabase,
    StoredFit,
    StoredSample,
    read_database,
)
from tvbrdf_fitting.time_varying import SettlingDust
from tvbrdf_nodes.database_writer.store import DatabaseStore
from tvbrdf_rendering.curves import choose_scans, curve_of, curves_figure, fitted_radiance
from tvbrdf_rendering.parameters import grouped, parameters_figure, series_of
from tvbrdf_rendering.report import make_report
from tvbrdf_rendering.times import time_unit
from tvbrdf_rendering.truth import Truth, read_truth

MakeDatabase = Callable[..., Path]
DUST = SettlingDust(
    kd=(0.1, 0.2, 0.4),
    w=(0.1, 0.1, 0.11),
    g=0.4,
    tau_per_min=0.05,
    ks=0.6,
    sigma_s=0.12,
    tau_start=0.1,
    attenuation=3.3,
)


@pytest.fixture(scope="module")
def path(make_database: MakeDatabase) -> Path:
    return make_database(scans=5, missing=(3,), unfitted=(4,))


@pytest.fixture(scope="module")
def sample(path: Path) -> StoredSample:
    return read_database(path).samples[0]


def first_fit(sample: StoredSample) -> StoredFit:
    fit = sample.scans[0].fit
    assert fit is not None
    return fit


def test_no_label_is_cut_off_or_overlaps_another(
    sample: StoredSample, path: Path, make_database: MakeDatabase
) -> None:
    check_labels(curves_figure(sample))
    check_labels(parameters_figure(sample, truth=read_truth(path)))
    for scans in (1, 2):
        few = read_database(make_database(scans=scans)).samples[0]
        check_labels(curves_figure(few))
        check_labels(parameters_figure(few))
    dust = read_database(make_database(DUST, scans=2)).samples[0]
    check_labels(parameters_figure(dust))


def test_the_checker_sees_overlap() -> None:
    figure = Figure()
    FigureCanvasAgg(figure)
    for x in (0.5, 0.51):
        figure.text(x, 0.5, "label")
    with pytest.raises(AssertionError, match="overlaps"):
        check_labels(figure)
    figure = Figure()
    FigureCanvasAgg(figure)
    figure.text(0.99, 0.5, "label")
    with pytest.raises(AssertionError, match="cut off"):
        check_labels(figure)


def test_pictures_are_readable_files(path: Path, tmp_path: Path) -> None:
    files = make_report(path, tmp_path / "report")
    assert set(files) == {"summary", "summary_json", "curves", "parameters"}
    assert {file.name for file in (tmp_path / "report").iterdir()} == {
        "summary.txt",
        "summary.json",
        "curves.png",
        "parameters.png",
    }
    for name in ("curves", "parameters"):
        picture = imread(files[name])
        assert picture.shape[1] >= 1000
        assert picture[..., :3].std() > 0.05  # not one even colour


def test_the_curve_is_the_measured_one(sample: StoredSample) -> None:
    scan = sample.scans[0]
    camera_scan = scan.radiance().cameras[1]
    curve = curve_of(camera_scan, scan.fit)
    assert (np.diff(curve.angle_deg) > 0).all()
    # sample frame: lights every 0.5 deg from -90 to +78; files hold 6 decimals, 6e-5 deg near 90
    assert curve.angle_deg[0] == pytest.approx(-89.5, abs=1e-3)
    assert curve.angle_deg[-1] == pytest.approx(78.0, abs=1e-3)
    peak_deg = curve.angle_deg[curve.radiance.sum(axis=1).argmax()]
    assert peak_deg == pytest.approx(12.0, abs=1.5)  # mirror direction of camera 1; lobe 3 deg
    ((low, high),) = curve.gaps_deg  # the arm, around -12 deg, hides less than 2 deg to each side
    assert curve.gaps_are_the_arms
    assert [low, high] == pytest.approx([-14.0, -10.0], abs=1e-3)


def test_other_gaps_are_not_blamed_on_the_arm(sample: StoredSample) -> None:
    whole = sample.scans[0].radiance().cameras[1]
    kept = np.abs(whole.light_direction[:, 0] - 0.5) > 0.05
    cut = replace(whole, light_direction=whole.light_direction[kept], radiance=whole.radiance[kept])
    curve = curve_of(cut, None)
    assert len(curve.gaps_deg) == 2
    assert not curve.gaps_are_the_arms


def test_the_curve_is_the_fitted_one(sample: StoredSample) -> None:
    scan = sample.scans[0]
    camera_scan, fit = scan.radiance().cameras[1], first_fit(sample)
    curve = curve_of(camera_scan, fit)
    fitted = fitted_radiance(fit, camera_scan.light_direction, camera_scan.view_direction)
    order = np.argsort(np.arctan2(*camera_scan.light_direction[:, [0, 2]].T))
    np.testing.assert_allclose(curve.radiance - curve.residual, fitted[order], rtol=0, atol=1e-12)
    # linear interpolation of directions, 0.1 deg apart: within 1e-3 of the peak
    between = np.interp(curve.angle_deg, curve.fit_angle_deg, curve.fit_radiance[:, 0])
    np.testing.assert_allclose(between, fitted[order][:, 0], atol=1e-3 * fitted.max())
    # noise of 0.005 sqrt(0.01 + radiance), radiance below 1.3: 5 deviations are below 0.03
    assert np.abs(curve.residual).max() < 0.03


def test_without_a_fit_only_points_are_drawn(make_database: MakeDatabase) -> None:
    sample = read_database(make_database(scans=1, unfitted=(1,))).samples[0]
    curve = curve_of(sample.scans[0].radiance().cameras[1], None)
    assert len(curve.radiance) > 300
    assert curve.fit_angle_deg.size == curve.residual.size == 0
    check_labels(curves_figure(sample))


def test_first_middle_and_last_fitted_scan_are_chosen(
    sample: StoredSample, make_database: MakeDatabase
) -> None:
    assert [scan.scan for scan in choose_scans(sample)] == [1, 2, 5]
    two = read_database(make_database(scans=2)).samples[0]
    assert [scan.scan for scan in choose_scans(two)] == [1, 2]


def test_peaks_that_differ_much_get_a_logarithmic_axis(
    sample: StoredSample, make_database: MakeDatabase
) -> None:
    assert curves_figure(sample).axes[0].get_yscale() == "linear"
    fading = SettlingDust(
        kd=(0.02, 0.02, 0.02),
        w=(0.02, 0.02, 0.02),
        g=0.0,
        tau_per_min=0.5,
        ks=3.0,
        sigma_s=0.1,
        attenuation=3.3,
    )
    faded = read_database(make_database(fading, scans=2, unfitted=(1, 2), noise=1e-3)).samples[0]
    figure = curves_figure(faded)
    assert figure.axes[0].get_yscale() == "log"
    check_labels(figure)


def test_parameters_against_time(sample: StoredSample, path: Path) -> None:
    truth = read_truth(path)
    all_series = series_of(sample, truth)
    assert [series.name for series in all_series] == list(first_fit(sample).parameter_names)
    ks = next(series for series in all_series if series.name == "ks")
    np.testing.assert_array_equal(ks.time_s, [0.0, 120.0, 480.0])
    np.testing.assert_array_equal(ks.true_time_s, [0.0, 120.0, 240.0, 360.0, 480.0])
    assert ks.true_value[0] == 1.1
    assert set(grouped(all_series)) == {"kd", "sigma_d", "ks", "inverse_sigma_s"}
    assert [series.name for series in grouped(all_series)["kd"]] == ["kd_b", "kd_g", "kd_r"]
    assert series_of(sample, Truth({}, {}))[0].true_value.size == 0
    figure = parameters_figure(sample, truth=truth)
    labels = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert labels == ["blue", "green", "red", "fitted ± 1 sd", "truth", "missing"]


def test_an_empty_database_has_a_summary_only(tmp_path: Path) -> None:
    DatabaseStore(tmp_path / "database", "blue_paint").close()
    assert set(make_report(tmp_path / "database", tmp_path / "out")) == {"summary", "summary_json"}
    database: StoredDatabase = read_database(tmp_path / "database")
    with pytest.raises(DatabaseError, match="no scan to plot"):
        curves_figure(database.samples[0])
    with pytest.raises(DatabaseError, match="no fitted scan to plot"):
        parameters_figure(database.samples[0])
    with pytest.raises(DatabaseError, match="no database"):
        make_report(tmp_path / "elsewhere", tmp_path / "out")


def test_units_of_time() -> None:
    assert [time_unit([0.0, t]).sign for t in (36.0, 600.0, 36_000.0)] == ["s", "min", "h"]
    assert time_unit([]).sign == "s"


def test_pyplot_and_sqlalchemy_are_not_needed(path: Path, tmp_path: Path) -> None:
    code = (
        "import sys; from tvbrdf_rendering.report import make_report;"
        "make_report(sys.argv[1], sys.argv[2]);"
        "print({'matplotlib.pyplot', 'sqlalchemy'} & set(sys.modules))"
    )
    command = [sys.executable, "-W", "error", "-c", code, str(path), str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert (result.stdout, result.stderr) == ("set()\n", "")
