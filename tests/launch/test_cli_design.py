"""``tvbrdf design``: from words to designs, as text and as JSON, and its errors."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tvbrdf_fitting import fit_scan, get_model
from tvbrdf_fitting.choice.choose import choose_model
from tvbrdf_fitting.design.fisher_information import Rig
from tvbrdf_launch.cli import main

SATIN = [0.3, 0.5, 0.7, 0.4, 0.8, 6.0]
CHEAP = ("--noise", "pixels=40", "--noise", "frame_relative_std=2%")
"""A camera and a lamp that make lights needed."""


def run(*words: str) -> int:
    return main(["design", *words])


def read(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert run(*words, "--json") == 0, capsys.readouterr().err
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one line of an error."""
    assert run(*words) == 1
    error = capsys.readouterr().err
    assert error.startswith("tvbrdf: error: ")
    assert len(error.splitlines()) == 1
    return error


def observed(values: Sequence[float] = SATIN) -> Any:
    return Rig().observe(
        get_model("ON+TS"), np.array(values), cameras=(1, 2, 3), exposures_ms=(0.2, 4.0), lights=40
    )


def test_a_sample_at_its_start(capsys: pytest.CaptureFixture[str]) -> None:
    found = read(capsys, "drying_paint", "--simulate", "100", *CHEAP)
    assert found["model"] == "oren_nayar+torrance_sparrow"
    # the sample's file: orange paint, 1/sigma_s = 12, Ks = 0.9
    assert found["parameters"]["kd_r"] == pytest.approx(0.45)
    assert found["parameters"]["ks"] == pytest.approx(0.9)
    assert found["parameters"]["inverse_sigma_s"] == pytest.approx(12, rel=1e-6)
    assert found["wanted"]["ks"] == pytest.approx(0.045)
    assert found["wanted"]["sigma_d"] == 0.03
    assert found["reason"] == ""
    fewest, last = found["fewest"], found["simulated"][-1]
    assert last["reached"]
    assert last["design"] == fewest
    assert last["scans"] == 100
    for name, errors in last["errors"].items():
        assert errors["predicted"] == fewest["predicted"][name] <= found["wanted"][name]
        assert errors["interval"][0] < errors["simulated"] < errors["interval"][1]
        assert errors["interval"][0] <= found["wanted"][name]
    later = read(capsys, "drying_paint", "--at-s", "1200", "--simulate", "0", *CHEAP)
    # e^-5 from dry
    assert later["parameters"]["ks"] == pytest.approx(0.25 + 0.65 * np.exp(-5), rel=1e-6)
    assert later["simulated"] == []


def test_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*CHEAP, "--simulate", "40", "kd:=0.3", "--accuracy", "kd=2%", "ks:=0.5") == 0
    text = capsys.readouterr().out
    lines = text.splitlines()
    assert lines[0] == "oren_nayar+torrance_sparrow: typical values with kd:=0.3 ks:=0.5"
    (head,) = [line for line in lines if line.split()[:2] == ["cameras", "exposures/ms"]]
    assert head.split()[2:] == ["lights", "frames", "images", "time/s", "predicted/wanted",
                                "simulated/wanted"]  # fmt: skip
    assert sum(line.startswith("*  ") for line in lines) == 1
    assert "* fewest images, as simulated scans confirm" in lines
    (kd,) = [line.split() for line in lines if line.startswith("kd_g")]
    assert kd[:3] == ["kd_g", "0.3", "0.006"]
    (ks,) = [line.split() for line in lines if line.startswith("ks")]
    assert ks[:3] == ["ks", "0.5", "0.025"]
    assert "of 40 scans, [95 % interval]" in text


def test_what_is_not_wanted_need_not_be_known(capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--accuracy", "ks=any", "--accuracy", "inverse_sigma_s=any")
    assert run(*words, "--accuracy", "sigma_d=any", "--simulate", "20") == 0
    text = capsys.readouterr().out
    # one camera that does not see the lobe is enough
    (ks,) = [line.split() for line in text.splitlines() if line.startswith("ks")]
    assert ks == ["ks", "0.8", "any", "inf"]
    assert "nan" not in text


def test_a_fit_is_a_material(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    scan = observed()
    fit, choice = fit_scan(scan), choose_model(scan)
    one, other = tmp_path / "fit.json", tmp_path / "choice.json"
    one.write_text(json.dumps(fit.as_dict()))
    other.write_text(json.dumps(choice.as_dict()))
    found = read(capsys, str(one), "--simulate", "0")
    assert found["parameters"] == pytest.approx(fit.parameters)
    chosen = read(capsys, str(other), "ks:=1.5", "--simulate", "0")
    assert chosen["model"] == choice.result.model
    assert chosen["parameters"]["ks"] == 1.5
    assert chosen["parameters"]["kd_b"] == pytest.approx(choice.result.value("kd_b"))
    # a channel without values has none, unless it is set
    lost = fit.as_dict()
    lost["values"][1] = None
    one.write_text(json.dumps(lost))
    assert "no value of kd_g; set it with key:=value" in refused(capsys, str(one))
    assert read(capsys, str(one), "kd_g:=0.4", "--simulate", "0")["parameters"]["kd_g"] == 0.4
    one.write_text("[1, 2]")
    assert "has no fit" in refused(capsys, str(one))
    one.write_text('{"parameter_names": ["ks"], "values": "?"}')
    assert "is no fit" in refused(capsys, str(one))
    # as tvbrdf fit writes a series
    later = fit.as_dict() | {"values": [0.1, 0.2, 0.3, 0.3, 0.5, 4.0]}
    scans = [{"scan": 1, "fit": fit.as_dict()}, {"scan": 2, "fit": later, "choice": None}]
    one.write_text(json.dumps({"samples": [{"scans": scans}], "failures": []}))
    assert "has 2 fits: choose one with --scan" in refused(capsys, str(one))
    assert "scan 3: has no fit" in refused(capsys, str(one), "--scan", "3")
    second = read(capsys, str(one), "--scan", "2", "--simulate", "0")
    assert list(second["parameters"].values()) == later["values"]
    one.write_text("{")
    assert "not JSON" in refused(capsys, str(one))
    assert "No such file" in refused(capsys, str(tmp_path / "no.json"))


def test_another_model_takes_what_it_knows(capsys: pytest.CaptureFixture[str]) -> None:
    words = ("drying_paint", "--model", "oren_nayar+torrance_sparrow(coloured)", "--simulate", "0")
    found = read(capsys, *words)
    assert [found["parameters"][f"ks_{c}"] for c in "bgr"] == pytest.approx([0.9] * 3)
    assert found["parameters"]["kd_r"] == pytest.approx(0.45)


def test_options_reach_the_rig(capsys: pytest.CaptureFixture[str]) -> None:
    plain = read(capsys, "--simulate", "0", *CHEAP)
    assert plain["largest"]["cameras"] == [1, 2, 3, 4]
    assert plain["largest"]["exposures_ms"] == [0.2, 4.0, 32.0]
    found = read(
        capsys, "--simulate", "0", *CHEAP, "--cameras", "1,2", "--exposures", "1,4",
        "--camera-angles", "0,40", "--tilt", "5", "--sweep=-80,80", "--most-lights", "300",
        "--gain-error", "0.5%", "--light-error", "0.02", "--tilt-error", "0.05",
        "--fixed", "sigma_d", "--accuracy", "ks=any", "--accuracy", "inverse_sigma_s=0.5",
    )  # fmt: skip
    assert found["largest"]["cameras"] == [1, 2]
    assert found["largest"]["exposures_ms"] == [1.0, 4.0]
    assert found["largest"]["lights"] == 300
    assert found["fixed"] == ["sigma_d"]
    assert found["wanted"]["ks"] is None
    assert found["wanted"]["inverse_sigma_s"] == 0.5
    assert "sigma_d" not in found["wanted"]


def test_what_cannot_be_reached(capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--accuracy", "ks=0.1%", "--gain-error", "1%", "--light-error", "0.05")
    assert run(*words, "--json") == 1
    output = capsys.readouterr()
    found = json.loads(output.out)
    assert found["fewest"] is None
    assert found["designs"] == []
    assert found["reason"] in output.err
    assert "ks is known to" in found["reason"]
    error = refused(capsys, *words)
    assert "errors that frames share" in error


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nothing"], "unknown model 'nothing'"),
        (["nothing"], "nor is it a sample: drying_paint, settling_dust, wet_cloth"),
        (["no.yaml"], "no.yaml is missing"),
        (["ON+TS", "kx:=3"], "no parameter 'kx'"),
        (["ks:=much"], "expected a finite number"),
        (["--accuracy", "kx=3%"], "no parameter 'kx'"),
        (["--accuracy", "ks"], "not of the form NAME=NUMBER"),
        (["--accuracy", "ks=-1"], "must be above 0"),
        (["--noise", "pixel=3"], "did you mean 'pixels'?"),
        (["--noise", "pixels=0"], "must be finite and above 0"),
        (["--sweep=5"], "two angles"),
        (["--sweep=5,-5"], "sweep_deg from 5 to -5"),
        (["--cameras", "7"], "cameras [7]"),
        (["--cameras", ""], "cameras []"),
        (["--tilt", "nan"], "tilt_deg = [nan]"),
        (["--camera-angles", "0,120"], "camera_angles_deg = [0.0, 120.0]"),
        (["--scan", "1"], "--scan needs the .json file of a fit"),
        (["--at-s", "60"], "--at-s needs a sample"),
        (["--simulate", "1"], "at least two are needed"),
        (["--fixed", "kd,sigma_d,ks,inverse_sigma_s"], "nothing is wanted"),
        (["--fixed", "nothing"], "no parameter 'nothing'"),
        (["ward(anisotropic)"], "its anisotropy cannot be seen"),
        (["inverse_sigma_s:=1000"], "inverse_sigma_s = 1000 is outside"),
        (["--gain-error=-1"], "gain_relative_std"),
    ],
)
def test_errors_are_one_line(
    capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    assert message in refused(capsys, *words)


def test_a_measured_sample_has_no_parameters(
    capsys: pytest.CaptureFixture[str], shared_data: Path
) -> None:
    folder = shared_data / "rgl_on_rig" / "paper_white"
    assert "nobody knows the parameters" in refused(capsys, f"measured:{folder}")


@pytest.mark.parametrize("words", [
    ["--simulate", "-1"], ["--cameras", "a"], ["--most-lights=0"], ["--seed=-1"], ["--at-s", "nan"],
    ["--gain-error", "nan"],
])  # fmt: skip
def test_wrong_usage_is_status_2(words: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        run(*words)
    assert ended.value.code == 2


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import argparse, sys; from tvbrdf_launch.cli import design;"
        "parser = argparse.ArgumentParser(); design.add_parser(parser.add_subparsers());"
        "parser.format_help(); print([m for m in ('numpy', 'yaml', 'rich') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
