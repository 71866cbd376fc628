"""Materials that change with time: their laws, limits, and what a fit makes of them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.fitting.scans import Simulate
from tvbrdf_fitting import fit_scan, get_model
from tvbrdf_fitting.geometry import light_direction, view_direction
from tvbrdf_fitting.time_varying import (
    KINDS,
    ConstantMaterial,
    DryingPaint,
    DryingSurface,
    SettlingDust,
    TimeVaryingMaterial,
    from_dict,
)

PAINT = DryingPaint(
    kd_surface=(0.6, 0.6, 0.6),
    kd_paint=(0.1, 0.2, 0.5),
    ks_wet=4.0,
    ks_dry=0.5,
    sigma_s_wet=0.03,
    sigma_s_dry=0.2,
    rate_per_min=0.2,
    sigma_d=0.3,
    alpha_dry=0.2,
    beta_dry=0.8,
)
CLOTH = DryingSurface(
    kd_wet=(0.1, 0.12, 0.2),
    kd_dry=(0.3, 0.35, 0.5),
    dry_at_min=10.0,
    dry_width_min=2.0,
    ks_wet=0.4,
    sigma_s=0.2,
    sigma_d=0.6,
)
DUST = SettlingDust(
    kd=(0.05, 0.1, 0.3),
    w=(0.06, 0.065, 0.07),
    g=0.3,
    tau_per_min=0.05,
    ks=2.0,
    sigma_s=0.05,
    sigma_d=0.1,
)
CONSTANT = ConstantMaterial(
    "ON+TS", dict(zip(get_model("ON+TS").parameter_names, [0.3, 0.5, 0.7, 0.4, 1, 6], strict=True))
)
MATERIALS: list[TimeVaryingMaterial] = [PAINT, CLOTH, DUST, CONSTANT]


@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: m.kind)
def test_parameters_are_those_of_the_model_in_its_order(material: TimeVaryingMaterial) -> None:
    model = get_model(material.model)
    for time_s in (-5.0, 0.0, 60.0, 3e4):
        parameters = material.parameters_at(time_s)
        assert tuple(parameters) == model.parameter_names
        lower, upper = model.bounds
        values = model.from_mapping(parameters)
        assert (values >= lower).all()
        assert (values <= upper).all()
    assert material.parameters_at(-5.0) == material.parameters_at(0.0)


@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: m.kind)
def test_brdf_at_one_time_and_at_many(material: TimeVaryingMaterial) -> None:
    light = light_direction(np.linspace(-60, 80, 6))
    view = np.tile(view_direction(25.0), (6, 1))
    times = np.array([0.0, 60.0, 60.0, 300.0, 900.0, 0.0])
    many = material.brdf(light, view, times)
    assert many.shape == (6, 3)
    for row, time_s in enumerate(times):
        one = material.brdf(light[row : row + 1], view[row : row + 1], float(time_s))
        np.testing.assert_allclose(many[row : row + 1], one, rtol=1e-13)
    with pytest.raises(ValueError, match=r"\(2,\) times for 6 directions"):
        material.brdf(light, view, [0.0, 1.0])


class TestDryingPaint:
    def test_wet_and_dry_ends(self) -> None:
        wet, dry = PAINT.parameters_at(0.0), PAINT.parameters_at(1e6)
        assert wet["ks"] == pytest.approx(4.0)
        assert 1 / wet["inverse_sigma_s"] == pytest.approx(0.03)
        assert [wet[f"kd_{c}"] for c in "bgr"] == pytest.approx([0.1, 0.2, 0.5])
        assert dry["ks"] == pytest.approx(0.5)
        assert 1 / dry["inverse_sigma_s"] == pytest.approx(0.2)
        # 0.2 x surface + 0.8 x paint
        assert [dry[f"kd_{c}"] for c in "bgr"] == pytest.approx([0.2, 0.28, 0.52])

    def test_both_specular_parameters_decay_at_one_rate(self) -> None:
        times = np.linspace(0, 1200, 30)
        for name in ("ks", "inverse_sigma_s"):
            values = np.array([PAINT.parameters_at(t)[name] for t in times])
            left = values - PAINT.parameters_at(1e7)[name]
            slope = np.polyfit(times / 60, np.log(left), 1)[0]
            assert slope == pytest.approx(-0.2, rel=1e-6)

    def test_the_diffuse_rate_may_differ(self) -> None:
        slow = replace(PAINT, diffuse_rate_per_min=0.0)
        assert slow.parameters_at(1e6)["kd_b"] == pytest.approx(0.1)
        assert slow.parameters_at(1e6)["ks"] == pytest.approx(0.5)

    def test_colours_stay_in_the_plane_of_surface_and_paint(self) -> None:
        normal = np.cross(PAINT.kd_surface, PAINT.kd_paint)
        for time_s in (0.0, 100.0, 1000.0):
            p = PAINT.parameters_at(time_s)
            assert normal @ [p["kd_b"], p["kd_g"], p["kd_r"]] == pytest.approx(0.0, abs=1e-15)


class TestDryingSurface:
    def test_the_colour_moves_on_a_line_and_is_half_way_at_its_time(self) -> None:
        half = CLOTH.parameters_at(600.0)
        middle = (np.array(CLOTH.kd_wet) + CLOTH.kd_dry) / 2
        assert [half[f"kd_{c}"] for c in "bgr"] == pytest.approx(middle)
        early, late = CLOTH.parameters_at(0.0), CLOTH.parameters_at(1e5)
        share = 1 / (1 + math.exp(5.0))
        assert early["kd_b"] == pytest.approx(0.1 + 0.2 * share)
        assert late["kd_r"] == pytest.approx(0.5)

    def test_the_highlight_is_soon_gone(self) -> None:
        assert CLOTH.parameters_at(0.0)["ks"] == pytest.approx(0.4)
        assert CLOTH.parameters_at(60.0)["ks"] == pytest.approx(0.4 / math.e)
        assert CLOTH.parameters_at(1e9)["ks"] == 0.0


class TestSettlingDust:
    def test_it_is_the_papers_law(self) -> None:
        # rho(tau) = (1 - T) rho_dust + T rho_d + exp(-lambda tau) rho_s, put together by parts
        light = light_direction(np.linspace(-60, 80, 50))
        view = np.tile(view_direction(0.0), (50, 1))
        tau = 0.05 * 8
        p = DUST.parameters_at(480.0)
        assert p["tau"] == pytest.approx(tau)
        t = np.exp(-tau * (1 / light[:, 2] + 1 / view[:, 2]))[:, None]
        clean = get_model("oren_nayar").evaluate(light, view, [0.05, 0.1, 0.3, 0.1])
        lobe = get_model("torrance_sparrow").evaluate(light, view, [2.0, 20.0])
        g = 0.3
        phase = (1 - g * g) / (1 + g * g + 2 * g * (light * view).sum(axis=1)) ** 1.5
        dust = (phase / (light[:, 2] + view[:, 2]))[:, None] * np.array(DUST.w)
        wanted = (1 - t) * dust + t * clean + math.exp(-11.0 * tau) * lobe
        np.testing.assert_allclose(DUST.brdf(light, view, 480.0), wanted, rtol=1e-12)

    def test_clean_at_the_start(self) -> None:
        light = light_direction(np.linspace(-60, 80, 50))
        view = np.tile(view_direction(0.0), (50, 1))
        clean = get_model("ON+TS").evaluate(light, view, [0.05, 0.1, 0.3, 0.1, 2.0, 20.0])
        np.testing.assert_allclose(DUST.brdf(light, view, 0.0), clean, rtol=1e-13)


@pytest.mark.parametrize("material", [PAINT, CLOTH, DUST], ids=lambda m: m.kind)
@pytest.mark.parametrize("time_s", [0.0, 240.0])
def test_a_fit_finds_the_material_again(
    simulate: Simulate, material: TimeVaryingMaterial, time_s: float
) -> None:
    truth = list(material.parameters_at(time_s).values())
    result = fit_scan(simulate(truth, material.model, step=3), material.model)
    for name, true, value in zip(result.parameter_names, truth, result.values, strict=True):
        # dust that has not settled has no properties, and ends at the bound of tau
        if name not in result.undetermined:
            assert value == pytest.approx(true, rel=1e-3, abs=1e-7), name
    known = set(result.parameter_names) - set(result.undetermined)
    assert {"kd_b", "ks", "inverse_sigma_s", "sigma_d"} <= known


class TestFromDict:
    @pytest.mark.parametrize("material", MATERIALS[:3], ids=lambda m: m.kind)
    def test_a_mapping_as_in_a_scene_file(self, material: TimeVaryingMaterial) -> None:
        mapping = {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in vars(material).items()
        }
        assert from_dict(material.kind, mapping) == material

    def test_constant(self) -> None:
        made = from_dict("constant", {"model": "ON+TS", "parameters": CONSTANT.parameters})
        assert made == CONSTANT
        assert made.model == "oren_nayar+torrance_sparrow"

    def test_every_kind_is_known(self) -> None:
        assert {m.kind for m in MATERIALS} == set(KINDS)

    @pytest.mark.parametrize(
        ("kind", "changes", "message"),
        [
            ("drying_paint", {"ks_we": 1.0}, "drying_paint: unknown 'ks_we'; fields are kd_sur"),
            ("drying_paint", {"ks_wet": None}, "ks_wet = None must be a number"),
            ("drying_paint", {"ks_wet": "4"}, "ks_wet = '4' must be a number"),
            ("drying_paint", {"ks_wet": -1.0}, r"ks_wet = -1.0 must be in \[0, inf\]"),
            ("drying_paint", {"sigma_s_dry": 0.0}, "sigma_s_dry = 0.0 must be positive"),
            ("drying_paint", {"rate_per_min": math.nan}, "rate_per_min = nan is not finite"),
            ("drying_paint", {"kd_paint": [0.1, 0.2]}, "must be three numbers, B, G, R"),
            ("drying_paint", {"kd_paint": 0.5}, "must be three numbers, B, G, R"),
            ("drying_paint", {"ks_wet": [1, 2, 3]}, "must be a number"),
            ("drying_paint", {"alpha_dry": -5.0}, "Kd when dry is .* below 0"),
            ("drying_paint", {"diffuse_rate_per_min": -0.1}, "must not be negative"),
            ("drying_surface", {"dry_width_min": 0}, "dry_width_min = 0 must be positive"),
            ("settling_dust", {"g": 1.0}, r"g = 1.0 must be in \[-0.999, 0.999\]"),
        ],
    )
    def test_bad_fields(self, kind: str, changes: dict[str, Any], message: str) -> None:
        base = {m.kind: vars(m) for m in MATERIALS}[kind]
        with pytest.raises(ValueError, match=message):
            from_dict(kind, {**base, **changes})

    def test_missing_fields_and_unknown_kinds(self) -> None:
        with pytest.raises(ValueError, match="drying_surface: missing kd_wet, kd_dry, dry_at_min"):
            from_dict("drying_surface", {})
        with pytest.raises(ValueError, match="constant: missing model"):
            from_dict("constant", {})
        with pytest.raises(ValueError, match="unknown material 'rust'; known materials: drying"):
            from_dict("rust", {})
        with pytest.raises(ValueError, match="parameters must be a mapping"):
            from_dict("constant", {"model": "ON+TS", "parameters": [1, 2]})
        bad = dict(CONSTANT.parameters) | {"sigma_d": 3.0}
        with pytest.raises(ValueError, match="constant: sigma_d = 3"):
            from_dict("constant", {"model": "ON+TS", "parameters": bad})
