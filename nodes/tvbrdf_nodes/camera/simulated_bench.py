"""One simulated camera alone: plays world and arm to it, for tests and benchmarks."""

from __future__ import annotations

import time
from pathlib import Path

from tvbrdf_messages.bus import InProcessBus
from tvbrdf_messages.clock import ToldClock
from tvbrdf_messages.messages import SimGrant, SimHorizon, SimMotion, SimScene
from tvbrdf_messages.run_directory import Graph, Participant

from ..core.device import DriverContext
from ..core.node import Logger
from ..world.scene import Scene
from .driver import CaptureTag, RawFrame
from .simulated import SimulatedCamera
from .simulated_image import SimulatedCameraParameters

ZERO_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000


class LogLines:
    """A log that keeps its lines as (level, text)."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, str]] = []

    def info(self, text: str) -> None:
        """Keep a line."""
        self.lines.append(("info", text))

    def warning(self, text: str) -> None:
        """Keep a line."""
        self.lines.append(("warning", text))

    def error(self, text: str) -> None:
        """Keep a line."""
        self.lines.append(("error", text))


class SimulatedBench:
    """A simulated camera under a light that moves as it is told.

    Parameters
    ----------
    scene
        The scene.
    parameters
        Of the camera.
    motion
        All of the light's motion, ``start_ns`` counted from the beginning; by default the lamp is
        on and rests at 30 degrees.
    """

    def __init__(
        self,
        scene: Scene,
        parameters: SimulatedCameraParameters,
        motion: SimMotion | None = None,
    ) -> None:
        name = f"camera_{parameters.camera}"
        use = SimulatedCamera.link_topics(name, parameters)
        graph = Graph(
            directory="",
            utc_ns=ZERO_NS,
            monotonic_ns=0,
            simulated=True,
            participants=(
                Participant(
                    name="world", takes=("/sim/horizon",), gives=("/sim/scene", "/sim/grant")
                ),
                Participant(name="arm_controller", gives=("/sim/motion",)),
                Participant(name=f"{name}.device", takes=use.takes, gives=use.gives),
            ),
        )
        bus = InProcessBus(graph)
        self._world, self._arm = bus.port("world"), bus.port("arm_controller")
        self._scene = scene
        self._motion = motion or resting_light(30.0)
        self._told_ns = -1
        self.granted_ns = ZERO_NS
        self.horizons: list[SimHorizon] = []
        self.log: Logger = LogLines()
        self.driver = SimulatedCamera(
            parameters,
            DriverContext(
                name, ToldClock(ZERO_NS), self.log, Path(), lambda: bus.port(f"{name}.device")
            ),
        )

    def open(self) -> None:
        """Open the camera under the scene."""
        self.driver.open()
        scene = SimScene(scene=self._scene.as_dict(), zero_ns=ZERO_NS)
        self._world.publish("/sim/scene", scene, stamp_ns=ZERO_NS)
        self.driver.read()

    def advance(self, step_ns: int = STEP_NS) -> None:
        """Tell the motion of the next step, and grant it."""
        self.granted_ns += step_ns
        starts = tuple(ZERO_NS + start for start in self._motion.start_ns)
        new = [k for k, start in enumerate(starts) if self._told_ns <= start < self.granted_ns]
        motion = self._motion
        self._arm.publish(
            "/sim/motion",
            SimMotion(
                until_ns=self.granted_ns,
                start_ns=tuple(starts[k] for k in new),
                angle_deg=tuple(motion.angle_deg[k] for k in new),
                speed_deg_s=tuple(motion.speed_deg_s[k] for k in new),
                acceleration_deg_s2=tuple(motion.acceleration_deg_s2[k] for k in new),
                lamp=tuple(motion.lamp[k] for k in new),
            ),
            stamp_ns=self.granted_ns,
        )
        self._told_ns = self.granted_ns
        grant = SimGrant(until_ns=self.granted_ns)
        self._world.publish("/sim/grant", grant, stamp_ns=self.granted_ns)

    def read(self) -> list[RawFrame]:
        """Return all frames of what was granted."""
        frames = self.driver.read()
        while self.driver.pending():
            frames += self.driver.read()
        self.horizons += [
            envelope.message
            for envelope in self._world.receive(1_000_000)
            if isinstance(envelope.message, SimHorizon)
        ]
        return frames

    def frames(self, count: int, tag: CaptureTag, limit_s: float = 60.0) -> list[RawFrame]:
        """Start a capture, and return its first ``count`` frames.

        Raises
        ------
        TimeoutError
            After ``limit_s`` of real time.
        """
        self.driver.start(tag)
        found: list[RawFrame] = []
        deadline = time.monotonic() + limit_s
        while len(found) < count:
            if time.monotonic() > deadline:
                raise TimeoutError(f"{len(found)} of {count} frames after {limit_s} s")
            self.advance()
            found += self.read()
        self.driver.stop()
        return found[:count]

    def wait(self, driver: object = None) -> None:
        """Let time pass: what the conformance test calls."""
        self.advance()


def resting_light(angle_deg: float, *, lamp: bool = True) -> SimMotion:
    """Return the motion of a light that does not move."""
    return sweeping_light(angle_deg, 0.0, lamp=lamp)


def sweeping_light(from_deg: float, speed_deg_s: float, *, lamp: bool = True) -> SimMotion:
    """Return the motion of a light at constant speed."""
    return SimMotion(
        until_ns=0,
        start_ns=(0,),
        angle_deg=(from_deg,),
        speed_deg_s=(speed_deg_s,),
        acceleration_deg_s2=(0.0,),
        lamp=(lamp,),
    )
