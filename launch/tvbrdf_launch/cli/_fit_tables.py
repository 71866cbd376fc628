"""The tables of ``tvbrdf fit``: one scan in full, several scans with a line each."""

from __future__ import annotations

import math
import shutil
import textwrap
from collections.abc import Iterable, Sequence
from statistics import median
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tvbrdf_fitting.choice.choose import ModelChoice, Rung
    from tvbrdf_fitting.error_measures import ErrorMeasures
    from tvbrdf_fitting.result import FitResult
    from tvbrdf_rendering.fit_report import FittedSample, FittedScan
    from tvbrdf_rendering.trend import Trend

LARGEST_WIDTH = 110
MARKS = "* ended at a bound, ? not determined by the data, = fixed"
OVER_MODELS = "with how far the models differ that explain the data as well as the chosen one"
ERROR_HEADINGS = (
    ("rms_percent", "RMS/peak %"),
    ("rms_absolute", "RMS"),
    ("rms_over_mean", "RMS/mean"),
    ("rms_b", "RMS b"),
    ("rms_g", "RMS g"),
    ("rms_r", "RMS r"),
    ("rms_log", "RMS log"),
)


def table(rows: Sequence[Sequence[str]], left: Iterable[int] = (0,)) -> list[str]:
    """Rows in columns, numbers to the right; columns in ``left`` to the left."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    texts = {*left}
    return [
        "  ".join(
            cell.ljust(width) if column in texts else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def wrapped(text: str, indent: str = "  ") -> list[str]:
    """Lines of a long text, the second and later ones indented."""
    width = min(shutil.get_terminal_size((LARGEST_WIDTH, 24)).columns, LARGEST_WIDTH)
    return textwrap.wrap(
        text,
        max(width, 60),
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def scan_lines(sample: FittedSample) -> list[str]:
    """All there is to say of a sample's only scan."""
    scan = sample.scans[0]
    fit = scan.fit
    lines = [_title(sample) + f", scan {scan.scan}", *_data_lines(scan)]
    lines += wrapped(f"model {fit.model}, metric {fit.metric}, loss {fit.loss}")
    rows = _parameter_rows(scan)
    lines += ["", *table(rows, left=(0, len(rows[0]) - 2, len(rows[0]) - 1))]
    if scan.choice is not None:
        lines += wrapped(f"± over models: {OVER_MODELS}")
    lines += ["", *_error_lines(scan)]
    lines += ["", *_solver_lines(fit)]
    if scan.choice is not None:
        lines += ["", *choice_lines(scan.choice)]
    return [*lines, *_remark_lines(sample.all_remarks)]


def _title(sample: FittedSample) -> str:
    return f"{sample.name} ({sample.process})" if sample.process else sample.name


def _data_lines(scan: FittedScan) -> list[str]:
    plain = scan.as_dict()
    cameras = " ".join(map(str, plain["cameras"]))
    exposures = " ".join(f"{exposure:g}" for exposure in scan.exposures_ms)
    kind = "frames" if scan.source == "frames" else "light positions of the published grid"
    noise = "stated" if scan.source == "frames" else "estimated from neighbouring lights"
    size = plain["relative_noise"]
    share = "" if size is None else f", {100 * size:.2g} % of the median value"
    return wrapped(
        f"cameras {cameras}, {plain['rows']} {kind}, {plain['values']} values, exposures "
        f"{exposures} ms; noise {noise}{share}"
    )


def _parameter_rows(scan: FittedScan) -> list[list[str]]:
    from tvbrdf_fitting.models import get_model

    fit, choice = scan.fit, scan.choice
    over = [] if choice is None else ["± over models"]
    rows = [["parameter", "value", "± deviation", *over, "unit", "remark"]]
    for index, parameter in enumerate(get_model(fit.model).parameters):
        value, deviation = float(fit.values[index]), float(fit.standard_deviations[index])
        places = decimals(deviation, value)
        shown = f"{value:.{places}f}" if math.isfinite(value) else "-"
        spreads = [deviation] if choice is None else [deviation, choice.standard_deviations[index]]
        unit = "" if parameter.unit == "1" else parameter.unit
        remark = _remark(fit, parameter.name, value)
        rows.append(
            [parameter.name, shown, *(_spread(float(s), places) for s in spreads), unit, remark]
        )
    return rows


def _spread(deviation: float, places: int) -> str:
    return f"{deviation:.{places}f}" if math.isfinite(deviation) and deviation > 0 else "-"


def decimals(deviation: float, value: float = 0.0) -> int:
    """Decimals that show two digits of a deviation; five digits of the value if it has none."""
    if math.isfinite(deviation) and deviation > 0:
        return min(max(1 - math.floor(math.log10(deviation)), 0), 9)
    if math.isfinite(value) and value != 0:
        return min(max(4 - math.floor(math.log10(abs(value))), 0), 9)
    return 4


def _remark(fit: FitResult, name: str, value: float) -> str:
    if name in fit.fixed:
        return "fixed"
    if not math.isfinite(value):
        return "no data in this channel"
    remarks = []
    if name in fit.at_bound:
        index = fit.index(name)
        low, high = fit.internal_bounds[:, index]
        lower = abs(fit.internal_values[index] - low) <= abs(fit.internal_values[index] - high)
        remarks.append(f"at its {'lower' if lower else 'upper'} bound")
    if name in fit.undetermined:
        remarks.append("undetermined: the data say nothing of it")
    if name in fit.tied:
        remarks.append(f"follows {fit.tied[name]}")
    return ", ".join(remarks)


def _error_lines(scan: FittedScan) -> list[str]:
    fit, errors = scan.fit, scan.fit.errors
    rows = [
        ["RMS / peak", percent(errors.rms_percent), f"peak {number(errors.largest)}"],
        ["RMS / mean", percent(100 * errors.rms_over_mean), f"mean {number(errors.mean)}"],
        ["RMS", number(errors.rms_absolute), f"of {errors.count} values of radiance"],
        *_channel_rows(errors),
        ["RMS log", number(errors.rms_log), _log_remark(errors)],
        ["chi2 / dof", _chi_square(fit), f"{fit.degrees_of_freedom} degrees of freedom"],
        ["model error", number(fit.model_error_std), _model_error(fit)],
    ]
    if fit.loss != "least_squares":
        rows.append(["stray", str(fit.down_weighted), "values with less than half their weight"])
    return table(rows, left=(0, 2))


def _channel_rows(errors: ErrorMeasures) -> list[list[str]]:
    channels = (("b", errors.rms_b), ("g", errors.rms_g), ("r", errors.rms_r))
    return [[f"RMS {name}", number(value), ""] for name, value in channels]


def _log_remark(errors: ErrorMeasures) -> str:
    return (
        f"of ln(fitted / measured), {errors.log_count} values; left out: "
        f"{errors.log_dropped_grazing} grazing, {errors.log_dropped_measured} dark, "
        f"{errors.log_dropped_predicted} dark in the fit"
    )


def _chi_square(fit: FitResult) -> str:
    if fit.degrees_of_freedom <= 0:
        return "-"
    return number(fit.chi_square / fit.degrees_of_freedom)


def _model_error(fit: FitResult) -> str:
    if fit.model_error_std <= 0:
        return "noise explains what is left"
    unit = "relative" if fit.metric in {"log", "relative"} else "in radiance"
    return f"{unit}, added to the noise: the model does not explain the data within it"


def number(value: float) -> str:
    """Four digits, or - where there is nothing to say."""
    return f"{value:#.4g}".rstrip(".") if math.isfinite(value) else "-"


def percent(value: float) -> str:
    """Four digits and the sign, or - where there is nothing to say."""
    return f"{number(value)} %" if math.isfinite(value) else "-"


def _solver_lines(fit: FitResult) -> list[str]:
    text = (
        f"solved by {fit.solver} in {1e3 * fit.solve_time_s:.2f} ms with {fit.evaluations} "
        f"evaluations: {fit.reason}"
    )
    return wrapped(text)


def choice_lines(choice: ModelChoice) -> list[str]:
    """Every rung of the ladder, and why it was kept or not."""
    head = ["", "model tried", "parameters", "criterion", "noise", "error", "ms"]
    rows = [head, *(_rung_row(rung) for rung in choice.rungs)]
    lines = wrapped(f"chosen because {choice.reason}")
    lines += ["", *table(rows, left=(0, 1))]
    lines += wrapped(
        "criterion: lower is better; noise: RMS residual in stated deviations; error: in those "
        "that the best rung leaves",
    )
    lines += ["", "not kept"]
    for rung in choice.rungs:
        if rung.rejected:
            lost = f" (undetermined: {', '.join(rung.undetermined)})" if rung.undetermined else ""
            lines += wrapped(f"- {rung.model}: {rung.rejected}{lost}", "    ")
    return lines


def _rung_row(rung: Rung) -> list[str]:
    return [
        "" if rung.rejected else "kept",
        rung.model,
        str(rung.parameters),
        f"{rung.criterion:.1f}" if math.isfinite(rung.criterion) else "-",
        number(rung.noise),
        number(rung.error),
        f"{1e3 * rung.solve_time_s:.1f}",
    ]


def series_lines(sample: FittedSample) -> list[str]:
    """Tables with a line a scan, and how the parameters move."""
    scans = sample.scans
    lines = [f"{_title(sample)}: {len(scans)} scans fitted; scan {scans[0].scan} has"]
    lines += _data_lines(scans[0])
    models = list(dict.fromkeys(scan.fit.model for scan in scans))
    fit = scans[0].fit
    for model in models:
        own = [scan for scan in scans if scan.fit.model == model]
        which = "" if len(models) == 1 else f" (scans {', '.join(str(s.scan) for s in own)})"
        lines += wrapped(f"model {model}{which}, metric {fit.metric}, loss {fit.loss}")
        lines += ["", *table(_series_rows(own), left=()), ""]
    lines += [MARKS]
    if any(scan.choice is not None for scan in scans):
        lines += wrapped(f"deviations {OVER_MODELS}")
    lines += ["", *table(_series_errors(sample), left=())]
    lines += _trend_lines(sample)
    choice = scans[0].choice
    if choice is not None:
        title = "" if len(models) == 1 else f"scan {scans[0].scan}: "
        lines += ["", *(line if i else title + line for i, line in enumerate(choice_lines(choice)))]
    return [*lines, *_remark_lines(sample.all_remarks)]


def _series_rows(scans: Sequence[FittedScan]) -> list[list[str]]:
    names = scans[0].fit.parameter_names
    places = [_column_decimals(scans, index) for index in range(len(names))]
    timed = any(scan.time_s is not None for scan in scans)
    rows = [["scan", *(["time/min"] if timed else []), *names]]
    for scan in scans:
        time = "" if scan.time_s is None else f"{scan.time_s / 60:.2f}"
        cells = [_cell(scan, index, places[index]) for index in range(len(names))]
        rows.append([str(scan.scan), *([time] if timed else []), *cells])
    return rows


def _column_decimals(scans: Sequence[FittedScan], index: int) -> int:
    deviations = [_deviation(scan, index) for scan in scans]
    known = [deviation for deviation in deviations if math.isfinite(deviation) and deviation > 0]
    return decimals(median(known)) if known else 4


def _deviation(scan: FittedScan, index: int) -> float:
    """Return a parameter's standard deviation, over the models where one was chosen."""
    of = scan.fit if scan.choice is None else scan.choice
    return float(of.standard_deviations[index])


def _cell(scan: FittedScan, index: int, places: int) -> str:
    fit = scan.fit
    name, value = fit.parameter_names[index], float(fit.values[index])
    if not math.isfinite(value):
        return "-"
    marks = "*" * (name in fit.at_bound) + "?" * (name in fit.undetermined)
    if name in fit.fixed:
        return f"{value:.{places}f}="
    deviation = _deviation(scan, index)
    spread = f" ± {deviation:.{places}f}" if math.isfinite(deviation) else ""
    return f"{value:.{places}f}{spread}{marks}"


def _series_errors(sample: FittedSample) -> list[list[str]]:
    rows = [["scan", *(h for _, h in ERROR_HEADINGS), "peak", "chi2/dof", "model error", "ms"]]
    for scan in sample.scans:
        fit = scan.fit
        rows.append(
            [
                str(scan.scan),
                *(number(getattr(fit.errors, name)) for name, _ in ERROR_HEADINGS),
                number(fit.errors.largest),
                _chi_square(fit),
                number(fit.model_error_std),
                f"{1e3 * fit.solve_time_s:.1f}",
            ]
        )
    pooled = sample.pooled_errors
    if pooled is not None:
        cells = [number(getattr(pooled, name)) for name, _ in ERROR_HEADINGS]
        rows.append(["all", *cells, number(pooled.largest), "", "", ""])
    return rows


def _trend_lines(sample: FittedSample) -> list[str]:
    from tvbrdf_rendering.fit_report import trends

    found = trends(sample)
    if not found:
        return []
    head = ["trend", "", "first", "last", "mean", f"slope 1/{found[0].per}", "chi2/dof", "scans"]
    rows = [head, *(_trend_row(trend) for trend in found)]
    lines = ["", *table(rows, left=(0, 1))]
    return lines + wrapped(
        "over scans that determine the parameter; chi2/dof of a constant, by the random deviations"
    )


def _trend_row(trend: Trend) -> list[str]:
    if trend.mean is None or trend.mean_deviation is None or trend.slope is None:
        return [trend.name, trend.kind, "", "", "", "", "", str(trend.scans)]
    places = decimals(trend.mean_deviation)
    steep = trend.slope_deviation or math.nan
    fine = decimals(steep)
    return [
        trend.name,
        trend.kind,
        f"{trend.first:.{places}f}",
        f"{trend.last:.{places}f}",
        f"{trend.mean:.{places}f} ± {trend.mean_deviation:.{places}f}"
        if trend.kind == "constant"
        else "",
        f"{trend.slope:+.{fine}f} ± {steep:.{fine}f}",
        number(trend.scatter if trend.scatter is not None else math.nan),
        str(trend.scans),
    ]


def _remark_lines(remarks: Iterable[str]) -> list[str]:
    lines = [line for remark in remarks for line in wrapped(f"! {remark}")]
    return ["", *lines] if lines else []
