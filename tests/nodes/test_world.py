"""The world: it holds the scene, and time goes on as fast as the slowest device."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tvbrdf_fitting.geometry import light_direction, view_direction
from tvbrdf_fitting.published import CameraScan, scan_file_name, write_scan_file
from tvbrdf_messages.messages import Clock, SimGrant, SimHorizon, SimScene
from tvbrdf_nodes.core.parameters import ParameterError, build
from tvbrdf_nodes.world.node import WorldParameters
from tvbrdf_nodes.world.sample import make_sample
from tvbrdf_nodes.world.scene import (
    Scene,
    SceneError,
    available,
    load_scene,
    scene_from_dict,
)

if TYPE_CHECKING:
    from tests.nodes.stage import MakeStage, Stage

STEP_NS = 100_000_000
DEVICES = ("arm_controller", "second_controller")


class World:
    """A running world and two simulated devices that the test plays."""

    def __init__(self, make_stage: MakeStage, **parameters: Any) -> None:
        given = {"sample": "drying_paint", "effects": "ideal", "step_ms": 100.0} | parameters
        self.stage: Stage = make_stage(
            *((name, "arm_controller") for name in DEVICES), ("world", "world", given, True)
        )
        self.start_ns = self.stage.now_ns
        self.stage.begin()

    def reach(self, device: str, until_ns: int, *, idle: bool = False) -> None:
        message = SimHorizon(device=device, until_ns=self.start_ns + until_ns, idle=idle)
        self.stage.players[device].say("/sim/horizon", message)

    def granted(self) -> list[int]:
        """Return the moments granted since the last call, from the start."""
        grants = self.stage.players[DEVICES[0]].take(SimGrant)
        return [grant.until_ns - self.start_ns for grant in grants]

    def told(self) -> list[int]:
        """Return the times told on /clock so far, from the start."""
        clocks: list[Any] = [e.message for e in self.stage.said("/clock")]
        return [clock.now_ns - self.start_ns for clock in clocks if isinstance(clock, Clock)]


@pytest.fixture
def world(make_stage: MakeStage) -> World:
    return World(make_stage)


def test_it_tells_the_scene_and_grants_the_first_step(world: World, tmp_path: Path) -> None:
    (scene,) = world.stage.players[DEVICES[1]].take(SimScene)
    assert scene_from_dict(scene.scene) == load_scene("drying_paint", "ideal", 1)
    assert scene.zero_ns == world.start_ns
    assert world.granted() == [STEP_NS]
    assert world.told() == [0]
    record = json.loads((tmp_path / "scene.json").read_text())
    assert record.pop("zero_ns") == world.start_ns
    assert scene_from_dict(record) == load_scene("drying_paint", "ideal", 1)


def test_time_goes_on_when_all_devices_have_reached_it(world: World) -> None:
    world.granted()
    world.reach(DEVICES[0], STEP_NS)
    assert world.granted() == []
    world.reach(DEVICES[1], STEP_NS - 1)
    assert world.granted() == []
    assert world.told() == [0]
    world.reach(DEVICES[1], STEP_NS)
    assert world.granted() == [2 * STEP_NS]
    assert world.told() == [0, STEP_NS]
    assert world.stage.now_ns == world.start_ns + STEP_NS


def test_time_never_passes_a_device_that_waits(world: World) -> None:
    """A device with a full lossless queue tells no horizon."""
    world.granted()
    for _ in range(5):
        world.reach(DEVICES[0], STEP_NS)
    assert world.granted() == []
    assert world.told() == [0]


def test_strangers_do_not_move_time(world: World) -> None:
    world.granted()
    world.reach(DEVICES[0], STEP_NS)
    stranger = SimHorizon(device="somebody", until_ns=world.start_ns + 10 * STEP_NS)
    world.stage.players[DEVICES[1]].say("/sim/horizon", stranger)
    assert world.granted() == []


def test_a_device_that_died_is_waited_for(world: World) -> None:
    world.granted()
    dead, other = world.stage.players[DEVICES[1]], DEVICES[0]
    world.reach(DEVICES[1], STEP_NS)
    dead.die()
    world.reach(other, STEP_NS)
    assert world.granted() == []
    dead.return_()
    # its successor gets scene and grant again
    (scene,), (grant,) = dead.take(SimScene), dead.take(SimGrant)
    assert (scene.zero_ns, grant.until_ns) == (world.start_ns, world.start_ns + STEP_NS)
    world.reach(DEVICES[1], STEP_NS)
    assert world.granted() == [2 * STEP_NS]


@pytest.mark.parametrize(
    ("idle", "parameters", "cap"),
    [
        ((False, False), {"speedup": 20.0}, 20.0),
        ((True, True), {"idle_speedup": 20.0}, 20.0),
        ((False, True), {"moving_speedup": 20.0, "idle_speedup": 1.0}, 20.0),
        ((True, True), {"speedup": 10.0, "idle_speedup": 20.0}, 10.0),
        ((False, False), {"idle_speedup": 0.001, "moving_speedup": 0.001}, None),
    ],
)
def test_the_speed_has_a_cap_while_nothing_much_happens(
    make_stage: MakeStage,
    idle: tuple[bool, bool],
    parameters: dict[str, float],
    cap: float | None,
) -> None:
    world = World(make_stage, **parameters)
    world.granted()
    began = time.monotonic()
    steps = 8
    for step in range(1, steps + 1):
        for device, rests in zip(DEVICES, idle, strict=True):
            world.reach(device, step * STEP_NS, idle=rests)
        world.stage.wait(lambda: bool(world.granted()))
    took_s = time.monotonic() - began
    if cap is None:
        # as fast as the slowest device; the others' caps would have made it 800 s
        assert took_s < 10.0
    else:
        assert took_s >= steps * STEP_NS / 1e9 / cap - 1e-3


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"speedup": -1.0}, "speedup must be 0"),
        ({"idle_speedup": 0.0}, "above 0"),
        ({"step_ms": 0.0}, "step_ms is 0"),
        ({"sample": "slime"}, r"no sample 'slime'.*one of: drying_paint"),
        ({"effects": "magic"}, r"no effect 'magic'.*one of: ideal, realistic"),
        ({"sample": "measured:/nowhere"}, "/nowhere holds no folder tvBrdf-data"),
    ],
)
def test_what_can_not_be_simulated_is_refused_before_the_start(
    values: dict[str, Any], text: str
) -> None:
    with pytest.raises(ParameterError, match=text):
        build(WorldParameters, {"sample": "drying_paint"} | values)


# -- scenes


def test_shipped_scenes_are_there_and_can_be_read() -> None:
    assert set(available("samples")) == {"drying_paint", "settling_dust", "wet_cloth"}
    assert set(available("effects")) == {"ideal", "realistic"}
    for sample in available("samples"):
        for effects in available("effects"):
            scene = load_scene(sample, effects, 7)
            assert scene.seed == 7
            assert scene_from_dict(json.loads(json.dumps(scene.as_dict()))) == scene
            make_sample(scene.sample)


def test_every_effect_is_off_by_default() -> None:
    scene = Scene(sample={})
    assert load_scene("drying_paint", "ideal", 1) == Scene(
        sample=load_scene("drying_paint", "ideal", 1).sample
    )
    off = {**scene.as_dict()["arm"], **scene.as_dict()["camera"], **scene.as_dict()["lamp"]}
    on = {name: value for name, value in off.items() if value}
    assert on == {"saturation": True, "warm_up_fraction": 1.0}  # which needs a warm_up_s


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("arm: {jiter_ms: 1}", "unknown parameter 'jiter_ms'; did you mean 'jitter_ms'"),
        ("camera: {shot_noise: 1}", "parameter 'shot_noise' is 1 .int., expected bool"),
        ("lamp: 3", "parameter 'lamp' is 3"),
        ("noise: true", "unknown parameter 'noise'"),
        ("- 1", "expected a mapping"),
        ("a: [", "not YAML"),
    ],
)
def test_effects_that_are_wrong_are_refused_with_their_file(
    tmp_path: Path, content: str, text: str
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(content)
    with pytest.raises(SceneError, match=rf"mine\.yaml: .*{text}"):
        load_scene("drying_paint", str(path), 1)


def test_a_sample_without_a_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("ks: 1.0")
    with pytest.raises(SceneError, match=r"mine\.yaml: key 'kind' is missing"):
        load_scene(str(path), "ideal", 1)


def test_measured_reflectance_goes_on_straight_to_the_horizon(tmp_path: Path) -> None:
    """Real materials don't fade towards grazing light; a kink there would be the scene's own."""
    folder = tmp_path / "tvBrdf-data"
    folder.mkdir()
    angle = np.arange(-77.5, 90.01, 0.5)
    radiance = 0.08 + 1e-3 * (angle[:, None] + 77.5) * np.array([1.0, 2.0, 3.0])
    for camera, camera_angle in enumerate((0.0, 25.0, 50.0, 75.0), start=1):
        view = np.round(view_direction(camera_angle), 6)
        scan = CameraScan((4.0,), light_direction(angle), view, radiance)
        write_scan_file(folder / scan_file_name(1, camera), scan)
    sample = make_sample({"kind": "measured", "path": str(tmp_path)})
    near = np.array([-77.99, -77.75, -77.5, -77.25])
    expected = 0.08 + 1e-3 * (near[:, None] + 77.5) * np.array([1.0, 2.0, 3.0])
    # directions have six decimals: 6e-5 degrees, here 2e-7 in radiance, and the file's rounding
    np.testing.assert_allclose(sample.radiance(2, near, 0.0, 1), expected, rtol=0, atol=1e-6)
    assert not sample.radiance(2, np.array([-78.0, -90.0]), 0.0, 1).any()
    # at the other end the horizon is far: after a step it falls to nothing, never below
    far = sample.radiance(2, np.array([90.5, 95.0, 101.9, 102.0]), 0.0, 1)
    assert far[0] == pytest.approx(radiance[-1] + 5e-4 * np.array([1.0, 2.0, 3.0]), abs=1e-6)
    assert (np.diff(far, axis=0) < 0).all()
    assert (far >= 0).all()
    assert not far[-1].any()
