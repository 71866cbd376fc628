"""Stages for nodes, and on them a rig for the sequencer to command."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.nodes.sequencer_rig import MakeRig, Rig
from tests.nodes.stage import START_NS, MakeStage, Part, Stage


@pytest.fixture
def make_stage(tmp_path: Path) -> Iterator[MakeStage]:
    """Give a function that makes a stage of parts, tuples as :class:`Part`."""
    made: list[Stage] = []

    def make(*parts: tuple[Any, ...], utc_ns: int = START_NS) -> Stage:
        made.append(Stage(tmp_path, [Part(*part) for part in parts], utc_ns))
        return made[-1]

    yield make
    for stage in made:
        stage.end()


@pytest.fixture
def make_rig(make_stage: MakeStage) -> MakeRig:
    """Give a function that makes a rig; its arguments are the sequencer's parameters."""
    return lambda **parameters: Rig(make_stage, **parameters)


@pytest.fixture
def rig(make_rig: MakeRig) -> Rig:
    """Give a rig that is to take two scans a minute apart."""
    return make_rig()
