"""Databases as a measurement leaves them: real noise, real fits, the real store."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import pytest

from tests.rig_scans import EXPOSURES_MS, grid_of, observe
from tvbrdf_fitting.fit import fit_scan
from tvbrdf_fitting.observations import Observations
from tvbrdf_fitting.time_varying import DryingPaint, TimeVaryingMaterial
from tvbrdf_nodes.database_writer.store import DatabaseStore, FitRecord, ScanRecord

PAINT = DryingPaint(
    kd_surface=(0.55, 0.55, 0.5),
    kd_paint=(0.42, 0.14, 0.05),
    ks_wet=1.1,
    ks_dry=0.25,
    sigma_s_wet=0.05,
    sigma_s_dry=0.14,
    rate_per_min=0.25,
    sigma_d=0.35,
    beta_wet=1.0,
    beta_dry=0.85,
)
MakeDatabase = Callable[..., Path]


def store_fit(store: DatabaseStore, scan: int, observations: Observations, model: str) -> None:
    fit = fit_scan(observations, model)
    store.store_parameters(
        FitRecord(
            sample=store.sample_name,
            scan=scan,
            model=fit.model,
            parameter_names=fit.parameter_names,
            values=fit.values,
            standard_deviations=fit.standard_deviations,
            covariance=fit.covariance,
            errors={
                **fit.errors.as_dict(),
                "chi_square": fit.chi_square,
                "degrees_of_freedom": fit.degrees_of_freedom,
            },
            solver=fit.solver,
            reason=fit.reason,
            evaluations=fit.evaluations,
            solve_time_ms=1e3 * fit.solve_time_s,
            at_bound=fit.at_bound,
            undetermined=fit.undetermined,
        )
    )


@pytest.fixture(scope="session")
def make_database(tmp_path_factory: pytest.TempPathFactory) -> MakeDatabase:
    """Return a function that measures, fits and stores a material."""

    def make(
        material: TimeVaryingMaterial = PAINT,
        *,
        scans: int = 5,
        interval_s: float = 120.0,
        noise: float = 0.005,
        missing: tuple[int, ...] = (),
        unfitted: tuple[int, ...] = (),
        truth: bool = True,
        sample: str = "blue_paint",
        process: str = "drying paint",
    ) -> Path:
        path = tmp_path_factory.mktemp("database")
        names = tuple(material.parameters_at(0.0))
        true = {}
        with DatabaseStore(path, sample, process=process) as store:
            for scan in range(1, scans + 1):
                time_s = (scan - 1) * interval_s
                values = list(material.parameters_at(time_s).values())
                true[str(scan)] = {"time_s": time_s, "values": values}
                if scan in missing:
                    store.store_missing(scan, "the arm did not answer", time_s=time_s)
                    continue
                observations = observe(values, material.model, seed=scan, noise=noise)
                store.store_scan(
                    ScanRecord(
                        sample=sample,
                        scan=scan,
                        start_stamp_ns=1_769_851_800_000_000_000 + int(time_s * 1e9),
                        time_s=time_s,
                        exposures_ms=EXPOSURES_MS,
                        grid=grid_of(observations),
                        observations={
                            field.name: getattr(observations, field.name)
                            for field in fields(observations)
                        },
                    )
                )
                if scan not in unfitted:
                    store_fit(store, scan, observations, material.model)
            store.store_note(1_769_851_800_000_000_000, "paint applied", zero=True)
        if truth:
            content = {"parameter_names": names, "scans": true}
            (path / "truth.json").write_text(json.dumps(content))
        return path

    return make
