"""From launch files to graphs: classes, parameters and topics are checked before a start."""

from __future__ import annotations

import textwrap
from pathlib import Path

import pytest

from tvbrdf_launch.errors import LaunchError
from tvbrdf_launch.launch_file import load_launch_file
from tvbrdf_launch.plan import Plan, make_plan
from tvbrdf_launch.stop_order import stop_stages
from tvbrdf_messages.run_directory import Graph, Participant, read_graph

RUN = Path("/run/t/1")


@pytest.fixture(autouse=True)
def test_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


def plan(folder: Path, text: str) -> Plan:
    path = folder / "rig.yaml"
    path.write_text(textwrap.dedent(text))
    return make_plan(load_launch_file(path, {}, RUN), RUN)


def test_the_graph_has_the_nodes_and_the_devices_of_simulated_drivers(tmp_path: Path) -> None:
    made = plan(
        tmp_path,
        """\
        nodes:
          - {name: world, node: world, parameters: {sample: drying_paint}}
          - name: camera_1
            node: launch_test_nodes:Probe
            parameters:
              gives: [/operator/mark]
              driver: launch_test_nodes:SimulatedDriver
              driver_parameters: {port: x, gain: 2}
          - name: reader
            node: launch_test_nodes:Probe
            parameters: {takes: [/operator/mark]}
        """,
    )
    graph = made.graph
    camera, device = graph.find("camera_1"), graph.find("camera_1.device")
    assert camera.node == "launch_test_nodes:Probe"
    assert camera.driver == "launch_test_nodes:SimulatedDriver"
    assert camera.parameters["driver_parameters"] == {"port": "x", "gain": 2}
    assert not camera.live
    assert (device.node, device.gives, device.takes) == ("", ("/sim/horizon",), ("/sim/grant",))
    assert graph.readers("camera_1", "/operator/mark") == ("reader",)
    assert graph.simulated
    assert [node.name for node in made.nodes] == ["world", "camera_1", "reader"]


def test_the_graph_survives_its_file(tmp_path: Path) -> None:
    made = plan(tmp_path, "nodes:\n  - {name: one, node: fitter}\n".replace("fitter", PROBE))
    graph = Graph(
        directory=str(tmp_path),
        utc_ns=made.graph.utc_ns,
        monotonic_ns=made.graph.monotonic_ns,
        simulated=made.graph.simulated,
        participants=made.graph.participants,
    )
    graph.write()
    assert read_graph(tmp_path) == graph


PROBE = "launch_test_nodes:Probe"
REAL = "driver: launch_test_nodes:RealDriver"
ERRORS = [
    ("  - {name: one, node: camara}", 2, "unknown node 'camara'; did you mean 'camera'?"),
    ("  - {name: one, node: no.such:Class}", 2, "on PYTHONPATH?"),
    ("  - {name: one, node: launch_test_nodes:Nothing}", 2, "has no class Nothing"),
    ("  - {name: one, node: launch_test_nodes:RealDriver}", 2, "is no node"),
    (
        f"  - name: one\n    node: {PROBE}\n    parameters:\n      gvies: []",
        5,
        "did you mean 'gives'",
    ),
    (
        f"  - name: one\n    node: {PROBE}\n    parameters:\n      child: 3",
        5,
        "node one: parameter 'child' is 3 (int), expected bool",
    ),
    (f"  - name: one\n    node: {PROBE}\n    parameters:\n      gives: [3]", 5, "expected str"),
    (
        f"  - name: one\n    node: {PROBE}\n    parameters: {{gives: [/scan/statu]}}",
        2,
        "unknown topic '/scan/statu'; did you mean '/scan/status'?",
    ),
    (
        f"  - name: one\n    node: {PROBE}\n    parameters: {{takes: [/operator/mark]}}",
        2,
        "node one takes /operator/mark, which nobody gives",
    ),
    (
        f"  - name: one\n    node: {PROBE}\n    parameters: {{gives: [/sim/grant]}}",
        2,
        "may not touch /sim/grant",
    ),
    (
        f"  - name: one\n    node: {PROBE}\n    parameters:\n      driver: x.y:Z",
        5,
        "unknown driver: x.y:Z",
    ),
    (
        f"  - name: one\n    node: {PROBE}\n    parameters:\n      driver: nothing",
        5,
        "not of the form package.module:Class",
    ),
    (
        f"  - name: one\n    node: {PROBE}\n    parameters:\n      {REAL}\n"
        "      driver_parameters:\n        prt: x",
        7,
        "driver of one: unknown parameter 'prt'; did you mean 'port'?",
    ),
    (
        f"  - name: one\n    node: {PROBE}\n    parameters:\n      {REAL}",
        5,
        "driver of one: parameter 'port' is missing",
    ),
    (
        f"  - name: one\n    node: {PROBE}\n    parameters:\n      {REAL}\n"
        "      driver_parameters: {port: a}\n      speedup: 10",
        7,
        "speedup 10 is refused: one is real",
    ),
]


@pytest.mark.parametrize(("text", "line", "what"), ERRORS, ids=[e[2][:40] for e in ERRORS])
def test_every_error_has_its_file_and_line(tmp_path: Path, text: str, line: int, what: str) -> None:
    with pytest.raises(LaunchError) as caught:
        plan(tmp_path, f"nodes:\n{text}\n")
    assert str(caught.value).startswith(f"{tmp_path}/rig.yaml:{line}: ")
    assert what in str(caught.value)


def test_a_module_that_can_not_be_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken_driver.py").write_text("raise RuntimeError('no licence')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(LaunchError, match=r"rig\.yaml:2: .*RuntimeError: no licence"):
        plan(tmp_path, "nodes:\n  - {name: one, node: broken_driver:Node}\n")


def rig(speedup: str, driver: str, port: str) -> str:
    return f"""\
nodes:
  - name: world
    node: world
    parameters: {{sample: drying_paint, speedup: {speedup}}}
  - name: camera_1
    node: {PROBE}
    parameters:
      driver: launch_test_nodes:SimulatedDriver
      driver_parameters: {{port: x}}
  - name: arm
    node: {PROBE}
    parameters:
      driver: launch_test_nodes:{driver}
      driver_parameters: {{port: {port}}}
"""


def test_speedup_is_for_simulated_devices_only(tmp_path: Path) -> None:
    assert plan(tmp_path, rig("10", "SimulatedDriver", "x")).graph.simulated
    plan(tmp_path, rig("1", "RealDriver", "/dev/ttyUSB0"))
    for speedup in ("10", "0", "0.5"):
        with pytest.raises(LaunchError, match=r"rig\.yaml:4: speedup .* refused: arm is real"):
            plan(tmp_path, rig(speedup, "RealDriver", "/dev/ttyUSB0"))


def test_a_real_driver_on_the_port_of_a_simulated_controller_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "twin").mkdir()
    (tmp_path / "twin" / "__init__.py").touch()
    (tmp_path / "twin" / "simulated.py").write_text(
        textwrap.dedent("""\
        from launch_test_nodes import Probe, TopicUse

        class Twin(Probe):
            @classmethod
            def topics(cls, name, parameters):
                return TopicUse(gives=("/sim/motion",))
        """)
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    twin = "  - {name: twin, node: twin.simulated:Twin}\n"
    assert plan(tmp_path, rig("10", "RealDriver", "$(run)/arm.tty") + twin)
    with pytest.raises(LaunchError, match="arm is real"):
        plan(tmp_path, rig("10", "RealDriver", "/dev/ttyUSB0") + twin)
    with pytest.raises(LaunchError, match="arm is real"):
        plan(tmp_path, rig("10", "RealDriver", "$(run)/arm.tty"))


def test_too_long_a_run_directory_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(f"nodes:\n  - {{name: one, node: {PROBE}}}\n")
    run = Path("/" + 110 * "x")
    with pytest.raises(LaunchError, match="set TVBRDF_RUN to a shorter directory"):
        make_plan(load_launch_file(path, {}, run), run)


def participant(name: str, takes: str = "", gives: str = "", node: str = "n:N") -> Participant:
    return Participant(name=name, takes=tuple(takes.split()), gives=tuple(gives.split()), node=node)


def test_light_first_then_along_the_data_and_the_world_last() -> None:
    graph = Graph(
        directory="/r",
        utc_ns=0,
        monotonic_ns=0,
        simulated=True,
        participants=(
            participant("world", "/sim/horizon", "/clock /sim/grant"),
            participant("arm_controller", "/sim/grant", "/sim/motion /sim/horizon"),
            participant("arm", "/clock /scan/command", "/arm/state /scan/sweep_result"),
            participant("camera_1", "/scan/command", "/camera_1/frame /camera_1/info"),
            participant("camera_1.device", "/sim/motion", "/sim/horizon", node=""),
            participant("recorder", "/scan/parameters /scan/radiance /camera_1/frame"),
            participant("hdr_merger", "/arm/state /camera_1/frame", "/scan/radiance"),
            participant("fitter", "/scan/radiance /scan/stored", "/scan/parameters"),
            participant(
                "database_writer",
                "/scan/radiance /scan/parameters /scan/missing /operator/mark",
                "/scan/stored",
            ),
            participant("sequencer", "/scan/stored", "/scan/command /scan/missing /operator/mark"),
        ),
    )
    assert stop_stages(graph) == (
        ("arm", "sequencer"),
        ("camera_1",),
        ("hdr_merger",),
        ("fitter",),
        ("recorder", "database_writer"),
        ("world", "arm_controller"),
    )


def test_loops_of_lossless_topics_end() -> None:
    graph = Graph(
        directory="/r",
        utc_ns=0,
        monotonic_ns=0,
        simulated=False,
        participants=(
            participant("a", "/scan/radiance", "/scan/parameters"),
            participant("b", "/scan/parameters", "/scan/radiance"),
        ),
    )
    stages = stop_stages(graph)
    assert sorted(name for stage in stages for name in stage) == ["a", "b"]
