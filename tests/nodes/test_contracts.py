"""What holds of every node, read from its declarations and from its source."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import tvbrdf_nodes
from tvbrdf_messages.errors import BusError
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_messages.topics import find_topic, table
from tvbrdf_nodes.core.loading import NODES, LoadingError, load_class, node_class_path
from tvbrdf_nodes.core.node import Node
from tvbrdf_nodes.core.parameters import build

ROOT = Path(tvbrdf_nodes.__file__).parent
CALIBRATION = str(ROOT.parents[1] / "launch" / "calibration.yaml")
SIMULATED_CAMERA = "tvbrdf_nodes.camera.simulated:SimulatedCamera"
REQUIRED: dict[str, dict[str, Any]] = {
    "world": {"sample": "drying_paint"},
    "camera": {"driver": SIMULATED_CAMERA},
    "hdr_merger": {"calibration": CALIBRATION, "cameras": ["camera_1"]},
    "database_writer": {"path": "db", "sample": "paint"},
    "sequencer": {"sample": "paint"},
    "recorder": {"path": "bag"},
    "player": {"bag": "run.mcap", "topics": ["/arm/state", "/replay/command"]},
}
"""Parameters that a node can't be without."""
SIMULATION = ("world", "arm_controller")
NODE_FILES = sorted(ROOT.glob("*/node.py"))
FORBIDDEN_IN_NODES = {
    "socket",
    "zmq",
    "threading",
    "multiprocessing",
    "asyncio",
    "concurrent",
    "subprocess",
    "select",
    "selectors",
    "serial",
}
"""A node's inputs are messages, timers and its driver's readings."""


def imports(tree: ast.AST, package: str) -> Iterator[tuple[str, int]]:
    """Yield the absolute name and the line of each module that is imported anywhere in a file."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = parts[: len(parts) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            yield module, node.lineno
            yield from ((f"{module}.{alias.name}", node.lineno) for alias in node.names)


def source(path: Path) -> tuple[ast.AST, str]:
    """Return a file's tree and the package that its relative imports start from."""
    package = ".".join(["tvbrdf_nodes", *path.relative_to(ROOT).parent.parts])
    return ast.parse(path.read_text(), str(path)), package


def use_of(kind: str) -> Any:
    cls = load_class(node_class_path(kind))
    return cls.topics(
        "camera_1" if kind == "camera" else kind, build(cls.parameters_type, REQUIRED.get(kind, {}))
    )


@pytest.mark.parametrize("kind", NODES)
def test_every_shipped_node_declares_what_it_is(kind: str) -> None:
    cls = load_class(node_class_path(kind))
    assert issubclass(cls, Node)
    assert dataclasses.is_dataclass(cls.parameters_type)
    assert cls.parameters_type.__dataclass_params__.frozen  # type: ignore[attr-defined]
    use = use_of(kind)
    assert len(set(use.takes)) == len(use.takes)
    assert len(set(use.gives)) == len(use.gives)
    for topic in (*use.takes, *use.gives):
        find_topic(topic)
    assert {"/diagnostics", "/log"} <= set(use.gives)
    # its docstring is what `tvbrdf node info` has to say of it
    assert (cls.__doc__ or "").strip().endswith(".") or "\n" in (cls.__doc__ or "")


@pytest.mark.parametrize("kind", NODES)
def test_only_the_simulation_knows_that_it_is_one(kind: str) -> None:
    use = use_of(kind)
    simulated = {topic for topic in (*use.takes, *use.gives) if find_topic(topic).simulation}
    assert bool(simulated) == (kind in SIMULATION)


def test_drivers_of_real_devices_have_no_link_to_a_simulation() -> None:
    for path, simulated in (
        ("tvbrdf_nodes.arm.serial_arm:SerialArm", False),
        ("tvbrdf_nodes.camera.opencv_camera:OpenCvCamera", False),
        ("tvbrdf_nodes.camera.aravis_camera:AravisCamera", False),
        (SIMULATED_CAMERA, True),
    ):
        driver = load_class(path)
        assert hasattr(driver, "link_topics") == simulated, path
        assert driver.live is not simulated, path
        assert dataclasses.is_dataclass(driver.parameters_type), path


def test_a_graph_in_which_a_real_node_touches_the_simulation_is_refused() -> None:
    def graph(node: str) -> Graph:
        world = Participant(name="world", gives=("/sim/grant",), node="tvbrdf_nodes.world.node:W")
        cheat = Participant(name="cheat", takes=("/sim/grant",), node=node)
        return Graph(
            directory="", utc_ns=0, monotonic_ns=0, simulated=True, participants=(world, cheat)
        )

    with pytest.raises(BusError, match="cheat may not touch /sim/grant"):
        graph("my_lab.nodes:Merger").check()
    graph("my_lab.simulated_stage:Stage").check()
    graph("").check()  # a device inside another process


def test_everything_in_the_table_is_given_and_taken_by_somebody() -> None:
    devices = load_class(SIMULATED_CAMERA)
    link = devices.link_topics("camera_1", build(devices.parameters_type, {"camera": 1}))
    uses = [use_of(kind) for kind in NODES] + [link]
    given = {topic for use in uses for topic in use.gives}
    taken = {topic for use in uses for topic in use.takes}
    for row in table():
        name = row.name.replace("{camera}", "camera_1")
        assert name in given, name
        if row.quality == "lossless":
            assert name in taken, name
    assert taken <= given


@pytest.mark.parametrize("path", NODE_FILES, ids=lambda path: path.parent.name)
def test_nodes_hold_no_sockets_threads_or_sleeps(path: Path) -> None:
    tree, package = source(path)
    found = {name.split(".")[0] for name, _ in imports(tree, package)}
    assert not found & FORBIDDEN_IN_NODES
    calls = [ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)]
    assert "time.sleep" not in calls
    assert "sleep" not in calls


@pytest.mark.parametrize("path", NODE_FILES, ids=lambda path: path.parent.name)
def test_nodes_read_no_wall_clock(path: Path) -> None:
    """Time is the run's clock. The world alone paces the simulation by real, monotonic time."""
    tree, package = source(path)
    allowed = {"monotonic"} if path.parent.name == "world" else set()
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id in ("time", "datetime")
    }
    assert used <= allowed
    names = {name for name, _ in imports(tree, package)}
    assert "datetime" not in names
    if not allowed:
        assert "time" not in names


def test_code_for_hardware_never_imports_a_simulation() -> None:
    """The launch file alone chooses; nothing but a simulation knows the simulation."""
    checked = 0
    for path in sorted(ROOT.rglob("*.py")):
        inside = path.relative_to(ROOT)
        if path.stem.startswith("simulated") or inside.parts[0] == "world":
            continue
        tree, package = source(path)
        checked += 1
        for name, line in imports(tree, package):
            modules = name.split(".")
            simulated = any(part.startswith("simulated") for part in modules)
            world = modules[:2] == ["tvbrdf_nodes", "world"]
            assert not simulated, f"{inside}:{line} imports {name}"
            assert not world, f"{inside}:{line} imports {name}"
    assert checked > 30


NUMERICS_MAY = {
    "fit.py": {"time"},  # tells how long a solution took
    "solve/separable/__init__.py": {"time"},  # tells how long compiling took
    "design/simulation.py": {"time"},  # tells how long its fits took
    "batch.py": {"concurrent"},  # for people with many scans; no node uses these two
    "many_scans.py": {"concurrent", "multiprocessing"},
}


def test_numerics_know_no_time_and_no_socket() -> None:
    import tvbrdf_fitting

    folder = Path(tvbrdf_fitting.__file__).parent
    forbidden = FORBIDDEN_IN_NODES | {"tvbrdf_messages", "tvbrdf_nodes", "time"}
    for path in sorted(folder.rglob("*.py")):
        tree = ast.parse(path.read_text())
        found = {name.split(".")[0] for name, _ in imports(tree, "tvbrdf_fitting")}
        allowed = NUMERICS_MAY.get(str(path.relative_to(folder)), set())
        assert not found & (forbidden - allowed), path


def test_starting_a_node_loads_nothing_heavy() -> None:
    """What takes long is imported while the arm homes."""
    heavy = {"scipy", "cv2", "sqlalchemy", "matplotlib"}
    at_start = [ROOT / name / "node.py" for name in ("arm", "sequencer", "world", "hdr_merger")]
    for path in at_start:
        tree = ast.parse(path.read_text())
        top = ast.Module([n for n in tree.body if isinstance(n, (ast.Import, ast.ImportFrom))], [])
        found = {name.split(".")[0] for name, _ in imports(top, "tvbrdf_nodes")}
        assert not found & heavy, path


def test_all_modules_can_be_imported_without_hardware() -> None:
    names = [m.name for m in pkgutil.walk_packages([str(ROOT)], "tvbrdf_nodes.")]
    assert len(names) > 50
    for name in names:
        importlib.import_module(name)


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("nothing", "no node 'nothing'; there are: world, arm"),
        ("tvbrdf_nodes.arm.node:", "is not of the form package.module:Class"),
        ("tvbrdf_nodes.arm.node:ArmNode.x", "is not of the form"),
        ("tvbrdf_nodes.nowhere:Node", "can't import tvbrdf_nodes.nowhere"),
        ("tvbrdf_nodes.arm.node:Missing", "has no class Missing"),
        ("tvbrdf_nodes.arm.node:SERVICE_S", "has no class SERVICE_S"),
    ],
)
def test_a_node_that_does_not_exist_is_told(path: str, text: str) -> None:
    with pytest.raises(LoadingError, match=text):
        load_class(node_class_path(path))
