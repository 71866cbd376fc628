"""What a camera node says: what its camera is, what it saw, and why it won't do."""

from __future__ import annotations

from tvbrdf_messages.messages import CameraInfo, Frame, ScanCommand

from .driver import CameraIdentity, CameraSettings, RawFrame, Region

EXPOSURE_TOLERANCE = 0.01
"""Relative difference of an exposure as read back from the one that was asked for."""


def camera_info(name: str, identity: CameraIdentity, settings: CameraSettings) -> CameraInfo:
    """Return what a camera is and how it is set."""
    region = settings.region or Region(0, 0, identity.width, identity.height)
    return CameraInfo(
        camera=name,
        model=identity.model,
        serial=identity.serial,
        width=region.width,
        height=region.height,
        bit_depth=identity.bit_depth,
        region_x=region.x,
        region_y=region.y,
        hardware_stamps=identity.hardware_stamps,
        exact_exposure=identity.exact_exposure,
        frame_rate_hz=settings.frame_rate_hz,
    )


def frame_message(
    name: str,
    command: ScanCommand,
    kind: str,
    index: int,
    frame: RawFrame,
    identity: CameraIdentity,
    settings: CameraSettings | None,
) -> Frame:
    """Return the message that carries a frame, taken for ``command`` as its ``index``-th."""
    region = settings.region if settings is not None else None
    return Frame(
        camera=name,
        kind=kind,
        sample=command.sample,
        scan=command.scan,
        sweep=command.sweep,
        attempt=command.attempt,
        index=index,
        exposure_ms=frame.exposure_ms,
        bit_depth=identity.bit_depth,
        region_x=region.x if region is not None else 0,
        region_y=region.y if region is not None else 0,
        image=frame.image,
    )


def differ(exposure_ms: float, other_ms: float) -> bool:
    """Return whether two exposures are not the same."""
    return abs(exposure_ms - other_ms) > EXPOSURE_TOLERANCE * other_ms


def wrong_exposure(identity: CameraIdentity, wanted_ms: float, read_back_ms: float) -> str:
    """Return what is wrong with an exposure that was read back; empty if nothing is."""
    if not identity.exact_exposure or not differ(read_back_ms, wanted_ms):
        return ""
    return f"exposure is {read_back_ms:g} ms as read back, not {wanted_ms:g} ms"


def unfit_for_scans(identity: CameraIdentity) -> str:
    """Return why a camera can't take part in a scan; empty if it can."""
    lacks = []
    if not identity.exact_exposure:
        lacks.append("can't set its exposure exactly")
    if not identity.hardware_stamps:
        lacks.append("gives no hardware stamps")
    if not lacks:
        return ""
    text = f"{identity.model} {' and '.join(lacks)}"
    return f"{text}; to scan all the same set approximate_timing: true"
