"""What tests of the simulated camera know of its frames."""

from __future__ import annotations

from collections.abc import Callable

from tvbrdf_nodes.camera.driver import CaptureTag, RawFrame
from tvbrdf_nodes.camera.simulated_bench import SimulatedBench

TAG = CaptureTag(sample="s", scan=1, sweep=2, attempt=1)
MakeBench = Callable[..., SimulatedBench]


def middle_ns(frame: RawFrame, delay_ms: float = 5.0) -> int:
    """Middle of the exposure of a frame that came without jitter."""
    return frame.received_ns - round(1e6 * (delay_ms + frame.exposure_ms / 2))
