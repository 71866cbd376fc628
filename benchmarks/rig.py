"""The whole simulated rig: frames a second, latency from last frame to parameters, memory."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.running import Seen, run_rig

REAL_RIG_FRAMES_S = 120.0
"""Four cameras at 30 frames a second."""


def throughput(width: int, height: int, scans: int) -> dict[str, float]:
    """Print and return the frames a second that go through the whole graph."""
    seen = run_rig(scans=scans, width=width, height=height, warm_up_s=5)
    sweeps = seen.sweeps()
    frames = sum(count for _, _, count in sweeps)
    busy_s = sum(end - begin for begin, end, _ in sweeps)
    per_s = frames / busy_s
    lost = sum(seen.counters("gaps").values())
    megabytes = per_s * width * height * 6 / 1e6
    print(
        f"  {width}×{height}: {frames} frames in {len(sweeps)} sweeps, {per_s:6.0f} frames/s "
        f"({per_s / REAL_RIG_FRAMES_S:.1f} × the real rig), {megabytes:.0f} MB/s, {lost} lost"
    )
    return {"frames_per_s": per_s, "lost": float(lost)}


def endurance(scans: int = 20) -> dict[str, Any]:
    """Print and return latency and memory over many scans."""
    seen = run_rig(scans=scans, warm_up_s=5)
    latencies = np.array(seen.latencies_ms(last_sweep=2))
    p50, p99 = np.percentile(latencies, [50, 99])
    print(
        f"  last frame to parameters on the bus, {latencies.size} scans: p50 {p50:.0f} ms, "
        f"p99 {p99:.0f} ms (target 250)"
    )
    growth = _growth_mb(seen)
    for node, (early, late) in sorted(growth.items()):
        print(f"  memory of {node:16} {early:6.1f} MB after scan 3, {late:6.1f} MB after {scans}")
    return {"latency_p99_ms": float(p99), "growth_mb": growth}


def _growth_mb(seen: Seen) -> dict[str, tuple[float, float]]:
    """Return each node's resident memory after the third scan and at the end."""
    third_s = sorted(t for t, p in seen.parameters)[2]
    found: dict[str, tuple[float, float]] = {}
    for at_s, told in seen.diagnostics:
        if told.state == "running" and at_s > third_s:
            early = found.get(told.node, (told.resident_mb, 0.0))[0]
            found[told.node] = (early, told.resident_mb)
    return found


def main() -> dict[str, Any]:
    """Print and return all figures."""
    print("Whole simulated rig, four cameras, 3 exposures × 361 positions (frames within sweeps)")
    small = throughput(128, 128, scans=2)
    large = throughput(640, 480, scans=1)
    return {"128": small, "640": large, **endurance()}


if __name__ == "__main__":
    main()
