"""Designs: is the predicted accuracy the fit's own, does it come true, and are they the fewest?"""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import chain, combinations, pairwise
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from tests.fitting.scans import SATIN
from tests.paths import CALIBRATION_FILE
from tvbrdf_fitting import CommonErrors, fit_scan, get_model
from tvbrdf_fitting.design.fisher_information import Information, NoiseModel, Rig
from tvbrdf_fitting.design.search import (
    PHASES,
    Accuracy,
    Design,
    DesignStudy,
    default_accuracy,
    find_designs,
    make_design,
    meaningless,
)
from tvbrdf_fitting.design.simulation import confirm, simulate_design
from tvbrdf_fitting.geometry import above_horizon, light_direction
from tvbrdf_fitting.measurement.calibration import load_calibration

EXPOSURES_MS = (0.2, 4.0, 32.0)
MATTE = [0.3, 0.5, 0.7, 0.4, 0.02, 3.0]
SHARP = [0.05, 0.12, 0.4, 0.2, 3.0, 50.0]
DUST = [0.3, 0.5, 0.7, 0.4, 0.8, 6.0, 0.05, 0.06, 0.07, 0.35, 0.5]
COMMON = CommonErrors(light_angle_std_deg=0.02, gain_relative_std=0.005, plate_tilt_std_deg=0.05)
NOISY = Rig(noise=NoiseModel(pixels=40, frame_relative_std=0.02))
"""A cheap camera under a flickering lamp, so that lights are needed."""


def study_of(values: list[float], rig: Rig | None = None, **more: Any) -> DesignStudy:
    parameters = get_model("ON+TS").as_mapping(values)
    return find_designs("ON+TS", parameters, rig=rig or NOISY, **more)


# -- the prediction is the fit's


@pytest.mark.parametrize("common", [None, COMMON], ids=["alone", "shared"])
@pytest.mark.parametrize(
    ("model", "values", "fixed"),
    [
        ("ON+TS", SATIN, ()),
        ("ON+TS", SHARP, ()),
        ("oren_nayar+torrance_sparrow(coloured)", [*SATIN[:5], 0.6, 0.4, 6.0], ("sigma_d",)),
        ("dust", DUST, ("w_b", "w_g", "w_r", "g")),
    ],
)
def test_deviations_are_those_that_a_fit_states(
    model: str, values: list[float], fixed: tuple[str, ...], common: CommonErrors | None
) -> None:
    information = Information(NOISY, model, values, EXPOSURES_MS, fixed=fixed, common_errors=common)
    cameras, exposures = (1, 3, 4), (0.2, 32.0)
    predicted = information.deviations(cameras, exposures, 50, 0.3)
    scan = NOISY.observe(
        information.model,
        information.values,
        cameras=cameras,
        exposures_ms=exposures,
        lights=50,
        phase=0.3,
    )
    fit = fit_scan(scan, model, fixed=information.fixed, common_errors=information.common_errors)
    # The fit stops within 1e-5 of a deviation or so of the truth, where deviations hardly change;
    # Gram matrices of columns with a condition below 1e4 lose 8 digits.
    np.testing.assert_allclose(predicted.published, fit.standard_deviations, rtol=1e-6)
    internal = np.sqrt(np.diag(fit.internal_covariance))
    np.testing.assert_allclose(predicted.internal, internal, rtol=1e-6)
    share = np.diag(fit.covariance_common) / np.maximum(np.diag(fit.covariance), 1e-300)
    np.testing.assert_allclose(predicted.common_share, share, atol=1e-6)


def test_flicker_that_channels_share_counts_once() -> None:
    """Three channels of one frame say of a lobe's width what one of them does."""
    quiet = NoiseModel(pixels=10**9, read_noise_e=1.0, frame_relative_std=0.01)
    alone = Information(Rig(noise=quiet), "ON+TS", SATIN, (4.0,))
    together = alone.deviations((1,), (4.0,), 40).internal
    blocks, excess, _ = alone.blocks(40)
    own = np.linalg.inv(blocks[0, 0])
    assert together[4] ** 2 == pytest.approx((own + own @ excess[0, 0] @ own)[4, 4], rel=1e-9)
    # as if each channel had its own flicker, it would be nearly the root of 3 too small
    assert together[4] > 1.5 * np.sqrt(own[4, 4])


def test_more_cameras_never_hurt() -> None:
    for common in (None, COMMON):
        information = Information(NOISY, "ON+TS", SATIN, EXPOSURES_MS, common_errors=common)
        known = {
            chosen: information.deviations(chosen, EXPOSURES_MS, 30).internal
            for k in range(1, 5)
            for chosen in combinations((1, 2, 3, 4), k)
        }
        for some, more in ((a, b) for a in known for b in known if set(a) < set(b)):
            # rounding; the lobe's width is unknown to cameras 3 and 4 alone, where both are huge
            assert (known[more] <= known[some] * (1 + 1e-6)).all(), (some, more)


def test_fewer_values_than_parameters_determine_nothing() -> None:
    """Cameras 3 and 4 see no lobe of 1 degree, and a fit refuses three values all the same."""
    values = [0.3, 0.5, 0.7, 0.8, 50.0]
    information = Information(NOISY, "lambert+torrance_sparrow", values, (4.0,))
    assert np.isinf(information.deviations((4,), (4.0,), 1).published).all()
    two = information.deviations((3, 4), (4.0,), 1).published
    np.testing.assert_array_equal(np.isfinite(two), [True, True, True, False, False])


def test_lights_are_spread_over_the_horizon() -> None:
    rig = Rig()
    angle = rig.lights_deg(100, 0.125)
    assert above_horizon(light_direction(angle)).all()
    np.testing.assert_allclose(np.diff(angle), 1.68)
    assert -78 < angle[0] < -77
    hidden = rig.observe(
        get_model("ON+TS"), np.array(SATIN), cameras=(1, 2), exposures_ms=(4.0,), lights=100
    )
    seen = [int((hidden.camera == camera).sum()) for camera in (1, 2)]
    gap = np.abs(rig.lights_deg(100)) <= 1.75
    assert seen == [100 - gap.sum(), 100]
    assert gap.sum() == 2
    # wherever it is in the list, the camera in the light's plane is the one behind the arm
    turned = replace(rig, camera_angles_deg=(25.0, 0.0))
    hidden = turned.observe(
        get_model("ON+TS"), np.array(SATIN), cameras=(1, 2), exposures_ms=(4.0,), lights=100
    )
    assert [int((hidden.camera == camera).sum()) for camera in (1, 2)] == [100, 98]
    assert rig.time_s(361, (0.2, 4.0)) == pytest.approx(2 * 361 / 30)
    assert rig.time_s(20, EXPOSURES_MS) == pytest.approx(36.0)
    assert rig.time_s(200, (100.0,)) == pytest.approx(20.0)


def test_the_noise_is_the_simulated_rigs() -> None:
    """By the calibration file's own formula, for a white diffuser and a dark one."""
    camera = load_calibration(CALIBRATION_FILE).cameras[2]
    noise = NoiseModel()
    radiance, exposure = np.array([[1.0, 0.1, 0.0]]), np.array([4.0])
    scale = np.array(camera.radiance_per_dn_per_ms) / exposure[:, None]
    pixels = 128 * 128 * camera.patch.height
    own = camera.pixel_variance_dn2(radiance / scale) / pixels * scale**2
    expected = own + (camera.relative_noise_std * radiance) ** 2
    np.testing.assert_allclose(noise.variance(radiance, exposure), expected, rtol=1e-3)
    assert noise.own_variance(radiance, exposure) == pytest.approx(own, rel=1e-3)
    full = camera.saturation_linear_dn - camera.black_level_dn
    level = full * np.array(camera.radiance_per_dn_per_ms)
    assert noise.saturation_radiance_ms == pytest.approx(level[0], rel=1e-3)
    # 4 standard deviations below: 6.667 at 1 ms is 10000 electrons, whose noise is 100
    at = np.array([[0.95, 0.97, 1.0]]) * noise.saturation_radiance_ms
    np.testing.assert_array_equal(noise.unsaturated(at, np.ones(1)), [[True, False, False]])


# -- it comes true


@pytest.mark.parametrize("values", [MATTE, SATIN, SHARP], ids=["matte", "satin", "sharp"])
def test_simulated_errors_are_as_predicted(values: list[float]) -> None:
    study = study_of(values, exposures_ms=(0.2, 4.0))
    information, scans = study.information, 400
    # all cameras and twice the fewest lights: where the linear prediction holds
    lights = 2 * min(d.lights for d in study.designs)
    design = make_design(information, study.wanted, (1, 2, 3, 4), (0.2, 4.0), lights)
    errors = simulate_design(information, design, scans=scans, seed=1)
    squares = scans * np.square(errors.simulated / errors.predicted)
    # six parameters, 99.9 % for each
    assert (squares > chi2.ppf(5e-4, scans)).all(), errors.simulated / errors.predicted
    assert (squares < chi2.isf(5e-4, scans)).all(), errors.simulated / errors.predicted
    assert (np.abs(errors.bias) < 4).all()
    assert (errors.low < errors.simulated).all()
    assert (errors.simulated < errors.high).all()
    np.testing.assert_allclose(errors.predicted, design.predicted.published)


def test_simulated_errors_with_common_errors() -> None:
    study = study_of(SATIN, common_errors=COMMON, exposures_ms=(4.0,))
    assert study.fewest is not None
    errors = simulate_design(study.information, study.fewest, scans=100, seed=2)
    squares = 100 * np.square(errors.simulated / errors.predicted)
    assert (squares > chi2.ppf(5e-4, 100)).all(), errors.simulated / errors.predicted
    assert (squares < chi2.isf(5e-4, 100)).all(), errors.simulated / errors.predicted


def test_the_noise_is_what_is_simulated() -> None:
    """The check above can fail: half of the pixels give 1.41 times the errors."""
    study = study_of(SATIN, Rig(noise=NoiseModel(pixels=40, frame_relative_std=0.0)))
    half = study_of(SATIN, Rig(noise=NoiseModel(pixels=20, frame_relative_std=0.0)))
    design = make_design(study.information, study.wanted, (1, 2, 3, 4), (4.0,), 40)
    errors = simulate_design(half.information, design, scans=200, seed=3)
    np.testing.assert_allclose(errors.simulated / errors.predicted, np.sqrt(2), rtol=0.2)


def test_a_design_that_does_not_come_true_gets_more_lights() -> None:
    """At 4 ms the sharp peak saturates: it is known by its flanks, and not linearly."""
    study = study_of(SHARP, common_errors=COMMON, cameras=(1,), exposures_ms=(4.0,))
    assert study.fewest is not None
    trials = confirm(study, scans=60, seed=0)
    assert trials[0].design is study.fewest
    assert not trials[0].reached
    for before, after in pairwise(trials):
        assert not before.reached
        assert after.design.lights > before.design.lights
    wanted = np.array([*study.wanted.values()])
    assert trials[-1].reached == (not (trials[-1].errors.low > wanted).any())
    with pytest.raises(ValueError, match="at least two"):
        simulate_design(study.information, study.fewest, scans=1)


# -- they are the fewest


def subsets(items: tuple[float, ...]) -> chain[tuple[float, ...]]:
    return chain.from_iterable(combinations(items, k) for k in range(1, len(items) + 1))


def test_designs_are_those_of_a_search_through_all() -> None:
    study = study_of(SATIN, exposures_ms=(0.2, 4.0), cameras=(1, 2, 4), most_lights=80)
    information = study.information

    def reaches(cameras: tuple[int, ...], exposures: tuple[float, ...], lights: int) -> bool:
        return make_design(information, study.wanted, cameras, exposures, lights).ratio <= 1

    everything = []
    for cameras in subsets((1, 2, 4)):
        for exposures in subsets((0.2, 4.0)):
            good = [reaches(cameras, exposures, n) for n in range(1, 81)]  # type: ignore[arg-type]
            lasting = [n for n in range(1, 81) if all(good[n - 1 :])]
            if lasting:
                time_s = information.rig.time_s(lasting[0], exposures)
                everything.append((lasting[0] * len(exposures), len(cameras), time_s))
    best = {
        one
        for one in everything
        if not any(
            all(a <= b for a, b in zip(o, one, strict=True)) and o != one for o in everything
        )
    }
    found = {(d.frames, len(d.cameras), d.time_s) for d in study.designs}
    # Beyond a quarter more lights numbers are not checked: a design may be smaller than one whose
    # larger numbers all reach the accuracy, but here deviations fall evenly.
    assert found == best
    assert study.fewest is study.designs[0]
    assert study.fewest.images == min(d.images for d in study.designs)
    for design in study.designs:
        assert design.ratio <= 1
        assert design.phase in PHASES
        assert design.images == design.lights * len(design.exposures_ms) * len(design.cameras)


def test_a_sharp_lobe_needs_more_lights_than_a_broad_one() -> None:
    wanted = {"kd_b": Accuracy(np.inf), "kd_g": Accuracy(np.inf), "sigma_d": Accuracy(np.inf)}
    lights = []
    for sigma_s in (0.2, 0.02):
        values = [0.1, 0.1, 0.1, 0.3, 0.8, 1 / sigma_s]
        study = study_of(values, Rig(), accuracy=wanted)
        assert study.fewest is not None
        lights.append(study.fewest.lights)
    # the lobe is 2.3 degrees wide in the light's angle, of 168: tens of lights
    assert lights[1] > 3 * lights[0]
    assert 15 < lights[1] < 168


def test_a_finer_accuracy_needs_more() -> None:
    images = []
    for part in (0.1, 0.05, 0.025):
        accuracy = {name: Accuracy(part, relative=True) for name in ("ks", "inverse_sigma_s")}
        fewest = study_of(SATIN, accuracy=accuracy | {"sigma_d": Accuracy(0.3 * part)}).fewest
        assert fewest is not None
        images.append(fewest.images)
    assert images[0] < images[1] < images[2]


def test_what_cannot_be_reached_is_said() -> None:
    accuracy = {"ks": Accuracy(0.001, relative=True)}
    gains = study_of(SATIN, Rig(), accuracy=accuracy, common_errors=COMMON)
    assert gains.designs == ()
    assert gains.fewest is None
    (short,) = gains.shortfalls
    assert short.name == "ks"
    assert short.wanted == pytest.approx(0.0008)
    place = gains.information.model.parameter_names.index("ks")
    assert short.deviation == gains.largest.predicted.published[place]
    assert short.common_share > 0.5
    assert gains.largest.lights == 361
    reason = gains.reason()
    assert "cameras 1, 2, 3, 4, exposures of 0.2, 4, 32 ms and 361 lights ks is known to" in reason
    assert "errors that frames share" in reason
    # camera 4 sees half angles above 37 degrees only
    blind = study_of(SHARP, cameras=(4,))
    assert "ks is not determined at all" in blind.reason()
    assert "inverse_sigma_s is not determined at all" in blind.reason()
    assert blind.largest.predicted.published[0] < 0.01
    # saturated everywhere
    assert "not determined" in study_of(SATIN, exposures_ms=(1e5,)).reason()
    assert confirm(blind) == ()


# -- what is asked


def test_accuracy() -> None:
    assert Accuracy(0.05, relative=True).of(0.4) == pytest.approx(0.02)
    assert Accuracy(0.05, relative=True).of(-0.4) == pytest.approx(0.02)
    assert Accuracy(0.03).of(0.4) == 0.03
    assert Accuracy(0.05, relative=True).of(0.0) == pytest.approx(0.001)
    standard = default_accuracy(get_model("dust"))
    assert standard["sigma_d"] == standard["g"] == Accuracy(0.03)
    assert standard["ks"] == standard["inverse_sigma_s"] == Accuracy(0.05, relative=True)


def test_what_nothing_depends_on_is_not_asked_for() -> None:
    model = get_model("ON+TS")
    assert meaningless(model, np.array(SATIN)) == ()
    bare = [0.3, 0.5, 0.7, 0.4, 0.0, 6.0]
    assert meaningless(model, np.array(bare)) == ("inverse_sigma_s",)
    study = study_of(bare, Rig())
    assert "inverse_sigma_s" not in study.wanted
    assert study.wanted["ks"] == pytest.approx(0.001)
    assert study.fewest is not None
    errors = simulate_design(study.information, study.fewest, scans=100, seed=1)
    assert errors.at_bound == (False, False, False, False, True)
    # half of the errors are cut off at 0: their mean square is half, or less
    assert errors.simulated[4] < 0.85 * errors.predicted[4]
    assert (errors.simulated[:3] < 1.3 * errors.predicted[:3]).all()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"cameras": (5,)}, r"cameras \[5\] .the rig has \[1, 2, 3, 4\]"),
        ({"cameras": ()}, "at least one"),
        ({"exposures_ms": (0.0,)}, "above 0"),
        ({"exposures_ms": (np.inf,)}, r"exposures of \[inf\]"),
        ({"exposures_ms": ()}, r"exposures of \[\]"),
        ({"most_lights": 0}, "at least one is needed"),
        ({"most_lights": 10**9}, "take too long"),
        ({"fixed": get_model("ON+TS").parameter_names}, "every parameter is fixed or any"),
        ({"accuracy": dict.fromkeys(get_model("ON+TS").parameter_names, Accuracy(np.inf))}, "any"),
        ({"fixed": ("w",)}, "no parameter 'w'; it has kd_b"),
        ({"accuracy": {"kx": Accuracy(0.1)}}, "no parameter 'kx'"),
    ],
)
def test_what_makes_no_sense_is_refused(more: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        study_of(SATIN, **more)


def test_impossible_materials_rigs_and_noise_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"inverse_sigma_s = 1000 is outside \[0.666667, 200\] 1/rad"
    ):
        study_of([*SATIN[:5], 1000.0])
    with pytest.raises(ValueError, match="parameters missing"):
        find_designs("ON+TS", {"kd_b": 0.3})
    model = get_model("ward(anisotropic)")
    with pytest.raises(ValueError, match="anisotropic"):
        find_designs(model, model.as_mapping(model.typical))
    with pytest.raises(ValueError, match="no light"):
        study_of(SATIN, Rig(sweep_deg=(-90.0, -80.0)))
    for part in fields(NoiseModel):
        with pytest.raises(ValueError, match=part.name):
            NoiseModel(**{part.name: -1})
    for wrong in ({"tilt_deg": np.nan}, {"tilt_deg": 90.0}, {"camera_angles_deg": (0.0, 95.0)},
                  {"sweep_deg": (10.0, -10.0)}, {"sweep_deg": (-np.inf, 90.0)}):  # fmt: skip
        with pytest.raises(ValueError, match=f"rig: {next(iter(wrong))}"):
            Rig(**wrong)


def test_other_rigs() -> None:
    """Two cameras, flat plate: the rig is no constant."""
    rig = Rig(camera_angles_deg=(10.0, 60.0), tilt_deg=0.0, sweep_deg=(-60.0, 60.0))
    study = study_of(SATIN, rig)
    assert study.fewest is not None
    assert set(study.fewest.cameras) <= {1, 2}
    scan = rig.observe(
        study.information.model,
        study.information.values,
        cameras=(1, 2),
        exposures_ms=(4.0,),
        lights=24,
    )
    assert np.degrees(np.arcsin(np.abs(scan.light_direction[:, 0]))).max() == pytest.approx(57.5)
    assert isinstance(study.fewest, Design)
