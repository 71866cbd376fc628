"""``tvbrdf refit``: what it prints, and what it refuses with which words."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.launch.published_samples import edit, file_of, replaced, write_sample
from tests.launch.refit_inputs import Refit, copy_bag, inside, refit_with, results
from tests.replay.process_replay import BAG, INPUTS, RESULTS
from tests.replay.recorded_rig import read_all, write_bag
from tvbrdf_fitting.published import write_calibration
from tvbrdf_messages.bag import BagReader


@pytest.fixture(name="refit")
def refit_fixture(capsys: pytest.CaptureFixture[str]) -> Refit:
    return refit_with(capsys)


@pytest.fixture(scope="module")
def sample_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample(tmp_path_factory.mktemp("once") / "sample03", scans=2)


@pytest.fixture
def sample(sample_once: Path, tmp_path: Path) -> Path:
    """A sample with two scans, to be broken."""
    return shutil.copytree(sample_once, tmp_path / "sample03")


def without_frames(envelope: Any) -> bool:
    return not envelope.topic.endswith("/frame")


# -- what it prints and writes


def test_a_table_says_what_came_of_each_input(refit: Refit, sample: Path, tmp_path: Path) -> None:
    ended = refit(BAG, sample, "--out", tmp_path / "out")
    assert (ended.status, ended.err) == (0, "")
    heading, bag, published, rate = ended.out.splitlines()
    assert heading.split() == ["input", "scans", "refitted", "now", "not", "whole", "results"]
    assert bag.split() == ["rig.mcap", "1", "1", str(tmp_path / "out" / "rig")]
    assert published.split() == ["sample03", "2", "2", str(tmp_path / "out" / "sample03")]
    assert rate.startswith("3 scans in ")
    again = refit(BAG, sample, "--out", tmp_path / "out")
    assert [line.split()[2] for line in again.out.splitlines()[1:]] == ["0", "0"]


def test_json_has_all_of_it(refit: Refit, sample: Path, tmp_path: Path) -> None:
    found = refit(sample, "--out", tmp_path / "out", "--json").json()
    (target,) = found["targets"]
    assert target["source"] == str(sample)
    assert (target["scans"], target["refitted"], target["problems"]) == (2, 2, [])
    assert found["seconds"] > 0


def test_a_folder_of_inputs_is_refitted_one_by_one(
    refit: Refit, sample: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "all"
    folder.mkdir()
    shutil.copy(BAG, folder / "monday.mcap")
    shutil.move(sample, folder / "sample03")
    bag = copy_bag(folder / "tuesday", split_bytes=100_000)
    assert len(list(bag.iterdir())) > 1
    found = refit(folder, "--out", tmp_path / "out", "--json").json()
    names = [Path(target["folder"]).name for target in found["targets"]]
    assert names == ["monday", "sample03", "tuesday"]
    assert [target["scans"] for target in found["targets"]] == [1, 2, 1]
    monday, tuesday = (results(tmp_path / "out" / name) for name in ("monday", "tuesday"))
    assert monday[0]["values"] == tuesday[0]["values"]
    assert len(tuesday[0]["made_from"]["files"]) == len(list(bag.iterdir()))


def test_model_metric_loss_and_fixed_values_are_used_and_recorded(
    refit: Refit, sample: Path, tmp_path: Path
) -> None:
    words = ("--model", "ON+TS", "--metric", "relative", "--loss", "huber")
    ended = refit(sample, "--out", tmp_path / "out", *words, "--fixed", "sigma_d:=0.25")
    assert ended.status == 0, ended.err
    for record in results(tmp_path / "out" / "sample03"):
        assert record["settings"]["fitter"] == {
            "model": "ON+TS",
            "method": "separable",
            "metric": "relative",
            "loss": "huber",
            "fixed": {"sigma_d": 0.25},
        }
        values = dict(zip(record["parameter_names"], record["values"], strict=True))
        assert values["sigma_d"] == 0.25


def test_constants_of_the_cameras_divide_a_published_sample(
    refit: Refit, sample: Path, tmp_path: Path
) -> None:
    file = tmp_path / "twice.txt"
    write_calibration(file, [[2.0, 2.0, 2.0]] * 4)
    refit(sample, "--out", tmp_path / "once")
    refit(sample, "--out", tmp_path / "twice", "--calibration", file)
    once, twice = (results(tmp_path / name / "sample03")[0] for name in ("once", "twice"))
    # what grooves reflect to each other grows with Kd squared: some 2 % here
    assert twice["values"][:3] == pytest.approx([v / 2 for v in once["values"][:3]], rel=0.03)
    assert twice["settings"]["calibration"]["name"] == "twice.txt"


# -- results that are there already


def test_other_settings_are_refused_unless_it_is_made_again(
    refit: Refit, sample: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    refit(sample, "--out", out)
    error = refit(sample, "--out", out, "--model", "lambert").error
    assert f"{out / 'sample03'}: holds a refit that was made otherwise: " in error
    assert 'settings.fitter.model was "oren_nayar+torrance_sparrow", now "lambert"' in error
    assert "--again" in error
    assert refit(sample, "--out", out, "--model", "lambert", "--again").status == 0
    assert {record["model"] for record in results(out / "sample03")} == {"lambert"}


def test_other_files_are_refused(refit: Refit, sample: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    refit(sample, "--out", out)
    edit(file_of(sample, scan=2), lambda lines: lines[:-3])
    error = refit(sample, "--out", out).error
    assert "scan 2 was refitted from other files than" in error
    other = copy_bag(tmp_path / "rig.mcap")
    refit(BAG, "--out", out)
    error = refit(other, "--out", out).error
    assert "source.files was" in error


def test_a_folder_with_something_else_is_left_alone(
    refit: Refit, sample: Path, tmp_path: Path
) -> None:
    mine = tmp_path / "out" / "sample03"
    mine.mkdir(parents=True)
    (mine / "diary.txt").write_text("mine")
    for words in ((), ("--again",)):
        error = refit(sample, "--out", tmp_path / "out", *words).error
        assert f"{mine}: is not empty and no result of a refit (it holds 'diary.txt')" in error
    assert (mine / "diary.txt").read_text() == "mine"


# -- wrong requests


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--model", "velvet"), "unknown model 'velvet'; known models: cook_torrance"),
        (("--model", "ideal_mirror"), "is a delta function: for rendering, not for fits"),
        (("--metric", "radiant"), "unknown metric 'radiant'; did you mean 'radiance'?"),
        (("--loss", "hubert"), "unknown loss 'hubert'; did you mean 'huber'?"),
        (("--method", "magic"), "unknown method 'magic'"),
        (("--fixed", "colour:=1"), "has no parameter 'colour'"),
        (("--model", "auto", "--fixed", "ks:=1"), "--fixed needs a model"),
        (("--calibration", "nowhere.yaml"), "nowhere.yaml: the calibration can't be read: No such"),
        (("--from", "frames"), "has radiances only; leave --from frames out"),
    ],
)
def test_a_request_that_cannot_be_fulfilled_is_refused(
    refit: Refit, sample: Path, tmp_path: Path, words: tuple[str, ...], text: str
) -> None:
    assert text in refit(sample, "--out", tmp_path / "out", *words).error
    assert not (tmp_path / "out" / "sample03").exists()


def test_usage_errors_have_status_2(refit: Refit, sample: Path) -> None:
    assert refit(sample).status == 2
    assert refit(sample, "--out", "x", "--from", "thin_air").status == 2


# -- inputs that can't be used


def test_paths_that_hold_nothing_are_named(refit: Refit, tmp_path: Path, sample: Path) -> None:
    out = ("--out", tmp_path / "out")
    assert f"{tmp_path / 'no'}: there is no such file" in refit(tmp_path / "no", *out).error
    empty = tmp_path / "empty"
    empty.mkdir()
    assert f"{empty}: holds nothing to refit; give a bag" in refit(empty, *out).error
    assert "is given twice" in refit(sample, sample, *out).error
    assert "is one file of a scan; give the sample's" in refit(file_of(sample), *out).error


def test_a_bag_without_calibration_says_what_to_give(refit: Refit, tmp_path: Path) -> None:
    graph = {name: data for name, data in inside().items() if name.startswith("launch/")}
    bag = copy_bag(tmp_path / "bare.mcap", attachments=graph)
    out = tmp_path / "out"
    error = refit(bag, "--out", out).error
    assert f"{bag}: has no calibration inside; give the rig's with --calibration FILE" in error
    file = tmp_path / "calibration.yaml"
    file.write_bytes(inside()["calibration/calibration.yaml"])
    assert refit(bag, "--out", out, "--calibration", file).status == 0
    assert refit(BAG, "--out", out).status == 0
    bare, whole = (results(out / name)[0]["values"] for name in ("bare", "rig"))
    assert bare == whole


def test_a_bag_without_its_runs_graph_is_refitted_from_what_its_messages_tell(
    refit: Refit, tmp_path: Path
) -> None:
    kept = {name: data for name, data in inside().items() if name.startswith("calibration/")}
    bag = copy_bag(tmp_path / "bare.mcap", attachments=kept)
    assert refit(bag, "--out", tmp_path / "out").status == 0
    assert refit(BAG, "--out", tmp_path / "out").status == 0
    bare, whole = (results(tmp_path / "out" / name)[0] for name in ("bare", "rig"))
    assert bare["values"] == whole["values"]
    assert bare["settings"]["hdr_merger"]["bit_depth"] == 12


@pytest.mark.parametrize(
    ("left_out", "words", "text"),
    [
        (without_frames, (), "has no radiances (/scan/radiance) to refit and no frames"),
        (without_frames, ("--from", "frames"), "it has no radiances either: there is nothing"),
        (
            lambda e: True,
            ("--from", "radiance"),
            "has no radiances (/scan/radiance) to refit; leave --from radiance out",
        ),
        (
            lambda e: e.topic != "/arm/state",
            (),
            "frames can't be merged without /arm/state; record these topics too",
        ),
    ],
)
def test_a_bag_that_lacks_topics_says_which(
    refit: Refit, tmp_path: Path, left_out: Any, words: tuple[str, ...], text: str
) -> None:
    bag = copy_bag(tmp_path / "part.mcap", left_out)
    error = refit(bag, "--out", tmp_path / "out", *words).error
    assert f"{bag}: " in error
    assert text in error


def test_a_bag_with_radiances_alone_is_fitted(refit: Refit, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "radiance.mcap", read_all(RESULTS), {})
    assert refit(bag, "--out", tmp_path / "out").status == 0
    assert refit(BAG, "--out", tmp_path / "out").status == 0
    alone, merged = (results(tmp_path / "out" / name)[0] for name in ("radiance", "rig"))
    assert alone["values"] == pytest.approx(merged["values"], rel=1e-9)


def test_a_bag_that_ends_in_the_middle_of_its_scan_is_told(refit: Refit, tmp_path: Path) -> None:
    messages = [e for e in read_all(BAG) if e.topic in INPUTS]
    bag = write_bag(tmp_path / "short.mcap", messages[: len(messages) // 2], inside())
    error = refit(bag, "--out", tmp_path / "out").error
    assert f"{bag}: no scan in it is whole (scan 1: the bag does not have all of it)" in error


def test_bags_that_cannot_be_read_are_named_and_the_others_refitted(
    refit: Refit, sample: Path, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(BAG.read_bytes()[: BAG.stat().st_size // 2])
    foreign = tmp_path / "foreign.mcap"
    foreign.write_bytes(b"no bag at all" * 100)
    empty = tmp_path / "empty.mcap"
    empty.touch()
    damaged = tmp_path / "damaged.mcap"
    with BagReader(BAG) as reader:
        chunk = reader.files[0].chunks[1]
    data = bytearray(BAG.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    damaged.write_bytes(data)
    ended = refit(cut, foreign, empty, damaged, sample, "--out", tmp_path / "out")
    assert ended.status == 1
    errors = ended.err.splitlines()
    assert len(errors) == 4
    for path, error in zip((cut, foreign, empty, damaged), errors, strict=True):
        assert error.startswith(f"tvbrdf: error: {path}: "), error
    assert "recover" in errors[0]
    assert len(results(tmp_path / "out" / "sample03")) == 2


def test_a_damaged_scan_of_a_sample_is_named_and_done_once_it_is_whole(
    refit: Refit, sample: Path, tmp_path: Path
) -> None:
    file = file_of(sample, camera=2, scan=1)
    whole = file.read_text()
    edit(file, replaced(5, "F 1 2 three"))
    error = refit(sample, "--out", tmp_path / "out").error
    assert f"{file}:5: 'three' is not a number" in error
    assert [record["scan"] for record in results(tmp_path / "out" / "sample03")] == [2]
    file.write_text(whole)
    assert refit(sample, "--out", tmp_path / "out").status == 0
    assert [record["scan"] for record in results(tmp_path / "out" / "sample03")] == [1, 2]


def test_a_calibration_that_is_none_is_named(refit: Refit, tmp_path: Path) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text("tilt_deg: 12.0\n")
    error = refit(BAG, "--out", tmp_path / "out", "--calibration", file).error
    assert "wrong.yaml" in error
    assert "missing" in error


def test_a_record_that_was_edited_is_refused(refit: Refit, sample: Path, tmp_path: Path) -> None:
    refit(sample, "--out", tmp_path / "out")
    header = tmp_path / "out" / "sample03" / "refit.json"
    header.write_text("[")
    error = refit(sample, "--out", tmp_path / "out").error
    assert f"{header}: can't be read" in error
    assert refit(sample, "--out", tmp_path / "out", "--again").status == 0
    assert json.loads(header.read_text())["complete"] is True
