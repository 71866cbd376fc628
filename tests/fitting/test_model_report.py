"""What a report says of known models: energy, reciprocity, sign, isotropy."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.optimize import brentq

from tests.fitting.test_albedo import PURE_DUST, dust_values
from tvbrdf_fitting.geometry import FloatArray
from tvbrdf_fitting.models import Lambert, catalogue, get_model
from tvbrdf_fitting.properties.albedo import KINDS, directional_albedo, unit
from tvbrdf_fitting.properties.report import ModelReport, check_model
from tvbrdf_fitting.properties.trials import ENERGY_LIMIT, RECIPROCITY_LIMIT


@pytest.fixture(scope="module")
def white_oren_nayar() -> ModelReport:
    return check_model(get_model("oren_nayar"), [0.5, 0.8, 1.0, 0.3])


def test_report_of_energy(white_oren_nayar: ModelReport) -> None:
    report = white_oren_nayar
    (where,) = report.energy
    assert (where.channel, where.to_deg) == ("r", 90.0)
    at_start = directional_albedo(
        get_model("oren_nayar"), [0.5, 0.8, 1.0, 0.3], np.deg2rad(where.from_deg)
    )
    # the angle is found to 1e-4 degrees, where the albedo rises by 0.002 a degree
    assert abs(at_start.value[2] - 1) < 5e-6
    assert where.largest == report.largest_albedo[2] > 1.05
    assert report.creates_energy
    assert not report.good
    text = (
        "creates energy: albedo above 1 from 71.94 to 90 degrees, reaches at least 1.051 at 89.99"
    )
    assert report.findings == (f"{text} degrees in channel r",)
    by_angle = {row.theta_deg: row.value for row in report.albedo}
    assert by_angle[75.0][2] == pytest.approx(1.005, abs=5e-4)
    assert by_angle[89.0][2] == pytest.approx(1.044, abs=5e-4)


def test_report_is_plain_data(white_oren_nayar: ModelReport) -> None:
    found = json.loads(json.dumps(white_oren_nayar.as_dict(), allow_nan=False))
    assert found["model"] == "oren_nayar"
    assert found["parameters"]["sigma_d"] == 0.3
    assert found["energy"][0]["channel"] == "r"
    assert (found["good"], found["creates_energy"]) == (False, True)
    assert len(found["bihemispherical"]) == 3
    assert white_oren_nayar == check_model(get_model("oren_nayar"), [0.5, 0.8, 1.0, 0.3])


@pytest.mark.parametrize("name", catalogue())
def test_every_model_keeps_its_promises(name: str) -> None:
    report = check_model(get_model(name), angles_deg=(0.0, 60.0), tolerance=1e-4)
    assert not report.breaks_reciprocity
    assert not report.breaks_sign
    assert report.reciprocal == (report.reciprocity_defect.value <= RECIPROCITY_LIMIT)
    assert report.isotropic == get_model(name).isotropic
    kinds = [row.kind for row in report.albedo]
    assert set(kinds) == set(KINDS[: 1 if report.reciprocal else 2])
    # Phong's and Dür's divide by cosines that vanish, the others stay below 1 at typical values
    unbounded = (name.startswith("phong") and "energy_conserving" not in name) or "duer" in name
    assert report.creates_energy == unbounded


def test_dust_creates_energy_above_its_limit() -> None:
    model, limit = get_model(PURE_DUST), 1 / (2 * np.pi)
    assert not check_model(model, dust_values(0.999 * limit)).creates_energy
    report = check_model(model, dust_values(1.01 * limit))
    # at grazing nothing is seen of the surface, and all of the light meets dust
    mu = brentq(lambda mu: 1.01 * (1 - mu * np.log((1 + mu) / mu)) - 1 - ENERGY_LIMIT, 1e-4, 0.1)
    assert [where.channel for where in report.energy] == ["b", "g", "r"]
    for where in report.energy:
        assert where.from_deg == pytest.approx(np.rad2deg(np.arccos(mu)), abs=2e-4)
        assert where.largest_at_deg == 89.99
    assert report.findings[-1].endswith("channels b, g, r")


def test_energy_inside_a_range_of_angles() -> None:
    # the energy-conserving lobe loses light towards grazing, so that 1.1 of it is too much only
    # up to some angle
    model = get_model("phong(energy_conserving)")
    (where, *others) = check_model(model, [1.1, 40.0]).energy
    assert len(others) == 2
    assert where.from_deg == 0.0
    assert where.largest == pytest.approx(1.1, rel=1e-6)
    assert where.largest_at_deg == 0.0
    at_end = directional_albedo(model, [1.1, 40.0], np.deg2rad(where.to_deg))
    np.testing.assert_allclose(at_end.value, 1.0, atol=5e-6)


@pytest.mark.parametrize(
    ("sigma_d", "negative"), [(0.6, False), (0.66, False), (0.68, True), (1.5, True)]
)
def test_dark_oren_nayar_is_negative_from_0_67(sigma_d: float, negative: bool) -> None:
    # the inter-reflection term, in Kd^2, hides it for bright surfaces
    report = check_model(get_model("oren_nayar"), [1e-3, 1e-3, 1e-3, sigma_d], angles_deg=(0.0,))
    assert (report.smallest.value < 0) == negative
    assert not report.breaks_sign
    if negative:
        assert report.smallest.theta_light_deg > 80
        assert report.smallest.theta_view_deg > 80
        assert "below 0 in" in report.findings[0]


def test_the_smallest_value_is_where_it_is_said_to_be() -> None:
    model, values = get_model("oren_nayar"), [0.5, 0.4, 0.3, 1.2]
    smallest = check_model(model, values, angles_deg=(0.0,)).smallest
    light = unit(np.deg2rad(smallest.theta_light_deg), np.deg2rad(smallest.phi_light_deg))
    view = unit(np.deg2rad(smallest.theta_view_deg), np.deg2rad(smallest.phi_view_deg))
    value = model.evaluate(light, view, values)[0]
    assert value.min() == pytest.approx(smallest.value, rel=1e-6)
    assert "bgr"[int(value.argmin())] == smallest.channel


@pytest.mark.parametrize("form", ["paper", "blinn"])
def test_forms_of_dust_that_are_not_reciprocal(form: str) -> None:
    report = check_model(get_model(f"dust({form})+oren_nayar+torrance_sparrow"))
    assert report.reciprocity_defect.value > 0.5
    assert not report.breaks_reciprocity
    assert report.findings[0].startswith("not reciprocal, by definition")
    assert {row.kind for row in report.albedo} == set(KINDS)


class Liar(Lambert):
    """Not reciprocal, and brighter along x."""

    def prepare(self, light: FloatArray, view: FloatArray) -> FloatArray:
        return np.asarray((0.6 + light[:, 0]) * light[:, 2] / np.pi)


def test_broken_promises_are_found() -> None:
    report = check_model(Liar(), [0.5, 0.5, 0.5], angles_deg=(0.0, 60.0), tolerance=1e-6)
    assert report.breaks_reciprocity
    assert report.breaks_sign
    assert not report.isotropic
    assert not report.creates_energy
    assert not report.good
    said = "; ".join(report.findings)
    assert "not reciprocal, although the model promises it" in said
    assert "not isotropic, although the model promises it" in said
    assert "although the model promises otherwise" in said
    # light from x: Kd (0.6 + sin) cos of it is scattered, at 60 degrees 0.366
    rows = {(row.theta_deg, row.phi_deg): row.value[0] for row in report.albedo}
    assert rows[60.0, 0.0] == pytest.approx(0.5 * (0.6 + np.sqrt(0.75)) * 0.5, rel=1e-6)
    assert rows[60.0, 90.0] == pytest.approx(0.5 * 0.6 * 0.5, rel=1e-6)


def test_parameters_outside_the_domain() -> None:
    model = get_model("torrance_sparrow")
    with pytest.raises(ValueError, match="torrance_sparrow"):
        check_model(model, [0.8, -1.0])
    with pytest.raises(ValueError, match="must be finite"):
        check_model(model, [np.nan, 6.0])
    report = check_model(model, [0.8, 1000.0], angles_deg=(0.0,))
    assert report.findings == ("inverse_sigma_s = 1000 lies outside its bounds 0.666667 to 200",)
    assert report.out_of_bounds == ("inverse_sigma_s",)
    assert not report.good
    # a promise holds within the bounds: it is the value that is wrong, not the model
    negative = check_model(get_model("lambert"), [0.5, -0.1, 0.5], angles_deg=(0.0,))
    assert negative.smallest.value == pytest.approx(-0.1 / np.pi)
    assert not negative.breaks_sign
    assert not negative.good
    assert not any("promises" in finding for finding in negative.findings)
