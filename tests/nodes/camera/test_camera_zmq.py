"""A simulated camera's link over real sockets: registrations, credit, what the shell waits for."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest
import zmq

from tvbrdf_messages.bus import ZmqPort
from tvbrdf_messages.clock import ToldClock
from tvbrdf_messages.messages import SimGrant, SimHorizon, SimMotion, SimScene
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_nodes.camera.driver import CameraSettings, CaptureTag, RawFrame
from tvbrdf_nodes.camera.simulated import SimulatedCamera
from tvbrdf_nodes.camera.simulated_bench import ZERO_NS, LogLines
from tvbrdf_nodes.camera.simulated_image import SimulatedCameraParameters
from tvbrdf_nodes.core.device import DriverContext
from tvbrdf_nodes.world.scene import Scene

LIMIT_S = 20.0


@pytest.fixture
def ports(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, Any, SimulatedCamera]]:
    directory = tmp_path_factory.mktemp("z")  # socket paths must be short
    parameters = SimulatedCameraParameters(camera=3, width=16, height=16)
    use = SimulatedCamera.link_topics("camera_3", parameters)
    graph = Graph(
        directory=str(directory),
        utc_ns=ZERO_NS,
        monotonic_ns=0,
        simulated=True,
        participants=(
            Participant(name="world", takes=("/sim/horizon",), gives=("/sim/scene", "/sim/grant")),
            Participant(name="arm_controller", gives=("/sim/motion",)),
            Participant(name="camera_3.device", takes=use.takes, gives=use.gives),
        ),
    )
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    world, arm = ZmqPort(graph, "world", context), ZmqPort(graph, "arm_controller", context)
    driver = SimulatedCamera(
        parameters,
        DriverContext(
            "camera_3",
            ToldClock(ZERO_NS),
            LogLines(),
            directory,
            lambda: ZmqPort(graph, "camera_3.device", context),
        ),
    )
    driver.open()
    yield world, arm, driver
    driver.close()
    for port in (world, arm):
        port.close()
    context.term()


def test_takes_part_over_sockets(
    ports: tuple[ZmqPort, ZmqPort, SimulatedCamera],
) -> None:
    world, arm, driver = ports
    poller = zmq.Poller()
    frames: list[RawFrame] = []
    horizons: list[SimHorizon] = []
    deadline = time.monotonic() + LIMIT_S

    def turn() -> None:
        """One turn of the shell's loop, and of the others'."""
        assert time.monotonic() < deadline
        for socket in driver.waitables():
            poller.register(socket, zmq.POLLIN)
        poller.poll(0 if driver.pending() else 10)
        frames.extend(driver.read())
        for port in (world, arm):
            port.service()
        horizons.extend(e.message for e in world.receive() if isinstance(e.message, SimHorizon))

    while not (world.ready() and arm.ready()):
        turn()
    constant = {"kd_b": 0.2, "kd_g": 0.3, "kd_r": 0.4}
    sample = {
        "kind": "constant",
        "model": "oren_nayar",
        "parameters": {**constant, "sigma_d": 0.0},
    }
    scene = Scene(sample=sample).as_dict()
    world.publish("/sim/scene", SimScene(scene=scene, zero_ns=ZERO_NS), stamp_ns=ZERO_NS)
    driver.configure(CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0))
    driver.start(CaptureTag())
    for k in range(1, 6):
        until_ns = ZERO_NS + k * 100_000_000
        motion = SimMotion(
            until_ns=until_ns,
            start_ns=(ZERO_NS,) if k == 1 else (),
            angle_deg=(20.0,) if k == 1 else (),
            speed_deg_s=(0.0,) if k == 1 else (),
            acceleration_deg_s2=(0.0,) if k == 1 else (),
            lamp=(True,) if k == 1 else (),
        )
        world.publish("/sim/grant", SimGrant(until_ns=until_ns), stamp_ns=until_ns)
        arm.publish("/sim/motion", motion, stamp_ns=until_ns)
        while not horizons or horizons[-1].until_ns < until_ns:
            turn()
    assert 13 <= len(frames) <= 15
    assert [frame.frame_id for frame in frames] == list(range(len(frames)))
    assert all(horizon.device == "camera_3.device" for horizon in horizons)
    assert frames[-1].image[0, 0, 2] > frames[-1].image[0, 0, 0] > 64
