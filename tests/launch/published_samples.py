"""Samples in the published layout for the tests of ``tvbrdf fit``, and how that is run."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from numpy.typing import ArrayLike

from tests import rig_scans
from tvbrdf_fitting import Observations
from tvbrdf_fitting.published import scan_file_name, write_parameters, write_scan_file
from tvbrdf_launch.cli import main

EXPOSURES_MS = rig_scans.EXPOSURES_MS
NAMES = ("kd_b", "kd_g", "kd_r", "sigma_d", "ks", "inverse_sigma_s")
PAINT = (0.08, 0.2, 0.45, 0.3, 0.6, 9.0)
START_NS = 1_769_851_800_000_000_000


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
    """What the rig sees every degree."""
    return rig_scans.observe(truth, seed=seed, lights=181)


grid_of = rig_scans.grid_of


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
