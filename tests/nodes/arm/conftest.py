"""An arm's node and the controller's twin in this process, joined by a real pseudo-terminal."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tvbrdf_messages.bus import InProcessBus
from tvbrdf_messages.clock import RunClock, ToldClock
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import (
    ArmState,
    ScanCommand,
    SimGrant,
    SimHorizon,
    SimMotion,
    SimScene,
    SweepResult,
)
from tvbrdf_messages.run_directory import Graph, Participant
from tvbrdf_nodes.core.runner import RUNNING, NodeRunner
from tvbrdf_nodes.world.scene import ArmEffects, Scene

ZERO_NS = 1_700_000_000_123_456_789
STEP_NS = 100_000_000
LIMIT_S = 20.0
"""Real time after which something that should happen counts as missing."""


class ArmRig:
    """The test plays world, sequencer and the readers; arm and twin are real nodes."""

    def __init__(
        self,
        directory: Path,
        effects: ArmEffects,
        arm: dict[str, Any],
        node: dict[str, Any],
        controller: dict[str, Any],
        clock: RunClock | None,
    ) -> None:
        directory.mkdir(exist_ok=True)
        self.directory = directory
        port = str(directory / "arm_controller.tty")
        driver = {"port": port, "arrival_stamps": "line", **arm}
        participants = (
            Participant(name="sequencer", gives=("/scan/command",), takes=("/scan/sweep_result",)),
            Participant(name="world", gives=("/sim/scene", "/sim/grant"), takes=("/sim/horizon",)),
            Participant(name="reader", takes=("/arm/state", "/sim/motion")),
            Participant(
                name="arm",
                node="tvbrdf_nodes.arm.node:ArmNode",
                takes=("/scan/command",),
                gives=("/arm/state", "/scan/sweep_result", "/diagnostics", "/log"),
                parameters={"driver_parameters": driver, **node},
                live=True,
            ),
            Participant(
                name="arm_controller",
                node="tvbrdf_nodes.arm.simulated:SimulatedController",
                takes=("/sim/scene", "/sim/grant"),
                gives=("/sim/motion", "/sim/horizon", "/diagnostics", "/log"),
                parameters=controller,
            ),
        )
        self.graph = Graph(
            directory=str(directory),
            utc_ns=ZERO_NS,
            monotonic_ns=0,
            simulated=True,
            participants=participants,
        )
        self.bus = InProcessBus(self.graph)
        self.bus.record = True
        self.clock = ToldClock(ZERO_NS)
        self.arm_clock = clock or self.clock
        self.sequencer = self.bus.port("sequencer")
        self.world = self.bus.port("world")
        self.bus.port("reader")
        scene = Scene(sample={"kind": "none"}, seed=7, arm=effects)
        self.scene = SimScene(scene=scene.as_dict(), zero_ns=ZERO_NS)
        self.granted_ns = ZERO_NS
        self._command_id = 0
        self.runners: dict[str, NodeRunner] = {}
        self.hold_time = False
        """While set, simulated time stands still."""
        self.pace_s = 0.0
        """Real time that a step of simulated time takes at least."""
        self._next_grant_s = 0.0

    # -- nodes

    def start(self, name: str) -> NodeRunner:
        """Start a node, or start it again as a new process would be."""
        clock = self.arm_clock if name == "arm" else self.clock
        runner = NodeRunner(
            self.graph, name, clock, self.bus.port(name), self.bus.port, log_to_stderr=False
        )
        self.runners[name] = runner
        runner.node.prepare()
        runner.set_state(RUNNING)
        runner.put(runner.node.start())
        return runner

    def start_all(self) -> ArmRig:
        """Start twin and arm, and let there be time."""
        self.world.publish("/sim/scene", self.scene, stamp_ns=ZERO_NS)
        self.start("arm_controller")
        self._grant()
        self.start("arm")
        return self

    def kill(self, name: str) -> None:
        """End a node as SIGKILL would: nothing of it runs any more, its files are closed."""
        runner = self.runners.pop(name)
        if name == "arm":
            runner.node._driver.close()  # type: ignore[attr-defined]
        runner.port.close()

    def close(self) -> None:
        """End everything."""
        if "arm" in self.runners:
            with self.twin_running():
                runner = self.runners.pop("arm")
                runner.put(runner.node.stop())
        for runner in self.runners.values():
            runner.put(runner.node.stop())

    @contextlib.contextmanager
    def twin_running(self) -> Iterator[None]:
        """Let the twin read and answer in a thread, while this one is in a call that waits."""
        ended = threading.Event()

        def pump() -> None:
            twin = self.runners.get("arm_controller")
            while twin is not None and not ended.wait(0.002):
                list(twin.node.poll())

        thread = threading.Thread(target=pump)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    # -- time

    def _grant(self) -> None:
        self.granted_ns += STEP_NS
        self._next_grant_s = time.monotonic() + self.pace_s
        self.world.publish(
            "/sim/grant", SimGrant(until_ns=self.granted_ns), stamp_ns=self.clock.now_ns()
        )

    def step(self) -> None:
        """Let every node do what it can; go on when the twin has arrived."""
        for runner in list(self.runners.values()):
            runner.take_messages()
            runner.put(runner.node.poll())
            runner.fire_timers()
        for envelope in self.world.receive():
            horizon = envelope.message
            if isinstance(horizon, SimHorizon) and horizon.until_ns >= self.granted_ns:
                self.clock.tell(horizon.until_ns)
        arrived = self.clock.now_ns() >= self.granted_ns
        if arrived and not self.hold_time and time.monotonic() >= self._next_grant_s:
            self._grant()

    def run(self, done: Callable[[], Any], what: str = "it") -> None:
        """Go on until ``done()``."""
        deadline = time.monotonic() + LIMIT_S
        while not done():
            assert time.monotonic() < deadline, f"{what} did not happen within {LIMIT_S} s"
            self.step()

    def run_for(self, seconds: float) -> None:
        """Go on for a while of simulated time."""
        end_ns = self.clock.now_ns() + round(1e9 * seconds)
        self.run(lambda: self.clock.now_ns() >= end_ns)

    # -- commands

    def send(self, action: str, **fields: Any) -> int:
        """Send a command; return its number."""
        self._command_id = max(self._command_id + 1, fields.get("command_id", 0))
        command = ScanCommand(
            **{
                "command_id": self._command_id,
                "incarnation": self.sequencer.incarnation,
                "not_after_ns": self.clock.now_ns() + 60 * 10**9,
                "action": action,
                "target": "arm",
                **fields,
            }
        )
        self.sequencer.publish("/scan/command", command, stamp_ns=self.clock.now_ns())
        return command.command_id

    def results(self, number: int) -> list[SweepResult]:
        """Return what was said about a command."""
        found = [e.message for e in self.published("/scan/sweep_result")]
        return [r for r in found if isinstance(r, SweepResult) and r.command_id == number]

    def do(self, action: str, **fields: Any) -> SweepResult:
        """Send a command, and return what came of it."""
        number = self.send(action, **fields)
        self.run(lambda: self.results(number), f"the answer to {action}")
        return self.results(number)[-1]

    def homed(self) -> ArmRig:
        """Home the arm."""
        result = self.do("home")
        assert result.state == "done", result.reason
        return self

    # -- what came

    def published(self, topic: str) -> list[Envelope]:
        """Return everything published on a topic."""
        return [envelope for envelope in self.bus.taps if envelope.topic == topic]

    def states(self) -> list[tuple[Envelope, ArmState]]:
        """Return every state of the arm, with its envelope."""
        found = [(e, e.message) for e in self.published("/arm/state")]
        return [(e, m) for e, m in found if isinstance(m, ArmState)]

    def motions(self) -> list[SimMotion]:
        """Return the true motion."""
        found = [e.message for e in self.published("/sim/motion")]
        return [m for m in found if isinstance(m, SimMotion)]

    def log(self) -> str:
        """Return what the nodes have said."""
        return "\n".join(f"{e.message}" for e in self.published("/log"))

    def kept_state(self) -> dict[str, Any]:
        """Return how the twin says that it stands."""
        path = self.directory / "arm_controller.json"
        found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
        return found


def true_angle_deg(motions: list[SimMotion], now_ns: int) -> float:
    """Return the light's true angle from the twin's motion."""
    for motion in motions:
        if motion.start_ns[0] <= now_ns < motion.until_ns:
            k = max(i for i, start in enumerate(motion.start_ns) if start <= now_ns)
            t = (now_ns - motion.start_ns[k]) * 1e-9
            half = 0.5 * motion.acceleration_deg_s2[k]
            return motion.angle_deg[k] + motion.speed_deg_s[k] * t + half * t * t
    raise AssertionError(f"no motion covers {now_ns}")


@pytest.fixture
def make_arm_rig(tmp_path: Path) -> Iterator[Callable[..., ArmRig]]:
    """Return a function that makes a rig; all are closed at the end."""
    made: list[ArmRig] = []

    def make(
        effects: ArmEffects | None = None,
        *,
        arm: dict[str, Any] | None = None,
        node: dict[str, Any] | None = None,
        controller: dict[str, Any] | None = None,
        clock: RunClock | None = None,
        **fields: Any,
    ) -> ArmRig:
        directory = tmp_path / f"run{len(made)}"
        base = replace(effects or ArmEffects(), **fields)
        made.append(ArmRig(directory, base, arm or {}, node or {}, controller or {}, clock))
        return made[-1]

    yield make
    for rig in made:
        rig.close()


@pytest.fixture
def true_angle() -> Callable[[list[SimMotion], int], float]:
    """Return :func:`true_angle_deg`."""
    return true_angle_deg
