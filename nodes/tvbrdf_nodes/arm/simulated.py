"""The twin of the arm's controller: a process of its own, behind a pseudo-terminal.

The arm's node opens the pseudo-terminal as it would open a real port, so pyserial's real code
runs. The twin keeps position and lamp when that node dies, as a controller does.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
import tty
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import SimGrant, SimHorizon, SimScene

from ..core.awake_time import AwakeTime
from ..core.device import DeviceError
from ..core.node import Node, NodeContext, Outputs, Send, TopicUse
from ..world.scene import scene_from_dict
from .protocol import LineParser, Request
from .simulated_firmware import Firmware
from .simulated_parameters import ControllerParameters
from .simulated_wire import Wire

QUEUE_BYTES = 8192
"""Simulated time does not go on while more than this waits to be read."""
MAX_PAST_NS = 1_000_000_000
SERVICE_S = 0.05
DRAIN_S = 0.002
SAVE_S = 0.2


class SimulatedController(Node[ControllerParameters]):
    """A simulated controller (see docs/serial_protocol.md for what it speaks).

    Its port is linked as ``<run directory>/<name>.tty``; how it stands is in ``<name>.json``.
    """

    parameters_type = ControllerParameters

    def __init__(self, context: NodeContext, parameters: ControllerParameters) -> None:
        super().__init__(context, parameters)
        self.link: Path = context.run_directory / f"{context.name}.tty"
        self._state_file: Path = context.run_directory / f"{context.name}.json"
        self._master = self._slave = -1
        self._replug_s: float | None = None
        self._parser = LineParser()
        self._scene: SimScene | None = None
        self._wire: Wire | None = None
        self._firmware: Firmware | None = None
        self._granted_ns = 0
        self._told_ns = 0
        self._tell_again = False
        self._progress = False
        self._saved: dict[str, Any] = {}
        self._save_after_s = 0.0
        self._awake = AwakeTime()

    @classmethod
    def topics(cls, name: str, parameters: ControllerParameters) -> TopicUse:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return TopicUse(
            takes=("/sim/scene", "/sim/grant"),
            gives=("/sim/motion", "/sim/horizon", "/diagnostics", "/log"),
        )

    def start(self) -> Outputs:
        """Make the pseudo-terminal; requests are read once there is a scene and time."""
        self._plug_in()
        self.context.set_watchdog("service", SERVICE_S)
        return ()

    def handle(self, envelope: Envelope) -> Outputs:
        """Take the scene, and time to go on."""
        message = envelope.message
        if isinstance(message, SimScene):
            if self._scene is None:
                self._scene = message
        elif isinstance(message, SimGrant):
            self._granted_ns = max(self._granted_ns, message.until_ns)
            self._tell_again = True
        if self._scene is not None and self._granted_ns:
            if self._firmware is None:
                self._switch_on(self._scene)
            yield from self.poll()

    def _switch_on(self, message: SimScene) -> None:
        # a controller that is restarted late does not live through what it has missed
        now_ns = max(message.zero_ns, self._granted_ns - MAX_PAST_NS)
        try:
            scene = scene_from_dict(message.scene)
            effects = scene.arm
            wire = Wire(scene.seed, round(1e6 * effects.latency_ms), 1e6 * effects.jitter_ms)
            self._firmware = Firmware(self.parameters, effects, message.zero_ns, now_ns, wire)
        except ValueError as error:
            raise DeviceError(f"{self.context.name}: {error}") from error
        self._wire, self._told_ns = wire, now_ns

    # -- the pseudo-terminal

    def _plug_in(self) -> None:
        self._replug_s = None
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._parser = LineParser()
        beside = self.link.with_suffix(".tty.new")
        beside.unlink(missing_ok=True)
        beside.symlink_to(os.ttyname(self._slave))
        beside.replace(self.link)

    def _unplug(self) -> None:
        for number in (self._master, self._slave):
            if number >= 0:
                os.close(number)
        self._master = self._slave = -1
        self.link.unlink(missing_ok=True)

    def waitables(self) -> Sequence[Any]:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return (self._master,) if self._master >= 0 and self._firmware is not None else ()

    def pending(self) -> bool:
        """Whether a grant is unfinished and the reader keeps up."""
        return self._progress

    def _read(self, firmware: Firmware, awake_s: float) -> None:
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self._master, 4096):
                for line in self._parser.feed(data):
                    if isinstance(line.message, Request):
                        firmware.execute(line.message, awake_s)

    def _write(self, wire: Wire) -> None:
        if self._master < 0:
            self._progress = bool(wire.waiting)
            wire.waiting.clear()
            return
        with contextlib.suppress(BlockingIOError):
            while wire.waiting:
                written = os.write(self._master, wire.waiting[:4096])
                del wire.waiting[:written]
                self._progress = True

    # -- working

    def poll(self) -> Outputs:
        """Read requests, keep the watchdog, and go on as far as time is granted."""
        firmware, wire = self._firmware, self._wire
        if firmware is None or wire is None:
            return
        self._progress = False
        awake_s, now_s = self._awake.now_s(), time.monotonic()
        if self._master >= 0:
            self._read(firmware, awake_s)
        elif self._replug_s is not None and now_s >= self._replug_s:
            self._plug_in()
        firmware.check_watchdog(awake_s)  # a keepalive that waited here is in time
        wire.release_late()
        self._write(wire)
        done = firmware.advance(self._granted_ns, lambda: len(wire.waiting) <= QUEUE_BYTES)
        self._write(wire)
        if wire.unplug_for_s is not None:
            self._unplug()
            self._replug_s = time.monotonic() + wire.unplug_for_s if wire.unplug_for_s else None
            wire.unplug_for_s = None
        self._progress = self._progress and not done
        if wire.waiting:
            self.context.set_watchdog("drain", DRAIN_S)
        self._save(firmware)
        if done:
            yield from self._tell(firmware)

    def _tell(self, firmware: Firmware) -> Outputs:
        if firmware.now_ns > self._told_ns:
            motion = firmware.arm.take_motion(self._told_ns, firmware.now_ns)
            self._told_ns = firmware.now_ns
            yield Send(topic="/sim/motion", message=motion, stamp_ns=firmware.now_ns)
        if self._tell_again:
            self._tell_again = False
            horizon = SimHorizon(
                device=self.context.name, until_ns=self._told_ns, idle=not firmware.arm.moving
            )
            yield Send(topic="/sim/horizon", message=horizon, stamp_ns=self._told_ns)

    def on_timer(self, name: str) -> Outputs:
        """Look after the watchdog and full queues."""
        if name == "service":
            self.context.set_watchdog("service", SERVICE_S)
        yield from self.poll()

    # -- how it stands

    def _save(self, firmware: Firmware, *, at_once: bool = False) -> None:
        arm = firmware.arm
        state = {
            "moving": arm.moving,
            "lamp": arm.lamp,
            "homed": arm.homed,
            "fault": firmware.fault,
            "emergency_stop": firmware.emergency_stop,
            "stopped_by_watchdog": firmware.stopped_by_watchdog,
        }
        if state == self._saved or (time.monotonic() < self._save_after_s and not at_once):
            return
        self._saved = state
        self._save_after_s = time.monotonic() + SAVE_S
        figures = {"angle_deg": arm.true_angle_deg, "requests": firmware.requests}
        beside = self._state_file.with_suffix(".json.new")
        beside.write_text(json.dumps({**figures, **state}))
        beside.replace(self._state_file)

    def stop(self) -> Outputs:
        """Stop the arm, switch the lamp off, and write down how it stands."""
        if self._firmware is not None:
            self._firmware.make_safe()
            self._saved = {}
            self._save(self._firmware, at_once=True)
        self._unplug()
        return ()

    def diagnostics(self) -> dict[str, Any]:
        """Return what the line has seen."""
        firmware, wire = self._firmware, self._wire
        return {
            "requests": firmware.requests if firmware else 0,
            "unreadable_lines": self._parser.unreadable,
            "waiting_bytes": len(wire.waiting) if wire else 0,
        }
