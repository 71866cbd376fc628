"""What the camera's tests share: a sample, a bench with one simulated camera, a node's rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tvbrdf_fitting.geometry import CAMERA_ANGLES_DEG, light_direction, view_direction
from tvbrdf_fitting.published import CameraScan, scan_file_name, write_scan_file
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import (
    Frame,
    ScanCommand,
    SimGrant,
    SimMotion,
    SimScene,
    SweepResult,
)
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_nodes.camera.driver import CameraSettings
from tvbrdf_nodes.camera.node import CameraNode
from tvbrdf_nodes.camera.parameters import CameraParameters
from tvbrdf_nodes.camera.simulated import SimulatedCamera
from tvbrdf_nodes.camera.simulated_bench import ZERO_NS, SimulatedBench
from tvbrdf_nodes.camera.simulated_image import SimulatedCameraParameters
from tvbrdf_nodes.core.inprocess import InProcessGraph
from tvbrdf_nodes.world.scene import CameraEffects, Scene

STEP_NS = 50_000_000
NAME = "camera_2"
SIMULATED = "tvbrdf_nodes.camera.simulated:SimulatedCamera"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A sample in the published layout: a coloured diffuse surface with a broad highlight."""
    (tmp_path / "tvBrdf-data").mkdir()
    angle_deg = np.arange(-77.5, 90.01, 0.5)
    light = light_direction(angle_deg)
    for camera, camera_angle in enumerate(CAMERA_ANGLES_DEG, start=1):
        view = view_direction(camera_angle)
        highlight = 0.3 * np.clip((light + view)[:, 2:] / 2.0, 0, 1) ** 8
        radiance = light[:, 2:] * (np.array([0.1, 0.3, 0.6]) + highlight)
        scan = CameraScan((4.0,), light, np.round(view, 6), radiance)
        write_scan_file(tmp_path / "tvBrdf-data" / scan_file_name(1, camera), scan)
    return tmp_path


@pytest.fixture
def make_bench(folder: Path) -> Callable[..., SimulatedBench]:
    def make(
        effects: CameraEffects | None = None,
        motion: SimMotion | None = None,
        camera: int = 2,
        exposure_ms: float = 4.0,
        sensor: dict[str, Any] | None = None,
        **scene: Any,
    ) -> SimulatedBench:
        whole = Scene(
            **{
                "sample": {"kind": "measured", "path": str(folder)},
                "camera": effects or CameraEffects(),
                **scene,
            }
        )
        sizes = {"width": 32, "height": 32} | (sensor or {})
        bench = SimulatedBench(whole, SimulatedCameraParameters(camera=camera, **sizes), motion)
        bench.open()
        bench.driver.configure(CameraSettings(exposure_ms=exposure_ms, frame_rate_hz=30.0))
        return bench

    return make


class Rig:
    """A camera node with everything around it played."""

    def __init__(
        self, tmp_path: Path, scene: Scene, parameters: dict[str, Any], live: bool
    ) -> None:
        use = CameraNode.topics(NAME, CameraParameters(driver=SIMULATED))
        link = SimulatedCamera.link_topics(NAME, SimulatedCameraParameters(camera=2))
        own = {"camera": 2, "width": 16, "height": 16}
        graph = Graph(
            directory=str(tmp_path),
            utc_ns=ZERO_NS,
            monotonic_ns=0,
            simulated=True,
            participants=(
                Participant(
                    name="world",
                    takes=("/sim/horizon",),
                    gives=("/clock", "/sim/scene", "/sim/grant"),
                ),
                Participant(name="arm_controller", gives=("/sim/motion",)),
                Participant(
                    name="sequencer", takes=("/scan/sweep_result",), gives=("/scan/command",)
                ),
                Participant(name="hdr_merger", takes=(f"/{NAME}/frame", f"/{NAME}/info")),
                Participant(
                    name=NAME,
                    takes=use.takes,
                    gives=use.gives,
                    node="tvbrdf_nodes.camera.node:CameraNode",
                    parameters={"driver": SIMULATED, "driver_parameters": own} | parameters,
                    live=live,
                ),
                Participant(name=f"{NAME}.device", takes=link.takes, gives=link.gives),
            ),
        )
        self.graph = InProcessGraph(graph, run=[NAME])
        self.world = self.graph.bus.port("world")
        self.arm = self.graph.bus.port("arm_controller")
        self.sequencer = self.graph.bus.port("sequencer")
        self.merger = self.graph.bus.port("hdr_merger")
        self.granted_ns = ZERO_NS
        self.command_id = 0
        self.scene = scene

    @property
    def node(self) -> CameraNode:
        node = self.graph.runners[NAME].node
        assert isinstance(node, CameraNode)
        return node

    def begin(self) -> None:
        scene = SimScene(scene=self.scene.as_dict(), zero_ns=ZERO_NS)
        self.world.publish("/sim/scene", scene, stamp_ns=ZERO_NS)
        rest: dict[str, Any] = {"speed_deg_s": (0.0,), "acceleration_deg_s2": (0.0,)}
        motion = SimMotion(
            until_ns=ZERO_NS, start_ns=(ZERO_NS,), angle_deg=(30.0,), lamp=(True,), **rest
        )
        self.arm.publish("/sim/motion", motion, stamp_ns=ZERO_NS)
        self.settle()

    def settle(self) -> None:
        while self.graph.step():
            pass

    def advance(self, seconds: float = STEP_NS * 1e-9) -> None:
        """Let simulated time pass, in the world's steps."""
        end_ns = self.granted_ns + round(seconds * 1e9)
        while self.granted_ns < end_ns:
            self.graph.clock.tell(self.granted_ns)
            self.granted_ns += STEP_NS
            nothing: dict[str, Any] = dict.fromkeys(
                ("start_ns", "angle_deg", "speed_deg_s", "acceleration_deg_s2", "lamp"), ()
            )
            motion = SimMotion(until_ns=self.granted_ns, **nothing)
            self.arm.publish("/sim/motion", motion, stamp_ns=self.granted_ns)
            grant = SimGrant(until_ns=self.granted_ns)
            self.world.publish("/sim/grant", grant, stamp_ns=self.granted_ns)
            self.settle()

    def command(self, action: str, **fields: Any) -> ScanCommand:
        self.command_id = fields.pop("command_id", self.command_id + 1)
        command = ScanCommand(
            **{
                "command_id": self.command_id,
                "incarnation": self.sequencer.incarnation,
                "not_after_ns": self.graph.clock.now_ns() + 10**9,
                "action": action,
                "sample": "paint",
                "scan": 1,
                "attempt": 1,
                "exposure_ms": 4.0,
                **fields,
            }
        )
        self.sequencer.publish("/scan/command", command, stamp_ns=0)
        self.settle()
        return command

    def results(self) -> list[SweepResult]:
        """Answers since the last call."""
        found = [envelope.message for envelope in self.sequencer.receive(1000)]
        return [message for message in found if isinstance(message, SweepResult)]

    def result(self) -> SweepResult:
        (result,) = self.results()
        return result

    def frames(self) -> list[Envelope]:
        """Frames since the last call."""
        found = self.merger.receive(100_000)
        return [envelope for envelope in found if isinstance(envelope.message, Frame)]

    def sweep(self, seconds: float = 0.5, **fields: Any) -> SweepResult:
        """Prepare, sweep, end, and return the answer to the sweep."""
        self.command("prepare", **fields)
        assert self.result().state == "done"
        self.command("sweep", **fields)
        self.advance(seconds)
        self.command("end_sweep", **fields)
        return self.result()


@pytest.fixture
def make_rig(tmp_path: Path, folder: Path) -> Iterator[Callable[..., Rig]]:
    with ExitStack() as stack:

        def make(*faults: dict[str, Any], live: bool = False, **parameters: Any) -> Rig:
            scene = Scene(
                sample={"kind": "measured", "path": str(folder)},
                camera=CameraEffects(quantisation=True, faults=faults),
            )
            rig = Rig(tmp_path, scene, parameters, live)
            stack.enter_context(rig.graph)
            rig.begin()
            return rig

        yield make


@pytest.fixture
def rig(make_rig: Callable[..., Rig]) -> Rig:
    return make_rig()
