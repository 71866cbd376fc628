"""The start of a whole rig: what it is told of, and what must be right before anything moves."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

if TYPE_CHECKING:
    from tests.system.conftest import Rig

pytestmark = pytest.mark.system

EXACT = 1e-6
"""Frames are float32 here (6e-8), and the sample's table is checked to 2e-7."""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"model": "velvet"}, "model: unknown model 'velvet'"),
        ({"metric": "beauty"}, "metric: 'beauty' is unknown; known: radiance"),
        ({"fixed": "{colour: 1.0}"}, "fixed: colour: oren_nayar+torrance_sparrow has kd_b"),
    ],
)
def test_a_fit_that_is_not_known_is_refused_before_the_arm_moves(
    rig: Rig, arguments: dict[str, Any], said: str
) -> None:
    rig.launch(**arguments)
    assert rig.wait() == 1, rig.text()
    assert said in rig.text()
    assert "Traceback" not in rig.text()
    assert "arm homing" not in rig.text()
    rig.expect_no_process(5.0)


def relative_error(rig: Rig) -> float:
    """Run a rig to its end; return the largest error of all parameters of all scans."""
    assert rig.wait() == 0, rig.text()
    rig.expect_nothing_left()
    truth = json.loads((rig.database / "truth.json").read_text())
    errors = []
    for scan in rig.sample().scans:
        assert scan.fit is not None
        assert list(scan.fit.parameter_names) == truth["parameter_names"]
        assert scan.fit.at_bound == scan.fit.undetermined == ()
        errors.append(scan.fit.values / truth["scans"][str(scan.scan)]["values"] - 1.0)
    return float(np.abs(errors).max())


def test_an_ideal_rig_is_exact(rig: Rig) -> None:
    """Nothing has to be said but that it is: its frames have no motion blur to take out."""
    rig.launch(effects="ideal", scans=2)
    assert relative_error(rig) < EXACT


def test_taking_out_blur_that_is_not_there_would_be_seen(rig: Rig) -> None:
    """So that the test above can fail; and the argument overrules what the scene says."""
    rig.launch(effects="ideal", scans=1, correct_motion_blur="true")
    assert relative_error(rig) > 10 * EXACT
