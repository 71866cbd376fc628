"""Small nodes for tests of the launcher: they note in the run's directory what happens to them."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from typing import Any, ClassVar

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import (
    ArmState,
    Frame,
    Mark,
    OperatorRequest,
    Parameters,
    ScanCommand,
    ScanStatus,
)
from tvbrdf_nodes.core.node import Exit, Node, NodeContext, Outputs, Reply, Send, TopicUse

PERIOD_S = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeParameters:
    """What a probe does."""

    takes: tuple[str, ...] = ()
    gives: tuple[str, ...] = ()
    fail_in: str = ""
    """``init``, ``prepare``, ``start`` or ``stop``."""
    exit_after_s: float = -1.0
    exit_code: int = 0
    hang_in_stop: bool = False
    child: bool = False
    speedup: float = 1.0
    driver: str = ""
    driver_parameters: dict[str, Any] | None = None


class Probe(Node[ProbeParameters]):
    """Publishes on each topic that it gives, and notes everything down."""

    parameters_type = ProbeParameters

    def __init__(self, context: NodeContext, parameters: ProbeParameters) -> None:
        super().__init__(context, parameters)
        self.count = self.received = 0
        self.note("init")
        self.fail("init")

    @classmethod
    def topics(cls, name: str, parameters: ProbeParameters) -> TopicUse:
        return TopicUse(takes=parameters.takes, gives=(*parameters.gives, "/diagnostics", "/log"))

    def note(self, event: str) -> None:
        line = f"{self.context.name} {event} {os.getpid()} {time.monotonic_ns()}\n"
        with (self.context.run_directory / "events.txt").open("a") as file:
            file.write(line)

    def fail(self, where: str) -> None:
        if self.parameters.fail_in == where:
            raise ValueError(f"told to fail in {where}")

    def prepare(self) -> None:
        self.fail("prepare")
        if self.parameters.child:
            subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])

    def start(self) -> Outputs:
        self.fail("start")
        self.note("start")
        self.context.set_watchdog("tick", PERIOD_S)
        if self.parameters.exit_after_s >= 0:
            self.context.set_watchdog("exit", self.parameters.exit_after_s)
        return ()

    def handle(self, envelope: Envelope) -> Outputs:
        self.received += 1
        if self.received == 1:
            self.note(f"first:{envelope.header.publisher}")
        return ()

    def on_timer(self, name: str) -> Outputs:
        if name == "exit":
            self.note("exit")
            yield Exit(self.parameters.exit_code, "told to exit")
            return
        self.context.set_watchdog("tick", PERIOD_S)
        for topic in self.parameters.gives:
            yield Send(topic=topic, message=message(topic, self.count))
        self.count += 1

    def on_signal(self) -> Outputs:
        self.note("signal")
        return ()

    def stop(self) -> Outputs:
        self.note("stop")
        self.fail("stop")
        if self.parameters.hang_in_stop:
            threading.Event().wait()
        return ()


def message(topic: str, number: int) -> Any:
    """Return a message for a topic that probes may give."""
    if topic == "/operator/mark":
        return Mark(text=f"mark {number}")
    if topic == "/arm/state":
        return ArmState(
            angle_deg=0.5 * number, speed_deg_s=15.0, lamp=True, moving=True, homed=True
        )
    if topic == "/scan/status":
        return ScanStatus(
            state="sweep",
            sample="paint",
            scan=1,
            scans=2,
            sweep=1,
            sweeps=3,
            fraction=0.25,
            remaining_s=90.0,
            text="sweeping",
        )
    if topic == "/scan/parameters":
        return fitted(1)
    if topic == "/scan/command":
        return command("stop")
    raise ValueError(f"probes have no message for {topic}")


def fitted(scan: int) -> Parameters:
    """Return a fitted scan; what nobody shows is zero or empty."""
    import numpy as np

    empty: dict[str, Any] = {"int": 0, "float": 0.0, "str": "", "tuple[str, ...]": ()}
    empty["dict[str, Any]"] = {}
    told: dict[str, Any] = {
        "scan": scan,
        "scan_time_s": 60.0,
        "parameter_names": ("Kd_b", "sigma_d"),
        "values": (0.12345, 0.3),
        "standard_deviations": (0.0012, 0.02),
        "at_bound": ("sigma_d",),
        "errors": {"rms_percent": 0.512},
        "solve_time_ms": 12.0,
        "covariance": np.eye(2),
    }
    rest = {f.name: empty[f.annotation] for f in Parameters.schema() if f.name not in told}
    return Parameters(**told, **rest)


def command(action: str, **fields: Any) -> ScanCommand:
    """Return a command that is never obeyed."""
    return ScanCommand(command_id=1, incarnation="none", not_after_ns=0, action=action, **fields)


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswererParameters:
    """What a person's requests are answered with."""

    exposures_ms: tuple[float, ...] = (1.0, 10.0)
    silent: bool = False


class Answerer(Node[AnswererParameters]):
    """Answers people with what they asked; passes a still on to the cameras."""

    parameters_type = AnswererParameters
    has_service: ClassVar[bool] = True

    @classmethod
    def topics(cls, name: str, parameters: AnswererParameters) -> TopicUse:
        return TopicUse(gives=("/scan/command", "/diagnostics", "/log"))

    def on_request(self, request: OperatorRequest) -> Outputs:
        if self.parameters.silent:
            return
        if request.verb == "still":
            yield Send(
                topic="/scan/command",
                message=command("still", exposures_ms=self.parameters.exposures_ms),
            )
        ok = request.arguments.get("text") != "refuse"
        text = f"{request.verb} done" if ok else "not this one"
        yield Reply(request.request_id, ok, text, {"arguments": request.arguments})


@dataclass(frozen=True, slots=True, kw_only=True)
class StillParameters:
    """What the stills show: a ramp of linear radiance, the same in all exposures."""

    width: int = 64
    height: int = 48
    bit_depth: int = 12
    black_level_dn: float = 64.0
    dn_per_ms: float = 400.0
    """At the ramp's bright end."""


def ramp_codes(parameters: StillParameters, exposure_ms: float) -> Any:
    """Return the codes of one exposure, (height, width, 3): a ramp in x, B to R 1 : 2 : 3."""
    import numpy as np

    ramp = np.linspace(0.01, 1.0, parameters.width)[None, :, None] * np.array([1.0, 2.0, 3.0]) / 3
    light = np.broadcast_to(ramp, (parameters.height, parameters.width, 3))
    codes = np.round(parameters.black_level_dn + light * parameters.dn_per_ms * exposure_ms)
    return np.minimum(codes, (1 << parameters.bit_depth) - 1).astype(np.uint16)


class StillCamera(Node[StillParameters]):
    """Sends a still at each exposure when it is told to."""

    parameters_type = StillParameters

    @classmethod
    def topics(cls, name: str, parameters: StillParameters) -> TopicUse:
        return TopicUse(takes=("/scan/command",), gives=(f"/{name}/frame", "/diagnostics", "/log"))

    def handle(self, envelope: Envelope) -> Outputs:
        message = envelope.message
        assert isinstance(message, ScanCommand)
        for index, exposure_ms in enumerate(message.exposures_ms):
            frame = Frame(
                camera=self.context.name,
                kind="still",
                sample="",
                scan=0,
                sweep=0,
                attempt=0,
                index=index,
                exposure_ms=exposure_ms,
                bit_depth=self.parameters.bit_depth,
                region_x=0,
                region_y=0,
                image=ramp_codes(self.parameters, exposure_ms),
            )
            yield Send(topic=f"/{self.context.name}/frame", message=frame)


@dataclass(frozen=True, slots=True, kw_only=True)
class DriverParameters:
    """Of the drivers below."""

    port: str
    gain: float = 1.0


class RealDriver:
    """Declares what a driver of a real device declares."""

    parameters_type = DriverParameters
    live: ClassVar[bool] = True


class SimulatedDriver:
    """Declares what a driver of a simulated device declares."""

    parameters_type = DriverParameters
    live: ClassVar[bool] = False

    @classmethod
    def link_topics(cls, name: str, parameters: DriverParameters) -> TopicUse:
        return TopicUse(takes=("/sim/grant",), gives=("/sim/horizon",))


@dataclass(frozen=True, slots=True, kw_only=True)
class MergerParameters:
    """Where the calibration is, as the merger's."""

    calibration: str
    cameras: tuple[str, ...] = ("camera_1", "camera_2")


class Merger(Node[MergerParameters]):
    """Knows the calibration."""

    parameters_type = MergerParameters

    @classmethod
    def topics(cls, name: str, parameters: MergerParameters) -> TopicUse:
        return TopicUse(gives=("/diagnostics",))
