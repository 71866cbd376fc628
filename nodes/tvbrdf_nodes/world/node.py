"""The world of a simulated rig: it holds the scene and owns the run's clock.

The clock advances to the smallest horizon that the simulated devices report, so it never passes a
device that waits for a full queue: ``speedup`` is a cap, not a promise.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Clock, SimGrant, SimHorizon, SimScene

from ..core.node import Node, NodeContext, Outputs, Send, TopicUse
from .scene import Scene, load_scene

SCENE_FILE = "scene.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldParameters:
    """What is simulated, and how fast."""

    sample: str
    effects: str = "realistic"
    seed: int = 1
    speedup: float = 0.0
    """Cap on simulated over real time while all cameras watch; 0: as fast as the slowest."""
    idle_speedup: float = 20.0
    """Cap while nothing moves, so that people and nodes can follow."""
    moving_speedup: float = 20.0
    """Cap while the arm moves but not all cameras watch: commands are on their way."""
    step_ms: float = 250.0
    """How far simulated devices may go ahead of the slowest."""

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        if self.speedup < 0 or self.idle_speedup <= 0 or self.moving_speedup <= 0:
            raise ValueError("speedup must be 0 (no cap) or more, the others above 0")
        if not 1 <= self.step_ms <= 1000:
            raise ValueError(f"step_ms is {self.step_ms}, expected 1 to 1000")
        load_scene(self.sample, self.effects, self.seed)  # what is missing is told before the start


class WorldNode(Node[WorldParameters]):
    """Grants simulated devices time, and tells everybody what time it is."""

    parameters_type = WorldParameters

    def __init__(self, context: NodeContext, parameters: WorldParameters) -> None:
        super().__init__(context, parameters)
        self.scene: Scene = load_scene(parameters.sample, parameters.effects, parameters.seed)
        self._devices = context.graph.publishers("/sim/horizon")
        self._horizons: dict[str, SimHorizon] = {}
        self._granted_ns = 0
        self._step_ns = int(parameters.step_ms * 1e6)
        self._last_advance_s = 0.0

    @classmethod
    def topics(cls, name: str, parameters: WorldParameters) -> TopicUse:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return TopicUse(
            takes=("/sim/horizon",),
            gives=("/clock", "/sim/scene", "/sim/grant", "/diagnostics", "/log"),
        )

    def start(self) -> Outputs:
        """Tell the scene and grant the first step."""
        now_ns = self.context.clock.now_ns()
        record = {"zero_ns": now_ns, **self.scene.as_dict()}
        (self.context.run_directory / SCENE_FILE).write_text(json.dumps(record, indent=1))
        self._last_advance_s = time.monotonic()
        yield Send(topic="/sim/scene", message=SimScene(scene=self.scene.as_dict(), zero_ns=now_ns))
        yield from self._grant(now_ns)

    def handle(self, envelope: Envelope) -> Outputs:
        """Take a device's horizon; go on when the last has reached what was granted."""
        horizon = envelope.message
        if isinstance(horizon, SimHorizon) and horizon.device in self._devices:
            self._horizons[horizon.device] = horizon
            if self._all_arrived():
                yield from self._advance()

    def _all_arrived(self) -> bool:
        return len(self._horizons) == len(self._devices) and all(
            horizon.until_ns >= self._granted_ns for horizon in self._horizons.values()
        )

    def _advance(self) -> Outputs:
        """Grant the next step, at once or when the cap on speed allows it."""
        idle = [horizon.idle for horizon in self._horizons.values()]
        cap = self.parameters.speedup
        if all(idle):
            cap = _lower(cap, self.parameters.idle_speedup)
        elif any(idle):
            cap = _lower(cap, self.parameters.moving_speedup)
        wait_s = 0.0
        if cap > 0:
            step_s = self._step_ns / 1e9 / cap
            wait_s = self._last_advance_s + step_s - time.monotonic()
        if wait_s > 0:
            self.context.set_watchdog("advance", wait_s)
        else:
            yield from self._grant(self._granted_ns)

    def on_timer(self, name: str) -> Outputs:
        """Grant what the cap on speed had put off."""
        yield from self._grant(self._granted_ns)

    def _grant(self, now_ns: int) -> Outputs:
        self._last_advance_s = time.monotonic()
        self._granted_ns = now_ns + self._step_ns
        yield Send(topic="/clock", message=Clock(now_ns=now_ns, speedup=self.parameters.speedup))
        yield Send(topic="/sim/grant", message=SimGrant(until_ns=self._granted_ns))

    def on_lost(self, publisher: str) -> Outputs:
        """Wait for a device that died: its successor gets the scene and the last grant again."""
        self._horizons.pop(publisher, None)
        return ()


def _lower(cap: float, other: float) -> float:
    return min(cap, other) if cap > 0 else other
