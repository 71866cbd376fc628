"""What a fit returns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .error_measures import ErrorMeasures
from .geometry import FloatArray
from .models import get_model


@dataclass(frozen=True, eq=False)
class FitResult:
    """Parameters of one scan, how well they are known, and how it went.

    Everything is in published units and in the order of `parameter_names`.

    Attributes
    ----------
    model
        Full name, which `get_model` takes; it also records the form of a dust model.
    parameter_names, values
        (p,) fitted or fixed values; NaN for a channel that was not measured.
    covariance_random, covariance_common
        (p, p) from the errors of each value, and from errors that frames share (0 unless they were
        stated). NaN for parameters the data say nothing of. sigma_d near 0 has a deviation that
        covers the interval of sigma_d^2 (`uncertainty.published_scale`). With
        `model_error_std` above 0 they belong to a model that is wrong: they say how well its best
        values are defined, not how near the truth they are.
    at_bound
        Names of the free parameters that ended at a bound; deviations there are one-sided at best.
    undetermined
        Names of parameters whose value means nothing, for example sigma_s without a lobe.
    fixed
        Names of the parameters that were given.
    errors
        Error measures over the usable observations.
    model_error_std
        Standard deviation of radiance that was added to the noise because the model can't explain
        the data without; 0 where it can. The chi-square is without it.
    chi_square, degrees_of_freedom
        Sum of squared weighted residuals, and values less free parameters.
    solver, reason, evaluations
        What ran, why it stopped, and how often it evaluated the model.
    solve_time_s
        Wall time of the whole fit with its uncertainty and error measures.
    internal_names, internal_values, internal_covariance
        The coordinates fitted (sigma_d^2, log(1/sigma_s), artanh(g)) and their total covariance:
        there deviations are closest to normal.
    """

    model: str
    parameter_names: tuple[str, ...]
    values: FloatArray
    covariance_random: FloatArray
    covariance_common: FloatArray
    at_bound: tuple[str, ...]
    undetermined: tuple[str, ...]
    fixed: tuple[str, ...]
    errors: ErrorMeasures
    chi_square: float
    degrees_of_freedom: int
    model_error_std: float
    solver: str
    reason: str
    evaluations: int
    solve_time_s: float
    internal_names: tuple[str, ...]
    internal_values: FloatArray
    internal_covariance: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """(p, p) total covariance."""
        return self.covariance_random + self.covariance_common

    @property
    def standard_deviations(self) -> FloatArray:
        """(p,) total standard deviations; 0 for fixed parameters, NaN where there is none."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlations(self) -> FloatArray:
        """(p, p) correlations; NaN for fixed parameters and where there is no deviation."""
        deviation = self.standard_deviations
        scale = np.where(deviation > 0, deviation, np.nan)
        return np.asarray(self.covariance / np.outer(scale, scale))

    @property
    def parameters(self) -> dict[str, float]:
        """Values by name."""
        return dict(zip(self.parameter_names, self.values.tolist(), strict=True))

    def value(self, name: str) -> float:
        """Return a parameter's value."""
        return float(self.values[self._index(name)])

    def standard_deviation(self, name: str) -> float:
        """Return a parameter's total standard deviation."""
        return float(self.standard_deviations[self._index(name)])

    def brdf(self, light: ArrayLike, view: ArrayLike) -> FloatArray:
        """BRDF (n, 3) of the fitted model in 1/sr, B, G, R, for unit directions (n, 3)."""
        return get_model(self.model).evaluate(light, view, self.values)

    def radiance(self, light: ArrayLike, view: ArrayLike) -> FloatArray:
        """Pi x BRDF x cos(theta_i) (n, 3) of the fitted model."""
        cosine = np.atleast_2d(np.asarray(light, dtype=np.float64))[:, 2:3]
        return np.asarray(np.pi * cosine * self.brdf(light, view))

    def as_dict(self) -> dict[str, Any]:
        """Everything as plain Python types, numbers that are not finite as None (valid JSON)."""
        return {
            "model": self.model,
            "parameter_names": list(self.parameter_names),
            "values": _plain(self.values),
            "standard_deviations": _plain(self.standard_deviations),
            "covariance_random": _plain(self.covariance_random),
            "covariance_common": _plain(self.covariance_common),
            "at_bound": list(self.at_bound),
            "undetermined": list(self.undetermined),
            "fixed": list(self.fixed),
            "errors": self.errors.as_dict(),
            "chi_square": _plain(self.chi_square),
            "degrees_of_freedom": self.degrees_of_freedom,
            "model_error_std": self.model_error_std,
            "solver": self.solver,
            "reason": self.reason,
            "evaluations": self.evaluations,
            "solve_time_s": self.solve_time_s,
            "internal_names": list(self.internal_names),
            "internal_values": _plain(self.internal_values),
            "internal_covariance": _plain(self.internal_covariance),
        }

    def _index(self, name: str) -> int:
        if name not in self.parameter_names:
            raise KeyError(f"{self.model} has no parameter {name!r}: {self.parameter_names}")
        return self.parameter_names.index(name)


def _plain(values: FloatArray | float) -> Any:
    if isinstance(values, np.ndarray):
        return [_plain(v) for v in values]
    number = float(values)
    return number if math.isfinite(number) else None
