"""Devices that fail as the scene says, in a whole rig: the run copes, or says which and stops."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
import yaml

if TYPE_CHECKING:
    from tests.system.conftest import Rig

pytestmark = pytest.mark.system

MIDWAY = {"at_sweep": 1, "fraction": 0.4}


def launch(
    rig: Rig,
    *,
    arm: tuple[dict[str, Any], ...] = (),
    camera: tuple[dict[str, Any], ...] = (),
    **arguments: Any,
) -> int:
    """Run a rig with faults of its arm or camera; return the exit status."""
    effects = {"arm": {"faults": list(arm)}, "camera": {"faults": list(camera)}}
    path = rig.folder / "effects.yaml"
    path.write_text(yaml.safe_dump(effects))
    rig.launch(effects=path, **arguments)
    status = rig.wait()
    rig.expect_nothing_left()
    return status


@pytest.mark.parametrize("kind", ["drop", "reorder", "stop"])
def test_a_camera_that_loses_frames_once_is_asked_again(rig: Rig, kind: str) -> None:
    fault = {"kind": kind, "camera": 3, "scan": 1, "sweep": 1, "attempt": 1, "frame": 20}
    assert launch(rig, camera=(fault,), interval_s=40) == 0, rig.text()  # time for a retake
    sample = rig.expect_whole_database()
    assert [scan.scan for scan in sample.scans] == [1, 2], rig.text()
    assert "sweep 2: camera_3: " in rig.text()
    assert "camera_3 failed" not in rig.text()


def test_a_camera_that_always_loses_frames_costs_the_scan_with_the_reason(rig: Rig) -> None:
    fault = {"kind": "drop", "camera": 2, "scan": 1, "frame": 15, "count": 4}
    assert launch(rig, camera=(fault,)) == 0, rig.text()
    sample = rig.expect_whole_database()
    assert [scan.scan for scan in sample.scans] == [2]
    (missing,) = sample.missing
    assert "camera_2" in missing.reason


@pytest.mark.parametrize("kind", ["garbage", "wrong_checksum", "lost_bytes"])
def test_a_few_broken_lines_from_the_arm_do_no_harm(rig: Rig, kind: str) -> None:
    assert launch(rig, arm=({"kind": kind, "count": 3, **MIDWAY},)) == 0, rig.text()
    assert [scan.scan for scan in rig.expect_whole_database().scans] == [1, 2], rig.text()


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("silent", "its controller has stopped answering"),
        ("unplug", "the arm's port is gone"),
        ("stall", "the motor stalled"),
    ],
)
def test_an_arm_that_is_gone_for_good_ends_the_run_by_name(rig: Rig, kind: str, said: str) -> None:
    assert launch(rig, arm=({"kind": kind, **MIDWAY},)) == 1, rig.text()
    text = rig.text()
    # which the sequencer hears first, the broken sweep or the end of the arm's node, is chance
    first = next(line for line in text.splitlines() if line.startswith("sequencer: warning: "))
    starts = ("sequencer: warning: scan 1 sweep 1: arm: ", "sequencer: warning: arm is gone")
    assert first.startswith(starts)
    assert said in text
    assert "Traceback" not in text
    assert text.count("tvbrdf: error: ") == 1
    assert rig.sample().scans == ()
    for missing in rig.sample().missing:
        assert missing.reason


def test_an_arm_that_is_unplugged_for_a_moment_goes_on(rig: Rig) -> None:
    # idle simulated time runs 20 times as fast as the restart: leave it a long slot
    status = launch(rig, arm=({"kind": "unplug", "for_s": 0.5, **MIDWAY},), interval_s=120)
    assert status == 0, rig.text()
    sample = rig.expect_whole_database()
    assert sample.scans, rig.text()
