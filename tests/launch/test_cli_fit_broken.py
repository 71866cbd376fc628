"""``tvbrdf fit`` on broken and odd files: what it says, with which exit status."""

from __future__ import annotations

import gzip
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.launch.published_samples import (
    PAINT,
    Fit,
    edit,
    file_of,
    folder_instead,
    no_files,
    replaced,
    reverse_all,
    reversed_colours,
    write_fits,
    write_sample,
)

# -- broken files: one line that names the file, and status 1

HERE = "tvBrdf-data/scan01_brdf_camera1_allexposures.txt"
BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "cut in a line": (
        lambda s: file_of(s).write_bytes(file_of(s).read_bytes()[:5011]),
        f"{HERE}:169: the file is truncated: its last line has no end; copy it again",
    ),
    "cut in a group": (
        lambda s: edit(file_of(s), lambda lines: lines[:200]),
        f"{HERE}:200: the file is truncated: no 'L' line follows; copy it again",
    ),
    "first line only": (
        lambda s: edit(file_of(s), lambda lines: lines[:1]),
        f"{HERE}:1: the file is truncated: no 'F' line follows",
    ),
    "empty": (lambda s: file_of(s).write_bytes(b""), f"{HERE}: is empty; copy it again"),
    "two numbers": (
        lambda s: edit(file_of(s), replaced(5, "F 0.1 0.2")),
        f"{HERE}:5: has 2 numbers after 'F' instead of 3 (radiance b g r)",
    ),
    "four numbers": (
        lambda s: edit(file_of(s), replaced(6, "L 0 0 1 0")),
        f"{HERE}:6: has 4 numbers after 'L' instead of 3 (light x y z)",
    ),
    "a line lost": (
        lambda s: edit(file_of(s), lambda lines: lines[:5] + lines[6:]),
        f"{HERE}:6: starts with 'V' where a line 'L a b c' belongs: each light position has",
    ),
    "no unit vector": (
        lambda s: edit(file_of(s), replaced(6, "L 0.000000 0.000000 1.010000")),
        f"{HERE}:6: the light direction is no unit vector (0 0 1.01, length 1.01): give x y z of",
    ),
    "no unit vectors": (
        lambda s: edit(
            file_of(s), lambda lines: ["L 0 0.6 0.6" if x[0] == "L" else x for x in lines]
        ),
        f"{HERE}:3: the light direction is no unit vector (0 0.6 0.6, length 0.848528; 165 such",
    ),
    "light below the horizon": (
        lambda s: edit(file_of(s), replaced(6, "L 0.600000 0.000000 -0.800000")),
        f"{HERE}:6: the light direction is below the sample's horizon (0.6 0 -0.8, length 1): "
        "leave out such positions, or turn the directions into the sample's frame",
    ),
    "view below the horizon": (
        lambda s: edit(
            file_of(s), lambda lines: ["V 0.6 0 -0.8" if x[0] == "V" else x for x in lines]
        ),
        f"{HERE}:4: the view direction is below the sample's horizon",
    ),
    "two views": (
        lambda s: edit(file_of(s), replaced(7, "V 0.600000 0.000000 0.800000")),
        f"{HERE}:7: the view direction changes within the file (0.6 0 0.8, length 1): it began as "
        "-0.207912 0 0.978148; a file belongs to one camera",
    ),
    "not finite": (
        lambda s: edit(file_of(s), replaced(5, "F 0.1 nan 0.2")),
        f"{HERE}:5: 'nan' is not a finite number; leave out what was not measured",
    ),
    "decimal commas": (
        lambda s: edit(file_of(s), replaced(5, "F 0,1 0,2 0,3")),
        f"{HERE}:5: '0,1' is not a number; decimals follow a point",
    ),
    "absurd": (
        lambda s: edit(file_of(s), replaced(5, "F 0.1 1e200 0.2")),
        f"{HERE}:5: radiance 1e+200 is beyond any that a camera measures",
    ),
    "compressed": (
        lambda s: file_of(s).write_bytes(gzip.compress(file_of(s).read_bytes(), mtime=0)),
        "the line 'Exposure a b c' is missing: is it a file of the published layout?",
    ),
    "a folder": (
        folder_instead,
        f"{HERE}: cannot be read: Is a directory",
    ),
    "no exposure": (
        lambda s: edit(file_of(s), replaced(1, "Exposure")),
        f"{HERE}:1: the exposure times are missing",
    ),
    "another scan's exposures": (
        lambda s: edit(file_of(s), replaced(1, "Exposure 1.000000")),
        "camera2_allexposures.txt:1: exposures (0.2, 4.0, 32.0) differ from the other cameras' "
        "(1.0,) ms; is it a file of another scan?",
    ),
    "no files": (
        no_files,
        "red_paint: holds no scan file in tvBrdf-data/, such as scan01_brdf_camera1",
    ),
    "three lines of constants": (
        lambda s: (s / "tvBrdf-calibration.txt").write_text("1 1 1\n" * 3),
        "tvBrdf-calibration.txt: has 3 lines instead of 4, one a camera (B, G, R each)",
    ),
    "a constant of 0": (
        lambda s: (s / "tvBrdf-calibration.txt").write_text("1 1 1\n" * 3 + "1 0 1\n"),
        "tvBrdf-calibration.txt:4: 0 is not positive: radiances are divided by it",
    ),
    "too many fits": (
        lambda s: write_fits(s, np.ones((2, 6))),
        "brdf-params.txt: has 2 lines for 1 fitted scans; correct the file or remove it",
    ),
    "scans that are not listed": (
        lambda s: (s / "tvBrdf-info.txt").write_text("Sample x (y)\nExposure 1.0\nScans 0\n"),
        "tvBrdf-info.txt: lists scans [], but tvBrdf-data/ has files of [1]; correct the list",
    ),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_file_is_named_with_what_to_do(fit: Fit, sample: Path, kind: str) -> None:
    damage, message = BROKEN[kind]
    damage(sample)
    ended = fit(sample, "--no-pictures", "--json")
    assert message in ended.error
    assert str(sample) in ended.error
    assert ended.out == ""


ODD: dict[str, tuple[Callable[[Path], object], str]] = {
    "cut between groups": (
        lambda s: edit(file_of(s, 2), lambda lines: lines[: 1 + 3 * 100]),
        "camera 2 has no light positions after 10.0°, the other cameras have",
    ),
    "camera missing": (lambda s: file_of(s, 3).unlink(), "there is no file of camera 3"),
    "misnamed": (
        lambda s: file_of(s, 3).rename(s / "tvBrdf-data" / "scan1_brdf_camera3_allexposures.txt"),
        "scan1_brdf_camera3_allexposures.txt in tvBrdf-data is not read: scan files are named",
    ),
    "twice": (
        lambda s: edit(file_of(s, 4), lambda lines: lines + lines[1:]),
        "camera 4 has 168 light positions twice",
    ),
    "copied": (
        lambda s: shutil.copyfile(file_of(s, 2), file_of(s, 3)),
        "cameras 2 and 3 have the same view direction: is one file a copy of the other?",
    ),
    "one camera R, G, B": (
        lambda s: edit(file_of(s, 2), reversed_colours),
        "camera 2 agrees with the others if its channels are R, G, B",
    ),
    "all cameras R, G, B, but fits": (
        lambda s: (reverse_all(s), write_fits(s, [PAINT])),
        "Kd in brdf-params.txt agrees with the radiances if its channels are R, G, B",
    ),
    "all cameras R, G, B, but a name": (
        reverse_all,
        "the sample's name 'red_paint' says red, but blue is",
    ),
    "dead channel": (
        lambda s: edit(
            file_of(s, 2),
            lambda lines: [
                f"F {x.split()[1]} 0.0 {x.split()[3]}" if x[0] == "F" else x for x in lines
            ],
        ),
        "camera 2 has no radiance above 0 in channel g: is it dead?",
    ),
}


@pytest.mark.parametrize("kind", ODD)
def test_what_is_odd_is_told_and_counts_if_asked(fit: Fit, sample: Path, kind: str) -> None:
    change, remark = ODD[kind]
    change(sample)
    ended = fit(sample, "--no-pictures")
    assert (ended.status, ended.err) == (0, "")
    assert f"! {remark}" in " ".join(ended.out.split())
    strict = fit(sample, "--no-pictures", "--strict", "--json")
    assert strict.status == 1
    (found,) = strict.json()["samples"]
    assert any(remark in text for text in [*found["remarks"], *found["scans"][0]["remarks"]])


def test_a_broken_scan_does_not_keep_the_others_from_being_fitted(fit: Fit, tmp_path: Path) -> None:
    sample = write_sample(tmp_path / "paints" / "sample01", scans=3)
    write_sample(tmp_path / "paints" / "sample02")
    edit(file_of(sample, 4, scan=2), lambda lines: lines[:-1])
    ended = fit(tmp_path / "paints", "--no-pictures")
    assert "scan02_brdf_camera4_allexposures.txt:504: the file is truncated" in ended.error
    assert "sample01: 2 scans fitted" in ended.out
    assert ended.out.index("sample01:") < ended.out.index("sample02,")
    assert fit(tmp_path / "paints", "--no-pictures", "--json").status == 1
