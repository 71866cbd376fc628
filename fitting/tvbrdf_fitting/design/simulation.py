"""Is a design as good as predicted? Noisy scans of it, each fitted, against the truth.

Noise is that of `fisher_information.NoiseModel` (photons of a whole patch are many enough to be
normal), errors that frames share are drawn anew for each scan from their priors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..batch import fit_parameters
from ..fit import fit_scan
from ..geometry import FloatArray
from ..inference.nuisances import make_nuisances
from ..observations import Observations
from ..problem import make_problem
from .fisher_information import Information
from .search import Design, DesignStudy, make_design

CONFIDENCE = 0.95
MOST_TRIALS = 8
_LARGEST = 1e140
"""Error beyond which it does not matter how large it is."""


@dataclass(frozen=True, eq=False)
class SimulatedErrors:
    """Errors of fits of a design's scans, (q,) each, of the free parameters `names`.

    Attributes
    ----------
    predicted, simulated
        Predicted standard deviation and root mean square error. Errors are taken in internal
        coordinates, where they are closest to normal, and scaled to published units by one factor
        for both.
    low, high
        Interval of the simulated one from the number of scans (chi-square, `CONFIDENCE`).
    bias
        Mean error in standard deviations of the mean.
    at_bound
        True where the material lies at a bound of the model: errors have one side there, and are
        smaller than predicted.
    scans
        How many.
    """

    names: tuple[str, ...]
    predicted: FloatArray
    simulated: FloatArray
    low: FloatArray
    high: FloatArray
    bias: FloatArray
    at_bound: tuple[bool, ...]
    scans: int


def simulate_design(
    information: Information, design: Design, *, scans: int = 200, seed: int = 0
) -> SimulatedErrors:
    """Fit noisy scans of a design, with the lights where they stand worst.

    Parameters
    ----------
    information, design
        Of a `design.DesignStudy`.
    scans, seed
        Number of scans, and what their noise is drawn from.

    Raises
    ------
    ValueError
        Fewer than two scans.
    FitError
        The design has fewer values than parameters.
    """
    from scipy.stats import chi2

    if scans < 2:
        raise ValueError(f"{scans} scans: at least two are needed")
    errors = _Fits(information, design).errors(scans, np.random.default_rng(seed))
    # a lobe that nobody sees can have an amplitude of 1e200, whose square is no number
    errors = np.clip(errors, -_LARGEST, _LARGEST)
    model, free = information.model, list(information.free)
    internal = design.predicted.internal[free]
    known = np.isfinite(internal) & (internal > 0)
    factor = np.full(len(free), np.nan)
    factor[known] = design.predicted.published[free][known] / internal[known]
    squares = np.square(errors).sum(axis=0)
    simulated = np.sqrt(squares / scans)
    tail = 0.5 * (1 - CONFIDENCE)
    spread = np.sqrt(np.maximum(squares / scans - errors.mean(axis=0) ** 2, 1e-300))
    lower, upper = model.internal_bounds
    at_bound = (information.internal <= lower) | (information.internal >= upper)
    return SimulatedErrors(
        names=tuple(model.parameter_names[i] for i in free),
        predicted=design.predicted.published[free],
        simulated=simulated * factor,
        low=np.sqrt(squares / chi2.isf(tail, scans)) * factor,
        high=np.sqrt(squares / chi2.ppf(tail, scans)) * factor,
        bias=errors.mean(axis=0) / (spread / np.sqrt(scans)),
        at_bound=tuple(bool(at_bound[i]) for i in free),
        scans=scans,
    )


@dataclass(frozen=True, eq=False)
class Trial:
    """A design, the errors of its simulated scans, and whether they are as small as wanted."""

    design: Design
    errors: SimulatedErrors
    reached: bool


def confirm(study: DesignStudy, *, scans: int = 200, seed: int = 0) -> tuple[Trial, ...]:
    """Simulate the designs of a study from the one with the fewest images on, until one does.

    At most `MOST_TRIALS` are simulated. One that does not reach the accuracy, although predicted,
    comes again with a quarter more lights, as far as there may be so many. An error that is above
    what is wanted by less than its interval counts as reached.

    Returns
    -------
    In the order of simulation; if any reached the accuracy, it is the last.
    """
    waiting = list(study.designs)
    trials: list[Trial] = []
    wanted = np.array([*study.wanted.values()])
    while waiting and len(trials) < MOST_TRIALS:
        design = min(waiting, key=lambda d: (d.images, len(d.cameras)))
        waiting.remove(design)
        errors = simulate_design(study.information, design, scans=scans, seed=seed)
        trials.append(Trial(design, errors, not (errors.low > wanted).any()))
        if trials[-1].reached:
            break
        lights = min(math.ceil(design.lights * 1.25), study.most_lights)
        if lights > design.lights:
            larger = (design.cameras, design.exposures_ms, lights)
            waiting.append(make_design(study.information, study.wanted, *larger))
    return tuple(trials)


class _Fits:
    """Scans of one design."""

    def __init__(self, information: Information, design: Design) -> None:
        self._information = information
        whole = information.rig.observe(
            information.model,
            information.values,
            cameras=design.cameras,
            exposures_ms=design.exposures_ms,
            lights=design.lights,
            phase=design.phase,
        )
        rows = np.flatnonzero(whole.usable.any(axis=1))
        self._scan: Observations = whole.select(rows)
        self._problem = make_problem(self._scan, information.model, information.fixed, {})
        self._nuisances = make_nuisances(self._problem, self._scan, information.common_errors)

    def errors(self, scans: int, rng: np.random.Generator) -> FloatArray:
        """Errors (scans, q) of the free parameters in internal coordinates."""
        information = self._information
        model, free = information.model, list(information.free)
        radiance = np.stack([self._noisy(rng) for _ in range(scans)])
        fit = self._with_nuisances if len(self._nuisances) else self._together
        values = fit(radiance)
        internal = np.stack([model.to_internal(v) for v in values])
        return np.asarray(internal[:, free] - information.internal[free])

    def _noisy(self, rng: np.random.Generator) -> FloatArray:
        """Radiance (n, 3) of one scan."""
        noise, exposure_ms = self._information.rig.noise, self._scan.exposure_ms
        drawn = rng.normal(size=len(self._nuisances))
        here = self._nuisances.apply(self._problem, drawn) if len(drawn) else self._problem
        true = here.predict(self._information.internal).T
        flicker = 1 + noise.frame_relative_std * rng.normal(size=(len(true), 1))
        deviation = np.sqrt(noise.own_variance(true, exposure_ms))
        return np.asarray(true * flicker + deviation * rng.normal(size=true.shape))

    def _together(self, radiance: FloatArray) -> FloatArray:
        scan, information = self._scan, self._information
        variance = np.where(scan.usable, scan.variance, np.inf)
        return fit_parameters(
            scan.light_direction,
            scan.view_direction,
            radiance,
            variance,
            information.model,
            fixed=information.fixed,
        ).values

    def _with_nuisances(self, radiance: FloatArray) -> FloatArray:
        information = self._information
        results = [
            fit_scan(
                replace(self._scan, radiance=values),
                information.model,
                method="separable",
                fixed=information.fixed,
                common_errors=information.common_errors,
                model_error=False,
            )
            for values in radiance
        ]
        return np.stack([result.values for result in results])
