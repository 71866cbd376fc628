"""Which parameters the data determine, and which ended at a bound."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from ..geometry import FloatArray
from ..models import ReflectanceModel
from ..problem import Problem
from .uncertainty import SIGNIFICANCE, Uncertainty

CONFOUNDED = 0.99
OUT_OF_SIGHT = 1e6
"""Brightness of a part at its best, over the brightest value, of which nothing is known."""


def bounds_reached(problem: Problem, internal: FloatArray) -> tuple[int, ...]:
    """Free coordinates at a bound (within rounding, or a trust region's distance to it)."""
    reached = []
    for i in problem.free:
        tolerance = 1e-9 * max(1.0, abs(internal[i]))
        lower, upper = problem.lower[i], problem.upper[i]
        if internal[i] <= lower + tolerance or internal[i] >= upper - tolerance:
            reached.append(i)
    return tuple(reached)


def undetermined(
    problem: Problem, internal: FloatArray, uncertainty: Uncertainty, at_bound: tuple[int, ...]
) -> tuple[int, ...]:
    """Free parameters of which the fitted number means nothing.

    Those without information; those whose carrier (a lobe's amplitude for its width, every Kd for
    sigma_d, tau for w) is within 3 standard deviations of 0, or undetermined itself; those whose
    standard deviation is their full scale, or, for sigma_d^2 and tau, the value itself; amplitudes
    of what nobody saw (`unseen`); pairs that only act together.
    """
    model = problem.model
    total = uncertainty.random + uncertainty.common
    deviation = np.sqrt(np.diag(total))
    names = list(model.parameter_names)
    found = {i for i in range(len(names)) if i not in problem.free and i not in problem.fixed}
    hidden = unseen(problem, internal, deviation)
    found.update(hidden)

    def significant(name: str) -> bool:
        i = names.index(name)
        # a fixed value has deviation 0; NaN compares as False
        large = internal[i] > 0 and internal[i] >= SIGNIFICANCE * deviation[i]
        return bool(large) and i not in hidden

    for i in problem.free:
        parameter = model.parameters[i]
        carried = all(any(significant(n) for n in group) for group in parameter.carried_by)
        vague = not deviation[i] < parameter.full_scale  # catches NaN
        # shapes that start at 0 (sigma_d^2, tau) and are indistinguishable from it
        lost_at_zero = (
            bool(parameter.grid)
            and problem.lower[i] == 0
            and i not in at_bound
            and deviation[i] >= internal[i]
        )
        if i in uncertainty.uninformed or not carried or vague or lost_at_zero:
            found.add(i)
    for one, other in model.confounded:
        i, j = names.index(one), names.index(other)
        if i in problem.free and j in problem.free:
            bound = deviation[i] * deviation[j]
            if bound > 0 and abs(total[i, j]) > CONFOUNDED * bound:
                found.update((i, j))
    return tuple(sorted(found))


def unseen(problem: Problem, internal: FloatArray, deviation: FloatArray) -> tuple[int, ...]:
    """Free amplitudes of parts, as narrow lobes between the lights, whose size nobody saw.

    Amplitudes have no bound, so that a lobe can be lifted until its last flank takes up a single
    value's noise. What is meaningless depends on the scale of the data: an amplitude is counted in
    that with which its part, seen at its best (light and view along the normal), would be as bright
    as the brightest value of any channel, or as the largest noise. A part is unseen

    - where its amplitude is not significant, and its deviation is 1 or more: the data can't tell
      nothing from more than they ever saw. (An amplitude near 0 with a smaller one says that there
      is next to nothing, and is determined.)
    - where its amplitude is above `OUT_OF_SIGHT`: all that was seen of it is less than a millionth
      of what it would be. This holds for significant amplitudes too, which a wrong model may need.

    The flank of a bright lobe that tells its amplitude to a third is enough to be seen.

    Parameters
    ----------
    problem
        Of the fit, with the weights that go with it.
    internal, deviation
        (p,) fitted coordinates, and their standard deviations; NaN where there is none.
    """
    model, free = problem.model, set(problem.free)
    seen = problem.weight > 0
    noise = 1.0 / np.where(seen, problem.weight, np.inf)
    brightest = float(np.max(np.maximum(np.abs(problem.radiance), noise)))
    found = []
    for term in model.terms:
        indices = [model.parameter_names.index(name) for name in term.amplitudes]
        shapes = [float(internal[model.parameter_names.index(name)]) for name in term.shapes]
        typical = float(np.mean(internal[indices]))
        at_best = np.pi * float(term.vector(_head_on(model), shapes, typical)[0])
        for index in set(indices) & free:
            size, error = at_best * internal[index], at_best * deviation[index]
            significant = size >= SIGNIFICANCE * error
            # NaN, of a part without information, compares as False
            if size >= OUT_OF_SIGHT * brightest or (not significant and error >= brightest):
                found.append(index)
    return tuple(sorted(found))


@lru_cache(maxsize=64)
def _head_on(model: ReflectanceModel) -> Any:
    """A model's functions of light and view along the normal."""
    normal = np.array([[0.0, 0.0, 1.0]])
    return model.prepare(normal, normal)
