"""Half and difference angles: round trips, also at the poles, and what the rig's cameras see."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

from tvbrdf_fitting.geometry import CAMERA_ANGLES_DEG, light_direction, view_direction
from tvbrdf_fitting.half_angle import from_half_angles, to_half_angles
from tvbrdf_fitting.models import get_model

EPS = np.finfo(float).eps
ROUNDINGS = 16 * EPS
"""Some ten operations on numbers of size 1."""


def directions(count: int, seed: int, lowest: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    cosine, azimuth = rng.uniform(lowest, 1.0, count), rng.uniform(0, 2 * np.pi, count)
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=1)


def invariants(light: np.ndarray, view: np.ndarray) -> np.ndarray:
    """All that an isotropic BRDF can depend on, and the sense of the turn from view to light."""
    turn = view[:, 0] * light[:, 1] - view[:, 1] * light[:, 0]
    return np.stack([light[:, 2], view[:, 2], np.einsum("ij,ij->i", light, view), turn])


def test_directions_come_back() -> None:
    light, view = directions(2000, 1), directions(2000, 2)
    angles = to_half_angles(light, view)
    back = from_half_angles(angles.theta_h, angles.theta_d, angles.phi_d)
    np.testing.assert_allclose(invariants(*back), invariants(light, view), rtol=0, atol=ROUNDINGS)
    together = light + view
    azimuth = np.arctan2(together[:, 1], together[:, 0])
    back = from_half_angles(angles.theta_h, angles.theta_d, angles.phi_d, azimuth)
    # phi_d's error is that of l_z - v_z over the smaller of |H_xy|, |D|; it moves l by |D| times it
    flat = np.hypot(together[:, 0], together[:, 1])
    np.testing.assert_array_less(
        np.abs(back[0] - light).max(axis=1), ROUNDINGS / np.minimum(flat, 1)
    )
    np.testing.assert_array_less(
        np.abs(back[1] - view).max(axis=1), ROUNDINGS / np.minimum(flat, 1)
    )


def test_angles_come_back() -> None:
    rng = np.random.default_rng(3)
    theta_h, theta_d = rng.uniform(0.01, 1.5, (2, 2000))
    phi_d = rng.uniform(-np.pi, np.pi, 2000)
    light, view = from_half_angles(theta_h, theta_d, phi_d, rng.uniform(-3, 3, 2000))
    np.testing.assert_allclose(np.linalg.norm([light, view], axis=2), 1.0, rtol=0, atol=ROUNDINGS)
    angles = to_half_angles(light, view)
    # the angles are amplified where H nearly vanishes and where azimuths are short
    scale = ROUNDINGS / (np.cos(theta_d) * np.minimum(np.sin(theta_h), np.sin(theta_d)))
    assert (np.abs(angles.theta_h - theta_h) < scale).all()
    assert (np.abs(angles.theta_d - theta_d) < scale).all()
    turned = np.angle(np.exp(1j * (angles.phi_d - phi_d)))
    assert (np.abs(turned) < scale).all()


@pytest.mark.parametrize("small", [1e-3, 1e-8, 1e-15])
@pytest.mark.parametrize("pole", ["half", "difference", "both"])
def test_poles_keep_their_digits(small: float, pole: str) -> None:
    """An arc cosine would lose all digits below 1e-8."""
    phi = np.linspace(-3.0, 3.0, 13)
    theta_h = small if pole in {"half", "both"} else 0.7
    theta_d = small if pole in {"difference", "both"} else 0.7
    light, view = from_half_angles(theta_h, theta_d, phi)
    angles = to_half_angles(light, view)
    # components of size 1 have errors of an ulp, which angles take over
    np.testing.assert_allclose(angles.theta_h, theta_h, rtol=4 * EPS / 1e-3, atol=ROUNDINGS)
    np.testing.assert_allclose(angles.theta_d, theta_d, rtol=4 * EPS / 1e-3, atol=ROUNDINGS)
    back = from_half_angles(angles.theta_h, angles.theta_d, angles.phi_d)
    np.testing.assert_allclose(invariants(*back), invariants(light, view), rtol=0, atol=ROUNDINGS)


@pytest.mark.parametrize("name", ["half", "difference", "both"])
def test_on_the_poles(name: str) -> None:
    light = directions(50, 4, lowest=0.1)
    mirrored = light * [-1, -1, 1]
    view = {"half": mirrored, "difference": light, "both": light}[name].copy()
    if name == "both":
        light = view = np.array([[0.0, 0.0, 1.0]])
    angles = to_half_angles(light, view)
    assert np.isfinite([angles.theta_h, angles.theta_d, angles.phi_d]).all()
    if name in {"half", "both"}:
        assert (angles.theta_h == 0).all()
    if name in {"difference", "both"}:
        assert (angles.theta_d == 0).all()
        assert (angles.phi_d == 0).all()
    back = from_half_angles(angles.theta_h, angles.theta_d, angles.phi_d)
    np.testing.assert_allclose(invariants(*back), invariants(light, view), rtol=0, atol=ROUNDINGS)


def test_against_rotations_in_fifty_digits() -> None:
    """d = R_y(-theta_h) R_z(-phi_h) l, as Rusinkiewicz defines it."""
    light, view = directions(25, 5, lowest=0.02), directions(25, 6, lowest=0.02)
    angles = to_half_angles(light, view)
    with mpmath.workdps(50):
        for i in range(25):
            one, other = ([mpmath.mpf(float(x)) for x in v[i]] for v in (light, view))
            one, other = ([x / mpmath.norm(v) for x in v] for v in (one, other))
            together = [a + b for a, b in zip(one, other, strict=True)]
            x, y, z = (c / mpmath.norm(together) for c in together)
            theta_h, phi_h = mpmath.acos(z), mpmath.atan2(y, x)
            about_z = (
                one[0] * mpmath.cos(phi_h) + one[1] * mpmath.sin(phi_h),
                one[1] * mpmath.cos(phi_h) - one[0] * mpmath.sin(phi_h),
            )
            along = about_z[0] * mpmath.cos(theta_h) - one[2] * mpmath.sin(theta_h)
            up = about_z[0] * mpmath.sin(theta_h) + one[2] * mpmath.cos(theta_h)
            assert abs(angles.theta_h[i] - theta_h) < 8 * EPS
            assert abs(angles.theta_d[i] - mpmath.acos(up)) < 8 * EPS
            # the inputs' lengths differ from 1 by an ulp, which phi_d sees over sin(theta_h)
            tolerance = ROUNDINGS / (mpmath.sin(theta_h) * mpmath.sin(mpmath.acos(up)))
            assert abs(angles.phi_d[i] - mpmath.atan2(about_z[1], along)) < tolerance


def test_exchange_and_reflection() -> None:
    light, view = directions(200, 7, lowest=0.05), directions(200, 8, lowest=0.05)
    angles, exchanged = to_half_angles(light, view), to_half_angles(view, light)
    assert (exchanged.theta_h == angles.theta_h).all()
    half_turn = np.angle(np.exp(1j * (exchanged.phi_d - angles.phi_d - np.pi)))
    np.testing.assert_allclose(half_turn, 0.0, atol=ROUNDINGS)
    mirror = np.array([1.0, -1.0, 1.0])
    reflected = to_half_angles(light * mirror, view * mirror)
    np.testing.assert_allclose(reflected.phi_d, -angles.phi_d, atol=ROUNDINGS)
    for other in (exchanged, reflected):
        np.testing.assert_allclose(other.folded_phi_d, angles.folded_phi_d, atol=ROUNDINGS)
    # hence folded angles give the same value of a reciprocal, isotropic model
    model = get_model("ON+TS")
    folded = from_half_angles(angles.theta_h, angles.theta_d, angles.folded_phi_d)
    np.testing.assert_allclose(
        model.evaluate(*folded, model.typical),
        model.evaluate(light, view, model.typical),
        rtol=1e-12,
    )


def test_what_the_rigs_cameras_see() -> None:
    """The smallest half angles of the facts page: 0, 12.7, 25.3 and 37.6 degrees."""
    light = light_direction(np.linspace(-78.0, 90.0, 16801))
    smallest = []
    for number, angle in enumerate(CAMERA_ANGLES_DEG):
        seen = to_half_angles(light, view_direction(angle))
        smallest.append(np.degrees(seen.theta_h.min()))
        if number == 0:
            # in the plane of incidence
            assert np.degrees(seen.folded_phi_d.max()) < 1e-6
    np.testing.assert_allclose(smallest, [0.0, 12.7, 25.3, 37.6], atol=0.1)


def test_shapes_are_checked() -> None:
    one = to_half_angles([0.0, 0.0, 1.0], directions(4, 9))
    assert one.theta_h.shape == (4,)
    for wrong in ([0.0, 0.0, 2.0], [0.0, np.nan, 1.0]):
        with pytest.raises(ValueError, match=r"view direction 0 = .* is no unit vector"):
            to_half_angles(directions(3, 1), wrong)
    with pytest.raises(ValueError, match="3 light directions but 4 view"):
        to_half_angles(directions(3, 1), directions(4, 1))
    with pytest.raises(ValueError, match=r"view directions have shape \(2, 2\)"):
        to_half_angles(directions(2, 1), np.zeros((2, 2)))
