"""Light's path: exact at constant speed and acceleration, never extrapolated."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tvbrdf_fitting.measurement.light_path import LightPath

UTC_NS = 1_800_000_000_123_456_789
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CRUISE_DEG_S = 15.0
ACCELERATION_DEG_S2 = 50.0
START_DEG = -95.0
RAMP_S = CRUISE_DEG_S / ACCELERATION_DEG_S2
TOTAL_S = 190.0 / CRUISE_DEG_S + RAMP_S


def profile(time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Trapezoidal profile from -95 to 95 degrees: angle and speed."""
    t = np.clip(time_s, 0.0, TOTAL_S)
    up, down = np.minimum(t, RAMP_S), np.maximum(t - (TOTAL_S - RAMP_S), 0.0)
    angle = START_DEG + ACCELERATION_DEG_S2 * up**2 / 2 + CRUISE_DEG_S * (t - up)
    angle -= ACCELERATION_DEG_S2 * down**2 / 2
    speed = ACCELERATION_DEG_S2 * up - ACCELERATION_DEG_S2 * down
    return angle, speed


def ns(time_s: NDArray[Any]) -> IntArray:
    return UTC_NS + np.rint(time_s * 1e9).astype(np.int64)


def seconds(stamp_ns: IntArray) -> FloatArray:
    return (stamp_ns - UTC_NS) / 1e9


# reports at 50 Hz that fall on both corners of the profile (0.3 s) and cover rest on both sides
REPORTS_NS = ns(np.arange(-10, 671) * 0.02)


def path(direction: int = 1, with_speed: bool = True) -> LightPath:
    angle, speed = profile(seconds(REPORTS_NS))
    return LightPath.from_reports(
        REPORTS_NS, direction * angle, direction * speed if with_speed else None
    )


@pytest.mark.parametrize("direction", [1, -1])
def test_exact_at_constant_speed_and_acceleration(direction: int) -> None:
    random = np.random.default_rng(0)
    stamps = ns(random.uniform(0.0, 13.0, 2000))
    angle, speed = profile(seconds(stamps))
    cruising = (seconds(stamps) > RAMP_S) & (seconds(stamps) < TOTAL_S - RAMP_S - 0.02)
    starting = seconds(stamps) < RAMP_S
    with_speed, without = path(direction), path(direction, with_speed=False)
    # 1 ns at 15 degrees a second, and rounding of float64
    np.testing.assert_allclose(
        with_speed.angle_at(stamps[cruising | starting]),
        direction * angle[cruising | starting],
        rtol=0,
        atol=1e-7,
    )
    np.testing.assert_allclose(
        with_speed.speed_at(stamps[cruising | starting]),
        direction * speed[cruising | starting],
        atol=1e-5,
    )
    np.testing.assert_allclose(
        without.angle_at(stamps[cruising]), direction * angle[cruising], rtol=0, atol=1e-7
    )
    # a straight line under acceleration a over a time h is off by at most a h**2 / 8
    error = np.abs(without.angle_at(stamps[starting]) - direction * angle[starting])
    assert np.max(error) <= ACCELERATION_DEG_S2 * 0.02**2 / 8 * (1 + 1e-6)


@given(
    first=st.integers(-(10**9), 10**9),
    coefficients=st.tuples(*[st.floats(-30.0, 30.0)] * 4),
    share=st.floats(0.0, 1.0),
)
@settings(deadline=None)
def test_hermite_pieces_reproduce_cubics(
    first: int, coefficients: tuple[float, float, float, float], share: float
) -> None:
    polynomial = np.polynomial.Polynomial(coefficients)
    start = UTC_NS + first
    stamps = start + np.array([0, 20_000_000, 50_000_000])
    t = (stamps - start) / 1e9
    light = LightPath.from_reports(stamps, polynomial(t), polynomial.deriv()(t))
    at = start + round(share * 50_000_000)
    x = (at - start) / 1e9
    assert float(light.angle_at(at)) == pytest.approx(float(polynomial(x)), abs=1e-9)
    assert float(light.speed_at(at)) == pytest.approx(float(polynomial.deriv()(x)), abs=1e-6)


def test_nothing_is_extrapolated_nor_guessed_over_lost_reports() -> None:
    kept = np.ones(REPORTS_NS.size, dtype=bool)
    kept[200:215] = False
    kept[300:303] = False
    angle, _ = profile(seconds(REPORTS_NS))
    light = LightPath.from_reports(REPORTS_NS[kept], angle[kept])
    first, last = int(REPORTS_NS[0]), int(REPORTS_NS[-1])
    lost = int(REPORTS_NS[207])
    short = int(REPORTS_NS[301])
    stamps = np.array([first - 1, first, last, last + 1, lost, short, REPORTS_NS[199]])
    expected = [False, True, True, False, False, True, True]
    assert light.known_at(stamps).tolist() == expected
    assert np.isfinite(light.angle_at(stamps)).tolist() == expected
    assert np.isfinite(light.speed_at(stamps)).tolist() == expected


def test_an_arm_that_stays_is_known_all_along() -> None:
    light = LightPath.from_reports(REPORTS_NS, np.full(REPORTS_NS.size, 30.0))
    assert np.all(light.angle_at(REPORTS_NS + 3)[:-1] == 30.0)


@given(seed=st.integers(0, 2**32))
@settings(max_examples=20, deadline=None)
def test_order_and_repeats_of_reports_do_not_matter(seed: int) -> None:
    random = np.random.default_rng(seed)
    order = random.permutation(np.concatenate([np.arange(681), random.integers(0, 681, 30)]))
    angle, speed = profile(seconds(REPORTS_NS))
    light = LightPath.from_reports(REPORTS_NS[order], angle[order], speed[order])
    stamps = ns(random.uniform(0.0, 13.0, 50))
    assert np.array_equal(light.angle_at(stamps), path().angle_at(stamps))


def test_wrong_reports_are_refused() -> None:
    with pytest.raises(ValueError, match="arm: 1 position reports in the sweep"):
        LightPath.from_reports([5, 5], [1.0, 1.0])
    with pytest.raises(ValueError, match="arm: 0 position reports"):
        LightPath.from_reports([], [])
    with pytest.raises(ValueError, match="give integer ns"):
        LightPath.from_reports([0.5, 1.5], [1.0, 1.0])
    with pytest.raises(ValueError, match="one finite angle"):
        LightPath.from_reports([1, 2, 3], [1.0, float("nan"), 2.0])
    with pytest.raises(ValueError, match="one finite angle"):
        LightPath.from_reports([1, 2, 3], [1.0, 2.0])
