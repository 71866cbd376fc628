"""The result of a measurement as a table: parameters with uncertainty, error measures, truth."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from statistics import median
from typing import Any

from tvbrdf_fitting.error_measures import ErrorMeasures, pool
from tvbrdf_fitting.published import write_atomically
from tvbrdf_fitting.published.database import StoredDatabase, StoredFit, StoredSample, read_database

from .truth import Truth, read_truth

ERROR_HEADINGS = {
    "rms_percent": "RMS/peak %",
    "rms_absolute": "RMS",
    "rms_over_mean": "RMS/mean",
    "rms_b": "RMS b",
    "rms_g": "RMS g",
    "rms_r": "RMS r",
    "rms_log": "RMS log",
    "largest": "peak",
    "mean": "mean",
    "count": "values",
    "chi_square_per_degree": "chi2/dof",
    "model_error_std": "model err",
    "log_count": "in log",
    "log_dropped_grazing": "-grazing",
    "log_dropped_measured": "-dark",
    "log_dropped_predicted": "-dark fit",
}
"""Columns of the table of errors; other measures follow under their own names in the JSON."""

HEADINGS = {"inverse_sigma_s": "1/sigma_s"}
"""Columns of the table of parameters that have another name there."""

LEGEND = """\
Parameters: published units (sigma_d and sigma_s in radians), channels b g r;
  value ± standard deviation; * ended at a bound, ? not determined by the data.
  truth: what the simulation used; in brackets (measured - truth) / standard deviation.
Errors: of the radiance pi BRDF cos(theta_i), all cameras, lights and channels. RMS/peak: by the
  scan's largest value; RMS/mean: by its mean; RMS log: of ln(fit / measured), over values > 1e-4
  and angles < 80 degrees only; -grazing, -dark, -dark fit: values that it left out.
  chi2/dof: weighted by the stated noise; far above 1, the model or the noise is wrong. model err:
  standard deviation that was added to the noise of each value because the model can't explain
  the data without; deviations of parameters then say how well its best values are defined.
"""


@dataclass(frozen=True)
class ParameterValue:
    """One fitted parameter; None where it is not known."""

    value: float | None
    standard_deviation: float | None
    truth: float | None
    at_bound: bool
    undetermined: bool


@dataclass(frozen=True)
class SummaryRow:
    """One scan of a sample: measured and fitted, measured only, or missing."""

    sample: str
    scan: int
    state: str
    """``fitted``, ``unfitted`` or ``missing``."""
    time_s: float | None
    model: str
    parameters: dict[str, ParameterValue]
    errors: dict[str, float | int | None]
    solver: str
    reason: str
    """Why the solver stopped, or why the scan is missing."""
    solve_time_ms: float | None


def summary_table(database: StoredDatabase) -> list[SummaryRow]:
    """One row for each scan of each sample, in order."""
    truth = read_truth(database.path)
    rows = []
    for sample in database.samples:
        of_sample = [
            _fitted_row(sample.name, scan.scan, scan.time_s, scan.fit, truth)
            for scan in sample.scans
        ]
        of_sample += [
            SummaryRow(
                sample.name, lost.scan, "missing", lost.time_s, "", {}, {}, "", lost.reason, None
            )
            for lost in sample.missing
        ]
        rows += sorted(of_sample, key=lambda row: row.scan)
    return rows


def _fitted_row(
    sample: str, scan: int, time_s: float, fit: StoredFit | None, truth: Truth
) -> SummaryRow:
    if fit is None:
        return SummaryRow(sample, scan, "unfitted", time_s, "", {}, {}, "", "", None)
    parameters = {
        name: ParameterValue(
            value=_finite(fit.values[index]),
            standard_deviation=_finite(fit.standard_deviations[index]),
            truth=truth.of(scan, name),
            at_bound=name in fit.at_bound,
            undetermined=name in fit.undetermined,
        )
        for index, name in enumerate(fit.parameter_names)
    }
    return SummaryRow(
        sample,
        scan,
        "fitted",
        time_s,
        fit.model,
        parameters,
        fit.errors,
        fit.solver,
        fit.reason,
        fit.solve_time_ms,
    )


def pooled_errors(rows: Sequence[SummaryRow]) -> dict[str, float | int | None]:
    """Error measures of all fitted scans together; empty if none has all measures."""
    names = {field.name for field in fields(ErrorMeasures)}
    measures = []
    for row in rows:
        if row.errors.keys() >= names - {"scans"}:
            known = {name: row.errors[name] for name in names & row.errors.keys()}
            filled = {name: math.nan if value is None else value for name, value in known.items()}
            measures.append(ErrorMeasures(**filled))  # type: ignore[arg-type]
    return pool(measures).as_dict() if measures else {}


def format_summary(database: StoredDatabase) -> str:
    """Return the tables of all samples as text."""
    rows = summary_table(database)
    parts = [
        _format_sample(sample, [row for row in rows if row.sample == sample.name])
        for sample in database.samples
    ]
    return "\n".join([*parts, LEGEND])


def summary_as_json(database: StoredDatabase) -> dict[str, Any]:
    """Return what :func:`format_summary` shows, and what has no room there, as plain types."""
    rows = summary_table(database)
    samples = []
    for sample in database.samples:
        own = [row for row in rows if row.sample == sample.name]
        samples.append(
            {
                "sample": sample.name,
                "process": sample.process,
                "pooled_errors": pooled_errors(own),
                "notes": [
                    {"stamp_ns": note.stamp_ns, "text": note.text, "zero": note.zero}
                    for note in sample.notes
                ],
                "scans": [_row_as_json(row) for row in own],
            }
        )
    return {"samples": samples}


def write_summary(
    path: Path | str, database: StoredDatabase | Path | str, *, json_path: Path | str | None = None
) -> Path:
    """Write the tables of a database as text, and as JSON beside (``summary.json``).

    Parameters
    ----------
    path
        The text file to write.
    database
        A database, or the path of one.
    json_path
        Where the JSON goes; by default ``path`` with the ending ``.json``.

    Returns
    -------
    Path
        The JSON file.
    """
    path = Path(path)
    json_path = path.with_suffix(".json") if json_path is None else Path(json_path)
    if not isinstance(database, StoredDatabase):
        database = read_database(database)
    write_atomically(path, format_summary(database).encode())
    text = json.dumps(summary_as_json(database), indent=2, allow_nan=False)
    write_atomically(json_path, f"{text}\n".encode())
    return json_path


def _row_as_json(row: SummaryRow) -> dict[str, Any]:
    plain = {field.name: getattr(row, field.name) for field in fields(SummaryRow)}
    plain["parameters"] = {name: vars(value) for name, value in row.parameters.items()}
    plain["errors"] = {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in row.errors.items()
    }
    return plain


def _format_sample(sample: StoredSample, rows: list[SummaryRow]) -> str:
    fitted = [row for row in rows if row.state == "fitted"]
    missing = [row for row in rows if row.state == "missing"]
    process = f" ({sample.process})" if sample.process else ""
    counts = f"{len(sample.scans)} scans measured, {len(fitted)} fitted, {len(missing)} missing"
    lines = [f"Sample {sample.name}{process}: {counts}"]
    if fitted:
        lines += [f"Model {fitted[0].model}", "", *_parameter_lines(rows, fitted)]
        lines += ["", *_error_lines(fitted)]
    lines += [""] if missing else []
    lines += [f"Scan {row.scan} is missing: {row.reason}" for row in missing]
    lines += [""] if sample.notes else []
    lines += [f"Note: {note.text}" for note in sample.notes]
    return "\n".join([*lines, ""])


def _parameter_lines(rows: list[SummaryRow], fitted: list[SummaryRow]) -> list[str]:
    names = list(fitted[0].parameters)
    table = [["scan", "time/min", *(HEADINGS.get(name, name) for name in names)]]
    decimals = {name: _column_decimals(fitted, name) for name in names}
    for row in rows:
        time = "" if row.time_s is None else f"{row.time_s / 60:.2f}"
        if row.state != "fitted":
            table.append([str(row.scan), time, row.state, *[""] * (len(names) - 1)])
            continue
        values = [row.parameters.get(name) for name in names]
        pairs = [(value, decimals[name]) for name, value in zip(names, values, strict=True)]
        table.append([str(row.scan), time, *(_value_cell(*pair) for pair in pairs)])
        if any(value is not None and value.truth is not None for value in values):
            table.append(["", "truth", *(_truth_cell(*pair) for pair in pairs)])
    return _aligned(table)


def _value_cell(value: ParameterValue | None, decimals: int) -> str:
    if value is None or value.value is None:
        return "-"
    mark = "*" * value.at_bound + "?" * value.undetermined
    if not value.standard_deviation:
        return f"{value.value:.{decimals}f}{mark}"
    return f"{value.value:.{decimals}f} ± {value.standard_deviation:.{decimals}f}{mark}"


def _truth_cell(value: ParameterValue | None, decimals: int) -> str:
    if value is None or value.truth is None:
        return "-"
    if not value.standard_deviation or value.value is None:
        return f"{value.truth:.{decimals}f}"
    deviation = (value.value - value.truth) / value.standard_deviation
    return f"{value.truth:.{decimals}f} ({deviation:+.1f})"


def _column_decimals(fitted: list[SummaryRow], name: str) -> int:
    """Decimals that show two digits of a column's median standard deviation; 4 if it has none."""
    parameters = [row.parameters[name] for row in fitted if name in row.parameters]
    deviations = [value.standard_deviation for value in parameters if value.standard_deviation]
    if not deviations:
        return 4
    return min(max(1 - math.floor(math.log10(median(deviations))), 0), 9)


def _error_lines(fitted: list[SummaryRow]) -> list[str]:
    shown = [_shown_errors(row.errors) for row in fitted]
    names = [name for name in ERROR_HEADINGS if name in shown[0]]
    table = [["scan", *(ERROR_HEADINGS[name] for name in names), "solved in ms", "because"]]
    for row, errors in zip(fitted, shown, strict=True):
        cells = [_error_cell(errors.get(name)) for name in names]
        table.append([str(row.scan), *cells, f"{row.solve_time_ms:.1f}", row.reason])
    pooled = pooled_errors(fitted)
    if pooled:
        table.append(["all", *(_error_cell(pooled.get(name)) for name in names), "", ""])
    return _aligned(table, left={len(names) + 2})


def _shown_errors(errors: dict[str, float | int | None]) -> dict[str, float | int | None]:
    """Error measures with chi-square by its degrees of freedom, where both are there."""
    chi_square, degrees = errors.get("chi_square"), errors.get("degrees_of_freedom")
    if chi_square is None or not degrees:
        return errors
    return errors | {"chi_square_per_degree": chi_square / degrees}


def _error_cell(value: float | int | None) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    return str(value) if isinstance(value, int) else f"{value:#.4g}"


def _aligned(table: list[list[str]], left: set[int] | None = None) -> list[str]:
    """Columns to the right, those in ``left`` to the left."""
    widths = [max(len(row[column]) for row in table) for column in range(len(table[0]))]
    lines = []
    for row in table:
        cells = [
            cell.ljust(width) if column in (left or ()) else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return lines


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
