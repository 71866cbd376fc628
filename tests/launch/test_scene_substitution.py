"""``$(scene KEY)``: what a launch file of a simulated rig takes from the scene."""

from __future__ import annotations

from pathlib import Path

import pytest

from tvbrdf_launch.errors import LaunchError
from tvbrdf_launch.find_files import find_launch_file
from tvbrdf_launch.launch_file import load_launch_file
from tvbrdf_launch.plan import make_plan

RUN = Path("/run/t/1")


def corrects(name: str, **arguments: str) -> object:
    """Return whether the merger of a shipped launch file takes out motion blur."""
    launch = load_launch_file(find_launch_file(name), arguments, RUN)
    return make_plan(launch, RUN).graph.find("hdr_merger").parameters["correct_motion_blur"]


@pytest.mark.parametrize(
    ("effects", "blurred"),
    [
        ("realistic", True),
        ("ideal", False),
        ("camera: {motion_blur: true}", True),
        ("camera: {shot_noise: true}", False),
        ("{}", False),
    ],
)
def test_motion_blur_is_taken_out_where_there_is_some(
    tmp_path: Path, effects: str, blurred: bool
) -> None:
    if ":" in effects or "{" in effects:
        path = tmp_path / "effects.yaml"
        path.write_text(effects)
        effects = str(path)
    assert corrects("simulated_rig", effects=effects) is blurred
    # unless it is said otherwise
    for said in (True, False):
        given = {"effects": effects, "correct_motion_blur": str(said).lower()}
        assert corrects("simulated_rig", **given) is said


def test_real_frames_are_always_blurred() -> None:
    calibration = str(find_launch_file("simulated_rig").with_name("calibration.yaml"))
    cameras = {f"camera_{number}": str(number) for number in range(1, 5)}
    assert corrects("rig", sample="paint", calibration=calibration, **cameras) is True


ARGUMENTS = "arguments:\n  sample: {default: drying_paint}\n  effects: {default: ideal}\n"


@pytest.mark.parametrize(
    ("head", "value", "text"),
    [
        (ARGUMENTS, "$(scene camera.blur)", "a scene has no 'camera.blur', such as"),
        (ARGUMENTS, "$(scene camera.motion_blur.x)", "a scene has no 'camera.motion_blur.x'"),
        (ARGUMENTS, "$(scene)", r"unknown substitution \$\(scene\); there are .*\$\(scene KEY\)"),
        (ARGUMENTS.replace("ideal", "nice"), "$(scene seed)", "nice.* one of: ideal, realistic"),
        ("", "$(scene seed)", "no argument 'sample'"),
    ],
)
def test_what_a_scene_has_not_is_told(tmp_path: Path, head: str, value: str, text: str) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(f"{head}nodes:\n  - name: one\n    node: fitter\n    when: {value}\n")
    line = path.read_text().count("\n")
    with pytest.raises(LaunchError, match=rf"rig\.yaml:{line}: .*{text}"):
        load_launch_file(path, {}, RUN)
