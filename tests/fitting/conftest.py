"""Scans, simulated and real, for the tests of models and fits."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fitting.scans import Simulate, read_material, simulate
from tvbrdf_fitting.observations import Observations


@pytest.fixture(name="simulate", scope="session")
def simulate_fixture() -> Simulate:
    return simulate


@pytest.fixture(scope="session")
def real_material(shared_data: Path) -> Callable[[str], Observations]:
    return lambda name: read_material(shared_data / "rgl_on_rig" / name)
