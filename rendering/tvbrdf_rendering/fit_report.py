"""What came out of fitting one or more scans of a sample: trends, pictures, and all of it as JSON.

The command line prints the tables; here is what they and the pictures have in common.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tvbrdf_fitting.error_measures import ErrorMeasures, pool
from tvbrdf_fitting.models import get_model
from tvbrdf_fitting.observations import Observations
from tvbrdf_fitting.published import write_atomically
from tvbrdf_fitting.published.database import StoredFit, StoredSample, StoredScan
from tvbrdf_fitting.result import FitResult

from .trend import Trend, trend_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tvbrdf_fitting.choice.choose import ModelChoice

DataSource = Literal["frames", "grid"]
_UNTIMED_LIMIT = 180
_NUMBERED_CHANNEL = re.compile(r"(.+)_([bgr])_(\d+)")


@dataclass(frozen=True, eq=False)
class FittedScan:
    """One scan of a sample with its fit.

    Attributes
    ----------
    scan, time_s
        Number, and seconds since t = 0 where that is known.
    exposures_ms
        Of its sweeps.
    observations, source
        What was fitted: "frames" as they were measured, or the published "grid" of light positions
        with a noise that was estimated from it.
    fit, choice
        The result, and how its model was chosen if it was.
    remarks
        What is suspicious in its files.
    """

    scan: int
    time_s: float | None
    exposures_ms: tuple[float, ...]
    observations: Observations
    source: DataSource
    fit: FitResult
    choice: ModelChoice | None = None
    remarks: tuple[str, ...] = ()

    @property
    def relative_noise(self) -> float:
        """Median of the values' deviations by their median."""
        usable = self.observations.usable
        deviation = np.sqrt(self.observations.variance[usable])
        middle = float(np.median(self.observations.radiance[usable]))
        return float(np.median(deviation)) / middle if middle > 0 else math.nan

    def as_dict(self) -> dict[str, Any]:
        """Everything but the observations as plain Python types (valid JSON)."""
        usable = self.observations.usable
        return {
            "scan": self.scan,
            "time_s": self.time_s,
            "exposures_ms": list(self.exposures_ms),
            "cameras": np.unique(self.observations.camera).tolist(),
            "rows": int(usable.any(axis=1).sum()),
            "values": int(usable.sum()),
            "source": self.source,
            "relative_noise": _finite(self.relative_noise),
            "remarks": list(self.remarks),
            "fit": self.fit.as_dict(),
            "choice": None if self.choice is None else _choice_as_dict(self.choice),
        }


def _choice_as_dict(choice: ModelChoice) -> dict[str, Any]:
    plain = choice.as_dict()
    plain.pop("result")  # it is the fit
    return plain


@dataclass(frozen=True, eq=False)
class FittedSample:
    """A sample with its fitted scans, in order.

    Attributes
    ----------
    name, process, folder
        Which.
    scans
        Those that could be read and fitted.
    remarks
        What is suspicious in the sample as a whole.
    failures
        Why other scans could not, one line each.
    """

    name: str
    process: str
    folder: Path
    scans: tuple[FittedScan, ...]
    remarks: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()

    @property
    def all_remarks(self) -> tuple[str, ...]:
        """The sample's and, with their number where there are several, the scans' remarks."""
        one = len(self.scans) == 1
        own = [
            remark if one else f"scan {scan.scan}: {remark}"
            for scan in self.scans
            for remark in scan.remarks
        ]
        return (*self.remarks, *own)

    @property
    def pooled_errors(self) -> ErrorMeasures | None:
        """Error measures of all scans together."""
        return pool([scan.fit.errors for scan in self.scans]) if self.scans else None

    @property
    def has_times(self) -> bool:
        """Whether the time of every scan is known."""
        return all(scan.time_s is not None for scan in self.scans)

    def as_dict(self) -> dict[str, Any]:
        """Everything as plain Python types (valid JSON)."""
        pooled = self.pooled_errors
        return {
            "sample": self.name,
            "process": self.process,
            "folder": str(self.folder),
            "remarks": list(self.remarks),
            "failures": list(self.failures),
            "pooled_errors": None if pooled is None else pooled.as_dict(),
            "trends": [trend.as_dict() for trend in trends(self)],
            "scans": [scan.as_dict() for scan in self.scans],
        }


def trends(sample: FittedSample) -> tuple[Trend, ...]:
    """Return the trend of every parameter that is not fixed; none if the models differ."""
    models = {scan.fit.model for scan in sample.scans}
    if len(models) != 1 or len(sample.scans) < 2:
        return ()
    model = get_model(models.pop())
    fixed = set(sample.scans[0].fit.fixed)
    return tuple(
        _trend(sample, parameter.name, parameter.unit)
        for parameter in model.parameters
        if parameter.name not in fixed
    )


def _trend(sample: FittedSample, name: str, unit: str) -> Trend:
    rows = []
    for scan in sample.scans:
        fit = scan.fit
        index = fit.index(name)
        deviation = math.sqrt(max(float(fit.covariance_random[index, index]), 0.0))
        time = scan.time_s / 60 if sample.has_times and scan.time_s is not None else scan.scan
        if name not in fit.undetermined + fit.at_bound and deviation > 0:
            rows.append((float(time), fit.value(name), deviation))
    return trend_of(name, unit, rows, per="min" if sample.has_times else "scan")


def pictured(sample: FittedSample) -> tuple[FittedScan, ...]:
    """First, middle and last scan."""
    count = len(sample.scans)
    chosen = sorted({0, (count - 1) // 2, count - 1}) if count else []
    return tuple(sample.scans[index] for index in chosen)


def write_pictures(
    sample: FittedSample,
    out_dir: Path | str,
    *,
    axis: Literal["auto", "linear", "log"] = "auto",
) -> dict[str, Path]:
    """Draw the first, middle and last scan, and the parameters in time if there are several.

    Parameters
    ----------
    sample
        With its fits.
    out_dir
        Folder, made if it is not there.
    axis
        Of radiance, see `fit_curves.fit_curves_figure`.

    Returns
    -------
    dict
        The files by what they are: ``scan01/curves``, ``scan01/lobe``, ``scan01/blind`` (where the
        measured directions say nothing), …, ``parameters``.
    """
    from .blind_map import draw_blind_map
    from .fit_curves import plot_fit_curves
    from .lobe import plot_lobe
    from .style import save

    out_dir = Path(out_dir)
    out_dir.mkdir(parents=True, exist_ok=True)
    written: dict[str, Path] = {}
    for scan in pictured(sample):
        name = f"scan{scan.scan:02d}"
        title = picture_title(sample, scan)
        curves, lobe = out_dir / f"{name}_curves.png", out_dir / f"{name}_lobe.png"
        written[f"{name}/curves"] = plot_fit_curves(
            scan.observations, scan.fit, curves, title=title, axis=axis
        )
        written[f"{name}/lobe"] = plot_lobe(scan.observations, scan.fit, lobe, title=title)
        if get_model(scan.fit.model).isotropic:
            blind = out_dir / f"{name}_blind.png"
            fits = scan.choice or scan.fit
            written[f"{name}/blind"] = draw_blind_map(fits, scan.observations, blind)
    if len(sample.scans) > 1 and len({scan.fit.model for scan in sample.scans}) == 1:
        written["parameters"] = save(parameters_in_time(sample), out_dir / "parameters.png")
    return written


def picture_title(sample: FittedSample, scan: FittedScan) -> str:
    """Sample, scan and model on one line, how well it fits on the next."""
    errors = scan.fit.errors
    log = f", RMS of the log ratio {errors.rms_log:.3g}" if errors.log_count else ""
    peak = f"RMS {errors.rms_percent:.3g} % of the peak, {100 * errors.rms_over_mean:.3g} % of the"
    return f"{sample.name}, scan {scan.scan}: {scan.fit.model}\n{peak} mean{log}"


def parameters_in_time(sample: FittedSample) -> Figure:
    """Draw the parameters of a sample's scans with their deviations, over time or scan number."""
    from .parameters import parameters_figure

    figure = parameters_figure(as_stored(sample))
    if not sample.has_times:
        for axes in figure.axes:
            if axes.get_xlabel():
                axes.set_xlabel("scan")
    return figure


def as_stored(sample: FittedSample) -> StoredSample:
    """Return the sample as a database would have it; without times, scans count as seconds."""
    # times of many scans would be shown in hours: then a scan counts as one
    last = max((scan.scan for scan in sample.scans), default=0)
    step = 1.0 if last <= _UNTIMED_LIMIT else 3600.0
    return StoredSample(
        name=sample.name,
        process=sample.process,
        run_id="",
        folder=sample.folder,
        scans=tuple(
            StoredScan(
                folder=sample.folder,
                scan=scan.scan,
                start_stamp_ns=0,
                time_s=scan.scan * step
                if scan.time_s is None or not sample.has_times
                else scan.time_s,
                exposures_ms=scan.exposures_ms,
                quality={},
                fit=_stored_fit(scan.fit),
            )
            for scan in sample.scans
        ),
        missing=(),
        notes=(),
    )


def _stored_fit(fit: FitResult) -> StoredFit:
    """Return a fit as a database would have it, without what was fixed."""

    def renamed(names: Sequence[str]) -> tuple[str, ...]:
        # a second lobe's ks_b_2 as ks_2_b: channels of a parameter are found by their ending
        return tuple(_NUMBERED_CHANNEL.sub(r"\1_\3_\2", name) for name in names)

    kept = [i for i, name in enumerate(fit.parameter_names) if name not in fit.fixed]
    return StoredFit(
        model=fit.model,
        parameter_names=renamed([fit.parameter_names[i] for i in kept]),
        values=fit.values[kept],
        standard_deviations=fit.standard_deviations[kept],
        covariance=fit.covariance[np.ix_(kept, kept)],
        errors=fit.errors.as_dict(),
        solver=fit.solver,
        reason=fit.reason,
        evaluations=fit.evaluations,
        solve_time_ms=1e3 * fit.solve_time_s,
        at_bound=renamed(fit.at_bound),
        undetermined=renamed(fit.undetermined),
        details={"metric": fit.metric, "loss": fit.loss},
    )


def write_fits(path: Path | str, content: Any) -> Path:
    """Write what `FittedSample.as_dict` gives, or a list of it, as JSON, whole or not at all."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False)
    write_atomically(path, f"{text}\n".encode())
    return path


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
