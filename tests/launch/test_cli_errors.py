"""How verbs end with errors: one line for bad input, a traceback for a fault of the program."""

from __future__ import annotations

import argparse
import importlib
import inspect
from pathlib import Path

import numpy as np
import pytest

from tvbrdf_fitting.geometry import CAMERA_ANGLES_DEG, light_direction, view_direction
from tvbrdf_fitting.measurement.calibration import CalibrationError
from tvbrdf_fitting.problem import FitError
from tvbrdf_fitting.published import CameraScan, scan_file_name, write_scan_file
from tvbrdf_launch.cli import OUR_PACKAGES, main, samples
from tvbrdf_launch.errors import LaunchError, RunError
from tvbrdf_messages.bag.errors import BagError
from tvbrdf_messages.errors import BusError
from tvbrdf_nodes.core.parameters import ParameterError


def ending_with(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    """Let a verb end with an error."""

    def run(arguments: argparse.Namespace) -> int:
        raise error

    monkeypatch.setattr(samples, "run", run)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (FitError("5 usable values\n  are too few"), "5 usable values are too few"),
        (CalibrationError("a.yaml: no cameras"), "a.yaml: no cameras"),
        (RunError("no run"), "no run"),
        (LaunchError("unknown key"), "unknown key"),
        (BusError("port is taken"), "port is taken"),
        (BagError("a.mcap", "is empty"), "a.mcap: is empty"),
        (ParameterError("x", "x is -1"), "x is -1"),
        (FileNotFoundError(2, "No such file or directory", "a.txt"),
         "a.txt: No such file or directory"),
    ],
)  # fmt: skip
def test_errors_about_what_was_given_are_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: Exception,
    line: str,
) -> None:
    ending_with(monkeypatch, error)
    assert main(["samples"]) == 1
    assert capsys.readouterr().err == f"tvbrdf: error: {line}\n"


def test_notes_are_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    error = FitError("too few values")
    error.add_note("while fitting scan 3")
    ending_with(monkeypatch, error)
    assert main(["samples"]) == 1
    assert capsys.readouterr().err == "tvbrdf: error: too few values; while fitting scan 3\n"


@pytest.mark.parametrize("error", [ValueError("shapes (3,) (2,)"), KeyError("x"), TypeError("no")])
def test_faults_of_the_program_are_not_hidden(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    ending_with(monkeypatch, error)
    with pytest.raises(type(error)) as raised:
        main(["samples"])
    assert raised.value is error
    assert "please report it" in raised.value.__notes__[0]


def test_a_scan_that_cannot_be_fitted_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A benchmark on a scan with fewer values than parameters."""
    data = tmp_path / "sample01" / "tvBrdf-data"
    data.mkdir(parents=True)
    for camera, angle in enumerate(CAMERA_ANGLES_DEG[:1], start=1):
        grey = np.full((1, 3), 0.2)
        scan = CameraScan((4.0,), light_direction([20.0]), view_direction(angle), grey)
        write_scan_file(data / scan_file_name(1, camera), scan)
    assert main(["bench", "fit", str(tmp_path / "sample01"), "--out", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert told.startswith("tvbrdf: error: ")
    assert "usable values cannot determine" in told
    assert len(told.splitlines()) == 1


def test_our_packages_are_named() -> None:
    """Those of the project, whose errors are found by their module's name."""
    root = Path(inspect.getfile(importlib.import_module("tvbrdf_launch"))).parents[2]
    folders = {path.parent.name for path in root.glob("*/tvbrdf_*/__init__.py")}
    assert folders == set(OUR_PACKAGES)
