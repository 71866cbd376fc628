"""``tvbrdf bench fit``: what it compares, its errors against what is known, its files."""

from __future__ import annotations

import argparse
import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from tvbrdf_fitting.geometry import CAMERA_ANGLES_DEG, light_direction, view_direction
from tvbrdf_fitting.models import SURFACE, get_model
from tvbrdf_fitting.problem import make_problem
from tvbrdf_fitting.published import CameraScan, scan_file_name, write_scan_file
from tvbrdf_fitting.solve.solvers import SOLVERS
from tvbrdf_launch.cli import bench
from tvbrdf_launch.cli.bench import grid, table
from tvbrdf_launch.cli.bench.contestants import CONTESTANTS, Contestant, rounded, single_start
from tvbrdf_launch.cli.bench.fit import read
from tvbrdf_launch.cli.bench.grid import Cell
from tvbrdf_launch.cli.bench.hemisphere import Hemisphere, _density, _pairs
from tvbrdf_launch.cli.bench.rig_scenes import measure, random_material
from tvbrdf_launch.errors import RunError

SATIN = (0.3, 0.5, 0.7, 0.4, 0.8, 6.0)
MODEL = get_model(SURFACE)
SMALL = grid.Plan(
    lights=(24, 96),
    cameras=(1, 4),
    noises=(0.002, 0.02),
    scenes=3,
    contestants=(Contestant("separable"), Contestant("separable", "float16"), CONTESTANTS[-1]),
)


def run(*words: str) -> int:
    root = argparse.ArgumentParser()
    bench.add_parser(root.add_subparsers())
    arguments = root.parse_args(["bench", "fit", *words])
    return int(arguments.run(arguments))


@pytest.fixture(scope="module")
def cells() -> list[Cell]:
    return grid.simulate(SMALL)


@pytest.fixture
def sample(tmp_path: Path) -> Path:
    """A sample of two scans, the second with a calibration that makes it the first again."""
    folder = tmp_path / "sample07"
    (folder / "tvBrdf-data").mkdir(parents=True)
    light = light_direction(np.linspace(-70.0, 85.0, 61))
    for camera, angle in enumerate(CAMERA_ANGLES_DEG, start=1):
        view = view_direction(angle)
        radiance = np.pi * MODEL.evaluate(light, view, SATIN) * light[:, 2:]
        for scan in (1, 2):
            write_scan_file(
                folder / "tvBrdf-data" / scan_file_name(scan, camera),
                CameraScan((0.2, 4.0, 32.0), light, view, radiance * scan),
            )
    return folder


# -- scenes and contestants


def test_a_whole_scan_has_the_rigs_336_lights() -> None:
    whole = measure(np.random.default_rng(0), SATIN, arm=False)
    assert [int((whole.camera == camera).sum()) for camera in range(1, 5)] == [336] * 4
    behind = measure(np.random.default_rng(0), SATIN)
    assert int((behind.camera == 1).sum()) == 329
    assert int((behind.camera == 2).sum()) == 336


def test_noise_is_what_the_variance_says() -> None:
    noisy = measure(np.random.default_rng(1), SATIN, noise=0.02)
    exact = measure(np.random.default_rng(1), SATIN, noise=0.0)
    score = (noisy.radiance - exact.radiance) / np.sqrt(noisy.variance)
    # 3999 values: their mean square is within 0.1 of 1 but once in 100 000 times
    assert np.mean(score**2) == pytest.approx(1.0, abs=0.1)
    assert (exact.variance < noisy.variance / 300).all()


def test_random_materials_are_within_the_bounds() -> None:
    rng = np.random.default_rng(2)
    lower, upper = MODEL.bounds
    for _ in range(100):
        material = random_material(rng)
        assert ((material >= lower) & (material <= upper)).all()


@pytest.mark.parametrize(("precision", "step"), [("float32", 6e-8), ("float16", 5e-4)])
def test_rounded_data_are_off_by_half_a_step(precision: str, step: float) -> None:
    whole = measure(np.random.default_rng(3), SATIN)
    given = rounded(whole, precision)
    off = np.abs(given.radiance / whole.radiance - 1).max()
    assert step / 10 < off <= step
    np.testing.assert_allclose(given.light_direction, whole.light_direction, atol=2 * step)
    assert rounded(whole, "float64") is whole


@pytest.mark.parametrize("contestant", CONTESTANTS, ids=lambda c: f"{c.solver}-{c.precision}")
def test_every_contestant_finds_an_easy_optimum(contestant: Contestant) -> None:
    given = contestant.given(measure(np.random.default_rng(4), SATIN, noise=0.002, lights=91))
    problem = make_problem(given, MODEL, {}, {})
    best = SOLVERS["trust_region"](problem).internal
    np.testing.assert_allclose(contestant.solve(problem), best, rtol=1e-5)


def test_a_single_start_that_breaks_down_stays_within_the_bounds() -> None:
    whole = measure(np.random.default_rng(5), SATIN, lights=12, cameras=(4,))
    wild = replace(whole, radiance=np.where(whole.radiance > 0.1, 1e200, whole.radiance))
    problem = make_problem(wild, MODEL, {}, {})
    found = single_start(problem)
    assert np.isfinite(found).all()
    assert ((found >= problem.lower) & (found <= problem.upper)).all()


# -- error over the hemisphere


def test_pairs_of_directions_cover_the_hemisphere() -> None:
    light, view = _pairs(np.random.default_rng(6), 40_000)
    cosines = light[:, 2] * view[:, 2]
    # the integral of cos cos over both hemispheres, up to 80 degrees, to 3 of its deviations
    whole = (math.pi * math.sin(math.radians(80.0)) ** 2) ** 2
    ratio = cosines / _density(light, view)
    ratio = np.append(ratio, np.zeros(40_000 - len(ratio)))  # pairs beyond
    estimate, deviation = ratio.mean(), ratio.std() / math.sqrt(len(ratio))
    assert estimate == pytest.approx(whole, abs=3 * deviation)
    assert deviation < 0.01 * whole


@pytest.mark.parametrize("change", [0.1, -0.3])
def test_error_of_a_scaled_brdf_is_the_scale(change: float) -> None:
    truth = np.array([0.0, 0.0, 0.0, 0.1, 2.0, 3.0])
    other = truth * [1, 1, 1, 1, 1 + change, 1]
    assert Hemisphere(MODEL).relative_error(other, truth) == pytest.approx(abs(change), rel=1e-9)
    assert Hemisphere(MODEL).relative_error(truth, truth) == 0.0


@pytest.mark.parametrize("inverse_sigma_s", [2.0, 10.0, 100.0])
def test_error_of_a_lobes_width_is_that_of_many_samples(inverse_sigma_s: float) -> None:
    truth = np.array([0.2, 0.3, 0.4, 0.1, 2.0, math.log(inverse_sigma_s)])
    other = np.array([*truth[:5], truth[5] + 0.05])
    few = Hemisphere(MODEL).relative_error(other, truth)
    many = Hemisphere(MODEL, 200_000).relative_error(other, truth)
    assert few == pytest.approx(many, rel=0.1)


# -- cells


def test_there_is_a_cell_for_every_combination(cells: list[Cell]) -> None:
    assert len(cells) == 3 * 2 * 2 * 2
    assert {cell.fits for cell in cells} == {3}
    assert all(cell.time_ms > 0 for cell in cells)
    assert all(cell.brdf <= cell.brdf_95 for cell in cells)


def test_more_noise_is_more_error_and_nothing_is_exact(cells: list[Cell]) -> None:
    for cell in cells:
        if cell.noise == 0.002:
            place = (cell.solver, cell.precision, cell.lights, cell.cameras)
            louder = next(
                c
                for c in cells
                if c.noise == 0.02 and (c.solver, c.precision, c.lights, c.cameras) == place
            )
            # ten times the noise; a single material of three may by chance gain less
            assert louder.brdf > 2 * cell.brdf > 0


def test_fronts_are_those_that_nothing_beats(cells: list[Cell]) -> None:
    for noise in SMALL.noises:
        own = [c for c in cells if c.noise == noise and c.precision == "float64"]
        front = [c for c in own if c.fast]
        assert front
        for cell in own:
            better = [
                c
                for c in own
                if c.time_ms < cell.time_ms
                and c.brdf_95 < cell.brdf_95 * 0.9
                and c.brdf_95 < cell.brdf_95 - 1e-4
            ]
            assert not (cell.fast and better)
        least = min(own, key=lambda c: c.time_ms)
        assert least.fast
        assert any(c.few for c in own if c.images == min(o.images for o in own))
    assert not any(c.fast or c.few for c in cells if c.precision != "float64")


def test_of_equals_the_faster_needs_few_images(cells: list[Cell]) -> None:
    one = cells[0]
    slow = replace(one, solver="slow", time_ms=2 * one.time_ms, brdf_95=one.brdf_95 * 1.001)
    exact = replace(one, solver="exact", time_ms=3 * one.time_ms, brdf_95=one.brdf_95 / 2)
    marked = {c.solver: c for c in grid.mark_fronts([one, slow, exact])}
    assert [marked[name].fast for name in (one.solver, "slow", "exact")] == [True, False, True]
    assert [marked[name].few for name in (one.solver, "slow", "exact")] == [False, False, True]


def test_the_table_marks_the_front_of_every_solver(cells: list[Cell]) -> None:
    slow = [replace(c, time_ms=9.0) for c in cells]
    quick = [replace(c, solver="quick", time_ms=1.0) for c in cells if c.solver == "separable"]
    text = table.as_text(grid.mark_fronts([*slow, *quick]))
    rows = [line for line in text.splitlines() if line.split()[:1] in (["24"], ["96"])]
    timed = [line for line in rows if " 9" in line and "/" not in line]
    assert len(timed) == 2 * 2
    # all three take 9 ms and the last column 1 ms, with the errors of the first
    assert not any(" 9 t" in line for line in timed)
    assert any(line.rstrip().endswith("1 tn") for line in timed)


def test_what_is_not_a_number_is_the_worst() -> None:
    values = np.array([1.0, math.nan, 2.0, 3.0])
    assert grid._quantile(values, 0.5) == 2.0
    assert grid._quantile(values) == math.inf
    assert grid._quantile(np.arange(1.0, 21.0)) == 19.0


@pytest.mark.parametrize(("whole", "count"), [(336, 12), (336, 181), (61, 61), (30, 24)])
def test_subsets_are_evenly_spaced(whole: int, count: int) -> None:
    chosen = list(grid.subsets(whole, count))
    assert len({tuple(c) for c in chosen}) == len(chosen) == max(min(whole // count, 12), 1)
    for subset in chosen:
        assert len(set(subset.tolist())) == count
        assert subset.min() >= 0
        assert subset.max() < whole
        steps = np.diff(subset)
        assert steps.max() - steps.min() <= 1


# -- a real scan


def test_a_scan_is_read_and_divided_by_its_calibration(sample: Path) -> None:
    first, number = read(sample, None)
    assert number == 1
    assert len(first) == 4 * 61
    (sample / "tvBrdf-calibration.txt").write_text("2 2 2\n" * 4)
    second, number = read(sample, 2)
    assert number == 2
    # both files have six decimals
    np.testing.assert_allclose(second.radiance, first.radiance, atol=1e-6)


def test_all_of_a_scan_agrees_with_itself(sample: Path) -> None:
    seen, _ = read(sample, 1)
    plan = grid.Plan(lights=(12, 24), cameras=(2, 4), contestants=(Contestant("separable"),))
    cells = grid.on_scan(seen, plan)
    assert {(c.lights, c.cameras, c.fits) for c in cells} == {
        (lights, cameras, fits)
        for lights, fits in ((12, 5), (24, 2), (61, 1))
        for cameras in (2, 4)
    }
    whole = next(c for c in cells if (c.lights, c.cameras) == (61, 4))
    assert whole.brdf == whole.kd == whole.log_sigma_s == 0.0
    # all that is off is the files' sixth decimal
    assert all(c.brdf_95 < 1e-3 for c in cells)
    assert all(c.noise is None and 0 < (c.rms_percent or 0) < 1e-3 for c in cells)


def test_a_missing_or_broken_sample_is_one_line(
    sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RunError, match="tvBrdf-data"):
        run(str(tmp_path / "nothing"))
    with pytest.raises(RunError, match="no file of scan 09"):
        run(str(sample), "--scan", "9")
    with pytest.raises(RunError, match="--scan needs the PATH"):
        run("--scan", "1")
    (tmp_path / "taken").touch()
    with pytest.raises(FileExistsError):  # at once: the whole plan takes minutes
        run("--out", str(tmp_path / "taken"))
    path = sample / "tvBrdf-data" / scan_file_name(1, 3)
    path.write_text(path.read_text()[:-20])
    with pytest.raises(RunError, match=r"camera3.* is truncated"):
        run(str(sample))
    assert not (tmp_path / "out").exists()  # nothing is left of what could not begin


# -- what is written


def test_files_and_text(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(grid, "QUICK", SMALL)
    assert run("--quick", "--out", str(tmp_path / "new" / "out")) == 0
    out, errors = capsys.readouterr()
    assert errors == ""
    assert "NOISE 0.2% AT WHITE" in out
    assert "NOISE 2.0% AT WHITE" in out
    folder = tmp_path / "new" / "out"
    assert {path.name for path in folder.iterdir()} == {
        "speed_error.png",
        "speed_error.csv",
        "speed_error.txt",
    }
    assert (folder / "speed_error.txt").read_text().strip() in out
    with (folder / "speed_error.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 24
    assert {row["solver"] for row in rows} == {"separable", "scipy lm"}
    picture = imread(folder / "speed_error.png")
    assert picture.shape[1] >= 1000
    assert picture[..., :3].std() > 0.05  # not one even colour


def test_json_of_a_real_scan(
    sample: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(grid, "QUICK", SMALL)
    assert run(str(sample), "--quick", "--json", "--out", str(tmp_path / "out")) == 0

    def refuse(word: str) -> Any:
        pytest.fail(f"{word} is not JSON")

    found = json.loads(capsys.readouterr().out, parse_constant=refuse)
    assert found["title"] == "sample07, scan 1, against the fit of all of it"
    assert {cell["lights"] for cell in found["cells"]} == {24, 61}
    assert all(Path(path).is_file() for path in found["written"].values())


def test_errors_that_are_lost_can_be_printed(cells: list[Cell]) -> None:
    lost = [replace(c, ks=math.inf, brdf_95=math.inf, ks_95=1e12) for c in cells]
    text = table.as_text(lost)
    assert "> 10000" in text
    assert "inf" not in text
    assert lost[0].as_dict()["ks"] is None
