"""Databases as a measurement leaves them: real noise, real fits, the real store."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from tvbrdf_fitting.fit import fit_scan
from tvbrdf_fitting.geometry import light_direction, view_direction
from tvbrdf_fitting.observations import Observations
from tvbrdf_fitting.published import CameraScan
from tvbrdf_fitting.time_varying import DryingPaint, SettlingDust, TimeVaryingMaterial
from tvbrdf_nodes.database_writer.store import DatabaseStore, FitRecord, ScanRecord

EXPOSURES_MS = (0.2, 4.0, 32.0)
HIDDEN_DEG = 2.0
"""The arm hides the sample from the top camera within this much of its direction."""

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
DUST = SettlingDust(
    kd=(0.1, 0.2, 0.4),
    w=(0.1, 0.1, 0.11),
    g=0.4,
    tau_per_min=0.05,
    sigma_d=0.2,
    ks=0.6,
    sigma_s=0.12,
    tau_start=0.1,
    attenuation=3.3,
)

MakeDatabase = Callable[..., Path]


def observe(material: TimeVaryingMaterial, time_s: float, noise: float, seed: int) -> Observations:
    """What the rig would see of a material at a moment, every half degree from four cameras."""
    random = np.random.default_rng(seed)
    world_deg = np.arange(-90.0, 90.25, 0.5)
    light = light_direction(world_deg)
    world_deg, light = world_deg[light[:, 2] > 1e-3], light[light[:, 2] > 1e-3]
    parts = []
    for camera, angle_deg in enumerate((0.0, 25.0, 50.0, 75.0), start=1):
        view = np.tile(view_direction(angle_deg), (len(light), 1))
        clean = np.pi * light[:, 2:] * material.brdf(light, view, time_s)
        deviation = noise * np.sqrt(0.05 + clean)
        hidden = (np.abs(world_deg) < HIDDEN_DEG) & (camera == 1)
        parts.append(
            Observations(
                light_direction=light,
                view_direction=view,
                radiance=clean + deviation * random.standard_normal(clean.shape),
                variance=deviation**2,
                valid=np.tile(~hidden[:, None], (1, 3)),
                camera=np.full(len(light), camera),
                sweep=np.zeros(len(light), dtype=int),
                exposure_ms=np.full(len(light), 4.0),
                time_s=np.full(len(light), time_s),
            )
        )
    return Observations.concatenate(parts)


def grid_of(observations: Observations) -> dict[int, CameraScan]:
    grid = {}
    for camera in (1, 2, 3, 4):
        seen = observations.camera == camera
        grid[camera] = CameraScan(
            EXPOSURES_MS,
            observations.light_direction[seen],
            observations.view_direction[seen][0],
            np.where(observations.valid[seen], observations.radiance[seen], np.nan),
        )
    return grid


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
                values = material.parameters_at(time_s)
                true[str(scan)] = {"time_s": time_s, "values": [values[name] for name in names]}
                if scan in missing:
                    store.store_missing(scan, "the arm did not answer", time_s=time_s)
                    continue
                observations = observe(material, time_s, noise, seed=scan)
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
