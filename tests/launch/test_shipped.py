"""The launch files that ship: they are good, use what they declare, and stop in order."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tvbrdf_launch.errors import LaunchError
from tvbrdf_launch.find_files import find_launch_file, shipped
from tvbrdf_launch.launch_file import load_launch_file
from tvbrdf_launch.plan import Plan, make_plan
from tvbrdf_launch.stop_order import stop_stages

RUN = Path("/run/t/1")
REAL = {
    "sample": "paint",
    "calibration": str(find_launch_file("simulated_rig").with_name("calibration.yaml")),
    "camera_1": "A",
    "camera_2": "B",
    "camera_3": "C",
    "camera_4": "D",
}
CAMERAS = ("camera_1", "camera_2", "camera_3", "camera_4")


def plan(name: str, **arguments: str) -> Plan:
    return make_plan(load_launch_file(find_launch_file(name), arguments, RUN), RUN)


def test_the_simulated_rig() -> None:
    made = plan("simulated_rig", sample="wet_cloth", scans="5", width="64", database="a/b")
    graph = made.graph
    assert graph.simulated
    assert {node.name for node in made.nodes if node.ends_run} == {"sequencer"}
    assert graph.find("sequencer").parameters["scans"] == 5
    assert graph.find("sequencer").parameters["sample"] == "wet_cloth"
    assert graph.find("database_writer").parameters["path"] == "a/b"
    assert graph.find("arm").parameters["driver_parameters"]["port"] == f"{RUN}/arm_controller.tty"
    calibration = Path(graph.find("hdr_merger").parameters["calibration"])
    assert calibration.is_file()
    for number, camera in enumerate(CAMERAS, start=1):
        own = graph.find(camera).parameters["driver_parameters"]
        assert (own["camera"], own["width"]) == (number, 64)
        assert graph.find(f"{camera}.device").gives
    # nothing that can't be made again is ever started anew: time, and the hardware
    assert {n.name for n in made.nodes if n.restart.policy == "never"} == {
        "world",
        "arm_controller",
    }


def test_it_stops_light_first_and_world_last() -> None:
    assert [set(stage) for stage in stop_stages(plan("simulated_rig").graph)] == [
        {"sequencer", "arm"},
        set(CAMERAS),
        {"hdr_merger"},
        {"fitter"},
        {"database_writer"},
        {"world", "arm_controller"},
    ]


def test_the_real_rig_differs_in_devices_only() -> None:
    real, simulated = plan("rig", **REAL).graph, plan("simulated_rig").graph
    assert not real.simulated
    assert all(real.find(name).live for name in ("arm", *CAMERAS))
    names = {p.name for p in simulated.participants if p.node}
    assert names - {p.name for p in real.participants} == {"world", "arm_controller"}
    for participant in real.participants:
        twin = simulated.find(participant.name)
        assert (twin.node, twin.takes, twin.gives) == (
            participant.node,
            participant.takes,
            participant.gives,
        )


@pytest.mark.parametrize("missing", sorted(REAL))
def test_the_real_rig_says_what_it_must_know(missing: str) -> None:
    given = {name: value for name, value in REAL.items() if name != missing}
    with pytest.raises(LaunchError, match=rf"rig\.yaml:\d+: argument '{missing}' .*must be given"):
        plan("rig", **given)


def test_the_real_rig_has_no_speedup() -> None:
    with pytest.raises(LaunchError, match="speedup is for rigs that are simulated altogether"):
        plan("rig", **REAL, speedup="10")


def test_one_real_camera_in_the_simulated_rig_ends_the_speedup(tmp_path: Path) -> None:
    for file in find_launch_file("simulated_rig").parent.glob("*.yaml"):
        (tmp_path / file.name).write_text(file.read_text())
    mixed = tmp_path / "mixed.yaml"
    text = (tmp_path / "simulated_rig.yaml").read_text()
    simulated = (
        r"tvbrdf_nodes\.camera\.simulated:SimulatedCamera\n +driver_parameters:\n( {8}.*\n)+"
    )
    real = (
        "tvbrdf_nodes.camera.opencv_camera:OpenCvCamera\n      driver_parameters: {source: '0'}\n"
    )
    mixed.write_text(re.sub(simulated, real, text, count=1))
    with pytest.raises(
        LaunchError, match=r"mixed\.yaml:\d+: speedup 0 is refused: camera_1 is real"
    ):
        plan(str(mixed))
    assert plan(str(mixed), speedup="1").graph.find("camera_1").live


def test_every_declared_argument_is_used() -> None:
    for name in shipped():
        path = find_launch_file(name)
        declared = set(shipped()[name].arguments)
        used = set(re.findall(r"\$\(var (\w+)\)", path.read_text()))
        assert used == declared, path


def test_every_argument_and_file_is_described() -> None:
    assert set(shipped()) == {"simulated_rig", "rig", "pipeline", "play", "replay"}
    for name, declaration in shipped().items():
        assert declaration.description, name
        for argument in declaration.arguments.values():
            assert argument.description, f"{name}: {argument.name}"
