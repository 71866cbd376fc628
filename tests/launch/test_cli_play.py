"""``tvbrdf bag play`` and ``bag control``: what they refuse, and a bag played to its end."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.launcher_process import LauncherProcess
from tests.nodes.player.test_player_node import START_NS, STEP_NS, command, info, state, write
from tvbrdf_launch.cli import main, parser
from tvbrdf_launch.find_files import find_launch_file
from tvbrdf_launch.launch_file import load_launch_file
from tvbrdf_launch.plan import make_plan


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    at = [START_NS + k * STEP_NS for k in range(10)]
    told = [(at[0], info(0, at[0])), (at[0], command(at[0]))]
    return write(tmp_path / "run.mcap", [*told, *((t, state(k, t)) for k, t in enumerate(at))])


@pytest.fixture
def launcher() -> Iterator[LauncherProcess]:
    folder = Path(tempfile.mkdtemp(prefix="tv"))
    one = LauncherProcess(folder, folder)
    with one.cleared():
        yield one


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--topics", "/scan/command"], "/scan/command is never played: hardware moves by it"),
        (["--remap", "/replay/command:=/scan/command"], "/scan/command is never played"),
        (["--remap", "/arm/state:=/scan/command"], "/scan/command is never played"),
        (["--remap", "/arm/state"], "--remap '/arm/state' is not of the form OLD:=NEW"),
        (["--remap", "/arm/state:=/clock"], "/clock is the player's own"),
        (["--topics", "/scan/missing", "/arm/state"], "run.mcap: has nothing on /scan/missing"),
        (["--topics", "/nothing"], "no topic '/nothing'"),
        (["--start-offset", "3"], "run.mcap: start offset 3 s: the bag lasts 0.180 s"),
        (["--start-offset", "0.1", "--until", "0.05"], "until 0.05 s: nothing lies between"),
    ],
)
def test_what_is_refused(
    bag: Path, words: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bag", "play", str(bag), *words]) == 1
    assert text in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--rate", "-1"], ["--rate", "nan"], ["--until", "-3"]])
def test_numbers_that_are_none(
    bag: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["bag", "play", str(bag), *words])
    assert words[0] in capsys.readouterr().err


def test_a_bag_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bag", "play", str(tmp_path / "no.mcap")]) == 1
    assert f"{tmp_path / 'no.mcap'}: there is no such bag" in capsys.readouterr().err


def test_options_are_named_as_in_ros2_bag_play() -> None:
    words = ["--rate", "2", "--start-offset", "1", "--until", "3", "--loop", "--pause"]
    words += ["--topics", "/arm/state", "--remap", "/arm/state:=/arm/state"]
    given = parser().parse_args(["bag", "play", "x.mcap", *words])
    assert (given.rate, given.start_offset, given.until) == (2.0, 1.0, 3.0)
    assert given.loop
    assert given.pause
    short = parser().parse_args(["bag", "play", "x.mcap", "-r", "2", "-l", "-p", "-m", "/a:=/b"])
    assert (short.rate, short.loop, short.pause, short.remap) == (2.0, True, True, ["/a:=/b"])


def test_its_run_holds_the_player_alone(bag: Path, tmp_path: Path) -> None:
    file = find_launch_file("play")
    graph = make_plan(load_launch_file(file, {"bag": str(bag)}, tmp_path), tmp_path).graph
    (player,) = graph.participants
    assert set(player.gives) == {
        "/clock", "/arm/state", "/camera_1/info", "/replay/command", "/diagnostics", "/log"
    }  # fmt: skip
    assert graph.simulated


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["seek"], "tvbrdf bag control seek needs a number: seconds"),
        (["pause", "3"], "tvbrdf bag control pause takes no number"),
    ],
)
def test_control_says_what_it_needs(
    words: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bag", "control", *words]) == 1
    assert text in capsys.readouterr().err


@pytest.mark.system
def test_a_bag_is_played_to_its_end(launcher: LauncherProcess, bag: Path) -> None:
    said = launcher.tvbrdf("bag", "play", str(bag), "--plain", "--rate", "0")
    assert said.returncode == 0, said.stderr
    assert "player has finished" in said.stdout
    launcher.expect_no_process()
    asked = launcher.tvbrdf("bag", "control", "pause")
    assert asked.returncode == 1
    assert "has ended" in asked.stderr
