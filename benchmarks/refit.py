"""How fast are refits? From radiances in the published layout, and from a bag's frames.

The database has as many scans as the published one: 41 samples, 1123 scans, 4 cameras with a light
every half degree; it is written with the project's own writer from random simulated materials. The
bag has frames of 128 x 128 pixels from the simulated rig: three sweeps of 12 s a scan.

The whole command is timed, with what it loads; the rate is that of the work after loading.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fit_timing import ONE_THREAD, take_turns
from tests.replay.recorded_rig import SWEEP_S, record_rig
from tvbrdf_fitting.fit import fit_scan
from tvbrdf_fitting.observations import Observations
from tvbrdf_fitting.published import CameraScan, read_scan, scan_file_name
from tvbrdf_fitting.published.scan import DATA_FOLDER
from tvbrdf_fitting.published.scan_file import format_scan_file
from tvbrdf_launch.cli.bench.rig_scenes import measure, random_material

SAMPLES, SCANS = 41, 1123
EXPOSURES_MS = (0.2, 4.0, 32.0)
NOISE = 0.005
BAG_SCANS, PIXELS, FIT_ROUNDS = 2, 128, 25
TARGET_RATE, TARGET_TIMES = 500.0, 20.0


def write_database(folder: Path, samples: int = SAMPLES, scans: int = SCANS) -> int:
    """Write a database in the published layout; return its size in bytes."""
    rng = np.random.default_rng(41)
    per_sample = Counter(number % samples + 1 for number in range(scans))
    size = 0
    for sample in range(1, samples + 1):
        data = folder / f"sample{sample:02d}" / DATA_FOLDER
        data.mkdir(parents=True)
        truth = random_material(rng)
        for scan in range(1, per_sample[sample] + 1):
            seen = measure(rng, truth, noise=NOISE, arm=False)
            for camera, one in _cameras(seen).items():
                text = format_scan_file(one)
                (data / scan_file_name(scan, camera)).write_bytes(text)
                size += len(text)
    return size


def _cameras(seen: Observations) -> dict[int, CameraScan]:
    found = {}
    for camera in np.unique(seen.camera).tolist():
        rows = seen.camera == camera
        found[camera] = CameraScan(
            EXPOSURES_MS,
            seen.light_direction[rows],
            seen.view_direction[rows][0],
            seen.radiance[rows],
        )
    return found


def refit(path: Path, out: Path, jobs: int) -> dict[str, Any]:
    """Run the command; return its own figures and the time of the whole."""
    command = [sys.executable, "-m", "tvbrdf_launch", "refit", str(path), "--out", str(out)]
    began = time.monotonic()
    ended = subprocess.run(
        [*command, "--jobs", str(jobs), "--json"], check=False, capture_output=True, text=True
    )
    if ended.returncode != 0:
        raise RuntimeError(ended.stderr[-2000:])
    found: dict[str, Any] = json.loads(ended.stdout)
    return {
        "whole_s": time.monotonic() - began,
        "seconds": found["seconds"],
        "scans": sum(target["refitted"] for target in found["targets"]),
    }


def from_radiance(folder: Path, samples: int, scans: int, jobs: int) -> dict[str, float]:
    """Return figures of a refit of a published database."""
    size = write_database(folder / "database", samples, scans)
    found = refit(folder / "database", folder / "out_radiance", jobs)
    seen = read_scan(folder / "database" / "sample01", 1).observations()
    times = take_turns({"fit": lambda: fit_scan(seen)}, FIT_ROUNDS)
    return {
        "fit_scan_ms": 1e3 * times.least("fit"),
        "scans": found["scans"],
        "size_mb": size / 1e6,
        "whole_s": found["whole_s"],
        "scans_per_s": found["scans"] / found["seconds"],
        "ms_per_scan_and_core": 1e3 * jobs * found["seconds"] / found["scans"],
    }


def from_frames(folder: Path, scans: int, pixels: int, jobs: int) -> dict[str, float]:
    """Return figures of a refit of a bag's frames."""
    bag = record_rig(folder / "rig", scans=scans, pixels=pixels)
    found = refit(bag, folder / "out_frames", jobs)
    real_s = len(EXPOSURES_MS) * SWEEP_S
    return {
        "scans": found["scans"],
        "size_mb": bag.stat().st_size / 1e6,
        "whole_s": found["whole_s"],
        "s_per_scan": found["seconds"] / found["scans"],
        "times_real": real_s * found["scans"] / found["seconds"],
    }


def main(
    samples: int = SAMPLES,
    scans: int = SCANS,
    bag_scans: int = BAG_SCANS,
    pixels: int = PIXELS,
    jobs: int = 2,
) -> dict[str, dict[str, float]]:
    """Print every figure with its target beside; return them."""
    os.environ.update(ONE_THREAD)
    with tempfile.TemporaryDirectory(prefix="tvb") as directory:
        radiance = from_radiance(Path(directory), samples, scans, jobs)
        print(
            f"refit from radiances: {radiance['scans']:.0f} scans in the published layout "
            f"({radiance['size_mb']:.0f} MB), {jobs} processes\n"
            f"  {radiance['scans_per_s']:.0f} scans/s (target: above {TARGET_RATE:.0f}), "
            f"{radiance['ms_per_scan_and_core']:.2f} ms a scan and core\n"
            f"  fit_scan alone, in the same run: {radiance['fit_scan_ms']:.2f} ms\n"
            f"  the whole command: {radiance['whole_s']:.1f} s"
        )
        frames = from_frames(Path(directory), bag_scans, pixels, jobs)
        print(
            f"refit from frames: {frames['scans']:.0f} scans of {pixels} x {pixels} pixels "
            f"({frames['size_mb']:.0f} MB), {jobs} processes\n"
            f"  {frames['times_real']:.1f} x the real rig's time (target: at least "
            f"{TARGET_TIMES:.0f}), {frames['s_per_scan']:.2f} s a scan\n"
            f"  the whole command: {frames['whole_s']:.1f} s"
        )
    return {"radiance": radiance, "frames": frames}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=2)
    main(jobs=parser.parse_args().jobs)
