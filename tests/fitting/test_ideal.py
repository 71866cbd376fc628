"""Ideal mirror and refraction: one direction, its throughput, and no value anywhere else."""

from __future__ import annotations

import numpy as np
import pytest

from tvbrdf_fitting.models import SumModel, get_model
from tvbrdf_fitting.models.ideal import DeltaLobe, IdealMirror, IdealRefraction, delta_lobes
from tvbrdf_fitting.models.optics import fresnel_dielectric

GLASS = 1.5
SURFACE = "ideal_mirror(dielectric)+ideal_refraction"
WHITE = [1.0, 1.0, 1.0]


def random_directions(seed: int, count: int = 300) -> np.ndarray:
    """Return unit vectors on both sides of the surface."""
    rng = np.random.default_rng(seed)
    z, azimuth = rng.uniform(-1, 1, count), rng.uniform(-np.pi, np.pi, count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def test_mirror_sends_all_light_to_the_mirror_direction() -> None:
    light = random_directions(0)
    direction, throughput = IdealMirror().scattered(light, [0.2, 0.5, 0.9])
    np.testing.assert_array_equal(direction, light * [-1, -1, 1])
    np.testing.assert_array_equal(throughput, np.tile([0.2, 0.5, 0.9], (len(light), 1)))


def test_surface_of_glass_divides_the_power() -> None:
    """Mirror and refraction together keep it: the radiance that crosses has grown by eta^2."""
    light = random_directions(1)
    mirror, refraction = IdealMirror(dielectric=True), IdealRefraction()
    reflected = mirror.scattered(light, [*WHITE, GLASS]).throughput
    onward = refraction.scattered(light, [*WHITE, GLASS])
    grown = np.where(light[:, 2] > 0, GLASS**2, GLASS**-2)[:, None]
    np.testing.assert_allclose(reflected + onward.throughput / grown, 1.0, rtol=1e-14)
    np.testing.assert_allclose(reflected[:, 0], fresnel_dielectric(light[:, 2], GLASS))


def test_radiance_through_glass_at_normal_incidence() -> None:
    down = IdealRefraction().scattered([0.0, 0.0, 1.0], [0.5, 0.8, 1.0, GLASS])
    np.testing.assert_allclose(down.direction, [[0, 0, -1]], atol=1e-15)
    np.testing.assert_allclose(
        down.throughput, [[0.96 * 2.25 * t for t in (0.5, 0.8, 1.0)]], rtol=1e-14
    )
    up = IdealRefraction().scattered([0.0, 0.0, -1.0], [*WHITE, GLASS])
    np.testing.assert_allclose(up.throughput, 0.96 / 2.25, rtol=1e-14)


def test_total_reflection_lets_nothing_through() -> None:
    light = np.array([[0.8, 0.0, -0.6], [0.6, 0.0, -0.8]])  # critical cosine: 0.745
    direction, throughput = IdealRefraction().scattered(light, [*WHITE, GLASS])
    np.testing.assert_array_equal(direction[0], 0.0)
    np.testing.assert_array_equal(throughput[0], 0.0)
    np.testing.assert_allclose(direction[1], [-0.9, 0.0, np.sqrt(0.19)], rtol=1e-15)
    assert (throughput[1] > 0.3).all()


@pytest.mark.parametrize(
    ("model", "values"),
    [
        (IdealMirror(), [0.2, 0.5, 0.9]),
        (IdealMirror(dielectric=True), [0.2, 0.5, 0.9, GLASS]),
        (IdealRefraction(), [0.2, 0.5, 0.9, GLASS]),
        (IdealRefraction(), [0.2, 0.5, 0.9, 1 / GLASS]),
    ],
)
def test_gathering_is_scattering_the_other_way_round(model: DeltaLobe, values: list[float]) -> None:
    light = random_directions(2)
    there = model.scattered(light, values)
    some = np.linalg.norm(there.direction, axis=1) > 0
    some &= np.abs(there.direction[:, 2]) > 0.05  # away from the critical angle, where it's a root
    back = model.gathered(there.direction[some], values)
    np.testing.assert_allclose(back.direction, light[some], atol=1e-13)
    # a cosine c comes back with a relative error of eps / c^2, and the smallest here is 0.004
    np.testing.assert_allclose(back.throughput, there.throughput[some], rtol=1e-10)


def test_they_have_no_value_and_no_terms() -> None:
    light, view = np.abs(random_directions(3)), np.abs(random_directions(4))
    model = get_model(SURFACE)
    assert model.delta
    assert model.terms == ()
    assert not model.evaluate(light, view, model.typical).any()
    assert not model.evaluate(light, light * [-1, -1, 1], model.typical).any()
    assert not model.jacobian(light, view, model.typical).any()


def test_a_sum_shows_what_is_not_a_delta_function() -> None:
    model = get_model("lambert+ideal_mirror")
    assert isinstance(model, SumModel)
    assert model.parameter_names[3:] == ("reflectance_b", "reflectance_g", "reflectance_r")
    got = model.evaluate([0.6, 0.0, 0.8], [-0.6, 0.0, 0.8], [0.1, 0.2, 0.3, 0.9, 0.9, 0.9])
    np.testing.assert_allclose(got, [[0.1 / np.pi, 0.2 / np.pi, 0.3 / np.pi]], rtol=1e-15)


def test_a_renderer_finds_the_delta_lobes_of_a_sum() -> None:
    model = get_model(f"lambert+{SURFACE}")
    values = np.arange(1, 12) / 20
    (mirror, of_mirror), (refraction, of_refraction) = delta_lobes(model, values)
    assert (mirror.name, refraction.name) == tuple(SURFACE.split("+"))
    np.testing.assert_array_equal(of_mirror, values[3:7])
    np.testing.assert_array_equal(of_refraction, values[7:])
    assert list(delta_lobes(get_model("lambert"), [0.1, 0.2, 0.3])) == []


@pytest.mark.parametrize("name", ["ideal_mirror", SURFACE, "oren_nayar+ideal_mirror"])
def test_directions_of_a_fit_are_refused(name: str) -> None:
    light = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8]])
    assert "no BRDF value" in str(get_model(name).refuse(light, light))


def test_wrong_directions_and_values_are_refused() -> None:
    with pytest.raises(ValueError, match=r"ideal_mirror: directions have shape \(2, 2\)"):
        IdealMirror().scattered(np.ones((2, 2)), WHITE)
    with pytest.raises(ValueError, match=r"parameters have shape \(4,\), expected \(3,\)"):
        IdealMirror().scattered([0.0, 0.0, 1.0], [*WHITE, GLASS])
