"""What can't work is refused before anything moves, in words that help."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from tests.system.conftest import Rig

pytestmark = pytest.mark.system


def error_line(rig: Rig) -> str:
    """Return the one line that says what is wrong."""
    (line,) = rig.text().splitlines()
    assert line.startswith("tvbrdf: error: "), line
    return line.removeprefix("tvbrdf: error: ")


def expect_nothing_started(rig: Rig) -> None:
    assert rig.processes() == []
    assert not rig.run.exists()
    assert not rig.database.exists()


def contents(rig: Rig) -> dict[Path, bytes]:
    """Return all files but the catalogue, in which opening alone counts changes."""
    files = (path for path in rig.database.rglob("*") if path.is_file())
    return {path: path.read_bytes() for path in files if "catalogue" not in path.name}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"sample": "no_such_sample"}, ("no_such_sample", "drying_paint")),
        ({"effects": "no_such_effects"}, ("no_such_effects", "realistic")),
        ({"calibration": "/no/such/file.yaml"}, ("/no/such/file.yaml",)),
        ({"exposures_ms": "[0.2,-1]"}, ("exposures_ms",)),
        ({"widht": 3}, ("widht", "width")),
        ({"width": "wide"}, ("width", "wide")),
    ],
)
def test_arguments_that_cannot_work(
    rig: Rig, arguments: dict[str, Any], said: tuple[str, ...]
) -> None:
    rig.launch(**arguments)
    assert rig.wait() == 1, rig.text()
    line = error_line(rig)
    assert [word for word in said if word not in line] == [], line
    expect_nothing_started(rig)


@pytest.mark.parametrize(
    ("text", "number", "said"),
    [
        ("nodes:\n  - name: one\n    node: wrold\n", 3, ("wrold", "world")),
        ("nodes:\n  - {name: one, node: fitter}\n", 2, ("one", "/scan/radiance", "nobody")),
        ("description: x\nnodse: []\n", 2, ("nodse", "nodes")),
        (
            "nodes:\n  - name: w\n    node: world\n    parameters:\n      sample: drying_paint\n"
            "      effects: ideal\n      seed: many\n",
            7,
            ("seed", "many"),
        ),
    ],
)
def test_launch_files_that_cannot_work(
    rig: Rig, text: str, number: int, said: tuple[str, ...]
) -> None:
    path = rig.folder / "wrong.yaml"
    path.write_text(text)
    rig.launch(file=path)
    assert rig.wait() == 1, rig.text()
    line = error_line(rig)
    assert f"wrong.yaml:{number}: " in line, line
    assert [word for word in said if word not in line] == [], line
    expect_nothing_started(rig)


def test_a_folder_of_somebody_else_is_not_written_to(rig: Rig) -> None:
    rig.database.mkdir()
    thesis = rig.database / "thesis.tex"
    thesis.write_text("precious")
    rig.launch()
    assert rig.wait() == 1, rig.text()
    assert str(rig.database) in rig.text()
    assert "Traceback" not in rig.text()
    assert [path.name for path in rig.database.iterdir()] == ["thesis.tex"]
    assert thesis.read_text() == "precious"
    rig.expect_no_process(5.0)


def test_a_database_is_not_gone_on_with_unasked(rig: Rig) -> None:
    rig.launch(scans=1)
    assert rig.wait() == 0, rig.text()
    before = contents(rig)
    rig.launch(scans=2)
    assert rig.wait() == 1, rig.text()
    assert str(rig.database) in rig.text()
    assert "resume" in rig.text()
    assert contents(rig) == before
    assert [scan.scan for scan in rig.sample().scans] == [1]
