"""``tvbrdf fit``: what it prints and writes, and which requests it refuses."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from tests.launch.published_samples import (
    EXPOSURES_MS,
    NAMES,
    PAINT,
    START_NS,
    Fit,
    file_of,
    grid_of,
    observe,
    truth_of,
    write_sample,
)
from tvbrdf_fitting import CommonErrors, Observations, fit_scan
from tvbrdf_fitting.choice.choose import choose_model
from tvbrdf_fitting.models import SURFACE
from tvbrdf_fitting.published import (
    SampleInfo,
    ScanInfo,
    read_scan,
    scan_file_name,
    write_calibration,
    write_info,
)
from tvbrdf_launch.cli._fit_tables import decimals, scan_lines, series_lines
from tvbrdf_nodes.database_writer.store import DatabaseStore, ScanRecord
from tvbrdf_rendering.fit_report import FittedSample, FittedScan


def test_one_scan_is_printed_in_full(fit: Fit, sample: Path) -> None:
    ended = fit(sample, "--no-pictures")
    assert (ended.status, ended.err) == (0, "")
    lines = ended.out.splitlines()
    assert lines[0] == "red_paint, scan 1"
    rows = {line.split()[0]: line.split() for line in lines if line.split()}
    for name, true in zip(NAMES, PAINT, strict=True):
        value, deviation = float(rows[name][1]), float(rows[name][2])
        # deviations are estimated, too: to about a tenth
        assert abs(value - true) < 4.5 * deviation, name
    assert rows["sigma_d"][3] == "rad"
    for label in ("RMS / peak", "RMS / mean", "RMS b", "RMS g", "RMS r", "RMS log", "chi2 / dof"):
        assert any(line.startswith(label) for line in lines), label
    assert "noise explains what is left" in ended.out
    assert "solved by separable least squares" in ended.out
    assert "light positions of the published grid" in ended.out
    assert "!" not in ended.out
    assert not list(sample.parent.glob("*_fit"))


def test_json_has_everything_and_stands_alone(fit: Fit, sample: Path) -> None:
    content = fit(sample, "--no-pictures", "--json").json()
    (one,) = content["samples"]
    (scan,) = one["scans"]
    expected = fit_scan(read_scan(sample).observations())
    assert scan["fit"]["parameter_names"] == list(NAMES)
    assert scan["fit"]["values"] == pytest.approx(expected.values.tolist(), rel=1e-12)
    assert scan["fit"]["errors"]["rms_percent"] == pytest.approx(expected.errors.rms_percent)
    assert scan["source"] == "grid"
    assert (content["failures"], content["written"], one["remarks"]) == ([], {}, [])


def test_pictures_and_json_go_beside_the_sample_or_where_told(
    fit: Fit, sample: Path, tmp_path: Path
) -> None:
    ended = fit(sample)
    beside = tmp_path / "red_paint_fit"
    names = ["fit.json", "scan01_blind.png", "scan01_curves.png", "scan01_lobe.png"]
    assert sorted(path.name for path in beside.iterdir()) == names
    for name in names:
        assert str(beside / name) in ended.out
    content = json.loads((beside / "fit.json").read_text())
    assert content["scans"][0]["fit"]["model"] == SURFACE
    written = fit(sample, "--out", tmp_path / "there", "--json").json()["written"]
    assert sorted(Path(path).name for path in written[str(sample)].values()) == names
    assert all(Path(path).is_file() for path in written[str(sample)].values())


def test_any_file_of_a_scan_means_the_whole_scan(fit: Fit, sample: Path, tmp_path: Path) -> None:
    whole = fit(sample, "--no-pictures", "--json").json()["samples"]
    assert whole[0]["scans"][0]["cameras"] == [1, 2, 3, 4]
    loose = shutil.copytree(sample / "tvBrdf-data", tmp_path / "loose")
    for path in (file_of(sample, 3), sample / "tvBrdf-data", loose / scan_file_name(1, 2)):
        found = fit(path, "--no-pictures", "--json").json()["samples"]
        assert found[0]["scans"][0]["fit"]["values"] == whole[0]["scans"][0]["fit"]["values"]
    assert fit(loose / scan_file_name(1, 2)).status == 0
    assert (loose / "loose_scan01_fit" / "fit.json").is_file()


def test_options_reach_the_fit(fit: Fit, sample: Path) -> None:
    observations = read_scan(sample).observations()
    ended = fit(
        sample, "--no-pictures", "--json", "--metric", "log", "--loss", "huber", "--method",
        "paper", "--fix", "sigma_d:=0.3", "--fix", "kd:=0.2", "--model", "ON+TS",
    )  # fmt: skip
    found = ended.json()["samples"][0]["scans"][0]["fit"]
    fixed = {"sigma_d": 0.3, "kd_b": 0.2, "kd_g": 0.2, "kd_r": 0.2}
    expected = fit_scan(observations, metric="log", loss="huber", method="paper", fixed=fixed)
    assert found["values"] == pytest.approx(expected.values.tolist(), rel=1e-9)
    assert set(found["fixed"]) == set(fixed)
    assert (found["metric"], found["loss"]) == ("log", "huber")
    text = fit(sample, "--no-pictures", "--fix", "sigma_d:=0.3", "--loss", "cauchy").out
    assert "fixed" in next(line for line in text.splitlines() if line.startswith("sigma_d"))
    assert "values with less than half their weight" in text


def test_the_chosen_model_comes_with_its_reasons(fit: Fit, sample: Path) -> None:
    ended = fit(sample, "--no-pictures", "--model", "auto")
    assert ended.status == 0
    lines = ended.out.splitlines()
    kept = next(line for line in lines if line.startswith("kept"))
    assert kept.split()[1] == SURFACE
    text = " ".join(ended.out.split())
    assert f"chosen because {SURFACE}: noise explains the data" in text
    assert "- lambert: the kept one is better by" in text
    choice = fit(sample, "--no-pictures", "--model", "auto", "--json").json()["samples"][0]
    scan = choice["scans"][0]
    rungs = scan["choice"]["rungs"]
    assert [rung["model"] for rung in rungs if not rung["rejected"]] == [SURFACE]


def test_deviations_over_the_models_are_printed() -> None:
    observations = observe(PAINT, seed=1)
    choice = choose_model(observations)
    choice = replace(choice, standard_deviations=3 * choice.standard_deviations)
    scans = tuple(
        FittedScan(n, None, (4.0,), observations, "frames", choice.result, choice) for n in (1, 2)
    )
    lines = scan_lines(FittedSample("paint", "", Path(), scans[:1]))
    rows = {line.split()[0]: line.split()[1:4] for line in lines if line.split()}
    assert any("± deviation  ± over models" in line for line in lines)
    fit = choice.result
    for name, alone in zip(fit.parameter_names, fit.standard_deviations.tolist(), strict=True):
        assert [float(cell) for cell in rows[name][1:]] == pytest.approx(
            [alone, 3 * alone],
            rel=0.06,  # two digits
        )
    text = "\n".join(series_lines(FittedSample("paint", "", Path(), scans)))
    for value, alone in zip(fit.values.tolist(), fit.standard_deviations.tolist(), strict=True):
        places = decimals(3 * alone)
        assert f"{value:.{places}f} ± {3 * alone:.{places}f}" in text
    assert "how far the models differ that explain the data as well" in text


def test_a_sample_is_printed_with_a_line_a_scan_and_trends(fit: Fit, tmp_path: Path) -> None:
    sample = write_sample(tmp_path / "sample01", scans=5)
    stamps = [ScanInfo(n, START_NS, 60.0 * (n - 1), False) for n in range(1, 6)]
    write_info(
        sample / "tvBrdf-info.txt",
        SampleInfo("red paint", "drying paint", EXPOSURES_MS, tuple(stamps)),
    )
    ended = fit(sample, "--no-pictures")
    assert (ended.status, ended.err) == (0, "")
    lines = ended.out.splitlines()
    assert lines[0] == "red paint (drying paint): 5 scans fitted; scan 1 has"
    assert any(line.split()[:3] == ["scan", "time/min", "kd_b"] for line in lines)
    assert any(line.split()[:2] == ["5", "4.00"] for line in lines)
    assert any(line.split()[:1] == ["all"] for line in lines)
    trend = {line.split()[0]: line.split()[1] for line in lines if len(line.split()) > 1}
    assert trend["ks"] == "falls"
    assert trend["kd_r"] == "constant"
    only = fit(sample, "--scan", "4", "--no-pictures")
    assert only.out.startswith("red paint (drying paint), scan 4\n")
    assert fit(sample, "--scan", "9", "--no-pictures").error.endswith(
        "has no scan 9; it has 1, 2, 3, 4, 5"
    )


def test_samples_below_a_folder_have_folders_of_pictures(fit: Fit, tmp_path: Path) -> None:
    write_sample(tmp_path / "paints" / "sample02", scans=2)
    write_sample(tmp_path / "paints" / "brown_paper")
    out = fit(tmp_path / "paints").out
    assert out.index("sample02:") < out.index("brown_paper,")
    below = tmp_path / "paints_fit"
    found = {str(path.relative_to(below)) for path in below.rglob("*.*")}
    assert found == {
        "brown_paper/fit.json",
        "brown_paper/scan01_blind.png",
        "brown_paper/scan01_curves.png",
        "brown_paper/scan01_lobe.png",
        "sample02/fit.json",
        "sample02/parameters.png",
        *(
            f"sample02/scan{n:02d}_{what}.png"
            for n in (1, 2)
            for what in ("curves", "lobe", "blind")
        ),
    }


def test_one_model_for_a_series_or_one_a_scan(fit: Fit, tmp_path: Path) -> None:
    sample = write_sample(tmp_path / "sample01", scans=2)
    joint = fit(sample, "--no-pictures", "--model", "auto")
    assert "chosen for 2 scans together" in " ".join(joint.out.split())
    each = fit(sample, "--no-pictures", "--model", "auto", "--scan-by-scan", "--json").json()
    assert len(each["samples"][0]["scans"]) == 2
    assert all("together" not in s["choice"]["reason"] for s in each["samples"][0]["scans"])


def test_calibration_is_applied(fit: Fit, sample: Path, tmp_path: Path) -> None:
    def kd_of(*words: str | Path) -> float:
        content = fit(sample, "--no-pictures", "--json", *words).json()
        values: list[float] = content["samples"][0]["scans"][0]["fit"]["values"]
        return values[0]

    plain = kd_of()
    write_calibration(tmp_path / "constants.txt", np.full((4, 3), 2.0))
    # Kd enters squared, too: to first order it halves
    assert kd_of("--calibration", tmp_path / "constants.txt") == pytest.approx(plain / 2, rel=0.05)
    write_calibration(sample / "tvBrdf-calibration.txt", np.full((4, 3), 4.0))
    assert kd_of() == pytest.approx(plain / 4, rel=0.05)


# -- databases of this project: frames as they were measured


@pytest.fixture(scope="session")
def database_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("database") / "paints"
    with DatabaseStore(path, "red_paint", process="drying paint") as store:
        for scan in (1, 2):
            observations = observe(truth_of(scan), seed=scan)
            arrays = {f.name: getattr(observations, f.name) for f in fields(Observations)}
            store.store_scan(
                ScanRecord(
                    sample="red_paint",
                    scan=scan,
                    start_stamp_ns=START_NS + scan * 60_000_000_000,
                    time_s=60.0 * (scan - 1),
                    exposures_ms=EXPOSURES_MS,
                    grid=grid_of(observations),
                    observations=arrays | {"light_angle_std_deg": np.array([0.02])},
                    quality={"gain_relative_std": 0.002, "frame_relative_std": [0.001] * 4},
                )
            )
    return path


@pytest.fixture
def database(database_once: Path, tmp_path: Path) -> Path:
    return shutil.copytree(database_once, tmp_path / "paints")


def test_kept_frames_are_fitted_as_the_fitter_does(fit: Fit, database: Path) -> None:
    ended = fit(database, "--no-pictures", "--json")
    (sample,) = ended.json()["samples"]
    common = CommonErrors(
        light_angle_std_deg={0: 0.02},
        gain_relative_std=0.002,
        frame_relative_std=dict.fromkeys((1, 2, 3, 4), 0.001),
    )
    for scan in sample["scans"]:
        number = scan["scan"]
        expected = fit_scan(observe(truth_of(number), seed=number), common_errors=common)
        assert scan["source"] == "frames"
        assert scan["time_s"] == 60.0 * (number - 1)
        assert scan["fit"]["values"] == pytest.approx(expected.values.tolist(), rel=1e-12)
        assert scan["fit"]["nuisances"].keys() == expected.nuisances.keys()
    grid = fit(database / "sample01", "--grid", "--no-pictures", "--json").json()["samples"][0]
    assert {scan["source"] for scan in grid["scans"]} == {"grid"}


@pytest.mark.parametrize("scan_by_scan", [[], ["--scan-by-scan"]], ids=["joint", "per scan"])
def test_each_scans_own_common_errors_are_used(
    fit: Fit, database: Path, scan_by_scan: list[str]
) -> None:
    """The second scan's light is known worse than the first's: so says its own file."""
    path = database / "sample01" / "observations" / "scan02.npz"
    with np.load(path) as arrays:
        changed = {name: arrays[name] for name in arrays.files}
    np.savez(path, **changed | {"light_angle_std_deg": np.array([0.5])})
    words = ["--model", "auto", "--no-pictures", "--json", *scan_by_scan]
    for scan, light_std_deg in zip(
        fit(database, *words).json()["samples"][0]["scans"], (0.02, 0.5), strict=True
    ):
        common = CommonErrors({0: light_std_deg}, 0.002, dict.fromkeys((1, 2, 3, 4), 0.001))
        scene = observe(truth_of(scan["scan"]), seed=scan["scan"])
        expected = fit_scan(scene, scan["fit"]["model"], common_errors=common)
        assert scan["fit"]["values"] == pytest.approx(expected.values.tolist(), rel=1e-12)
        found = scan["fit"]["nuisances"]["light_offset_sweep0_deg"]
        assert found == pytest.approx(expected.nuisances["light_offset_sweep0_deg"], rel=1e-9)


def test_frames_that_cannot_be_read_are_an_error(fit: Fit, database: Path) -> None:
    path = database / "sample01" / "observations" / "scan02.npz"
    path.write_bytes(path.read_bytes()[:2000])
    ended = fit(database, "--no-pictures")
    assert f"{path}: observations of scan 2 cannot be read" in ended.error
    assert "or fit the published grid with --grid" in ended.error
    assert "scan 1" in ended.out.splitlines()[0]
    assert fit(database, "--no-pictures", "--grid").status == 0


def test_frames_that_lack_a_part_are_an_error(fit: Fit, database: Path) -> None:
    path = database / "sample01" / "observations" / "scan01.npz"
    with np.load(path) as arrays:
        kept = {name: arrays[name] for name in arrays.files if name != "variance"}
    np.savez(path, **kept)
    assert "cannot be used: it lacks 'variance'" in fit(database, "--no-pictures").error


def test_a_damaged_catalogue_leaves_the_grid(fit: Fit, database: Path) -> None:
    (database / "catalogue.sqlite").write_bytes(b"no database at all" * 1000)
    ended = fit(database / "sample01", "--no-pictures")
    assert ended.status == 0
    text = " ".join(ended.out.split())
    assert "! the frames in" in text
    assert "are not used" in text
    assert fit(database / "sample01", "--no-pictures", "--strict").status == 1


# -- wrong requests


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--model", "ON+TX"], "known models: "),
        (["--model", "ideal_mirror"], "is a delta function: for rendering, not for fits"),
        (["--metric", "foo"], "unknown metric 'foo'; there are: cosine_weighted, log, radiance"),
        (["--loss", "hubert"], "unknown loss 'hubert'; did you mean 'huber'?"),
        (["--method", "papr"], "unknown method 'papr'; did you mean 'paper'?"),
        (["--fix", "kq:=1"], "has no parameter 'kq'"),
        (["--fix", "kd=1"], "'kd=1' is not of the form key:=value"),
        (["--fix", "kd:=much"], "parameter kd is 'much', expected a finite number"),
        (["--fix", "kd:=-1"], "scan 1 can't be fitted: fixed: kd_b = -1.0 is outside"),
        (["--fix", "kd:=1", "--model", "auto"], "--fix needs a model"),
        (["--model", "ward(anisotropic)"], "all lights lie in one plane"),
        (["--calibration", "/nowhere"], "/nowhere: there is no such file"),
        (["--scan", "2"], "has no scan 2; it has 1"),
        (["--out", "/proc/fit"], "give another folder with --out, or --no-pictures"),
    ],
)
def test_wrong_requests_are_told_in_one_line(
    fit: Fit, sample: Path, words: list[str], message: str
) -> None:
    assert message in fit(sample, *words).error


def test_wrong_paths_are_told_in_one_line(fit: Fit, sample: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("notes\n")
    assert "there is no such file or folder" in fit(tmp_path / "nowhere").error
    assert "holds neither tvBrdf-data/ nor folders with it" in fit(tmp_path / "empty").error
    assert "is not a scan file (scanTT_brdf_cameraV" in fit(tmp_path / "notes.txt").error
    assert "is a file of scan 1, not of 2" in fit(file_of(sample), "--scan", "2").error


@pytest.mark.parametrize("words", [[], ["x", "--axis", "polar"], ["x", "--scan", "0"], ["x", "y"]])
def test_wrong_usage_is_status_2(fit: Fit, words: list[str]) -> None:
    assert fit(*words).status == 2


def test_a_reason_that_all_scans_share_is_told_once(fit: Fit, tmp_path: Path) -> None:
    sample = write_sample(tmp_path / "sample01", scans=3)
    assert "no scan can be fitted: fixed: kd_b = -1.0" in fit(sample, "--fix", "kd:=-1").error


def test_figures_are_not_loaded_for_a_table(sample: Path) -> None:
    code = (
        "import sys; from tvbrdf_launch.cli import main;"
        f"status = main(['fit', {str(sample)!r}, '--no-pictures', '--json']);"
        "print(status, [m for m in ('matplotlib', 'sqlalchemy', 'cv2', 'zmq', 'rich') "
        "if m in sys.modules])"
    )
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.stderr == ""
    assert done.stdout.splitlines()[-1] == "0 []"


def test_real_materials_fit_as_well_as_is_known(fit: Fit, shared_data: Path) -> None:
    """RMS by peak of an independent multi-start fit, in per cent: the data's README."""
    known = {
        "paper_white": (2.10, 2.08),
        "satin_rosaline": (2.32, 1.52),
        "vch_golden_yellow": (4.31, 0.39),
        "cc_ibiza_sunset": (3.15, 0.80),
    }
    for column, model in enumerate(("ON+TS", "oren_nayar+torrance_sparrow(coloured)")):
        content = fit(
            shared_data / "rgl_on_rig", "--no-pictures", "--json", "--model", model
        ).json()
        assert len(content["samples"]) == len(known)
        for sample in content["samples"]:
            found = sample["scans"][0]["fit"]["errors"]["rms_percent"]
            # the last digit given
            assert found < known[sample["sample"]][column] + 0.005
            assert sample["remarks"] == []
