"""Observations: what is refused and where, masks, copies, joining."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from tests.fitting.scans import SATIN, Simulate
from tvbrdf_fitting import Observations, fit_scan


@pytest.mark.parametrize(
    ("field", "change", "message"),
    [
        (
            "radiance",
            (5, 1, math.nan),
            r"radiance\[5, 1\] = nan \(camera 1, sweep 1, channel g\)",
        ),
        ("radiance", (0, 2, math.inf), r"channel r\) is not finite; mark what could not"),
        ("variance", (3, 0, 0.0), r"variance\[3, 0\] = 0.0 .* is not positive"),
        ("variance", (3, 0, -1.0), "is not positive"),
        ("light_direction", (2, 0, 0.9), r"light_direction\[2\] = .* has length .*, not 1"),
        ("view_direction", (2, 0, math.nan), r"view_direction\[2, 0\] = nan"),
    ],
)
def test_bad_values_are_refused_with_their_place(
    simulate: Simulate, field: str, change: tuple[int, int, float], message: str
) -> None:
    observations = simulate(SATIN, step=30)
    array = getattr(observations, field).copy()
    array[change[0], change[1]] = change[2]
    with pytest.raises(ValueError, match=message):
        replace(observations, **{field: array})


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("camera", np.zeros(3, dtype=int), r"camera has shape \(3,\), expected \(\d+,\)"),
        ("variance", np.ones((4, 3)), r"variance has shape \(4, 3\)"),
        ("radiance", np.ones(4), r"expected \(4, 3\)"),
    ],
)
def test_wrong_shapes_are_refused(
    simulate: Simulate, field: str, value: np.ndarray, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        replace(simulate(SATIN, step=30), **{field: value})


def test_camera_numbers_must_be_whole_and_from_one(simulate: Simulate) -> None:
    observations = simulate(SATIN, step=30)
    with pytest.raises(ValueError, match="camera must be integers"):
        replace(observations, camera=observations.camera * 1.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="is below 1"):
        replace(observations, camera=observations.camera - 1)
    with pytest.raises(ValueError, match=r"exposure_ms\[0\] = -\d.* is not positive"):
        replace(observations, exposure_ms=-observations.exposure_ms)


def test_a_masked_value_may_be_anything(simulate: Simulate) -> None:
    observations = simulate(SATIN, step=6)
    masked = observations.valid & (np.arange(len(observations)) % 7 != 0)[:, None]
    observations = replace(
        observations,
        valid=masked,
        radiance=np.where(masked, observations.radiance, np.nan),
        variance=np.where(masked, observations.variance, -1.0),
    )
    np.testing.assert_allclose(fit_scan(observations).values, SATIN, rtol=1e-7)


def test_arrays_are_copied_and_locked(simulate: Simulate) -> None:
    observations = simulate(SATIN, step=30)
    radiance = observations.radiance.copy()
    copy = replace(observations, radiance=radiance)
    radiance[:] = 7.0
    assert copy.radiance.max() < 7.0
    with pytest.raises(ValueError, match="read-only"):
        copy.radiance[0, 0] = 1.0


def test_parts_join_in_order(simulate: Simulate) -> None:
    observations = simulate(SATIN, step=30)
    parts = [observations.select(observations.camera == c) for c in (1, 2, 3, 4)]
    whole = Observations.concatenate(parts)
    order = np.argsort(observations.camera, kind="stable")
    for field in fields(Observations):
        joined, apart = (getattr(o, field.name) for o in (whole, observations))
        np.testing.assert_array_equal(joined, apart[order])
    with pytest.raises(ValueError, match="nothing to concatenate"):
        Observations.concatenate([])
