"""Scans of an earlier run that were stored and not fitted, inside one process."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tvbrdf_fitting import fit_scan
from tvbrdf_fitting.published.database import StoredSample, read_database
from tvbrdf_fitting.published.observations import stored_observations
from tvbrdf_launch.testing.inprocess import InProcessRun
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Stored
from tvbrdf_nodes.database_writer.conversion import fit_record, scan_record
from tvbrdf_nodes.database_writer.store import DatabaseStore

if TYPE_CHECKING:
    from conftest import Run, RunRig


def sample_in(database: Path) -> StoredSample:
    (sample,) = read_database(database).samples
    return sample


def test_what_was_not_fitted_is_fitted_as_if_it_had_been(run_rig: RunRig, tmp_path: Path) -> None:
    """The second of three scans, in a run that then measures a fourth."""
    first = run_rig(scans=3, exposures_ms=[0.2, 4.0])
    database = tmp_path / "db"
    with DatabaseStore(database, "drying_paint") as store:
        for radiance in first.radiance:
            store.store_scan(scan_record(radiance))
        for parameters in first.parameters:
            if parameters.scan != 2:
                store.store_parameters(fit_record(parameters))
    run = run_rig(scans=4, exposures_ms=[0.2, 4.0], database=database, resume=True)
    assert run.exit is not None
    assert run.exit.code == 0
    assert sorted(found.scan for found in run.parameters) == [2, 4]
    sample = sample_in(database)
    assert sample.notes == ()
    for scan, live in zip(sample.scans, first.parameters, strict=False):
        assert scan.fit is not None
        np.testing.assert_array_equal(scan.fit.values, live.values)
        np.testing.assert_array_equal(scan.fit.covariance, live.covariance)
        observations, common = stored_observations(scan)
        offline = fit_scan(observations, common_errors=common)
        np.testing.assert_array_equal(scan.fit.values, offline.values)


def test_a_scan_that_comes_twice_before_it_is_stored_is_fitted_once(record: Run) -> None:
    """From the merger, which keeps it, and from the database, after a restart of either."""
    (envelope,) = (e for e in record.messages if e.topic == "/scan/radiance")
    with InProcessRun(record.graph, ["fitter"]) as run:

        def take(*envelopes: Envelope) -> list[int]:
            before = len(run.published("/scan/parameters"))
            run.feed(envelopes)
            return [fit.scan for fit in run.published("/scan/parameters")[before:]]

        def stored(scan: int) -> Envelope:
            message = Stored(sample="x", scan=scan, what="parameters")
            return envelope._replace(topic="/scan/stored", message=message)

        assert take(envelope) == [1]
        assert take(envelope, stored(2), envelope) == []
        # once it is stored, who sends it again means it: a replay that begins anew
        assert take(stored(1), envelope) == [1]
