"""Only as much model as the data carry: the simplest rung of a ladder that explains a scan.

*Errors.* The rung with the least error of its own (`model_error_std`, then chi-square) says
how large errors are: the stated noise, where that explains what it leaves; else more, the model's
error being part of it (Burnham and Anderson, "Model Selection and Multimodel Inference", 2002,
section 2.5: one variance factor for all models, from the most general). A wrong model's residuals
go together along a sweep, so that n values say as much as n / tau independent ones; tau is found
from the sums of neighbouring residuals (`independent_values`). For noise it is 1.

*Criterion.* Schwarz's ("Estimating the dimension of a model", 1978) for such errors, k free
parameters: ``sum of squares / tau + k ln(n / tau)``, the squares in deviations of these errors.

*Rule.* The simplest rung that none beats, see `model_rule`.

*Climb.* The ladder is a graph: from its first rung on, the neighbours of the rung that would be
kept are fitted one after the other, simpler ones first, until it has none left; where residuals
have structure those of the rung with the least error too, if no rung explains the data only where
that gives a hint of what matters. Where one explains them and leaves residuals without structure,
only neighbours with one more effect or another shape of lobe are fitted, not those with one more
lobe and its colours.

*Uncertainty.* What the choice adds to that of the kept fit's parameters: `spread`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

from ..inference.nuisances import CommonErrors
from ..observations import Observations
from ..problem import FitError
from .ladder import (
    DEFAULT_LADDER,
    EXPLAINED,
    Candidate,
    Ladder,
    Scan,
    Trial,
    Weighing,
    as_ladder,
    find,
)
from .model_choice import ModelChoice, Rung
from .rule import Comparison, Standing, Verdict
from .spread import deviations_over, weights_of

_STRUCTURELESS = 4.5
"""Largest mean of a block in its deviations: of 600 fits of the true model 1 in 150 is beyond."""
_INDEPENDENT = 1.5
"""Largest number of values that count as one: of 600 fits of the true model 1.38."""
_ONE_EFFECT = 2
"""Largest number of parameters that a roughness, a lobe, or its colours add."""


def choose_model(
    observations: Observations,
    *,
    ladder: Mapping[Any, Iterable[Any]] | Sequence[Any] = DEFAULT_LADDER,
    metric: str = "radiance",
    loss: str = "least_squares",
    method: str | None = None,
    common_errors: CommonErrors | None = None,
    previous: str | None = None,
) -> ModelChoice:
    """Fit a ladder of models to one scan and keep the simplest one that explains it.

    Parameters
    ----------
    observations
        What was measured. The variances decide what is explained.
    ladder
        Names for `get_model`, or `ladder.Candidate`. A mapping gives each rung's richer
        neighbours and is climbed; of a sequence every rung is fitted.
    metric, loss, method, common_errors
        As for `fit_scan`, whose default the method is.
    previous
        Rung of the scan before, which is kept unless the evidence against it is clear.

    Raises
    ------
    FitError
        No rung can be fitted.
    ValueError
        Unknown models, or a `previous` that is not on the ladder.
    """
    rungs, start = _ladder(ladder)
    options = _options(metric, loss, method, common_errors)
    before = None if previous is None else find(rungs, previous)
    return _choose([Scan(observations, options)], rungs, start, before)[0]


def choose_for_series(
    scans: Sequence[Observations],
    *,
    mode: Literal["joint", "per_scan"] = "joint",
    ladder: Mapping[Any, Iterable[Any]] | Sequence[Any] = DEFAULT_LADDER,
    metric: str = "radiance",
    loss: str = "least_squares",
    method: str | None = None,
    common_errors: CommonErrors | Sequence[CommonErrors | None] | None = None,
) -> list[ModelChoice]:
    """Choose models for a time series.

    Parameters
    ----------
    scans
        In the order of time.
    mode
        "joint": one model for all, by the sum of the criteria. Parameters can be compared from
        scan to scan, also where a lobe fades until it is `undetermined`. A rung is determined, and
        has a highlight, if it is so in any scan. "per_scan": scan by scan, each with the one
        before as `previous`: for scans as they come, and for samples that become another material.
    ladder, metric, loss, method
        As for `choose_model`.
    common_errors
        As for `choose_model`: of all scans, or a sequence with those of each. Their priors differ
        from scan to scan where light offsets and lamp drift were estimated scan by scan.

    Raises
    ------
    FitError
        No rung can be fitted; for "joint", none to all scans.
    ValueError
        Unknown mode or models, no scans, or not as many common errors as scans.
    """
    if mode not in {"joint", "per_scan"}:
        raise ValueError(f"unknown mode {mode!r}; known modes: joint, per_scan")
    if not scans:
        raise ValueError("no scans to choose a model for")
    rungs, start = _ladder(ladder)
    series = [
        Scan(scan, _options(metric, loss, method, common))
        for scan, common in zip(scans, _of_each(common_errors, len(scans)), strict=True)
    ]
    if mode == "joint":
        return _choose(series, rungs, start, None)
    choices: list[ModelChoice] = []
    previous: Candidate | None = None
    for one in series:
        choices += _choose([one], rungs, start, previous)
        previous = find(rungs, choices[-1].model)
    return choices


def _of_each(
    common: CommonErrors | Sequence[CommonErrors | None] | None, scans: int
) -> Sequence[CommonErrors | None]:
    if common is None or isinstance(common, CommonErrors):
        return [common] * scans
    if len(common) != scans:
        raise ValueError(
            f"common errors of {len(common)} scans for {scans}: give one for all, or one a scan"
        )
    return common


def _options(
    metric: str, loss: str, method: str | None, common_errors: CommonErrors | None
) -> dict[str, Any]:
    options: dict[str, Any] = {"metric": metric, "loss": loss, "common_errors": common_errors}
    return options if method is None else options | {"method": method}


def _ladder(given: Mapping[Any, Iterable[Any]] | Sequence[Any]) -> tuple[Ladder, list[Candidate]]:
    """Return the ladder, and what is fitted first: all of a sequence, one of a graph."""
    ladder = as_ladder(given)
    return ladder, list(ladder)[:1] if isinstance(given, Mapping) else list(ladder)


def _choose(
    scans: Sequence[Scan], ladder: Ladder, start: Sequence[Candidate], previous: Candidate | None
) -> list[ModelChoice]:
    """Climb until every neighbour of the kept rung is fitted that could matter."""
    waiting = [*start] if previous is None else [*start, previous]
    while True:
        for candidate in waiting:
            for scan in scans:
                scan.fit(candidate)
        tried = set(scans[0].trials)
        known = [c for c in ladder if all(c in scan.fitted for scan in scans)]
        if not known:
            waiting = [c for c in ladder if c not in tried][:1]
            if not waiting:
                failed = next(t for s in scans for t in s.trials.values() if t.result is None)
                raise FitError(f"no model of the ladder can be fitted; {failed.failure}")
            continue
        weighings = [scan.weigh() for scan in scans]
        comparison = _compared(scans, weighings, known)
        verdict = comparison.verdict(previous)
        further = comparison.further(verdict.kept)
        # one at a time: it may change what is worth fitting next
        waiting = _next(ladder, tried, weighings, verdict.kept, further)[:1]
        if not waiting:
            pairs = zip(scans, weighings, strict=True)
            return [_report(scan, weighing, verdict, len(scans)) for scan, weighing in pairs]


def _next(
    ladder: Ladder,
    tried: set[Candidate],
    weighings: Sequence[Weighing],
    kept: Standing,
    further: Standing,
) -> list[Candidate]:
    """Return the rungs still worth fitting."""
    here = kept.candidate
    below = [c for c, richer in ladder.items() if here in richer and c.size <= here.size]
    waiting = [c for c in below if c not in tried]
    if waiting:
        return waiting
    waiting = [c for c in ladder[here] if c not in tried]
    if all(map(_structureless, weighings)):
        return [c for c in waiting if 0 <= c.size - here.size <= _ONE_EFFECT]
    return waiting + [c for c in ladder[further.candidate] if c not in tried]


def _structureless(weighing: Weighing) -> bool:
    """Whether noise explains a scan, and nothing else can be seen in what is left."""
    return (
        weighing.explained
        and weighing.largest < _STRUCTURELESS
        and weighing.correlated < _INDEPENDENT
    )


def _compared(
    scans: Sequence[Scan], weighings: Sequence[Weighing], known: Sequence[Candidate]
) -> Comparison:
    standings = []
    explained = all(w.explained for w in weighings)
    for order, candidate in enumerate(known):
        trials = [scan.trials[candidate] for scan in scans]
        standings.append(
            Standing(
                candidate=candidate,
                order=order,
                parameters=max(trial.parameters for trial in trials),
                criterion=sum(w.criteria[candidate] for w in weighings),
                spread=sum(w.spreads[candidate] for w in weighings) / len(scans),
                determined=any(not trial.undetermined for trial in trials),
                highlight=math.nan if explained else max(trial.highlight for trial in trials),
            )
        )
    size = min(w.effective_values for w in weighings)
    return Comparison(standings, explained, math.log(max(size, 1.0)))


def _report(scan: Scan, weighing: Weighing, verdict: Verdict, scans: int) -> ModelChoice:
    by_candidate = {s.candidate: s for s in verdict.standings}
    rungs = tuple(
        _rung(scan, trial, weighing, by_candidate.get(c), verdict.rejected.get(c, ""))
        for c, trial in scan.trials.items()
    )
    kept = scan.trials[verdict.kept.candidate]
    weights = weights_of(
        {s.candidate.label: s.criterion - verdict.kept.criterion for s in verdict.standings}
    )
    fits = {c.label: trial.fit for c, trial in scan.fitted.items()}
    internal, published = deviations_over(kept.fit, fits, weights)
    return ModelChoice(
        result=kept.fit,
        model=kept.candidate.label,
        reason=_reason(scan, kept, weighing, verdict, scans),
        rungs=rungs,
        standard_deviations=published,
        internal_deviations=internal,
        weights=weights,
        values=weighing.values,
        effective_values=weighing.effective_values,
        solve_time_s=sum(rung.solve_time_s for rung in rungs),
    )


def _rung(
    scan: Scan, trial: Trial, weighing: Weighing, standing: Standing | None, rejected: str
) -> Rung:
    label = trial.candidate.label
    if standing is None or trial.result is None:
        why = trial.failure or "cannot be fitted to all scans of the series"
        return Rung(label, trial.candidate.size, rejected=why)
    fit, square = trial.result, scan.mean_square(trial)
    return Rung(
        model=label,
        parameters=trial.parameters,
        rejected=rejected,
        chi_square=fit.chi_square,
        degrees_of_freedom=fit.degrees_of_freedom,
        model_error_std=fit.model_error_std,
        noise=math.sqrt(square),
        criterion=standing.criterion,
        error=math.sqrt(weighing.spreads[trial.candidate]),
        highlight=standing.highlight,
        undetermined=trial.undetermined,
        explains=square <= EXPLAINED,
        solve_time_s=fit.solve_time_s,
    )


def _reason(scan: Scan, kept: Trial, weighing: Weighing, verdict: Verdict, scans: int) -> str:
    """What was found, what decided against simpler rungs, and what against the next better."""
    noise = math.sqrt(scan.mean_square(kept))
    if weighing.explained:
        what = f"noise explains the data: residuals are {noise:.3g} of their stated deviations"
    else:
        what = (
            f"no model explains the data within their noise; this one leaves {noise:.3g} of their "
            f"stated deviations, and {weighing.values} values are worth "
            f"{weighing.effective_values:.0f} independent ones"
        )
    parts = [f"{kept.candidate.label}: {what}"]
    simpler = [s for s in verdict.standings if s.parameters < verdict.kept.parameters]
    if simpler:
        best = min(simpler, key=lambda s: s.criterion)
        parts.append(
            f"the best simpler one, {best.candidate.label}, is rejected: "
            f"{verdict.rejected[best.candidate]}"
        )
    others = [s for s in verdict.standings if s not in simpler and s is not verdict.kept]
    if others:
        best = min(others, key=lambda s: s.criterion)
        parts.append(f"{best.candidate.label} is rejected: {verdict.rejected[best.candidate]}")
    if scans > 1:
        parts.append(f"chosen for {scans} scans together, by the sum of their criteria")
    return "; ".join(parts)


__all__ = ["ModelChoice", "Rung", "choose_for_series", "choose_model"]
