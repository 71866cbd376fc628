"""How much parameters differ over the rungs that explain a scan as well as the kept one.

A fit's covariance takes its model for granted. Where a rung was kept that others are hardly worse
than, or better by less than decides, the choice itself is uncertain, and a model that is too simple
moves the parameters that it has. With weights w_i of these rungs from the criterion (Burnham and
Anderson, "Model Selection and Multimodel Inference", 2002, section 4.3), C_i the variance that rung
i states and x_i its value::

    variance = sum w_i (C_i + (x_i - x)^2),    x the kept rung's value, which stays

The sum is over rungs in which a parameter means the same: albedos and roughness in any of them, a
lobe's parameters in lobes of the same kind, coloured or not, of which either model has one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ..geometry import FloatArray
from ..inference.uncertainty import Uncertainty, published_scale
from ..models import ReflectanceModel, SumModel, get_model
from ..models.registry import split
from ..result import FitResult
from .rule import DECISIVE

_DIFFUSE, _COLOURED = "diffuse", "coloured"


def weights_of(above: Mapping[str, float]) -> dict[str, float]:
    """Weights of rungs by name, sum 1, from their criteria's differences to the kept one's.

    Differences of `DECISIVE` and more have none. A lower criterion counts as the kept one's: by the
    rule the difference does not decide.
    """
    weight = {n: math.exp(-0.5 * max(d, 0.0)) for n, d in above.items() if d < DECISIVE}
    total = sum(weight.values())
    return {name: w / total for name, w in weight.items()}


def deviations_over(
    kept: FitResult, fits: Mapping[str, FitResult], weights: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    """Standard deviations (p,) of a kept fit's parameters, within rungs and between them.

    Parameters
    ----------
    kept
        The fit that is kept.
    fits
        It, and others of the same scan, by name.
    weights
        By name, as of `weights_of`; fits without a weight do not count.

    Returns
    -------
    internal, published
        NaN for what the kept fit says nothing of, 0 where a parameter is fixed. The published ones
        are those that belong to the internal ones, as a fit's do (`published_scale`).
    """
    if kept.optimum is None:
        raise ValueError(f"{kept.model}: the fit did not keep where it ended")
    total, variance = np.zeros(len(kept.values)), np.zeros(len(kept.values))
    for name, weight in weights.items():
        fit = fits[name]
        for mine, other in _shared(kept, fit):
            off = fit.internal_values[other] - kept.internal_values[mine]
            spread = fit.internal_covariance[other, other] + off * off
            if fit is kept or math.isfinite(spread):
                total[mine] += weight
                variance[mine] += weight * spread
    internal = np.sqrt(variance / total)
    covariance = _widened(np.asarray(kept.internal_covariance), internal)
    problem = kept.optimum.posterior.problem
    uncertainty = Uncertainty(covariance, np.zeros_like(covariance), (), np.zeros(0))
    scale = published_scale(problem, kept.optimum.internal, uncertainty)
    return internal, np.asarray(internal * scale)


def _widened(covariance: FloatArray, deviations: FloatArray) -> FloatArray:
    """Covariance with other deviations and the same correlations."""
    before = np.sqrt(np.diag(covariance))
    factor = np.where(before > 0, deviations / np.where(before > 0, before, 1.0), 1.0)
    return np.asarray(covariance * np.outer(factor, factor))


def _shared(kept: FitResult, other: FitResult) -> list[tuple[int, int]]:
    """Indices of parameters that mean the same in both fits."""
    if other is kept:
        return [(index, index) for index in range(len(kept.values))]
    mine, its = _meanings(get_model(kept.model)), _meanings(get_model(other.model))
    return [(index, its[meaning]) for meaning, index in mine.items() if meaning in its]


def _meanings(model: ReflectanceModel) -> dict[tuple[str, ...], int]:
    """Index of each parameter by the kind of part that it belongs to and its name there.

    Parts of which there are two of a kind are left out: which is which differs from fit to fit.
    """
    if not isinstance(model, SumModel):
        kind = _kind(model)
        return {(*kind, name): index for index, name in enumerate(model.parameter_names)}
    kinds = [_kind(part) for part in model.parts]
    return {
        (*kind, name): where.start + index
        for part, kind, where in zip(model.parts, kinds, model.slices, strict=True)
        if kinds.count(kind) == 1
        for index, name in enumerate(part.parameter_names)
    }


def _kind(part: ReflectanceModel) -> tuple[str, ...]:
    """What a part is, without its colours; all that is diffuse is of one kind."""
    if part.diffuse:
        return (_DIFFUSE,)
    (entry, options), *layered = split(part.name)
    if layered:
        return (part.name,)
    return (entry.name, *(option for option in options if option != _COLOURED))
