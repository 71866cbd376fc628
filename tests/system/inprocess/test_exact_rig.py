"""Without noise, the whole rig gives back what the sample is made of."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml

from tvbrdf_fitting.models import get_model
from tvbrdf_fitting.published import read_sample
from tvbrdf_fitting.published.database import read_database
from tvbrdf_nodes.world.sample import make_sample
from tvbrdf_nodes.world.scene import load_scene

if TYPE_CHECKING:
    from pathlib import Path

    from tests.system.inprocess.conftest import MakeSample, Run, RunRig

# Kd B, G, R, sigma_d, Ks, 1/sigma_s
MATERIALS = {
    "matte": (0.50, 0.45, 0.40, 0.50, 0.05, 3.0),
    "satin": (0.10, 0.20, 0.60, 0.30, 0.40, 6.0),
    "glossy": (0.05, 0.05, 0.30, 0.20, 0.90, 20.0),
}
DUST = (0.05, 0.06, 0.40, 0.30, 0.20, 8.0, 0.10, 0.12, 0.13, 0.30, 0.50)
EXACT = 1e-6
"""Frames are float32 here (6e-8), and the sample's table is checked to 2e-7."""
NO_BLUR = {"hdr_merger": {"correct_motion_blur": False}}


def relative_errors(run: Run, truth: dict[str, float]) -> dict[str, float]:
    (found,) = run.parameters
    assert found.at_bound == found.undetermined == ()
    assert found.parameter_names == tuple(truth)
    return {
        name: abs(value / truth[name] - 1.0)
        for name, value in zip(found.parameter_names, found.values, strict=True)
    }


@pytest.mark.parametrize("name", MATERIALS)
def test_every_parameter_is_recovered(
    run_rig: RunRig, constant_sample: MakeSample, name: str
) -> None:
    sample, truth = constant_sample(*MATERIALS[name])
    run = run_rig(sample=sample, effects="ideal", changes=NO_BLUR)
    assert run.exit is not None
    assert run.exit.code == 0
    errors = relative_errors(run, truth)
    assert max(errors.values()) < EXACT, errors


def test_every_parameter_of_dust_is_recovered(run_rig: RunRig, constant_sample: MakeSample) -> None:
    dust = "dust+oren_nayar+torrance_sparrow"
    sample, truth = constant_sample(*DUST, model=dust)
    # all eleven at once: nearly parallel, so the same errors weigh more than with the others fixed
    free = run_rig(sample=sample, effects="ideal", model=dust, changes=NO_BLUR)
    errors = relative_errors(free, truth)
    assert max(errors.values()) < 100 * EXACT, errors
    # and as the paper does: only tau, Ks and sigma_s are not known
    known = {n: v for n, v in truth.items() if n not in ("tau", "ks", "inverse_sigma_s")}
    paper = run_rig(sample=sample, effects="ideal", model=dust, fixed=known, changes=NO_BLUR)
    errors = relative_errors(paper, truth)
    assert max(errors.values()) < EXACT, errors


def test_motion_blur_is_taken_out(
    run_rig: RunRig, constant_sample: MakeSample, tmp_path: Path
) -> None:
    """32 ms at 15°/s: a lobe of 1/sigma_s = 20 would come out 2.4e-4 too wide."""
    blur = tmp_path / "blur.yaml"
    blur.write_text(yaml.safe_dump({"camera": {"motion_blur": True}}))
    sample, truth = constant_sample(*MATERIALS["glossy"])
    wide = relative_errors(run_rig(sample=sample, effects=blur, changes=NO_BLUR), truth)
    assert 2e-4 < wide["inverse_sigma_s"] < 4e-4
    found = relative_errors(run_rig(sample=sample, effects=blur), truth)
    assert found["inverse_sigma_s"] < 0.1 * wide["inverse_sigma_s"]
    assert max(found.values()) < 1e-4, found


def test_a_sample_that_changes_is_followed(run_rig: RunRig) -> None:
    """Drying paint, three scans a minute apart; frozen within each scan."""
    run = run_rig(sample="drying_paint", effects="ideal", scans=3, changes=NO_BLUR)
    sample = make_sample(load_scene("drying_paint", "ideal", 1).sample)
    times = []
    for found in run.parameters:
        truth = sample.truth(found.scan_time_s)
        assert truth is not None
        np.testing.assert_allclose(found.values, truth[2], rtol=EXACT, atol=0)
        times.append(found.scan_time_s)
    assert times == pytest.approx([0.0, 60.0, 120.0], abs=1.0)
    # and the same is in the database
    (stored,) = read_database(run.database).samples
    fits: list[Any] = [scan.fit for scan in stored.scans]
    assert [tuple(fit.values) for fit in fits] == [found.values for found in run.parameters]


def test_the_published_files_hold_what_was_measured(
    run_rig: RunRig, constant_sample: MakeSample
) -> None:
    sample, truth = constant_sample(*MATERIALS["satin"])
    run = run_rig(sample=sample, effects="ideal", changes=NO_BLUR)
    published = read_sample(run.database / "sample01")
    assert published.parameters is not None
    np.testing.assert_allclose(published.parameters, [list(truth.values())], rtol=0, atol=1.5e-6)
    model = get_model("oren_nayar+torrance_sparrow")
    (scan,) = published.scans
    for camera, seen in scan.cameras.items():
        view = np.broadcast_to(seen.view_direction, seen.light_direction.shape)
        brdf = model.evaluate(seen.light_direction, view, list(truth.values()))
        expected = np.pi * brdf * seen.light_direction[:, 2:]
        assert len(expected) == (329 if camera == 1 else 336)
        # six decimals, here and in the directions; between the frames are cubics, beside the gap
        # and the horizon straight lines
        error = np.abs(seen.radiance - expected)
        assert np.median(error) < 1e-6
        assert error.max() < 2e-3
