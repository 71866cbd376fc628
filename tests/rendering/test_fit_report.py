"""Pictures of fits: what they show is what was measured and fitted, and every label can be read."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from tests.rendering.labels import check_labels
from tests.rig_scans import deviation, observe
from tvbrdf_fitting import FitResult, Observations, fit_scan
from tvbrdf_fitting.choice.choose import choose_model
from tvbrdf_fitting.models import SURFACE, get_model
from tvbrdf_rendering.fit_curves import camera_curves, fit_curves_figure, residuals
from tvbrdf_rendering.fit_report import (
    FittedSample,
    FittedScan,
    as_stored,
    parameters_in_time,
    pictured,
    trends,
    write_fits,
    write_pictures,
)
from tvbrdf_rendering.lobe import in_plane, lobe_amplitudes, lobe_figure, lobes

PAINT = (0.08, 0.2, 0.45, 0.3, 0.6, 9.0)
GLOSS = (0.02, 0.02, 0.03, 0.0, 20.0, 15.0)


@pytest.fixture(scope="module")
def paint() -> tuple[Observations, FitResult]:
    observations = observe(PAINT)
    return observations, fit_scan(observations)


@pytest.fixture(scope="module")
def gloss() -> tuple[Observations, FitResult]:
    observations = observe(GLOSS)
    return observations, fit_scan(observations)


def fitted_sample(count: int, *, timed: bool = True, model: str = SURFACE) -> FittedSample:
    """A paint whose highlight fades while its colour stays."""
    scans = []
    for number in range(1, count + 1):
        truth = (*PAINT[:4], 0.9 * 0.7**number, PAINT[5])
        observations = observe(truth, seed=number)
        time_s = 120.0 * (number - 1) if timed else None
        scans.append(
            FittedScan(
                scan=number,
                time_s=time_s,
                exposures_ms=(0.2, 4.0, 32.0),
                observations=observations,
                source="grid",
                fit=fit_scan(observations, model),
                remarks=("odd",) if number == 2 else (),
            )
        )
    return FittedSample("red_paint", "drying paint", Path("sample01"), tuple(scans), ("strange",))


@pytest.fixture(scope="module")
def sample() -> FittedSample:
    return fitted_sample(6)


# -- curves


def test_curves_are_what_was_measured_and_fitted(paint: tuple[Observations, FitResult]) -> None:
    observations, fit = paint
    curves = camera_curves(observations, fit)
    assert [curve.camera for curve in curves] == [1, 2, 3, 4]
    angles = [curve.camera_angle_deg for curve in curves]
    np.testing.assert_allclose(angles, [0.0, 25.0, 50.0, 75.0], atol=1e-9)
    for curve in curves:
        rows = observations.camera == curve.camera
        np.testing.assert_array_equal(curve.radiance, observations.radiance[rows])
        expected = fit.radiance(
            observations.light_direction[rows], observations.view_direction[rows]
        )
        np.testing.assert_allclose(curve.fitted, expected, rtol=1e-12, atol=0)
        # linear between points 0.1 degrees apart: the lobe bends by 1e-4 of its peak within them
        between = np.stack(
            [np.interp(curve.angle_deg, curve.curve_deg, channel) for channel in curve.curve.T], 1
        )
        np.testing.assert_allclose(between, curve.fitted, atol=2e-4 * expected.max())
        # 5 deviations of 4000 values
        noise = np.sqrt(observations.variance[rows])
        assert (np.abs(residuals(curve, logarithmic=False)) < 5 * noise).all()


def test_the_axis_is_the_lights_world_angle(paint: tuple[Observations, FitResult]) -> None:
    curve = camera_curves(*paint)[0]
    np.testing.assert_allclose(curve.angle_deg, np.round(curve.angle_deg * 2) / 2, atol=1e-9)
    assert curve.angle_deg[0] == pytest.approx(-77.5)
    assert curve.angle_deg[-1] == pytest.approx(90.0)
    # the highlight: light and camera 1 mirrored about the normal, 12 degrees off the vertical
    peak = curve.curve_deg[np.argmax(curve.curve[:, 0])]
    assert peak == pytest.approx(24.0, abs=1.0)
    ((low, high),) = curve.gaps_deg
    assert (low, high) == pytest.approx((-2.0, 2.0))
    assert curve.gaps_are_the_arms


def test_values_that_are_not_valid_are_not_shown(paint: tuple[Observations, FitResult]) -> None:
    observations, fit = paint
    valid = observations.valid.copy()
    valid[:100, 1] = False
    valid[40:100] = False
    radiance = np.where(valid, observations.radiance, np.nan)
    curve = camera_curves(replace(observations, valid=valid, radiance=radiance), fit)[0]
    assert len(curve.angle_deg) == len(camera_curves(observations, fit)[0].angle_deg) - 60
    assert np.isnan(curve.radiance[:, 1]).sum() == 40
    assert np.isnan(residuals(curve, logarithmic=True)[:, 1]).sum() >= 40
    assert len(curve.gaps_deg) == 2
    assert not curve.gaps_are_the_arms
    check_labels(fit_curves_figure(replace(observations, valid=valid, radiance=radiance), fit))


def test_high_peaks_get_a_logarithmic_axis(
    paint: tuple[Observations, FitResult], gloss: tuple[Observations, FitResult]
) -> None:
    for (observations, fit), axis, expected in (
        (paint, "auto", "linear"),
        (gloss, "auto", "log"),
        (gloss, "linear", "linear"),
        (paint, "log", "log"),
    ):
        figure = fit_curves_figure(observations, fit, axis=axis)  # type: ignore[arg-type]
        assert {axes.get_yscale() for axes in figure.axes[:2]} == {expected}
        check_labels(figure)


def test_logarithmic_residuals_are_logarithms(gloss: tuple[Observations, FitResult]) -> None:
    curve = camera_curves(*gloss)[0]
    ratio = residuals(curve, logarithmic=True)
    bright = curve.fitted > 0.1
    np.testing.assert_allclose(
        np.exp(ratio[bright]), (curve.radiance / curve.fitted)[bright], rtol=1e-12
    )
    doubled = replace(curve, radiance=2 * curve.fitted)
    assert residuals(doubled, logarithmic=True)[bright] == pytest.approx(np.log(2.0))


def test_one_camera_or_three_are_drawn(paint: tuple[Observations, FitResult]) -> None:
    observations, fit = paint
    for cameras in ((3,), (1, 2, 4)):
        some = observations.select(np.isin(observations.camera, cameras))
        figure = fit_curves_figure(some, fit)
        assert len(figure.axes) == 2 * len(cameras)
        check_labels(figure)


# -- lobe


def test_the_lobe_is_the_fitted_brdf(paint: tuple[Observations, FitResult]) -> None:
    observations, fit = paint
    moving, *standing = lobes(observations, fit)
    assert moving.moving == "light"
    assert moving.standing_deg == pytest.approx(-12.0)
    view = np.broadcast_to(in_plane(-12.0), (len(moving.angle_deg), 3))
    expected = fit.brdf(in_plane(moving.angle_deg), view)
    np.testing.assert_allclose(moving.total, expected, rtol=1e-9)
    rows = (observations.camera == 1) & (observations.cosine_light > np.cos(np.deg2rad(88.8)))
    measured = observations.radiance[rows] / (np.pi * observations.cosine_light[rows][:, None])
    shown = moving.measured[np.abs(moving.measured_deg) < 88.8]
    np.testing.assert_allclose(shown, measured, rtol=1e-9)
    assert [lobe.standing_deg for lobe in standing] == pytest.approx([12.0, 45.0, 70.0])
    for lobe in standing:
        light = np.broadcast_to(in_plane(lobe.standing_deg), (len(lobe.angle_deg), 3))
        np.testing.assert_allclose(lobe.total, fit.brdf(light, in_plane(lobe.angle_deg)), rtol=1e-9)
        # camera 1 saw this light from -12 degrees: within 5 deviations of the mean of 2 or 3 values
        seen = lobe.measured[0]
        at = fit.brdf(in_plane(lobe.standing_deg), in_plane(-12.0))[0]
        cosine = np.cos(np.deg2rad(lobe.standing_deg))
        noise = deviation(np.pi * cosine * at) / (np.pi * cosine)
        # the values are up to half a degree apart, over which the lobe changes by 1 per cent
        assert (np.abs(seen - at) < 5 * noise + 0.01 * at).all()


def test_parts_of_the_lobe_are_the_models(paint: tuple[Observations, FitResult]) -> None:
    observations, fit = paint
    lobe = lobes(observations, fit)[0]
    view = np.broadcast_to(in_plane(-12.0), (len(lobe.angle_deg), 3))
    light = in_plane(lobe.angle_deg)
    diffuse = get_model("oren_nayar").evaluate(light, view, fit.values[:4])
    specular = get_model("torrance_sparrow").evaluate(light, view, fit.values[4:])
    np.testing.assert_allclose(lobe.diffuse, diffuse, rtol=1e-12)
    np.testing.assert_allclose(lobe.specular, specular, atol=1e-12)


@pytest.mark.parametrize(
    ("model", "amplitudes"),
    [
        ("lambert", ()),
        ("oren_nayar", ()),
        (SURFACE, ("ks",)),
        ("torrance_sparrow(coloured)", ("ks_b", "ks_g", "ks_r")),
        (
            "lambert+torrance_sparrow(coloured)+torrance_sparrow(coloured)",
            ("ks_b", "ks_g", "ks_r", "ks_b_2", "ks_g_2", "ks_r_2"),
        ),
        ("lambert+cook_torrance(ggx)", ("ks",)),
        ("dust", ("ks",)),
    ],
)
def test_amplitudes_of_lobes(model: str, amplitudes: tuple[str, ...]) -> None:
    chosen = get_model(model)
    assert lobe_amplitudes(chosen) == amplitudes
    without = chosen.as_mapping(chosen.typical) | dict.fromkeys(amplitudes, 0.0)
    light, view = in_plane(12.0), in_plane(-12.0)
    whole = chosen.evaluate(light, view, chosen.typical)
    diffuse = chosen.evaluate(light, view, chosen.from_mapping(without))
    assert ((diffuse < whole).all()) == bool(amplitudes)


def test_a_lobe_that_no_camera_sees_in_its_plane(paint: tuple[Observations, FitResult]) -> None:
    observations, fit = paint
    others = observations.select(observations.camera > 1)
    panels = lobes(others, fit)
    assert [lobe.moving for lobe in panels] == ["view"] * 3
    assert all(len(lobe.measured) == 0 for lobe in panels)
    check_labels(lobe_figure(others, fit))


def test_labels_of_the_lobe_can_be_read(
    paint: tuple[Observations, FitResult], gloss: tuple[Observations, FitResult]
) -> None:
    for observations, fit in (paint, gloss):
        check_labels(lobe_figure(observations, fit, title="red_paint, scan 1"))
    two = "lambert+torrance_sparrow(coloured)+cook_torrance(ggx,coloured)"
    observations = gloss[0]
    fit = fit_scan(observations, two)
    title = f"a_sample_with_a_long_name, scan 47: {two}"
    check_labels(lobe_figure(observations, fit, title=title))
    check_labels(fit_curves_figure(observations, fit, title=title))


# -- samples


def test_trends_are_those_of_the_sample(sample: FittedSample) -> None:
    found = {trend.name: trend for trend in trends(sample)}
    assert list(found) == list(sample.scans[0].fit.parameter_names)
    assert found["ks"].kind == "falls"
    assert found["ks"].first == sample.scans[0].fit.value("ks")
    assert found["ks"].slope is not None
    assert found["ks"].slope < 0
    assert {trend.per for trend in found.values()} == {"min"}
    # constant in truth; at 3 deviations of two tests each, one in 100 of such a set would be wrong
    for name in ("kd_b", "kd_g", "kd_r", "sigma_d", "inverse_sigma_s"):
        trend = found[name]
        assert trend.kind == "constant", name
        assert trend.mean is not None
        assert trend.mean_deviation is not None
        true = dict(zip(sample.scans[0].fit.parameter_names, PAINT, strict=True))[name]
        assert abs(trend.mean - true) < 4.5 * trend.mean_deviation


def test_a_straight_line_has_its_slope() -> None:
    scans = []
    base = fitted_sample(1).scans[0]
    for number in range(1, 6):
        values = base.fit.values.copy()
        values[0] = 0.1 + 0.02 * number
        scans.append(replace(base, scan=number, time_s=60.0 * number, fit=_with(base, values)))
    sample = FittedSample("line", "", Path("x"), tuple(scans))
    rising = trends(sample)[0]
    assert rising.kind == "rises"
    assert rising.slope == pytest.approx(0.02, rel=1e-9)
    # weighted: deviations of one scan over the time's spread of sqrt(10) minutes
    assert rising.slope_deviation == pytest.approx(
        base.fit.standard_deviation("kd_b") / np.sqrt(10), rel=1e-6
    )
    untimed = replace(sample, scans=tuple(replace(scan, time_s=None) for scan in scans))
    assert trends(untimed)[0].per == "scan"
    assert trends(replace(sample, scans=tuple(scans[:2])))[0].kind == "unknown"
    assert trends(replace(sample, scans=tuple(scans[:1]))) == ()


def _with(scan: FittedScan, values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> FitResult:
    return replace(scan.fit, values=values)


def test_everything_is_valid_json(sample: FittedSample, tmp_path: Path) -> None:
    observations = sample.scans[0].observations
    choice = choose_model(observations)
    chosen = replace(sample.scans[0], fit=choice.result, choice=choice)
    path = write_fits(tmp_path / "new" / "fit.json", replace(sample, scans=(chosen,)).as_dict())
    content = json.loads(path.read_text())
    assert content["sample"] == "red_paint"
    (scan,) = content["scans"]
    assert scan["values"] == observations.usable.sum()
    assert scan["fit"]["values"] == chosen.fit.values.tolist()
    assert "result" not in scan["choice"]
    kept = [rung for rung in scan["choice"]["rungs"] if not rung["rejected"]]
    assert [rung["model"] for rung in kept] == [scan["choice"]["model"]]
    whole = sample.as_dict()
    json.dumps(whole, allow_nan=False)
    assert whole["pooled_errors"]["scans"] == 6
    assert sample.all_remarks == ("strange", "scan 2: odd")


def test_pictures_of_a_sample(sample: FittedSample, tmp_path: Path) -> None:
    assert [scan.scan for scan in pictured(sample)] == [1, 3, 6]
    written = write_pictures(replace(sample, scans=sample.scans[:2]), tmp_path / "new")
    assert list(written) == [
        "scan01/curves", "scan01/lobe", "scan01/blind",
        "scan02/curves", "scan02/lobe", "scan02/blind", "parameters"
    ]  # fmt: skip
    for path in written.values():
        assert imread(path).shape[1] > 1000
    only = write_pictures(replace(sample, scans=sample.scans[:1]), tmp_path / "one")
    assert list(only) == ["scan01/curves", "scan01/lobe", "scan01/blind"]


def test_parameters_over_time_and_over_scans(sample: FittedSample) -> None:
    figure = parameters_in_time(sample)
    check_labels(figure)
    assert {axes.get_xlabel() for axes in figure.axes} - {""} == {"time / min"}
    figure = parameters_in_time(fitted_sample(3, timed=False))
    check_labels(figure)
    assert {axes.get_xlabel() for axes in figure.axes} - {""} == {"scan"}
    for first in (1, 200):
        moved = [
            replace(scan, scan=scan.scan + first - 1, time_s=None) for scan in sample.scans[:3]
        ]
        drawn = parameters_in_time(replace(sample, scans=tuple(moved)))
        shown = {float(x) for line in drawn.axes[0].lines for x in np.asarray(line.get_xdata())}
        # without times the axis counts scans, whatever unit their number would suggest
        assert shown == {float(scan.scan) for scan in moved}


def test_fixed_parameters_and_second_lobes_in_pictures(
    gloss: tuple[Observations, FitResult],
) -> None:
    two = "lambert+torrance_sparrow(coloured)+cook_torrance(ggx,coloured)"
    fit = fit_scan(gloss[0], two, fixed={"eta_2": 1.5})
    scan = FittedScan(1, 0.0, (4.0,), gloss[0], "frames", fit)
    stored = as_stored(FittedSample("x", "", Path("x"), (scan,))).scans[0].fit
    assert stored is not None
    assert "eta_2" not in stored.parameter_names
    assert {"ks_2_b", "ks_2_g", "ks_2_r"} <= set(stored.parameter_names)
    assert stored.values[stored.parameter_names.index("ks_2_r")] == fit.value("ks_r_2")
    assert stored.covariance.shape == (len(stored.values),) * 2
    other = replace(scan, scan=2, time_s=60.0)
    check_labels(parameters_in_time(FittedSample("x", "", Path("x"), (scan, other))))
