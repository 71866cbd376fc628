"""Messages that tests send about; of those that matter to a test it gives the fields itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from tvbrdf_messages.messages import ArmState, CameraInfo, Frame

START_NS = 1_800_000_000_000_000_000
"""2027-01-15 08:00:00 UTC."""
STATE = ArmState(angle_deg=1.0, speed_deg_s=15.0, lamp=True, moving=True, homed=True)


def camera_info(**fields: Any) -> CameraInfo:
    """Return what a camera says that it is."""
    usual: dict[str, Any] = {
        "camera": "camera_1",
        "model": "simulated",
        "serial": "1",
        "width": 64,
        "height": 48,
        "bit_depth": 12,
        "region_x": 0,
        "region_y": 0,
        "hardware_stamps": True,
        "exact_exposure": True,
        "frame_rate_hz": 30.0,
    }
    return CameraInfo(**{**usual, **fields})


def frame(image: Any, **fields: Any) -> Frame:
    """Return a frame of a sweep with that image."""
    usual: dict[str, Any] = {
        "camera": "camera_1",
        "kind": "light",
        "sample": "paint",
        "scan": 1,
        "sweep": 0,
        "attempt": 1,
        "index": 0,
        "exposure_ms": 4.0,
        "bit_depth": 12,
        "region_x": 0,
        "region_y": 0,
    }
    return Frame(image=image, **{**usual, **fields})


def noise(*seed: int, height: int = 48, width: int = 64) -> Any:
    """Return an image of 12 bits that no compression makes smaller, the same for a seed."""
    rng = np.random.default_rng(seed)
    return rng.integers(0, 4096, (height, width, 3), dtype=np.uint16)
