"""Which parameters the data determine, and which ended at a bound."""

from __future__ import annotations

import numpy as np

from ..geometry import FloatArray
from ..problem import Problem
from .uncertainty import SIGNIFICANCE, Uncertainty

CONFOUNDED = 0.99


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
    sigma_d, tau for w) is within 3 standard deviations of 0; those whose standard deviation is
    their full scale, or, for sigma_d^2 and tau, the value itself; pairs that only act together.
    """
    model = problem.model
    total = uncertainty.random + uncertainty.common
    deviation = np.sqrt(np.diag(total))
    names = list(model.parameter_names)
    found = {i for i in range(len(names)) if i not in problem.free and i not in problem.fixed}

    def significant(name: str) -> bool:
        i = names.index(name)
        # a fixed value has deviation 0; NaN compares as False
        return bool(internal[i] > 0 and internal[i] >= SIGNIFICANCE * deviation[i])

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
