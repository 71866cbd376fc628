"""``tvbrdf model``: every verb as text and as JSON, its exit status, and errors in one line."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest

from tvbrdf_fitting.models import ALIASES, SURFACE, catalogue, get_model, registered
from tvbrdf_launch.cli import main


def told(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> str:
    assert main(["model", *words]) == status
    out, errors = capsys.readouterr()
    assert errors == ""
    return out


def parsed(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> Any:
    return json.loads(
        told(capsys, *words, "--json", status=status),
        parse_constant=lambda word: pytest.fail(f"{word} is not JSON"),
    )


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Return the one line of an error."""
    assert main(["model", *words]) == 1
    out, errors = capsys.readouterr()
    assert out == ""
    assert len(errors.splitlines()) == 1
    assert errors.startswith("tvbrdf: error: ")
    return errors


# -- list


def test_list_has_every_model_and_the_sums(capsys: pytest.CaptureFixture[str]) -> None:
    rows = {row["name"]: row for row in parsed(capsys, "list")}
    assert {*registered(), SURFACE, *ALIASES.values()} <= set(rows)
    for entry in registered().values():
        row = rows[entry.name]
        assert row["summary"] == entry.summary
        assert row["options"] == list(entry.options)
        assert row["layer"] == entry.over
    assert rows["torrance_sparrow"]["parameters"] == ["ks", "inverse_sigma_s"]
    assert rows["dust"]["parameters"] == ["w_b", "w_g", "w_r", "g", "tau"]
    assert rows[SURFACE]["parameters"] == list(get_model(SURFACE).parameter_names)
    text = told(capsys, "list")
    assert re.search(r"^torrance_sparrow +coloured +ks inverse_sigma_s +specular: ", text, re.M)
    assert re.search(r"^oren_nayar +kd\[bgr\] sigma_d +diffuse: ", text, re.M)
    assert "alias 'ON+TS'" in text


# -- info


@pytest.mark.parametrize("name", catalogue())
def test_info_tells_parameters_formula_and_source(
    capsys: pytest.CaptureFixture[str], name: str
) -> None:
    model = get_model(name)
    found = parsed(capsys, "info", name)
    assert [p["name"] for p in found["parameters"]] == list(model.parameter_names)
    assert [p["internal"] for p in found["parameters"]] == list(model.internal_names)
    for row, parameter in zip(found["parameters"], model.parameters, strict=True):
        assert row["unit"] == parameter.unit
        assert row["lower"] == (parameter.lower if np.isfinite(parameter.lower) else None)
        assert row["upper"] == (parameter.upper if np.isfinite(parameter.upper) else None)
    text = told(capsys, "info", name)
    for part in found["parts"]:
        assert part["text"] in text
        assert re.search(r"^Sources?: ", part["text"], re.M)
        assert "::\n" in part["text"]
    for parameter in model.parameters:
        assert re.search(rf"^{parameter.name} +{re.escape(parameter.unit)} ", text, re.M)


def test_info_takes_sums_aliases_and_options(capsys: pytest.CaptureFixture[str]) -> None:
    text = told(capsys, "info", "dust")
    assert text.startswith("dust+oren_nayar+torrance_sparrow\n")
    assert "log(inverse_sigma_s)" in text
    assert "tau" in text
    assert "data may be unable to tell tau from w_b" in text
    for source in ("J. F. Blinn", "M. Oren and S. K. Nayar", "K. E. Torrance and E. M. Sparrow"):
        assert source in text
    text = told(capsys, "info", "lambert+torrance_sparrow+torrance_sparrow(coloured)")
    assert text.count("K. E. Torrance and E. M. Sparrow") == 1
    assert "ks_g_2" in text
    assert "for rendering, not for fits" in told(capsys, "info", "ideal_mirror")


# -- check


def test_check_of_a_good_model(capsys: pytest.CaptureFixture[str]) -> None:
    found = parsed(capsys, "check", "lambert", "kd:=0.25", "--angle", "0", "--angle", "60")
    assert found["parameters"] == {"kd_b": 0.25, "kd_g": 0.25, "kd_r": 0.25}
    assert [row["theta_deg"] for row in found["albedo"]] == [0.0, 60.0]
    for row in found["albedo"]:
        np.testing.assert_allclose(row["value"], 0.25, rtol=1e-12)
    np.testing.assert_allclose(found["bihemispherical"], 0.25, rtol=1e-6)
    assert (found["good"], found["findings"]) == (True, [])
    text = told(capsys, "check", "lambert", "kd:=0.25", "--angle", "60")
    assert re.search(r"^60 +0\.25000000 +0\.25000000 +0\.25000000 ", text, re.M)
    assert text.endswith("\ngood\n")


def test_check_tells_numbers_of_any_size(capsys: pytest.CaptureFixture[str]) -> None:
    text = told(capsys, "check", "lambert", "kd:=1e-9", "kd_r:=1e200", "--angle", "0", status=1)
    assert re.search(r"^0 +1\.0000000e-09 +1\.0000000e-09 +1\.0000000e\+200 ", text, re.M)
    assert "Largest albedo: B 1.0000e-09, G 1.0000e-09, R 1.0000e+200" in text


def test_check_outside_the_bounds_is_not_good(capsys: pytest.CaptureFixture[str]) -> None:
    text = told(capsys, "check", "ON+TS", "ks:=-1", "--tolerance", "1e-3", status=1)
    assert "! ks = -1 lies outside its bounds 0 to inf" in text
    assert text.endswith("\nnot good\n")


def test_check_of_one_that_creates_energy(capsys: pytest.CaptureFixture[str]) -> None:
    words = ("oren_nayar", "kd:=0.5", "--angle", "75", "kd_r:=1", "sigma_d:=0.3")
    text = told(capsys, "check", *words, status=1)
    # the published figure is 1.005
    assert re.search(r"^75 +0\.\d+ +0\.\d+ +1\.005\d+ ", text, re.M)
    assert "! creates energy: albedo above 1 from 71.94 to 90 degrees" in text
    assert text.endswith("\nnot good\n")
    found = parsed(capsys, "check", *words, status=1)
    assert [where["channel"] for where in found["energy"]] == ["r"]
    assert found["parameters"]["kd_g"] == 0.5


def test_check_of_one_that_is_not_reciprocal(capsys: pytest.CaptureFixture[str]) -> None:
    text = told(capsys, "check", "dust(paper)+oren_nayar+torrance_sparrow", "--tolerance", "1e-4")
    assert "directional-hemispherical, against the angle of the light" in text
    assert "hemispherical-directional, against the angle of the view" in text
    assert "! not reciprocal, by definition" in text


def test_check_of_one_that_is_not_isotropic(capsys: pytest.CaptureFixture[str]) -> None:
    words = ("ward(anisotropic)", "--angle", "60", "--tolerance", "1e-4")
    text = told(capsys, "check", *words)
    assert re.search(r"^angle +azimuth +B +G +R +error$", text, re.M)
    assert re.findall(r"^60 +(\d+) ", text, re.M) == ["0", "45", "90", "135"]


def test_later_parameters_win_over_their_group(capsys: pytest.CaptureFixture[str]) -> None:
    found = parsed(
        capsys, "check", "lambert+torrance_sparrow+torrance_sparrow(coloured)",
        "kd:=0.1", "kd_g:=0.2", "ks_2:=0.3", "ks_b_2:=0.4", "--angle", "0", "--tolerance", "1e-3",
    )  # fmt: skip
    values = found["parameters"]
    assert [values[f"kd_{c}"] for c in "bgr"] == [0.1, 0.2, 0.1]
    assert [values[f"ks_{c}_2"] for c in "bgr"] == [0.4, 0.3, 0.3]


# -- errors


def test_errors_name_the_thing(capsys: pytest.CaptureFixture[str]) -> None:
    for verb in ("info", "check"):
        assert "unknown model 'oren'; known models: " in refused(capsys, verb, "oren")
        assert "has no option 'red'; it has coloured" in refused(
            capsys, verb, "torrance_sparrow(red)"
        )
    surface = f"model {SURFACE} has no parameter"
    assert f"{surface} 'sigma'; did you mean 'sigma_d'?" in refused(
        capsys, "check", "ON+TS", "sigma:=1"
    )
    assert f"{surface} 'x'; it has: " in refused(capsys, "check", "ON+TS", "x:=1")
    assert "parameter ks is 'bright', expected a finite number" in refused(
        capsys, "check", "ON+TS", "ks:=bright"
    )
    assert "parameter ks is 'inf', expected a finite number" in refused(
        capsys, "check", "ON+TS", "ks:=inf"
    )
    assert "'ks=1' is not of the form key:=value" in refused(capsys, "check", "ON+TS", "ks=1")
    assert "'inverse_sigma_s': -1.0" in refused(capsys, "check", "ON+TS", "inverse_sigma_s:=-1")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["check", "lambert", "--angle", "90"], "90 is not an angle"),
        (["check", "lambert", "--angle", "nan"], "nan is not an angle"),
        (["check", "lambert", "--tolerance", "0"], "0 is not between 1e-12 and 1e-2"),
        (["check"], "name"),
        (["info"], "name"),
        ([], "VERB"),
        (["list", "kd:=1"], "unrecognized arguments: kd:=1"),
    ],
)
def test_wrong_usage_is_status_2(
    capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["model", *words])
    assert ended.value.code == 2
    assert said in capsys.readouterr().err
