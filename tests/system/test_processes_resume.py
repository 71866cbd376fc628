"""Scans that were stored and not fitted when processes were killed: they are fitted later, once."""

from __future__ import annotations

import contextlib
import os
import signal
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tvbrdf_fitting import fit_scan
from tvbrdf_fitting.published.database import StoredScan
from tvbrdf_fitting.published.observations import stored_observations
from tvbrdf_messages.messages import Parameters, Stored

if TYPE_CHECKING:
    from tests.system.conftest import Rig

pytestmark = [pytest.mark.system, pytest.mark.slow]

SPEEDUP = 8
"""A sweep then lasts half a second of real time, enough to hit it."""


def stop_fitter_until_stored(rig: Rig, scan: int) -> None:
    """Let the fitter stand still until a scan is on disk, and longer."""
    with rig.watch("/scan/stored") as watcher:
        rig.wait_state("sweeping")
        assert rig.table().nodes["fitter"].send(signal.SIGSTOP)
        rig.until(
            watcher,
            lambda m: isinstance(m, Stored) and (m.what, m.scan) == ("radiance", scan),
        )


def kill_everything(rig: Rig) -> None:
    for pid in rig.processes():
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    rig.wait()
    rig.expect_no_process(5.0)


def fitted_scans(rig: Rig) -> list[int]:
    """Return the scans of all parameters that the run sends to its end, which is good."""
    found: list[int] = []
    with rig.watch("/scan/parameters", "/scan/status") as watcher:

        def finished(message: object) -> bool:
            if isinstance(message, Parameters):
                found.append(message.scan)
            return getattr(message, "state", "") == "finished"

        rig.until(watcher, finished)
    assert rig.wait() == 0, rig.text()
    rig.expect_nothing_left()
    return found


def expect_offline_fit(scan: StoredScan) -> None:
    """What is stored is, bit for bit, what a fit of the stored observations gives."""
    observations, common = stored_observations(scan)
    offline = fit_scan(observations, common_errors=common)
    assert scan.fit is not None
    np.testing.assert_array_equal(scan.fit.values, offline.values)
    np.testing.assert_array_equal(scan.fit.covariance, offline.covariance)
    assert scan.fit.reason == offline.reason


@pytest.mark.parametrize("scans", [2, 3])
def test_scans_that_a_killed_run_had_stored_are_fitted_once(rig: Rig, scans: int) -> None:
    """With the third scan there is something left to measure as well."""
    rig.launch(speedup=SPEEDUP, interval_s=40)
    stop_fitter_until_stored(rig, 2)
    kill_everything(rig)
    before = rig.sample()
    assert [(scan.scan, scan.fit) for scan in before.scans] == [(1, None), (2, None)]
    rig.launch(resume="true", scans=scans, interval_s=40)
    assert fitted_scans(rig) == list(range(1, scans + 1))
    after = rig.expect_whole_database(scans)
    assert (after.notes, after.missing) == ((), ())  # nothing came a second time
    for scan in after.scans:
        expect_offline_fit(scan)
    for old, new in zip(before.scans, after.scans, strict=False):
        assert (old.start_stamp_ns, old.time_s) == (new.start_stamp_ns, new.time_s)
    assert ("arm homing" in rig.text()) == (scans == 3)


def test_a_fitter_that_dies_with_its_merger_gets_the_scan_from_the_database(rig: Rig) -> None:
    rig.launch(speedup=SPEEDUP)
    stop_fitter_until_stored(rig, 1)
    rig.kill("hdr_merger")
    rig.kill("fitter")
    assert sorted(fitted_scans(rig)) == [1, 2]
    sample = rig.expect_whole_database()
    assert (sample.notes, sample.missing) == ((), ())
    for scan in sample.scans:
        expect_offline_fit(scan)


def test_a_restarted_sequencer_takes_no_scan_again(rig: Rig) -> None:
    rig.launch(speedup=SPEEDUP, interval_s=80)
    rig.wait_state("sweeping", scan=2)
    rig.kill("sequencer")
    assert rig.wait() == 0, rig.text()
    rig.expect_nothing_left()
    sample = rig.expect_whole_database()
    assert (sample.notes, sample.missing) == ((), ())
    times = [scan.time_s for scan in sample.scans]
    assert times[0] == 0.0
    assert times[1] >= 80.0
