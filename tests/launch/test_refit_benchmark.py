"""The benchmark of refits, small: it runs, and its figures go together."""

from __future__ import annotations

import pytest

from benchmarks import refit


@pytest.mark.slow
def test_figures_of_a_small_run(capsys: pytest.CaptureFixture[str]) -> None:
    found = refit.main(samples=2, scans=5, bag_scans=1, pixels=16, jobs=1)
    radiance, frames = found["radiance"], found["frames"]
    assert (radiance["scans"], frames["scans"]) == (5, 1)
    assert radiance["ms_per_scan_and_core"] == pytest.approx(1e3 / radiance["scans_per_s"])
    assert 0 < radiance["fit_scan_ms"] < radiance["ms_per_scan_and_core"]
    assert frames["times_real"] == pytest.approx(36.0 / frames["s_per_scan"])
    text = capsys.readouterr().out
    assert "(target: above 500)" in text
    assert "(target: at least 20)" in text
