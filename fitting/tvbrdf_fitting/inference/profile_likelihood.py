"""Intervals of parameters from the profile of chi-square.

With p(t) the lowest chi-square (nuisances and their priors included) of a fit with the parameter
held at t, and p_min that of the fit itself, the interval of k standard deviations is where
``p(t) - p_min <= k^2``, within the bounds. Far from any bound it mostly is what the covariance
says, x +- k deviations in internal coordinates, and then exactly that is returned. Near a bound, or
where the model is far from linear (a narrow lobe between two light positions), it is not.

Where the fit ended at a bound, p_min is the chi-square there: the interval begins at the bound and
ends where the data let it. The share of such intervals that hold the truth is, to first order,
never below that of a normal distribution; for a truth at the bound half of the misses are gone
(H. Chernoff, "On the Distribution of the Likelihood Ratio", 1954).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..geometry import FloatArray
from ..models import get_model
from .marginal import Optimum
from .posterior import Point, maximise

if TYPE_CHECKING:
    from ..result import FitResult

NEAR = 3.0
"""A bound within this many standard deviations (or the interval's own) calls for a profile."""
_NORMAL = 0.02
"""Of the covariance's ends: where the profile's differ less, these are returned."""
_TOLERANCE = 2e-3
"""Of the profile's ends, relative to their distance to the fitted value."""
_GROWTH, _STEPS_OUT = 1.5, 60


def interval(result: FitResult, name: str, sigmas: float) -> tuple[float, float]:
    """Return the ends of a parameter's interval, published units; see `FitResult.interval`."""
    if not (math.isfinite(sigmas) and sigmas > 0):
        raise ValueError(f"{name}: an interval of {sigmas} standard deviations; give a number > 0")
    index = result.index(name)
    if name in result.fixed:
        return result.value(name), result.value(name)
    centre = float(result.internal_values[index])
    deviation = math.sqrt(float(result.internal_covariance[index, index]))
    low, high = (float(bound) for bound in result.internal_bounds[:, index])
    if not math.isnan(centre):
        if result.optimum is not None:
            leader = result.optimum.posterior.problem.tied.get(index, index)
            reach = sigmas * _left_out(result, leader)
            # a lobe out of sight can have an amplitude of 1e200: steps too far overflow
            with np.errstate(all="ignore"):
                ends = profile_interval(result.optimum, leader, result.internal_covariance, reach)
            low, high = ends
        else:
            reach = max(sigmas, NEAR) * deviation
            near = not (low < centre - reach and centre + reach < high)  # NaN is near
            if near or name in result.undetermined:
                raise ValueError(
                    f"{name} is near a bound or undetermined, so its interval needs the data, "
                    f"which a result that was pickled or copied no longer has: fit again, with "
                    f"initial=result.parameters, and ask there"
                )
            low, high = centre - sigmas * deviation, centre + sigmas * deviation
    transform = get_model(result.model).parameters[index].transform
    return transform.to_published(low), transform.to_published(high)


def _left_out(result: FitResult, index: int) -> float:
    """Factor by which common errors lengthen an interval where the fit has no nuisances."""
    if result.optimum is None or len(result.optimum.posterior.nuisances):
        return 1.0
    total, random = result.covariance[index, index], result.covariance_random[index, index]
    return math.sqrt(total / random) if random > 0 else 1.0


def profile_interval(
    optimum: Optimum, index: int, covariance: FloatArray, sigmas: float
) -> tuple[float, float]:
    """Return where the profile of chi-square by a free coordinate stays within sigmas^2.

    Parameters
    ----------
    optimum
        The fit.
    index
        Of the coordinate, internal.
    covariance
        (p, p) internal, to start from; may be NaN.
    sigmas
        Half the interval's length in standard deviations, were it normal.

    Returns
    -------
    lower and upper end, internal; infinite where the data allow any value
    """
    profile = _Profile(optimum, index, covariance)
    low, high = profile.end(-1, sigmas), profile.end(1, sigmas)
    if profile.deeper is not None:
        # the profile found a better fit than the fit itself
        again = _Profile(profile.deeper, index, covariance)
        return again.end(-1, sigmas), again.end(1, sigmas)
    return low, high


class _Profile:
    """Fits with one coordinate held, each from the nearest one before, and from a search.

    Without the search a narrow lobe between the lights would be missed, which a wide one may
    become where its amplitude is held.
    """

    def __init__(self, optimum: Optimum, index: int, covariance: FloatArray) -> None:
        self._posterior, self._index = optimum.posterior, index
        self._start = self._posterior.point(optimum.internal, optimum.values)
        self._moving = tuple(i for i in self._posterior.problem.free if i != index)
        variance = float(covariance[index, index])
        self._deviation = math.sqrt(variance) if variance > 0 else math.nan
        slope = covariance[:, index] / variance if variance > 0 else np.zeros(len(covariance))
        self._slope = np.where(np.isfinite(slope), slope, 0.0)
        self._centre = float(optimum.internal[index])
        self._points: dict[float, Point] = {self._centre: self._start}
        self._solve, self._searches = optimum.solve, False
        self.deeper: Optimum | None = None

    def end(self, side: int, sigmas: float) -> float:
        """Return the end of the interval below (-1) or above (1) the fitted value."""
        from scipy.optimize import brentq

        problem, centre = self._posterior.problem, self._centre
        bound = float((problem.upper if side > 0 else problem.lower)[self._index])
        room = abs(bound - centre)
        step = sigmas * self._deviation
        normal = centre + side * step
        if not step > 0:  # NaN: no information
            step = min(0.1 * room, max(1.0, abs(centre)))
        inside = outside = centre
        for _ in range(_STEPS_OUT):
            if outside == bound:
                return bound
            inside, outside = outside, centre + side * step if step < room else bound
            if outside == normal:
                self._search(False)
                if abs(self._excess(outside, sigmas)) <= _NORMAL * sigmas:
                    return normal
            self._search(True)
            if self._excess(outside, sigmas) > 0:
                tolerance = _TOLERANCE * abs(outside - centre)
                return float(brentq(self._excess, inside, outside, (sigmas,), xtol=tolerance))
            step *= _GROWTH
        return math.copysign(math.inf, side)

    def _excess(self, value: float, sigmas: float) -> float:
        """Root of the rise of chi-square with the coordinate at a value, less `sigmas`.

        The root is nearly linear in the value.
        """
        rise = 2 * (self._point(value).cost - self._start.cost)
        return math.sqrt(max(rise, 0.0)) - sigmas

    def _search(self, searches: bool) -> None:
        """Say whether fits are also started from a search, and forget those that were not."""
        if searches and not self._searches:
            self._points = {self._centre: self._start}
        self._searches = searches

    def _point(self, value: float) -> Point:
        if value not in self._points:
            nearest = self._points[min(self._points, key=lambda known: abs(known - value))]
            starts = [self._followed(nearest, value)]
            if self._searches:
                starts.append(self._searched(nearest, value))
            fits = [maximise(self._posterior, start, self._moving).point for start in starts]
            found = min(fits, key=lambda point: point.cost)
            self._points[value] = found
            lowest = self._start.cost if self.deeper is None else self.deeper.cost
            if found.cost < lowest - 1e-6 * max(1.0, lowest):
                free = maximise(self._posterior, found).point
                self.deeper = Optimum(
                    self._posterior, free.internal, free.values, free.cost, self._solve
                )
        return self._points[value]

    def _followed(self, nearest: Point, value: float) -> Point:
        """Return where the covariance puts the others when the coordinate moves to a value."""
        internal, moving = nearest.internal.copy(), list(self._moving)
        internal[moving] += self._slope[moving] * (value - nearest.internal[self._index])
        internal = self._posterior.problem.clamp(internal)
        internal[self._index] = value
        return self._posterior.point(internal, nearest.values)

    def _searched(self, nearest: Point, value: float) -> Point:
        problem = self._posterior.problem
        values = problem.values.copy()
        values[self._index] = value
        held = replace(
            problem,
            values=values,
            free=self._moving,
            fixed=problem.fixed | {self._index},
            # where parameters are tied, a search alone finds no good start
            initial={i: x for i, x in problem.initial.items() if problem.tied and i != self._index},
        )
        return self._posterior.point(self._solve(held).internal, nearest.values)
