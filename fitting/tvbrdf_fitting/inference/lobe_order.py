"""Which of several lobes of one kind comes first.

A sum of lobes is the same in any order, so that a solver ends at one or another as the noise has
it: of two scans of one sample, `ks_2` would belong to the broad lobe in one and to the narrow one
in the other. So results are put in order: the broader lobe first; lobes without an amplitude, or
whose shape is undetermined, come last.

Only lobes that the request treats alike change places: of one kind and with the same options,
parameter by parameter either both free within the same bounds or both fixed to the same value, none
of them tied, none given a value to start from.
"""

from __future__ import annotations

from collections.abc import Collection
from collections.abc import Set as AbstractSet
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..geometry import FloatArray, IntArray
from ..models.lobe import Twin
from ..problem import Problem

if TYPE_CHECKING:
    from ..result import FitResult


def in_order(result: FitResult, problem: Problem, named: Collection[str]) -> FitResult:
    """Return a fit's result with lobes of one kind in order, in all that goes by parameters.

    Parameters
    ----------
    result
        As the solver left it.
    problem
        What was solved.
    named
        Parameters that the request ties or starts from a value: their lobes stay where they are.
    """
    if not problem.model.twins:
        return result
    names = result.parameter_names
    lost = {i for i, name in enumerate(names) if name in result.undetermined}
    order = lobe_order(problem, result.internal_values, lost, named)
    if order is None:
        return result
    square = np.ix_(order, order)

    def moved(flagged: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(n for n, i in zip(names, order.tolist(), strict=True) if names[i] in flagged)

    optimum = result.optimum
    return replace(
        result,
        values=_frozen(result.values[order]),
        covariance_random=_frozen(result.covariance_random[square]),
        covariance_common=_frozen(result.covariance_common[square]),
        at_bound=moved(result.at_bound),
        undetermined=moved(result.undetermined),
        internal_values=_frozen(result.internal_values[order]),
        internal_covariance=_frozen(result.internal_covariance[square]),
        optimum=optimum and replace(optimum, internal=optimum.internal[order]),
    )


def lobe_order(
    problem: Problem,
    internal: FloatArray,
    lost: AbstractSet[int] = frozenset(),
    named: Collection[str] = (),
) -> IntArray | None:
    """Return where each parameter (p,) is to come from, or None where all are in place.

    Parameters
    ----------
    problem, named
        As of `in_order`.
    internal
        Coordinates (p,).
    lost
        Places of those that mean nothing.
    """
    order = np.arange(len(internal))

    def rank(twin: Twin) -> tuple[bool, float]:
        shapes = [i for i in range(twin.amplitudes.stop, twin.places.stop) if i in problem.free]
        dark = not (internal[twin.amplitudes] > 0).any()  # NaN where it was not measured
        return dark or (bool(shapes) and lost >= set(shapes)), twin.sharpness(internal)

    for kind in problem.model.twins:
        for alike in _alike(problem, kind, named):
            for here, twin in zip(alike, sorted(alike, key=rank), strict=True):
                order[here.places] = np.arange(twin.places.start, twin.places.stop)
    return None if (order == np.arange(len(order))).all() else order


def _alike(problem: Problem, kind: tuple[Twin, ...], named: Collection[str]) -> list[list[Twin]]:
    """Return groups of lobes of one kind that the request treats alike."""
    names = problem.model.parameter_names
    groups: dict[tuple[object, ...], list[Twin]] = {}
    for twin in kind:
        where = range(twin.places.start, twin.places.stop)
        if not any(names[i] in named for i in where):
            asked = tuple(
                (
                    i in problem.free,
                    float(problem.values[i]) if i in problem.fixed else None,
                    float(problem.lower[i]),
                    float(problem.upper[i]),
                )
                for i in where
            )
            groups.setdefault(asked, []).append(twin)
    return list(groups.values())


def _frozen(array: FloatArray) -> FloatArray:
    array.setflags(write=False)
    return array
