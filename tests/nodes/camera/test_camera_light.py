"""The light as the simulated camera knows it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tvbrdf_messages.messages import SimMotion
from tvbrdf_nodes.camera.simulated_light import SimulatedLight
from tvbrdf_nodes.world.scene import LampEffects

SECOND = 1_000_000_000
Piece = tuple[float, float, float, float, bool]
"""Start (s), angle, speed, acceleration, lamp."""
SWEEP: list[Piece] = [
    (0.0, -95.0, 0.0, 0.0, False),
    (1.0, -95.0, 0.0, 40.0, True),
    (1.5, -90.0, 20.0, 0.0, True),
    (9.5, 70.0, 20.0, -40.0, True),
    (10.0, 75.0, 0.0, 0.0, True),
    (12.0, 75.0, 0.0, 0.0, False),
]


def motion(pieces: list[Piece], until_s: float) -> SimMotion:
    columns: list[Any] = [list(column) for column in zip(*pieces, strict=True)] or [[]] * 5
    return SimMotion(
        until_ns=round(until_s * SECOND),
        start_ns=tuple(round(start * SECOND) for start in columns[0]),
        angle_deg=tuple(columns[1]),
        speed_deg_s=tuple(columns[2]),
        acceleration_deg_s2=tuple(columns[3]),
        lamp=tuple(columns[4]),
    )


def angle_at(seconds: float) -> float:
    start, angle, speed, acceleration, _ = [p for p in SWEEP if p[0] <= max(seconds, 0.0)][-1]
    t = max(seconds, 0.0) - start
    return angle + t * (speed + 0.5 * acceleration * t)


def at(light: SimulatedLight, seconds: Any) -> tuple[np.ndarray, np.ndarray]:
    return light.at(np.round(np.asarray(seconds) * SECOND).astype(np.int64))


def whole(lamp: LampEffects | None = None) -> SimulatedLight:
    light = SimulatedLight(lamp or LampEffects(), 0)
    light.take(motion(SWEEP, 13.0))
    return light


def test_angle_follows_the_pieces() -> None:
    seconds = np.linspace(-1.0, 15.0, 321)
    angle, brightness = at(whole(), seconds)
    assert np.allclose(angle, [angle_at(s) for s in seconds], atol=1e-9)
    lit = (seconds >= 1.0) & (seconds < 12.0)
    assert np.array_equal(brightness, lit.astype(float))


def test_times_may_have_any_shape() -> None:
    seconds = np.linspace(0.0, 12.0, 12).reshape(4, 3)
    angle, brightness = at(whole(), seconds)
    assert angle.shape == brightness.shape == (4, 3)
    assert np.allclose(angle.ravel(), at(whole(), seconds.ravel())[0])


def test_motion_told_in_windows_is_the_same() -> None:
    """Windows as the arm's twin tells them: each begins with what is left of a piece."""
    lamp = LampEffects(warm_up_s=3.0)
    windowed = SimulatedLight(lamp, 0)
    for k in range(130):
        begin, end = 0.1 * k, 0.1 * (k + 1)
        start, angle, speed, acceleration, on = [p for p in SWEEP if p[0] <= begin + 1e-9][-1]
        t = begin - start
        left = (begin, angle + t * (speed + 0.5 * acceleration * t), speed + acceleration * t)
        inside = [p for p in SWEEP if begin + 1e-9 < p[0] < end - 1e-9]
        windowed.take(motion([(*left, acceleration, on), *inside], end))
        assert windowed.until_ns == round(end * SECOND)
    seconds = np.linspace(3.5, 13.0, 200)
    expected, got = at(whole(lamp), seconds), at(windowed, seconds)
    assert np.allclose(got[0], expected[0], atol=1e-6)
    assert np.allclose(got[1], expected[1], atol=1e-9)


def test_old_motion_is_forgotten_and_new_kept() -> None:
    light = SimulatedLight(LampEffects(), 0)
    for k in range(1000):
        light.take(motion([(0.1 * k, float(k), 0.0, 0.0, True)], 0.1 * (k + 1)))
        light.forget(round(0.1 * (k - 20) * SECOND))
    assert light._starts.size <= 22
    assert at(light, [97.95, 99.95])[0].tolist() == [979.0, 999.0]


def test_a_piece_takes_the_place_of_what_was_told_for_later() -> None:
    light = whole()
    light.take(motion([(5.0, 0.0, 0.0, 0.0, True)], 13.0))
    assert at(light, [4.0, 6.0, 12.5])[0].tolist() == [angle_at(4.0), 0.0, 0.0]


def test_nothing_told_is_dark() -> None:
    angle, brightness = at(SimulatedLight(LampEffects(), 0), [0.0, 5.0])
    assert angle.tolist() == [0.0, 0.0]
    assert brightness.tolist() == [0.0, 0.0]


def test_lamp_cools_while_it_is_off_and_warms_again() -> None:
    """First order both ways, tau = 2 s: on at 1 s from cold, off at 4 s, on at 5 s."""
    lamp = LampEffects(warm_up_s=2.0)
    light = SimulatedLight(lamp, 0)
    switches = [(0.0, False), (1.0, True), (4.0, False), (5.0, True)]
    light.take(motion([(t, 0.0, 0.0, 0.0, on) for t, on in switches], 20.0))
    brightness = at(light, [0.5, 3.0, 4.5, 7.0])[1]
    warm_at_4 = 1 - np.exp(-1.5)
    warm_at_5 = warm_at_4 * np.exp(-0.5)
    expected = [0.0, 1 - np.exp(-1.0), 0.0, 1 - (1 - warm_at_5) * np.exp(-1.0)]
    assert np.allclose(brightness, expected, rtol=1e-12)


def test_lamp_that_is_on_at_first_has_been_on_for_long() -> None:
    """So a camera that is restarted does not see a cold lamp."""
    light = SimulatedLight(LampEffects(warm_up_s=20.0), 0)
    light.take(motion([(100.0, 0.0, 0.0, 0.0, True)], 101.0))
    assert at(light, [100.5])[1][0] == 1.0


def test_lamp_drifts_from_the_beginning_of_the_simulation() -> None:
    light = SimulatedLight(LampEffects(drift_per_hour=0.02), 0)
    light.take(motion([(0.0, 0.0, 0.0, 0.0, True)], 1.0))
    assert at(light, [1800.0])[1][0] == pytest.approx(1.01, rel=1e-12)
