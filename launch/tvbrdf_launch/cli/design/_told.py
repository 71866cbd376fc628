"""What ``tvbrdf design`` tells: tables for people, and JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from .._common import print_table
from ..model._models import plain

if TYPE_CHECKING:
    from tvbrdf_fitting.design.search import Design, DesignStudy
    from tvbrdf_fitting.design.simulation import Trial


def print_study(study: DesignStudy, trials: Sequence[Trial], source: str) -> None:
    """Print the designs, and what the proposed one knows of each parameter."""
    model = study.information.model
    print(f"{model.name}: {source}\n")
    if study.designs:
        simulated = ("simulated/wanted",) if trials else ()
        print_table([*_design_rows(study, trials)], (*_DESIGN_COLUMNS, *simulated))
        what = "fewest images" + (", as simulated scans confirm" if trials else ", as predicted")
        print(f"* {what}\n" if not trials or trials[-1].reached else "")
    design = trials[-1].design if trials else study.fewest or study.largest
    print(
        f"Cameras: {_listed(design.cameras)}; lights: {design.lights}; "
        f"exposures: {_listed(design.exposures_ms)} ms"
    )
    more = ("simulated", "interval", "simulated/predicted") if trials else ()
    rows = _parameter_rows(study, design, trials[-1] if trials else None)
    print_table([*rows], (*_COLUMNS, *more))
    if trials:
        errors = trials[-1].errors
        print(
            f"simulated: root mean square error of {errors.scans} scans, [95 % interval]"
            + ("; b: at a bound, where errors have one side" if any(errors.at_bound) else "")
        )


_DESIGN_COLUMNS = ("", "cameras", "exposures/ms", "lights", "frames", "images", "time/s",
                   "predicted/wanted")  # fmt: skip
_COLUMNS = ("parameter", "value", "wanted", "predicted")


def _design_rows(study: DesignStudy, trials: Sequence[Trial]) -> Iterator[dict[str, Any]]:
    """Yield designs with the fewest images first; those that were simulated with what came out."""
    simulated = {_key(trial.design): trial for trial in trials}
    designs = {_key(d): d for d in [*study.designs, *(trial.design for trial in trials)]}
    proposed = _proposed(study, trials)
    for key, design in sorted(designs.items(), key=lambda pair: pair[1].images):
        trial = simulated.get(key)
        yield {
            "": "*" if proposed is not None and key == _key(proposed) else "",
            "cameras": _listed(design.cameras),
            "exposures/ms": _listed(design.exposures_ms),
            "lights": design.lights,
            "frames": design.frames,
            "images": design.images,
            "time/s": f"{design.time_s:.3g}",
            "predicted/wanted": f"{design.ratio:.2f}",
            "simulated/wanted": "" if trial is None else f"{_simulated_ratio(study, trial):.2f}",
        }


def _parameter_rows(
    study: DesignStudy, design: Design, trial: Trial | None
) -> Iterator[dict[str, Any]]:
    information = study.information
    for place, name in enumerate(information.model.parameter_names):
        value = float(information.values[place])
        row = {"parameter": name, "value": f"{value:.4g}"}
        if name not in study.wanted:
            yield row | {"wanted": "fixed"}
            continue
        wanted, predicted = study.wanted[name], design.predicted.published[place]
        row["wanted"] = f"{wanted:.2g}" if math.isfinite(wanted) else "any"
        row["predicted"] = f"{predicted:.2g}"
        if trial is not None and math.isfinite(predicted):
            errors = trial.errors
            i = errors.names.index(name)
            row["simulated"] = f"{errors.simulated[i]:.2g}"
            row["interval"] = f"[{errors.low[i]:.2g}, {errors.high[i]:.2g}]"
            ratio = errors.simulated[i] / predicted
            row["simulated/predicted"] = f"{ratio:.2f}{' b' if errors.at_bound[i] else ''}"
        yield row


def _proposed(study: DesignStudy, trials: Sequence[Trial]) -> Design | None:
    """Return the last that was simulated, if it reached the accuracy; without any, the fewest."""
    if not trials:
        return study.fewest
    return trials[-1].design if trials[-1].reached else None


def _simulated_ratio(study: DesignStudy, trial: Trial) -> float:
    pairs = zip(trial.errors.simulated.tolist(), study.wanted.values(), strict=True)
    return max(float(error / allowed) for error, allowed in pairs if math.isfinite(allowed))


def _key(design: Design) -> tuple[Any, ...]:
    return design.cameras, design.exposures_ms, design.lights


def _listed(items: Sequence[float]) -> str:
    return ",".join(f"{item:g}" for item in items)


def as_dict(study: DesignStudy, trials: Sequence[Trial], source: str) -> dict[str, Any]:
    """Return everything as plain Python types, numbers that are not finite as None."""
    information = study.information
    names = information.model.parameter_names
    proposed = _proposed(study, trials)
    return {
        "model": information.model.name,
        "source": source,
        "parameters": dict(zip(names, information.values.tolist(), strict=True)),
        "fixed": [*information.fixed],
        "wanted": {name: plain(value) for name, value in study.wanted.items()},
        "designs": [_design_dict(study, design) for design in study.designs],
        "fewest": None if proposed is None else _design_dict(study, proposed),
        "largest": _design_dict(study, study.largest),
        "simulated": [_trial_dict(study, trial) for trial in trials],
    }


def _design_dict(study: DesignStudy, design: Design) -> dict[str, Any]:
    names = study.information.model.parameter_names
    return {
        "cameras": [*design.cameras],
        "exposures_ms": [*design.exposures_ms],
        "lights": design.lights,
        "frames": design.frames,
        "images": design.images,
        "time_s": design.time_s,
        "ratio": plain(design.ratio),
        "predicted": {
            name: plain(design.predicted.published[names.index(name)]) for name in study.wanted
        },
    }


def _trial_dict(study: DesignStudy, trial: Trial) -> dict[str, Any]:
    errors = trial.errors
    return {
        "design": _design_dict(study, trial.design),
        "scans": errors.scans,
        "reached": trial.reached,
        "errors": {
            name: {
                "predicted": plain(errors.predicted[i]),
                "simulated": plain(errors.simulated[i]),
                "interval": [plain(errors.low[i]), plain(errors.high[i])],
                "at_bound": errors.at_bound[i],
            }
            for i, name in enumerate(errors.names)
        },
    }
