"""A rig for the sequencer to command; arm, cameras, merger, fitter and database are played."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.nodes.stage import MakeStage, Player, Stage
from tests.paths import CALIBRATION_FILE
from tvbrdf_messages.messages import (
    DatabaseState,
    Mark,
    ScanCommand,
    ScanMissing,
    ScanStatus,
    Stored,
    SweepResult,
)
from tvbrdf_nodes.core.node import Exit

CAMERAS = ("camera_1", "camera_2")
EXPOSURES_MS = (0.2, 4.0, 32.0)
SWEEP_S = 0.5
"""Also part of the real time within which an answer must come."""
SAMPLE = "paint"
SILENT = "silent"
LAMP_SETTLE_S = 2.0

_ARM_ACTIONS = ("home", "lamp", "prepare", "sweep", "jog", "stop")
_CAMERA_ACTIONS = ("prepare", "dark", "still", "stop")
FaultKey = tuple[str, str, int, int, int]
"""Device, action, scan, sweep, attempt."""


class Rig:
    """Plays everybody but the sequencer, and keeps every command.

    Devices answer at once; ``faults`` says which answers are other than done: a reason, or
    ``SILENT`` for none at all.
    """

    def __init__(self, make_stage: MakeStage, **parameters: Any) -> None:
        given: dict[str, Any] = {
            "sample": SAMPLE,
            "scans": 2,
            "interval_s": 60.0,
            "exposures_ms": EXPOSURES_MS,
            "cameras": CAMERAS,
            "sweep_s": SWEEP_S,
            "warm_up_s": 10.0,
            "lamp_settle_s": LAMP_SETTLE_S,
            "answer_limit_s": 30.0,
        } | parameters
        merging = {"calibration": str(CALIBRATION_FILE), "cameras": CAMERAS}
        driver = "tvbrdf_nodes.camera.simulated:SimulatedCamera"
        self.stage: Stage = make_stage(
            ("arm", "arm"),
            *((camera, "camera", {"driver": driver}) for camera in CAMERAS),
            ("hdr_merger", "hdr_merger", merging),
            ("fitter", "fitter"),
            ("database_writer", "database_writer", {"path": "none", "sample": SAMPLE}),
            ("sequencer", "sequencer", given, True),
        )
        self.exposures_ms: tuple[float, ...] = given["exposures_ms"]
        self.faults: dict[FaultKey, str] = {}
        self.on_command: Callable[[ScanCommand], None] = lambda command: None
        """Called before a command is answered."""
        self.commands: list[ScanCommand] = []
        self.measured_scans: list[int] = []
        self.missing: list[ScanMissing] = []
        self.marks: list[Mark] = []
        self.stores = True
        """Whether the database confirms what it gets."""
        self.sweep_ids: dict[tuple[int, int, int], int] = {}
        self.stage.begin()

    # -- beginning and end

    def __getitem__(self, name: str) -> Player:
        return self.stage.players[name]

    @property
    def exit(self) -> Exit | None:
        return self.stage.graph.runners["sequencer"].exit

    @property
    def status(self) -> ScanStatus:
        status = self.stage.said("/scan/status")[-1].message
        assert isinstance(status, ScanStatus)
        return status

    def all_running(self) -> None:
        for player in self.stage.players.values():
            player.state()

    def database(self, **fields: Any) -> None:
        """The writer tells what the database holds; empty by default."""
        empty: dict[str, Any] = {"sample": SAMPLE, "scans": (), "fitted": (), "missing": ()}
        self["database_writer"].say("/scan/database", DatabaseState(**(empty | fields)))

    def ready(self, **fields: Any) -> None:
        """All nodes run, and the database is open."""
        self.all_running()
        self.database(**fields)
        self.play()

    # -- playing

    def play(self) -> None:
        """Answer until nobody has anything to say at this moment."""
        while True:
            commands = self["arm"].take(ScanCommand)
            for command in commands:
                self.commands.append(command)
                self.on_command(command)
                self.answer(command)
            if not self.store() and not commands:
                return

    def play_until(self, done: Callable[[], object], limit: int = 1000) -> None:
        """Play, with time going from one of the sequencer's timers to the next."""
        runner = self.stage.graph.runners["sequencer"]
        for _ in range(limit):
            self.play()
            if done() or self.exit is not None:
                return
            timer_ns = runner.next_timer_ns()
            assert timer_ns is not None, f"nothing will happen: {self.status}"
            self.stage.advance(max(0.0, (timer_ns - self.stage.now_ns) / 1e9))
        pytest.fail(f"not done after {limit} timers: {self.status}")

    def play_to_end(self) -> Exit:
        self.play_until(lambda: self.exit is not None)
        assert self.exit is not None
        return self.exit

    def answer(self, command: ScanCommand) -> None:
        """All whom it concerns carry out a command."""
        key = (command.scan, command.sweep, command.attempt)
        concerns_arm = command.target in ("all", "arm")
        if concerns_arm and command.action in _ARM_ACTIONS:
            if command.action == "sweep":
                self.sweep_ids[key] = command.command_id
                self.stage.advance(command.duration_s)
            self.say("arm", command, command.action)
        for camera in CAMERAS:
            if command.target in ("all", "cameras") and command.action in _CAMERA_ACTIONS:
                self.say(camera, command, command.action)
        if command.action == "end_sweep":
            for camera in CAMERAS:
                self.say(camera, command, "sweep", self.sweep_ids[key])
            if self.is_good(*key):
                self.say("hdr_merger", command, "sweep", 0)
                if key[1] == len(self.exposures_ms) - 1:
                    self.measured(command.scan)
            elif ("hdr_merger", "sweep", *key) in self.faults:
                self.say("hdr_merger", command, "sweep", 0)

    def is_good(self, scan: int, sweep: int, attempt: int) -> bool:
        """Return whether the merger gets all of a sweep, and finds it good."""
        devices = ("arm", *CAMERAS, "hdr_merger")
        faults = [self.faults.get((d, "sweep", scan, sweep, attempt)) for d in devices]
        return not any(faults) and all(map(self.is_alive, devices))

    def is_alive(self, name: str) -> bool:
        return self[name].port is self.stage.graph.bus.ports.get(name)

    def say(self, source: str, command: ScanCommand, action: str, command_id: int = -1) -> None:
        """Send what came of a command, unless this device is dead or silent."""
        fault = self.faults.get((source, action, command.scan, command.sweep, command.attempt), "")
        if fault == SILENT or not self.is_alive(source):
            return
        self[source].say(
            "/scan/sweep_result",
            SweepResult(
                source=source,
                command_id=command.command_id if command_id < 0 else command_id,
                action=action,
                state="broken" if fault else "done",
                reason=fault,
                sample=command.sample,
                scan=command.scan,
                sweep=command.sweep,
                attempt=command.attempt,
            ),
        )

    def measured(self, scan: int) -> None:
        """The database stores what merger and fitter have sent of a scan."""
        self.measured_scans.append(scan)
        if self.stores:
            for what in ("radiance", "parameters"):
                self.stored(scan, what)

    def stored(self, scan: int, what: str, **fields: Any) -> None:
        message = Stored(sample=SAMPLE, scan=scan, what=what, **fields)
        self["database_writer"].say("/scan/stored", message)

    def store(self) -> bool:
        """The database stores missing scans and notes; say whether there were any."""
        writer = self["database_writer"]
        missing, marks = writer.take(ScanMissing), writer.take(Mark)
        first = len(self.marks)
        self.missing += missing
        self.marks += marks
        if self.stores:
            for message in missing:
                self.stored(message.scan, "missing")
            for number in range(first, len(self.marks)):
                self.stored(number, "mark")
        return bool(missing or marks)

    # -- what was commanded

    def actions(self) -> list[str]:
        return [command.action for command in self.commands]

    def sweeps(self) -> list[tuple[int, int, int]]:
        """Scan, sweep and attempt of every sweep that was begun."""
        return [(c.scan, c.sweep, c.attempt) for c in self.commands if c.action == "sweep"]


MakeRig = Callable[..., Rig]
