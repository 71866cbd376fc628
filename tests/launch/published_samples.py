"""Samples in the published layout for the tests of ``tvbrdf fit``, and how that is run."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from tvbrdf_fitting import Observations
from tvbrdf_fitting.geometry import above_horizon, light_direction, view_direction
from tvbrdf_fitting.models import SURFACE, get_model
from tvbrdf_fitting.published import CameraScan, scan_file_name, write_parameters, write_scan_file
from tvbrdf_launch.cli import main

EXPOSURES_MS = (0.2, 4.0, 32.0)
NAMES = ("kd_b", "kd_g", "kd_r", "sigma_d", "ks", "inverse_sigma_s")
PAINT = (0.08, 0.2, 0.45, 0.3, 0.6, 9.0)
START_NS = 1_769_851_800_000_000_000
NOISE = 0.005


@dataclass
class Ended:
    """How a command ended."""

    status: int
    out: str
    err: str

    def json(self) -> Any:
        assert self.err == ""
        return json.loads(self.out)

    @property
    def error(self) -> str:
        """The one line of an error."""
        assert self.status == 1, self.out
        (line,) = self.err.splitlines()
        assert line.startswith("tvbrdf: error: ")
        return line


Fit = Callable[..., Ended]


def fit_with(capsys: pytest.CaptureFixture[str]) -> Fit:
    """Return what runs the verb in this process."""

    def run(*words: str | Path) -> Ended:
        capsys.readouterr()
        try:
            status = main(["fit", *map(str, words)])
        except SystemExit as ended:
            status = int(ended.code or 0)
        found = capsys.readouterr()
        return Ended(status, found.out, found.err)

    return run


def observe(truth: tuple[float, ...] = PAINT, seed: int = 1) -> Observations:
    """What the rig sees every degree, with shot noise that the variances state."""
    rng = np.random.default_rng(seed)
    world = np.linspace(-90.0, 90.0, 181)
    light = light_direction(world)
    parts = []
    for camera, angle in enumerate((0.0, 25.0, 50.0, 75.0), start=1):
        keep = above_horizon(light) & ((camera > 1) | (np.abs(world) > 1.6))
        n = int(keep.sum())
        view = np.tile(view_direction(angle), (n, 1))
        clean = np.pi * light[keep][:, 2:] * get_model(SURFACE).evaluate(light[keep], view, truth)
        deviation = NOISE * np.sqrt(0.02 + clean)
        parts.append(
            Observations(
                light_direction=light[keep],
                view_direction=view,
                radiance=clean + deviation * rng.standard_normal((n, 3)),
                variance=deviation**2,
                valid=np.ones((n, 3), dtype=bool),
                camera=np.full(n, camera),
                sweep=np.zeros(n, dtype=int),
                exposure_ms=np.full(n, 4.0),
                time_s=np.zeros(n),
            )
        )
    return Observations.concatenate(parts)


def grid_of(observations: Observations) -> dict[int, CameraScan]:
    grid = {}
    for camera in (1, 2, 3, 4):
        rows = observations.camera == camera
        grid[camera] = CameraScan(
            EXPOSURES_MS,
            observations.light_direction[rows],
            observations.view_direction[rows][0],
            observations.radiance[rows],
        )
    return grid


def truth_of(scan: int) -> tuple[float, ...]:
    """A highlight that fades from scan to scan."""
    return (*PAINT[:4], PAINT[4] * 0.7 ** (scan - 1), PAINT[5])


def write_sample(folder: Path, scans: int = 1) -> Path:
    (folder / "tvBrdf-data").mkdir(parents=True)
    for scan in range(1, scans + 1):
        for camera, one in grid_of(observe(truth_of(scan), seed=scan)).items():
            write_scan_file(folder / "tvBrdf-data" / scan_file_name(scan, camera), one)
    return folder


def file_of(sample: Path, camera: int = 1, scan: int = 1) -> Path:
    return sample / "tvBrdf-data" / scan_file_name(scan, camera)


def edit(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    lines = change(path.read_text().splitlines())
    path.write_text("".join(f"{line}\n" for line in lines))


def replaced(number: int, text: str) -> Callable[[list[str]], list[str]]:
    """Return a change of one line, counted from 1."""
    return lambda lines: [*lines[: number - 1], text, *lines[number:]]


def reversed_colours(lines: list[str]) -> list[str]:
    return [" ".join(["F", *line.split()[:0:-1]]) if line[0] == "F" else line for line in lines]


def folder_instead(sample: Path) -> None:
    file_of(sample).unlink()
    file_of(sample).mkdir()


def no_files(sample: Path) -> None:
    for camera in (1, 2, 3, 4):
        file_of(sample, camera).unlink()


def reverse_all(sample: Path) -> bool:
    for camera in (1, 2, 3, 4):
        edit(file_of(sample, camera), reversed_colours)
    return True


def write_fits(sample: Path, rows: ArrayLike) -> bool:
    (sample / "tvBrdf-fits").mkdir()
    write_parameters(sample / "tvBrdf-fits" / "brdf-params.txt", rows)
    return True
