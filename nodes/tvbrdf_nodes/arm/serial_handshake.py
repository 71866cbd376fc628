"""The first exchange with a controller: who it is, still and dark, and within what it may move."""

from __future__ import annotations

import time

from ..core.device import DeviceError
from .driver import ArmIdentity, ArmLimits
from .protocol import Answer, flags_from_text
from .serial_parameters import MAX_WATCHDOG_S, SerialArmParameters
from .serial_requests import PendingRequests
from .serial_ticks import TickCounter

PROTOCOL_VERSION = 1
STATUS_S = 0.02
"""How often a braking controller is asked whether it is at rest."""


class Handshake:
    """Identifies, stops and darkens a controller, sets its limits and reads its state.

    Raises
    ------
    DeviceError
        From the handlers of its answers, if the controller can't be used.
    """

    def __init__(self, parameters: SerialArmParameters, requests: PendingRequests) -> None:
        self._parameters, self._requests = parameters, requests
        self.identity: ArmIdentity | None = None
        self.limits: ArmLimits | None = None
        self.ticks = TickCounter(32)
        self.fault = ""
        self.ready = False
        self._ask_status_s: float | None = None

    def begin(self) -> None:
        """Ask who is there."""
        self._requests.ask("IDENTIFY", handler=self._take_identity)

    def _take_identity(self, answer: Answer) -> None:
        version = answer.count("protocol")
        if version != PROTOCOL_VERSION:
            raise self._error(f"it speaks protocol {version}, expected {PROTOCOL_VERSION}")
        identity = ArmIdentity(
            model=answer.text("model"),
            serial=answer.text("serial"),
            watchdog_s=answer.number("watchdog_s"),
        )
        if self._parameters.unattended and not 0 < identity.watchdog_s <= MAX_WATCHDOG_S:
            raise self._error(
                f"controller {identity.model} {identity.serial} does not stop by itself within "
                f"{MAX_WATCHDOG_S} s after the last keepalive (watchdog {identity.watchdog_s:g} "
                "s); it is used only where somebody is present: unattended: false"
            )
        self.identity = identity
        self.ticks = TickCounter(answer.count("tick_bits"))
        self._requests.ask("STOP")
        self._requests.ask("LAMP", 0)
        self._requests.ask("REPORTS", self._parameters.idle_report_rate_hz)
        self._requests.ask("STATUS", handler=self._take_status)

    def service(self) -> None:
        """Ask again whether the arm is at rest."""
        if self._ask_status_s is not None and time.monotonic() >= self._ask_status_s:
            self._ask_status_s = None
            self._requests.ask("STATUS", handler=self._take_status)

    def _take_status(self, answer: Answer) -> None:
        commanded = self._requests.waiting("STOP") or self._requests.waiting("LAMP")
        flags = flags_from_text(answer.text("flags"))
        if commanded or flags.moving or flags.lamp:
            self._ask_status_s = time.monotonic() + STATUS_S
            return
        fault = answer.text("fault")
        self.fault = "" if fault == "-" else fault
        p = self._parameters
        self._requests.ask(
            "LIMITS",
            p.min_angle_deg,
            p.max_angle_deg,
            p.max_speed_deg_s,
            p.max_acceleration_deg_s2,
            handler=self._take_limits,
        )

    def _take_limits(self, answer: Answer) -> None:
        p = self._parameters
        self.limits = ArmLimits(
            min_angle_deg=max(answer.number("min"), p.min_angle_deg),
            max_angle_deg=min(answer.number("max"), p.max_angle_deg),
            max_speed_deg_s=min(answer.number("speed"), p.max_speed_deg_s),
            acceleration_deg_s2=answer.number("acceleration"),
            settle_deg=answer.number("settle"),
        )
        if not 0 < self.limits.acceleration_deg_s2 <= p.max_acceleration_deg_s2:
            raise self._error(
                f"it accelerates with {self.limits.acceleration_deg_s2:g}°/s², more than "
                f"max_acceleration_deg_s2 ({p.max_acceleration_deg_s2:g}), and can't be told to "
                "take less"
            )
        self.ready = True

    def _error(self, text: str) -> DeviceError:
        return DeviceError(f"{self._parameters.port}: {text}")
