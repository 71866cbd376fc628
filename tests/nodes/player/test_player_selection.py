"""Which topics are played: nothing that hardware moves by, under no name."""

from __future__ import annotations

import pytest

from tvbrdf_messages.topics import table
from tvbrdf_nodes.arm.node import ArmNode
from tvbrdf_nodes.arm.parameters import ArmParameters
from tvbrdf_nodes.camera.node import CameraNode
from tvbrdf_nodes.core.loading import NODES, load_class
from tvbrdf_nodes.core.parameters import build
from tvbrdf_nodes.player.selection import (
    SelectionError,
    cameras_of,
    moves_hardware,
    preset,
    select,
)

EVERYTHING = tuple(row.name.replace("{camera}", "camera_1") for row in table())


def test_by_default_all_but_commands_the_clock_the_simulation_and_what_nodes_are() -> None:
    played = set(select(EVERYTHING).values())
    left = {"/clock", "/scan/command", "/diagnostics", "/log"}
    left |= {name for name in EVERYTHING if name.startswith("/sim/")}
    assert played == set(EVERYTHING) - left
    assert select(["/scan/command"]) == {"/scan/command": "/replay/command"}


def test_what_a_device_takes_is_never_played() -> None:
    """From the devices' own declarations: whatever they act on is refused, however it is asked."""
    camera = build(
        CameraNode.parameters_type, {"driver": "tvbrdf_nodes.camera.simulated:SimulatedCamera"}
    )
    takes = {
        *ArmNode.topics("arm", build(ArmParameters, {})).takes,
        *CameraNode.topics("camera_1", camera).takes,
    } - {"/clock"}
    assert takes
    for topic in takes:
        assert moves_hardware(topic)
        with pytest.raises(SelectionError, match="is never played: hardware moves by it"):
            select(EVERYTHING, [topic])
        for old in ("/replay/command", "/arm/state", topic):
            with pytest.raises(SelectionError, match="is never played"):
                select(EVERYTHING, [], {old: topic})


def test_only_the_merger_takes_what_was_commanded() -> None:
    sources = [load_class(path).__module__ for path in NODES.values()]
    import importlib
    from pathlib import Path

    takers = []
    for name in sources:
        file = importlib.import_module(name).__file__
        assert file is not None
        if '"/replay/command"' in Path(file).read_text():
            takers.append(name)
    assert takers == ["tvbrdf_nodes.hdr_merger.node"]


@pytest.mark.parametrize(
    ("topics", "remap", "text"),
    [
        (["/clock"], {}, "/clock is the player's own"),
        (["/nothing"], {}, "no topic '/nothing'"),
        ([], {"/arm/state": "/clock"}, "/clock is the player's own"),
        ([], {"/arm/state": "/camera_1/frame"}, "carries ArmState, .* carries Frame"),
        ([], {"/arm/position": "/arm/state"}, "no topic '/arm/position'"),
        (["/camera_1/frame"], {"/arm/state": "/arm/state"}, "/arm/state is not played"),
    ],
)
def test_what_can_not_be_played_is_told(
    topics: list[str], remap: dict[str, str], text: str
) -> None:
    with pytest.raises(SelectionError, match=text):
        select(EVERYTHING, topics, remap)


def test_what_is_asked_for_by_name() -> None:
    assert select(EVERYTHING, ["/sim/scene", "/log"]) == {
        "/sim/scene": "/sim/scene",
        "/log": "/log",
    }
    remap = {"/camera_1/frame": "/top/frame"}
    assert select(["/camera_1/frame"], [], remap) == remap


def test_the_pipeline_is_fed_with_what_its_nodes_do_not_say_themselves() -> None:
    own = {"/scan/radiance", "/scan/parameters", "/scan/stored", "/scan/database"}
    assert not own & set(preset("frames", ["camera_1"]))
    assert not (own - {"/scan/radiance"}) & set(preset("radiance", []))


def test_cameras_are_in_the_order_of_their_numbers() -> None:
    names = ["camera_10", "camera_2", "camera_1", "arm_view"]
    found = cameras_of([*(f"/{name}/frame" for name in names), "/arm/state"])
    assert found == ("arm_view", "camera_1", "camera_2", "camera_10")
