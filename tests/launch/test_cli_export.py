"""``tvbrdf bag export``: what it prints, and what it refuses with which words."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.launch.export_inputs import whole_bag
from tests.launch.refit_inputs import copy_bag, inside
from tests.replay.process_replay import BAG, RESULTS
from tvbrdf_launch.cli import main


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return whole_bag(tmp_path_factory.mktemp("bag") / "whole.mcap")


class Shell:
    """Runs the verb in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def good(self, *words: object) -> str:
        assert main(["bag", "export", *map(str, words)]) == 0
        out, err = self._capsys.readouterr()
        assert err == ""
        return out

    def bad(self, *words: object) -> str:
        assert main(["bag", "export", *map(str, words)]) == 1
        out, err = self._capsys.readouterr()
        assert out == ""
        assert len(err.splitlines()) == 1
        assert err.startswith("tvbrdf: error: ")
        return err


@pytest.fixture
def shell(capsys: pytest.CaptureFixture[str]) -> Shell:
    return Shell(capsys)


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_everything_at_once(bag: Path, tmp_path: Path, shell: Shell) -> None:
    out = tmp_path / "new" / "out"
    lines = shell.good(bag, "-o", out).splitlines()
    assert lines[0] == f"{out}/text: missing: 1, parameters: 1, scans: 1"
    assert lines[1].startswith(f"{out}/exr: images: ")
    assert lines[-1].startswith(f"{out}/foxglove.mcap: /arm/state: ")
    assert all(line.startswith("  left out: scan 1, camera_") for line in lines[2:-1])
    assert names(out) == ["export.json", "exr", "foxglove.mcap", "text"]
    assert names(out.parent) == ["out"]
    record = json.loads((out / "export.json").read_text())
    assert (record["bag"], record["run"]) == ("whole.mcap", "simulated")
    assert record["calibration"]["name"] == "calibration.yaml"


def test_json(bag: Path, tmp_path: Path, shell: Shell) -> None:
    out = tmp_path / "out"
    found: Any = json.loads(shell.good(bag, "-o", out, "--format", "text", "--json"))
    assert found == {
        "out": str(out),
        "written": [
            {
                "format": "text",
                "path": "text",
                "counts": {"missing": 1, "parameters": 1, "scans": 1},
                "remarks": [],
            }
        ],
        "left_out": {},
        "removed": [],
    }
    assert names(out) == ["export.json", "text"]


STOPS = """
import sys
from pathlib import Path
from tvbrdf_launch.export import export_bag

def tell(fraction, what):
    if fraction > 0:
        print("busy", flush=True)
        sys.stdin.read()

export_bag(Path(sys.argv[1]), Path(sys.argv[2]), tell=tell)
"""


def test_what_one_that_was_killed_had_left_is_removed(
    bag: Path, tmp_path: Path, shell: Shell
) -> None:
    out = tmp_path / "out"
    pipe, command = subprocess.PIPE, [sys.executable, "-c", STOPS, str(bag), str(out)]
    with subprocess.Popen(command, stdin=pipe, stdout=pipe) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"busy\n"
        (left,) = tmp_path.iterdir()
        process.kill()
        assert process.wait() == -signal.SIGKILL
    assert left.is_dir()
    first, *_ = shell.good(bag, "-o", out, "-f", "text").splitlines()
    assert first == f"removed {left}: what a run that was killed had left of the same output"
    assert names(tmp_path) == ["out"]


def test_what_a_bag_has_no_messages_for_is_told(tmp_path: Path, shell: Shell) -> None:
    text = shell.good(RESULTS, "-o", tmp_path / "out")
    assert "no exr: the bag has no frames (/camera_N/frame)" in text.splitlines()[-1]
    assert "  left out: the rig's geometry: the bag has no calibration" in text


def test_asked_for_by_name_it_is_an_error(bag: Path, tmp_path: Path, shell: Shell) -> None:
    out = tmp_path / "out"
    assert "has no frames (/camera_N/frame)" in shell.bad(RESULTS, "-o", out, "-f", "text", "exr")
    assert "has no radiances (/scan/radiance)" in shell.bad(BAG, "-o", out, "-f", "text")
    only = copy_bag(tmp_path / "a.mcap", lambda e: e.topic != "/arm/state")
    error = shell.bad(only, "-o", out, "-f", "exr")
    assert "does not tell where the light was: /arm/state is missing" in error
    assert names(tmp_path) == ["a.mcap"]


def test_calibration_from_a_file(tmp_path: Path, shell: Shell) -> None:
    bare = copy_bag(tmp_path / "a.mcap", attachments={})
    out = tmp_path / "out"
    assert "no calibration inside; give the rig's with --calibration FILE" in shell.bad(
        bare, "-o", out, "-f", "exr"
    )
    file = tmp_path / "mine.yaml"
    assert "the calibration can't be read" in shell.bad(bare, "-o", out, "--calibration", file)
    file.write_text("tilt_deg: much\n")
    error = shell.bad(bare, "-o", out, "-f", "exr", "--calibration", file)
    assert "mine.yaml" in error
    assert "give another with --calibration FILE" in error
    assert not out.exists()
    file.write_bytes(inside()["calibration/calibration.yaml"])
    text = shell.good(bare, "-o", out, "-f", "foxglove", "exr", "--calibration", file)
    assert "/tf_static: 1" in text
    assert "geometry" not in text
    assert json.loads((out / "export.json").read_text())["calibration"]["name"] == "mine.yaml"


def test_bad_bags_and_places(bag: Path, tmp_path: Path, shell: Shell) -> None:
    out = tmp_path / "out"
    assert "there is no such bag" in shell.bad(tmp_path / "none.mcap", "-o", out)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(bag.read_bytes()[:100_000])
    assert f"run 'tvbrdf bag recover {cut}'" in shell.bad(cut, "-o", out)
    damaged = tmp_path / "damaged.mcap"
    content = bytearray(bag.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    assert "checksum" in shell.bad(damaged, "-o", out)
    assert not out.exists()
    out.mkdir()
    assert f"{out}: exists already" in shell.bad(bag, "-o", out)
    shutil.rmtree(out)
    (tmp_path / "file").touch()
    error = shell.bad(bag, "-o", tmp_path / "file" / "out")
    assert "file/out: can't be written: File exists; give another place with --out" in error
    assert names(tmp_path) == ["cut.mcap", "damaged.mcap", "file"]


def test_unknown_formats_are_usage(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["bag", "export", str(bag), "-o", str(tmp_path / "out"), "-f", "png"])


def test_each_exposure_and_whole_frames(bag: Path, tmp_path: Path, shell: Shell) -> None:
    out = tmp_path / "out"
    shell.good(bag, "-o", out, "-f", "exr", "--each-exposure", "--whole-frames")
    folder = out / "exr" / "scan01" / "camera_1"
    assert {name.split("_")[0] for name in names(folder)} == {"exposure1", "exposure2"}
    record = json.loads((out / "export.json").read_text())
    assert (record["each_exposure"], record["whole_frames"]) == (True, True)


def test_a_bag_in_parts_gives_the_same(tmp_path: Path, shell: Shell) -> None:
    parts = copy_bag(tmp_path / "parts", split_bytes=100_000)
    assert len([*parts.iterdir()]) > 1
    for source, name in ((BAG, "one"), (parts, "two")):
        shell.good(source, "-o", tmp_path / name, "-f", "exr")
    one, two = ((tmp_path / name / "exr" / "index.csv").read_bytes() for name in ("one", "two"))
    assert one == two
