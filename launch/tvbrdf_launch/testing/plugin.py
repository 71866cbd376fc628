"""The pytest plugin ``tvbrdf``: fixtures ``rig``, ``bag`` and ``graph``.

Whatever a test started is stopped at its end, however it ends. A project that has a fixture of one
of these names keeps its own (pytest prefers the nearest), and finds ours under ``tvbrdf_rig``,
``tvbrdf_bag`` and ``tvbrdf_graph``. Loading this file loads nothing but pytest.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from .bags import BagFactory
    from .graphs import GraphFactory
    from .rigs import RigFactory


@pytest.fixture
def tvbrdf_rig(tmp_path: Path) -> Iterator[RigFactory]:
    """Start rigs from launch files: see ``rig``."""
    from .rigs import RigFactory

    with RigFactory(tmp_path) as factory:
        yield factory


@pytest.fixture
def tvbrdf_bag(tmp_path: Path) -> BagFactory:
    """Write and open bags: see ``bag``."""
    from .bags import BagFactory

    return BagFactory(tmp_path)


@pytest.fixture
def tvbrdf_graph(tmp_path: Path) -> Iterator[GraphFactory]:
    """Run any nodes together: see ``graph``."""
    from .graphs import GraphFactory

    with GraphFactory(tmp_path) as factory:
        yield factory


@pytest.fixture
def rig(tvbrdf_rig: RigFactory) -> RigFactory:
    """Start a rig from a launch file, in process or as real processes.

    ``rig("simulated_rig", scans=1, faults={"camera_2": [{"kind": "drop", "scan": 1}]})``
    """
    return tvbrdf_rig


@pytest.fixture
def bag(tvbrdf_bag: BagFactory) -> BagFactory:
    """Open a bag (``bag(path)``), or write one (``bag(run)``, ``bag([(topic, message), ...])``)."""
    return tvbrdf_bag


@pytest.fixture
def graph(tvbrdf_graph: GraphFactory) -> GraphFactory:
    """Run any nodes in process: ``graph("fitter", printer=(PrinterNode, {"digits": 4}))``."""
    return tvbrdf_graph
