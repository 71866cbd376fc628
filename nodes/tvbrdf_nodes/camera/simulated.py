"""The simulated camera: takes the frames that a real one would take under the scene's light.

It lives on simulated time: the world grants it time, the arm's twin tells the light's motion, and
it answers with a horizon once every frame that had arrived by then is handed over. Every grant's
frames are planned in one go, and rendered a few at a time so that its node stays responsive.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tvbrdf_messages.messages import SimGrant, SimHorizon, SimMotion, SimScene

from ..core.device import DeviceError, DriverContext
from ..core.node import TopicUse
from ..world.scene import Scene, SceneError, scene_from_dict
from .driver import (
    TRIGGER,
    CameraIdentity,
    CameraSettings,
    CaptureTag,
    RawFrame,
    Region,
    region_on,
)
from .simulated_clock import CameraClock
from .simulated_faults import FaultPlan
from .simulated_image import REFERENCE, SAMPLE, Bands, ImageMaker, SimulatedCameraParameters
from .simulated_light import SimulatedLight
from .simulated_noise import BLOCK, FrameDraws
from .simulated_view import SimulatedView

if TYPE_CHECKING:
    from tvbrdf_messages.bus import Port

    from .driver import Image

BATCH = 4
"""Frames rendered in one call of read()."""
MIN_EXPOSURE_MS, MAX_EXPOSURE_MS = 0.01, 10_000.0
KEEP_NS = round(2e6 * MAX_EXPOSURE_MS)
"""How long the light's motion is remembered."""


class _Planned(NamedTuple):
    """A frame that is certain but not yet rendered."""

    number: int
    middle_ns: int
    exposure_ns: int
    received_ns: int
    draws: FrameDraws
    radiance: NDArray[np.float64]
    """(2, 3) of sample and reference piece, without flicker and stray light."""


@dataclass(slots=True)
class _Capture:
    """What is under way between start() and stop()."""

    tag: CaptureTag
    next_number: int = 0
    """Of the next free-running frame."""
    triggers_ns: deque[int] = field(default_factory=deque)
    index: int = 0
    busy_until_ns: int = 0
    received_ns: int = 0
    draws: dict[int, list[FrameDraws]] = field(default_factory=dict)


class SimulatedCamera:
    """A camera of the simulated rig (see :class:`.driver.CameraDriver`).

    Parameters
    ----------
    parameters
        What it is.
    context
        What every driver is given; its link carries the simulation's messages.
    """

    live: ClassVar[bool] = False
    parameters_type = SimulatedCameraParameters

    def __init__(self, parameters: SimulatedCameraParameters, context: DriverContext) -> None:
        self._parameters, self._context = parameters, context
        self._link: Port | None = None
        self._world: _World | None = None
        self._settings = self._as_possible(CameraSettings(exposure_ms=4.0, frame_rate_hz=30.0))
        self._bands = Bands(self._region(), parameters.height)
        self._capture: _Capture | None = None
        self._planned: deque[_Planned] = deque()
        self._granted_ns = self._horizon_ns = self._busy_until_ns = -1
        self._early: list[SimMotion] = []
        """Motion that was told before the scene."""
        self._stale: tuple[int, float] = (0, 0.0)
        """Frames that still get an earlier exposure, and which (ms)."""

    @classmethod
    def link_topics(cls, name: str, parameters: SimulatedCameraParameters) -> TopicUse:
        """Return what its link takes and gives."""
        return TopicUse(takes=("/sim/scene", "/sim/grant", "/sim/motion"), gives=("/sim/horizon",))

    @property
    def identity(self) -> CameraIdentity:
        """See :class:`.driver.CameraDriver`."""
        parameters = self._parameters
        return CameraIdentity(
            model="simulated",
            serial=f"simulated-{parameters.camera}",
            width=parameters.width,
            height=parameters.height,
            bit_depth=parameters.bit_depth,
            hardware_stamps=True,
            exact_exposure=True,
        )

    # -- the device

    def open(self) -> None:
        """Open the link to the simulation."""
        if self._link is None:
            self._link = self._context.open_link()

    def close(self) -> None:
        """Leave the simulation."""
        self.stop()
        if self._link is not None:
            self._link.close()
            self._link = None

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """See :class:`.driver.CameraDriver`; exposures are set to the microsecond."""
        if self._capture is not None:
            raise DeviceError(f"{self._context.name}: settings can't change during a capture")
        faults = self._world.faults if self._world is not None else None
        wanted = self._as_possible(settings)
        if faults is not None:
            wanted = replace(wanted, exposure_ms=faults.exposure_set(wanted.exposure_ms))
            if wanted.exposure_ms != self._settings.exposure_ms:
                self._stale = (faults.stale_frames, self._settings.exposure_ms)
        self._settings = wanted
        self._bands = Bands(self._region(), self._parameters.height)
        return self._settings

    def _as_possible(self, settings: CameraSettings) -> CameraSettings:
        """Return the settings that the sensor can have nearest to those wanted."""
        width, height = self._parameters.width, self._parameters.height
        region = region_on(width, height, settings.region, self._context.name)
        exposure_ms = min(max(round(settings.exposure_ms, 3), MIN_EXPOSURE_MS), MAX_EXPOSURE_MS)
        rate = min(settings.frame_rate_hz, self._parameters.frame_rate_hz, 1e3 / exposure_ms)
        return replace(settings, exposure_ms=exposure_ms, frame_rate_hz=rate, region=region)

    def _region(self) -> Region:
        region = self._settings.region
        return region or Region(0, 0, self._parameters.width, self._parameters.height)

    def start(self, tag: CaptureTag) -> None:
        """See :class:`.driver.CameraDriver`; frames begin after all that it has given or told."""
        self.stop()
        now_ns = max(self._horizon_ns, self._busy_until_ns)
        if not tag.lamp and self._link is not None:
            # the controller may be a step ahead, and the lamp off only from there
            self._take_messages()
            now_ns = max(now_ns, self._granted_ns)
        self._capture = _Capture(tag=tag, next_number=-1, busy_until_ns=now_ns)
        if self._world is not None:
            self._world.faults.begin()

    def stop(self) -> None:
        """See :class:`.driver.CameraDriver`."""
        self._capture = None
        self._planned.clear()

    def trigger(self) -> None:
        """See :class:`.driver.CameraDriver`."""
        if self._capture is None or self._settings.mode != TRIGGER:
            raise DeviceError(f"{self._context.name}: trigger without a capture in trigger mode")
        self._capture.triggers_ns.append(self._horizon_ns)

    # -- simulated time

    def waitables(self) -> Sequence[Any]:
        """Return the link's sockets."""
        sockets = getattr(self._link, "sockets", None)
        return tuple(sockets()) if sockets is not None else ()

    def pending(self) -> bool:
        """Return whether frames wait to be rendered, or a horizon to be told."""
        return bool(self._planned) or self._may_go_on()

    def _may_go_on(self) -> bool:
        if self._world is None or self._granted_ns <= self._horizon_ns:
            return False
        return self._capture is None or self._world.light.until_ns >= self._granted_ns

    def read(self) -> list[RawFrame]:
        """See :class:`.driver.CameraDriver`; at most a few frames a call."""
        self._take_messages()
        world, capture = self._world, self._capture
        if not self._planned and self._may_go_on():
            # the horizon is told only when the frames of an earlier call were handed over
            if capture is not None and world is not None:
                self._planned.extend(self._plan(world, capture))
            if not self._planned:
                self._tell_horizon()
        frames: list[RawFrame] = []
        if capture is not None and world is not None:
            for _ in range(min(BATCH, len(self._planned))):
                frame = self._render(world, capture.tag, self._planned.popleft())
                frames += world.faults.pass_on(capture.tag, frame)
        return frames

    def _take_messages(self) -> None:
        link = self._link
        if link is None:
            raise DeviceError(f"{self._context.name}: the simulated camera is not open")
        service = getattr(link, "service", None)
        if service is not None:
            service()
        for envelope in link.receive():
            message = envelope.message
            if isinstance(message, SimScene):
                self._enter(message)
            elif isinstance(message, SimGrant):
                self._granted_ns = max(self._granted_ns, message.until_ns)
            elif isinstance(message, SimMotion):
                self._early.append(message)
        if self._world is not None:
            for motion in self._early:
                self._world.light.take(motion)
            self._early.clear()
        link.events()

    def _enter(self, message: SimScene) -> None:
        """Take a scene, and begin at its zero unless time has gone further already."""
        try:
            scene = scene_from_dict(message.scene)
        except SceneError as error:
            raise DeviceError(f"{self._context.name}: {error}") from error
        self._world = _World(scene, self._parameters, message.zero_ns)
        self._horizon_ns = max(self._horizon_ns, message.zero_ns)
        if self._capture is not None:
            self._capture.busy_until_ns = max(self._capture.busy_until_ns, self._horizon_ns)

    def _tell_horizon(self) -> None:
        self._horizon_ns = self._granted_ns
        if self._world is not None:
            # exposures may have begun before, but not by more than the longest one
            self._world.light.forget(self._horizon_ns - KEEP_NS)
        if self._link is not None:
            self._link.publish(
                "/sim/horizon",
                SimHorizon(
                    device=self._link.name,
                    until_ns=self._horizon_ns,
                    idle=self._capture is None,
                ),
                stamp_ns=self._horizon_ns,
            )

    # -- frames

    def _plan(self, world: _World, capture: _Capture) -> list[_Planned]:
        """Return all frames that will have arrived by the granted time."""
        found: list[tuple[int, int, int, int, FrameDraws]] = []
        while (start_ns := self._next_start_ns(world, capture)) is not None:
            exposure_ns = round(1e6 * self._exposure_ms())
            draws = self._draws(world, capture)
            delay_ms = self._parameters.frame_delay_ms + draws.jitter * world.jitter_ms
            end_ns = start_ns + exposure_ns
            received_ns = max(end_ns + round(1e6 * delay_ms), capture.received_ns + 1)
            if received_ns > self._granted_ns:
                break
            middle_ns = start_ns + exposure_ns // 2
            found.append((capture.index, middle_ns, exposure_ns, received_ns, draws))
            self._took(capture, end_ns, received_ns)
        if not found:
            return []
        times = np.array([row[1:3] for row in found], dtype=np.int64)
        radiance = world.view.radiance(capture.tag, times[:, 0], times[:, 1])
        return [_Planned(*row, seen) for row, seen in zip(found, radiance, strict=True)]

    def _next_start_ns(self, world: _World, capture: _Capture) -> int | None:
        """Return when the next frame's exposure begins, if one is due at all."""
        if self._settings.mode == TRIGGER:
            if not capture.triggers_ns:
                return None
            return max(capture.triggers_ns[0], capture.busy_until_ns)
        period_ns = round(1e9 / self._settings.frame_rate_hz)
        if capture.next_number < 0:
            capture.next_number = world.clock.frame_after(capture.busy_until_ns, period_ns)
        return world.clock.frame_start_ns(capture.next_number, period_ns)

    def _exposure_ms(self) -> float:
        left, earlier_ms = self._stale
        return earlier_ms if left > 0 else self._settings.exposure_ms

    def _took(self, capture: _Capture, end_ns: int, received_ns: int) -> None:
        capture.index += 1
        capture.next_number += 1
        if self._settings.mode == TRIGGER:
            capture.triggers_ns.popleft()
        capture.busy_until_ns, capture.received_ns = end_ns, received_ns
        left, earlier_ms = self._stale
        self._stale = (max(left - 1, 0), earlier_ms)

    def _draws(self, world: _World, capture: _Capture) -> FrameDraws:
        block, row = divmod(capture.index, BLOCK)
        if block not in capture.draws:
            tag = capture.tag
            key = (
                tag.scan << 16 | tag.sweep,
                tag.attempt << 48 | round(1e3 * self._settings.exposure_ms) << 1 | tag.lamp,
            )
            bands = self._bands
            made = world.maker.noise.draws(key, block, bands.edges, bands.width)
            capture.draws = {block: made}
        return capture.draws[block][row]

    def _render(self, world: _World, tag: CaptureTag, frame: _Planned) -> RawFrame:
        exposure_ms = frame.exposure_ns / 1e6
        self._busy_until_ns = frame.middle_ns + frame.exposure_ns // 2
        image = self._image(world, tag, frame, exposure_ms)
        return RawFrame(
            image=image,
            exposure_ms=exposure_ms,
            hardware_ns=world.clock.tell_ns(frame.middle_ns),
            received_ns=frame.received_ns,
            frame_id=frame.number,
        )

    def _image(self, world: _World, tag: CaptureTag, frame: _Planned, exposure_ms: float) -> Image:
        effects, bands = world.scene.camera, self._bands
        flicker = 1.0 + effects.relative_noise_std * frame.draws.flicker
        ambient = world.scene.lamp.ambient_radiance
        radiance = flicker * frame.radiance[list(bands.shown)] + ambient
        signal_dn = world.maker.signal_dn(radiance, exposure_ms)
        if not world.view.textured or SAMPLE not in bands.shown:
            return world.maker.make(bands, signal_dn, frame.draws)
        rows, columns = self._places()
        seen = world.view.texture(tag, frame.middle_ns, frame.exposure_ns, rows, columns)
        signals = [world.maker.signal_dn(flicker * seen + ambient, exposure_ms)]
        if REFERENCE in bands.shown:
            signals.append(signal_dn[1].reshape(1, 1, 3))
        return world.maker.make_textured(bands, signals, frame.draws)

    def _places(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where on the tray (-1 to 1) the rows and columns of the sample's band lie."""
        region, sensor = self._region(), self._parameters
        sample_rows = Bands(Region(0, 0, sensor.width, sensor.height), sensor.height).edges[1]
        rows = region.y + 0.5 + np.arange(self._bands.edges[1])
        columns = region.x + 0.5 + np.arange(region.width)
        return 2.0 * rows / sample_rows - 1.0, 2.0 * columns / sensor.width - 1.0


class _World:
    """All that a camera makes of a scene."""

    def __init__(self, scene: Scene, parameters: SimulatedCameraParameters, zero_ns: int) -> None:
        self.scene = scene
        self.jitter_ms = scene.camera.jitter_ms
        self.light = SimulatedLight(scene.lamp, zero_ns)
        self.clock = CameraClock(scene.seed, parameters.camera, scene.camera, zero_ns)
        self.faults = FaultPlan(scene.camera.faults, parameters.camera)
        self.view = SimulatedView(scene, parameters.camera, self.light)
        self.maker = ImageMaker(parameters, scene.camera, scene.seed)
