"""Start of the whole graph to its first frame, beside the same nodes' bare imports together."""

from __future__ import annotations

import subprocess
import sys
import time
from statistics import median
from typing import Any

from benchmarks.running import run_rig

RUNS = 5
BUS = "zmq, msgpack"
IMPORTS = {
    "world": f"{BUS}, yaml",
    "arm_controller": BUS,
    "arm": f"{BUS}, serial",
    **{f"camera_{number}": f"{BUS}, numpy, cv2" for number in range(1, 5)},
    "hdr_merger": f"{BUS}, numpy, cv2, yaml",
    "fitter": f"{BUS}, numpy, scipy.optimize",
    "database_writer": f"{BUS}, numpy, sqlalchemy.orm, sqlalchemy.dialects.sqlite",
    "sequencer": BUS,
}
"""Third-party modules that each node of the simulated rig loads before its first frame."""


def imports_s() -> float:
    """Return the time in which all nodes' bare imports are done when started together."""
    started = time.monotonic()
    processes = [
        subprocess.Popen([sys.executable, "-c", f"import {modules}"])
        for modules in IMPORTS.values()
    ]
    for process in processes:
        process.wait()
    return time.monotonic() - started


def first_frame_s() -> tuple[float, float]:
    """Return the time to the first frame, from the launch command and from the first process."""
    seen = run_rig(
        watch_frames=True, scans=1, warm_up_s=0, width=32, height=32, exposures_ms="[4.0]"
    )
    return seen.first_frame_s - seen.launched_s, seen.first_frame_s - seen.graph_s


def main() -> dict[str, Any]:
    """Print and return the medians of interleaved runs."""
    bare, whole, graph = [], [], []
    for _ in range(RUNS):
        bare.append(imports_s())
        from_command, from_graph = first_frame_s()
        whole.append(from_command)
        graph.append(from_graph)
    a, b, c = median(bare), median(whole), median(graph)
    print(f"Start (median of {RUNS} interleaved runs)")
    print(f"  bare imports of the {len(IMPORTS)} nodes, together   {a:5.2f} s")
    print(f"  graph written to first frame               {c:5.2f} s   ratio {c / a:.2f}")
    print(f"  tvbrdf launch to first frame               {b:5.2f} s   ratio {b / a:.2f}")
    return {"imports_s": a, "graph_s": c, "launch_s": b}


if __name__ == "__main__":
    main()
