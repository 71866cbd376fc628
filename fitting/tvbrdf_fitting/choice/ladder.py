"""Rungs of a ladder of models: fitted to a scan one by one, and weighed against each other.

`model_choice` has the rule; here is what it needs to know of each rung.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..fit import fit_scan
from ..geometry import BoolArray, FloatArray
from ..inference.marginal import Optimum
from ..models import SumModel, get_model
from ..observations import Observations
from ..problem import FitError
from ..result import FitResult
from ..solve.losses import LOSSES
from .independent_values import Blocks, correlation, nested_blocks

EXPLAINED = 1.5
"""Mean squared residual in stated deviations up to which noise explains the data.

Stated deviations are trusted to about a fifth: their square to this.
"""
_NORMAL_MEDIAN_SQUARE = 0.4549364231195727
"""Median of z^2 for a standard normal z."""


@dataclass(frozen=True)
class Candidate:
    """A model as a rung: some parameters may be held, so that the others are determined.

    Attributes
    ----------
    model
        Name for `get_model`.
    held
        Published values by name; a name holds for every lobe: "eta" is also "eta_2".
    """

    model: str
    held: tuple[tuple[str, float], ...] = ()

    @property
    def label(self) -> str:
        """Name for people, and for `previous`."""
        held = ", ".join(f"{name} = {value:g}" for name, value in self.held)
        return f"{self.model} with {held}" if held else self.model

    @property
    def size(self) -> int:
        """Number of parameters that are not held."""
        return len(get_model(self.model).parameters) - len(self.fixed())

    def fixed(self) -> dict[str, float]:
        """Return the held values by the model's own parameter names."""
        names = get_model(self.model).parameter_names
        out: dict[str, float] = {}
        for base, value in self.held:
            found = [n for n in names if n == base or re.fullmatch(rf"{base}_\d+", n)]
            if not found:
                raise ValueError(f"{self.model} has no parameter {base!r}; it has {list(names)}")
            out |= dict.fromkeys(found, value)
        return out


Ladder = Mapping[Candidate, tuple[Candidate, ...]]
"""Each rung with the richer ones next to it; the first is where to start."""


def clear_coat(model: str) -> Candidate:
    """Return a rung with the refractive index of lacquers and plastics.

    Where a rig sees few angles of incidence on the facets, data can't tell it from the amplitude.
    """
    return Candidate(model, (("eta", 1.5),))


def _default_ladder() -> Ladder:
    """Lambert or Oren-Nayar; no lobe, one (shared or coloured; Gaussian or GGX), or two."""
    one, coloured = "torrance_sparrow", "torrance_sparrow(coloured)"
    tail, tail_coloured = "cook_torrance(ggx)", "cook_torrance(ggx,coloured)"
    two, two_tail = f"{coloured}+{coloured}", f"{coloured}+{tail_coloured}"
    above = {
        "": (one,),
        one: (coloured, tail),
        coloured: (tail_coloured, two, two_tail),
        tail: (tail_coloured,),
        tail_coloured: (two_tail,),
        two: (two_tail,),
        two_tail: (),
    }

    def rung(diffuse: str, lobes: str) -> Candidate:
        name = f"{diffuse}+{lobes}" if lobes else diffuse
        return clear_coat(name) if "cook" in lobes else Candidate(name)

    ladder: dict[Candidate, tuple[Candidate, ...]] = {}
    for lobes, richer in above.items():
        rough = tuple(rung("oren_nayar", other) for other in richer)
        ladder[rung("lambert", lobes)] = (
            rung("oren_nayar", lobes),
            *(rung("lambert", other) for other in richer),
        )
        ladder[rung("oren_nayar", lobes)] = rough
    return ladder


DEFAULT_LADDER: Ladder = _default_ladder()


def as_ladder(given: Mapping[Any, Iterable[Any]] | Sequence[Any]) -> Ladder:
    """Return a ladder from names or candidates; of a sequence no rung has neighbours.

    Raises
    ------
    ValueError
        No rungs, or unknown models.
    """
    pairs = dict(given) if isinstance(given, Mapping) else dict.fromkeys(given, ())
    ladder = {_candidate(name): tuple(map(_candidate, richer)) for name, richer in pairs.items()}
    for richer in list(ladder.values()):
        for candidate in richer:
            ladder.setdefault(candidate, ())
    if not ladder:
        raise ValueError("the ladder has no rungs; name at least one model")
    return ladder


def find(ladder: Ladder, name: str) -> Candidate:
    """Return the rung with a label or model name (`get_model`'s aliases too)."""
    for candidate in ladder:
        if name == candidate.label:
            return candidate
    full = get_model(name).name
    for candidate in ladder:
        if get_model(candidate.model).name == full:
            return candidate
    raise ValueError(f"{name!r} is no rung of the ladder: {', '.join(c.label for c in ladder)}")


def _candidate(given: str | Candidate) -> Candidate:
    return Candidate(given) if isinstance(given, str) else given


@dataclass(frozen=True, eq=False)
class Trial:
    """A rung fitted to a scan, or why it could not be.

    Attributes
    ----------
    candidate, result, failure
        Which, the fit, and the error's message where there is no fit.
    misfit
        (m,) residuals in the metric's radiance units, nuisances included.
    prior
        Sum of the squared nuisances in prior deviations.
    unit
        (m,) the metric's unit of a model's error.
    """

    candidate: Candidate
    result: FitResult | None
    failure: str
    misfit: FloatArray
    prior: float
    unit: FloatArray

    @property
    def fit(self) -> FitResult:
        """The result, which must be there."""
        if self.result is None:
            raise ValueError(f"{self.candidate.label}: {self.failure}")
        return self.result

    @cached_property
    def parameters(self) -> int:
        """Number of free parameters that the data have a channel for."""
        optimum = self.fit.optimum
        return len(optimum.posterior.problem.free) if optimum is not None else 0

    @cached_property
    def undetermined(self) -> tuple[str, ...]:
        """Undetermined parameters, but for those of a channel that was not measured."""
        fit = self.fit
        return tuple(n for n in fit.undetermined if math.isfinite(fit.value(n)))

    @cached_property
    def highlight(self) -> float:
        """Share of the most distinct lobe that diffuse parts can't make; infinite without lobes.

        By squared weighted radiance: 1 less the squared multiple correlation with the diffuse
        columns of the Jacobian, the inverse of a variance inflation factor.
        """
        return _most_distinct_lobe(self.fit)


class Scan:
    """A scan, and the rungs that were fitted to it."""

    def __init__(self, observations: Observations, options: Mapping[str, Any]) -> None:
        self._observations, self._options = observations, options
        self._loss = LOSSES.get(options["loss"])
        self._blocks: Blocks | None = None
        self.trials: dict[Candidate, Trial] = {}

    def fit(self, candidate: Candidate) -> None:
        """Fit a rung, unless it was."""
        if candidate in self.trials:
            return
        fixed = candidate.fixed()
        try:
            result = fit_scan(
                self._observations, candidate.model, fixed=fixed or None, **self._options
            )
        except FitError as error:
            nothing = np.zeros(0)
            self.trials[candidate] = Trial(candidate, None, str(error), nothing, 0.0, nothing)
            return
        self.trials[candidate] = _trial(candidate, result)

    @property
    def fitted(self) -> dict[Candidate, Trial]:
        """The rungs that could be fitted."""
        return {c: t for c, t in self.trials.items() if t.result is not None}

    def mean_square(self, trial: Trial) -> float:
        """Mean squared residual in stated deviations; from the median for robust losses."""
        fit = trial.fit
        if self._loss is not None and self._loss.robust:
            square = np.square(trial.misfit) / self._noise(fit)
            return float(np.median(square)) / _NORMAL_MEDIAN_SQUARE
        return fit.chi_square / max(fit.degrees_of_freedom, 1)

    def weigh(self) -> Weighing:
        """Compare all rungs fitted so far, under the errors that the best of them leaves.

        Raises
        ------
        FitError
            None could be fitted; with the first one's reason.
        """
        fitted = self.fitted
        if not fitted:
            raise FitError(next(iter(self.trials.values())).failure)
        reference = min(fitted.values(), key=lambda t: (t.fit.model_error_std, self.mean_square(t)))
        noise = self._noise(reference.fit)
        variance = noise + np.square(reference.fit.model_error_std * reference.unit)
        residuals = {c: self._residual(t.misfit / np.sqrt(variance)) for c, t in fitted.items()}
        sums = {c: float(r @ r) + fitted[c].prior for c, r in residuals.items()}
        count = len(noise)
        factor = max(1.0, sums[reference.candidate] / max(count - reference.parameters, 1))
        correlated, largest = self._structure(reference.fit, residuals[reference.candidate])
        size = math.log(max(count / correlated, 1.0))
        return Weighing(
            reference=reference,
            explained=self.mean_square(reference) <= EXPLAINED,
            values=count,
            correlated=correlated,
            noise_factor=factor,
            largest=largest,
            criteria={
                c: s / (factor * correlated) + fitted[c].parameters * size for c, s in sums.items()
            },
            spreads={c: s / (factor * count) for c, s in sums.items()},
        )

    def _noise(self, fit: FitResult) -> FloatArray:
        """Stated variances (m,) of the values that a fit used."""
        rows = self._observations.usable.any(axis=1)
        return np.asarray(self._observations.variance[rows].T[_seen(fit)])

    def _residual(self, z: FloatArray) -> FloatArray:
        """Residuals (m,) in deviations as the loss weighs them."""
        return z if self._loss is None else z * np.sqrt(self._loss.weight(z))

    def _structure(self, fit: FitResult, z: FloatArray) -> tuple[float, float]:
        if self._blocks is None:
            rows = np.flatnonzero(self._observations.usable.any(axis=1))
            seen_rows = self._observations.select(rows)
            directions = [seen_rows.light_direction, seen_rows.view_direction]
            self._blocks = nested_blocks(np.concatenate(directions, axis=1), seen_rows.camera)
        seen = _seen(fit)
        whole = np.zeros(seen.shape)
        whole[seen] = z
        return correlation(whole, seen, self._blocks)


@dataclass(frozen=True)
class Weighing:
    """The rungs of one scan under common errors.

    Attributes
    ----------
    reference
        The rung whose residuals say how large errors are.
    explained
        Whether noise explains what it leaves.
    values, correlated
        Number of values, and how many of them count as one because their errors go together.
    noise_factor
        Variance of the errors over what was stated and added as the model's error.
    largest
        Largest mean residual of a block of neighbouring values in its deviations.
    criteria, spreads
        By rung: the criterion, and the mean squared residual in units of the errors.
    """

    reference: Trial
    explained: bool
    values: int
    correlated: float
    noise_factor: float
    largest: float
    criteria: dict[Candidate, float]
    spreads: dict[Candidate, float]

    @property
    def effective_values(self) -> float:
        """Number of independent values."""
        return self.values / self.correlated


def _trial(candidate: Candidate, result: FitResult) -> Trial:
    optimum = result.optimum
    if optimum is None:
        raise ValueError(f"{candidate.label}: the fit did not keep where it ended")
    problem = optimum.posterior.problem
    point = optimum.posterior.point(optimum.internal, optimum.values)
    seen = problem.weight > 0
    residual = point.residual.reshape(seen.shape)[seen] / problem.weight[seen]
    unit = np.broadcast_to(problem.metric.unit, seen.shape)[seen]
    return Trial(candidate, result, "", residual, float(optimum.values @ optimum.values), unit)


def _seen(fit: FitResult) -> BoolArray:
    if fit.optimum is None:
        raise ValueError(f"{fit.model}: the fit did not keep where it ended")
    return np.asarray(fit.optimum.posterior.problem.weight > 0)


def _most_distinct_lobe(fit: FitResult) -> float:
    model, optimum = get_model(fit.model), fit.optimum
    if optimum is None or not isinstance(model, SumModel):
        return math.inf if model.diffuse else 1.0
    lobes = [i for i, part in enumerate(model.parts) if not part.diffuse]
    if not lobes:
        return math.inf
    problem, internal = optimum.posterior.problem, optimum.internal
    slope = problem.slope_of(problem.predict(internal)) * problem.to_radiance
    basis = _diffuse_basis(model, optimum)
    best = 0.0
    for i in lobes:
        value = model.parts[i].value(problem.prepared[i], internal[model.slices[i]])
        lobe = (value * slope).ravel()
        size = float(lobe @ lobe)
        if size > 0:
            shared = basis.T @ lobe
            best = max(best, 1.0 - float(shared @ shared) / size)
    return best


def _diffuse_basis(model: SumModel, optimum: Optimum) -> FloatArray:
    """Orthonormal columns (3 n, q) of what the diffuse parts' free parameters change."""
    problem, internal = optimum.posterior.problem, optimum.internal
    own = {
        index
        for part, where in zip(model.parts, model.slices, strict=True)
        if part.diffuse
        for index in range(where.start, where.stop)
    }
    columns = tuple(i for i in problem.free if i in own)
    jacobian = problem.jacobian(internal, columns)
    scale = np.linalg.norm(jacobian, axis=0)
    return np.asarray(np.linalg.qr(jacobian[:, scale > 0] / scale[scale > 0])[0])
