"""The camera node: takes the frames that the sequencer asks for, and says when they happened.

A camera's part of a sweep ends with its answer to the sweep (action ``sweep``), sent after the last
frame when ``end_sweep`` came: it says how many frames there were, under which sequence numbers, and
whether any was lost.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import CameraInfo, ScanCommand
from tvbrdf_messages.topics import frame_topic, info_topic

from ..core.commands import CommandGate, result_of
from ..core.device import DeviceError, make_driver
from ..core.node import Node, NodeContext, Outputs, Send, TopicUse
from .capture import DARK, LIGHT, SETTLING, STILL, Capture
from .driver import FREE_RUN, TRIGGER, CameraDriver, CameraSettings, RawFrame, Region
from .parameters import CameraParameters
from .reports import (
    camera_info,
    differ,
    frame_message,
    unfit_for_scans,
    wrong_exposure,
)

ARM_ACTIONS = ("home", "lamp", "jog")
FIRST_EXPOSURE_MS = 4.0
"""Until the first command."""
_SILENCE, _SETTLED = "silence", "settled"


class CameraNode(Node[CameraParameters]):
    """Serves one camera through its driver."""

    parameters_type = CameraParameters

    def __init__(self, context: NodeContext, parameters: CameraParameters) -> None:
        super().__init__(context, parameters)
        name = context.name
        self._driver: CameraDriver = make_driver(
            context, parameters.driver, parameters.driver_parameters
        )
        self._gate = CommandGate("all", "cameras", name)
        self._topic = frame_topic(name)
        self._region = None if parameters.region is None else Region(*parameters.region)
        self._settings: CameraSettings | None = None
        self._info: CameraInfo | None = None
        self._prepared_ms: float | None = None
        """Exposure that was asked for in the last ``prepare`` that was done."""
        self._capture: Capture | None = None
        self._begun = 0
        """Counts captures of the driver."""
        self._failed = ""
        self._counters = dict.fromkeys(
            ("frames", "stale", "device_dropped", "device_repeated", "device_reordered", "broken"),
            0,
        )

    @classmethod
    def topics(cls, name: str, parameters: CameraParameters) -> TopicUse:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return TopicUse(
            takes=("/scan/command", "/clock"),
            gives=(
                frame_topic(name),
                info_topic(name),
                "/scan/sweep_result",
                "/diagnostics",
                "/log",
            ),
        )

    # -- life

    def prepare(self) -> None:
        """Open the camera and set it up."""
        self._driver.open()
        self._set(FIRST_EXPOSURE_MS, FREE_RUN)

    def start(self) -> Outputs:
        """Say what the camera is."""
        yield from self._tell_info()

    def stop(self) -> Outputs:
        """Close the camera; a sweep that was under way is broken."""
        yield from self._give_up("the camera's node was stopped")
        self._driver.close()

    def waitables(self) -> Sequence[Any]:
        """Return what the driver waits for."""
        return self._driver.waitables()

    def pending(self) -> bool:
        """Return whether the driver has more at once."""
        return self._driver.pending()

    def diagnostics(self) -> dict[str, Any]:
        """Return counters."""
        return {**self._counters, "refused_commands": self._gate.refused, "device": self._failed}

    # -- commands

    def handle(self, envelope: Envelope) -> Outputs:
        """Carry out a command, or say why not."""
        command = envelope.message
        if not isinstance(command, ScanCommand) or not self._gate.concerns(command):
            return
        if command.action in ARM_ACTIONS:
            return
        actions = {
            "prepare": self._prepare,
            "sweep": self._sweep,
            "end_sweep": self._end_sweep,
            "dark": self._take,
            "still": self._take,
            "stop": self._stop,
        }
        reason = self._gate.refusal(envelope, command, self.context.clock.now_ns())
        if not reason and command.action not in actions:
            reason = f"a camera knows no action {command.action!r}; it knows {', '.join(actions)}"
        reason = reason or self._unfit(command)
        if reason:
            yield from self._refuse(command, reason)
            return
        if command.action not in ("end_sweep", "stop"):
            yield from self._give_up(f"given up for command {command.command_id}")
        try:
            yield from actions[command.action](command)
        except DeviceError as error:
            yield from self._fail(command, str(error))

    def _refuse(self, command: ScanCommand, reason: str) -> Outputs:
        self.context.log.warning(f"{command.action} refused: {reason}")
        yield self._answer(command, reason, "refused")

    def _unfit(self, command: ScanCommand) -> str:
        """Return why this camera can't take part in a scan."""
        if self.parameters.approximate_timing or command.action not in ("prepare", "sweep", "dark"):
            return ""
        return unfit_for_scans(self._driver.identity)

    def _prepare(self, command: ScanCommand) -> Outputs:
        self._prepared_ms = None
        self._reopen()
        settings = self._set(command.exposure_ms, FREE_RUN)
        yield from self._tell_info()
        wrong = wrong_exposure(self._driver.identity, command.exposure_ms, settings.exposure_ms)
        if wrong:
            yield self._answer(command, wrong, "broken")
            return
        self._prepared_ms = command.exposure_ms
        if self.parameters.drop_stale_ms <= 0:
            yield self._answer(command)
            return
        self._capture = Capture(command, SETTLING, exposure_ms=settings.exposure_ms)
        self._driver.start(self._capture.tag)
        settled_ns = int(1e6 * self.parameters.drop_stale_ms)
        self.context.set_timer(_SETTLED, self.context.clock.now_ns() + settled_ns)

    def _sweep(self, command: ScanCommand) -> Outputs:
        prepared_ms = self._prepared_ms
        if prepared_ms is None or self._settings is None:
            yield from self._refuse(command, "not prepared: send prepare first")
            return
        if command.exposure_ms and differ(command.exposure_ms, prepared_ms):
            text = f"prepared for {prepared_ms:g} ms, not for {command.exposure_ms:g} ms"
            yield from self._refuse(command, text)
            return
        self._capture = Capture(command, LIGHT, exposure_ms=self._settings.exposure_ms)
        self._begin(self._capture)

    def _end_sweep(self, command: ScanCommand) -> Outputs:
        capture = self._capture
        if capture is None or capture.kind != LIGHT:
            yield from self._refuse(command, "no sweep is under way")
            return
        theirs = (command.scan, command.sweep, command.attempt)
        ours = (capture.command.scan, capture.command.sweep, capture.command.attempt)
        if theirs != ours:
            text = f"scan, sweep, attempt {ours} is under way, not {theirs}"
            yield from self._refuse(command, text)
            return
        if capture.frames == 0:
            capture.spoil("the camera gave no frame")
        yield from self._finish()

    def _take(self, command: ScanCommand) -> Outputs:
        """Take some frames at each exposure in turn; goes on in :meth:`poll`."""
        exposures = deque(command.exposures_ms or (command.exposure_ms,))
        kind, wanted = (DARK, max(command.frames, 1)) if command.action == "dark" else (STILL, 1)
        self._prepared_ms = None
        self._reopen()
        self._capture = Capture(command, kind, exposures, wanted=wanted)
        yield from self._next_exposure(self._capture)

    def _stop(self, command: ScanCommand) -> Outputs:
        self._prepared_ms = None
        yield from self._give_up("stopped")
        yield self._answer(command)

    # -- captures

    def _next_exposure(self, capture: Capture) -> Outputs:
        self._driver.stop()
        wanted_ms = capture.exposures_ms[0]
        mode = TRIGGER if capture.kind == STILL else FREE_RUN
        settings = self._set(wanted_ms, mode)
        yield from self._tell_info()
        capture.exposure_ms = settings.exposure_ms
        capture.at_exposure = 0
        wrong = wrong_exposure(self._driver.identity, wanted_ms, settings.exposure_ms)
        if wrong:
            capture.spoil(wrong)
            yield from self._finish()
            return
        self._begin(capture)

    def _begin(self, capture: Capture) -> None:
        """Start the camera."""
        self._begun += 1
        capture.order = type(capture.order)()
        self._driver.start(capture.tag)
        capture.last_frame_ns = self.context.clock.now_ns()
        self.context.set_timer(_SILENCE, capture.last_frame_ns + self._silence_ns())
        if capture.kind == STILL:
            self._driver.trigger()

    def _silence_ns(self) -> int:
        rate_hz = self._settings.frame_rate_hz if self._settings else self.parameters.frame_rate_hz
        exposure_s = self._settings.exposure_ms / 1e3 if self._settings else 0.0
        return int(1e9 * (self.parameters.silence_s + 10.0 / rate_hz + exposure_s))

    def on_timer(self, name: str) -> Outputs:
        """Notice that the camera has gone silent, or that stale frames are past."""
        capture = self._capture
        if capture is None:
            return
        if name == _SETTLED and capture.kind == SETTLING:
            yield from self._finish()
        elif name == _SILENCE and capture.kind != SETTLING:
            due_ns = capture.last_frame_ns + self._silence_ns()
            if self.context.clock.now_ns() < due_ns:
                self.context.set_timer(_SILENCE, due_ns)
                return
            self._spoil(f"the camera gave no frame for {self._silence_ns() / 1e9:.1f} s")
            if capture.kind != LIGHT:
                yield from self._finish()

    def on_overflow(self, topic: str) -> Outputs:
        """A live camera can't wait: a frame that a reader had no room for breaks the sweep."""
        self._spoil(f"a reader of {topic} was too slow")
        return ()

    def poll(self) -> Outputs:
        """Send the frames that have come."""
        try:
            frames = self._driver.read()
        except DeviceError as error:
            if self._capture is None:
                raise
            yield from self._fail(self._capture.command, str(error))
            return
        begun = self._begun
        for frame in frames:
            if self._begun != begun:
                return  # the rest are of a capture that has ended
            yield from self._take_frame(frame)

    def _take_frame(self, frame: RawFrame) -> Outputs:
        capture = self._capture
        if capture is None or capture.kind == SETTLING:
            return
        if not self._in_order(capture, frame):
            return
        if differ(frame.exposure_ms, capture.exposure_ms):
            self._counters["stale"] += 1
            if capture.at_exposure:
                self._spoil(f"a frame had {frame.exposure_ms:g} ms, not {capture.exposure_ms:g} ms")
            elif capture.kind == STILL:
                self._driver.trigger()
            return
        yield self._frame(capture, frame)
        if capture.wanted and capture.at_exposure >= capture.wanted and self._capture is capture:
            capture.exposures_ms.popleft()
            if capture.exposures_ms:
                try:
                    yield from self._next_exposure(capture)
                except DeviceError as error:
                    yield from self._fail(capture.command, str(error))
            else:
                yield from self._finish()

    def _in_order(self, capture: Capture, frame: RawFrame) -> bool:
        before = capture.order.dropped
        trouble = capture.order.see(frame.frame_id)
        if not trouble:
            return True
        self._counters[f"device_{trouble}"] += max(capture.order.dropped - before, 1)
        self._spoil(f"the camera {trouble} frames (at number {frame.frame_id})")
        return trouble == "dropped"

    def _frame(self, capture: Capture, frame: RawFrame) -> Send:
        message = frame_message(
            self.context.name,
            capture.command,
            capture.kind,
            capture.frames,
            frame,
            self._driver.identity,
            self._settings,
        )
        # outputs are published one by one, so this is the number that the frame will carry
        capture.sent(self.context.next_sequence(self._topic), frame.received_ns)
        self._counters["frames"] += 1
        return Send(
            topic=self._topic,
            message=message,
            stamp_ns=frame.received_ns - round(5e5 * frame.exposure_ms),
            received_ns=frame.received_ns,
            hardware_ns=frame.hardware_ns,
        )

    # -- ends

    def _spoil(self, reason: str) -> None:
        if self._capture is not None and self._capture.spoil(reason):
            self.context.log.warning(f"{self._capture.command.action}: {reason}")

    def _give_up(self, reason: str) -> Outputs:
        """End what is under way as broken."""
        if self._capture is not None:
            self._spoil(reason)
            yield from self._finish()

    def _finish(self) -> Outputs:
        """Stop the camera and answer the command that it worked for."""
        capture, self._capture = self._capture, None
        for timer in (_SILENCE, _SETTLED):
            self.context.cancel(timer)
        if capture is None:
            return
        try:
            self._driver.stop()
        except DeviceError as error:
            capture.spoil(str(error))
            self._failed = str(error)
        self._counters["broken"] += bool(capture.reasons)
        yield Send(topic="/scan/sweep_result", message=capture.result(self.context.name))

    def _fail(self, command: ScanCommand, text: str) -> Outputs:
        """The device failed: whatever was under way is broken; it is opened again when needed."""
        self._failed = text
        self.context.log.error(text)
        if self._capture is None:
            self._counters["broken"] += 1
            yield self._answer(command, text, "broken")
            return
        self._spoil(text)
        if self._capture.kind != LIGHT:
            yield from self._finish()
            return
        # a sweep is answered at its end, but the device is no longer asked for frames
        try:
            self._driver.stop()
        except DeviceError as error:
            self.context.log.error(str(error))

    def _reopen(self) -> None:
        if self._failed:
            self._driver.close()
            self._driver.open()
            self._failed = ""

    # -- settings

    def _set(self, exposure_ms: float, mode: str) -> CameraSettings:
        wanted = CameraSettings(
            exposure_ms=exposure_ms,
            frame_rate_hz=self.parameters.frame_rate_hz,
            mode=mode,
            region=self._region,
        )
        self._settings = self._driver.configure(wanted)
        return self._settings

    def _tell_info(self) -> Outputs:
        """Publish what the camera is and how it is set, when that is news."""
        if self._settings is None:
            return
        info = camera_info(self.context.name, self._driver.identity, self._settings)
        if info != self._info:
            self._info = info
            yield Send(topic=info_topic(self.context.name), message=info)

    def _answer(self, command: ScanCommand, reason: str = "", state: str = "done") -> Send:
        exposure_ms = self._settings.exposure_ms if self._settings is not None else 0.0
        result = result_of(command, self.context.name, state, reason, exposure_ms=exposure_ms)
        return Send(topic="/scan/sweep_result", message=result)
