"""What a fit returns."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .error_measures import ErrorMeasures
from .geometry import FloatArray
from .models import get_model

if TYPE_CHECKING:
    from .inference.marginal import Optimum


@dataclass(frozen=True, eq=False)
class FitResult:
    """Parameters of one scan, how well they are known, and how it went.

    Everything is in published units and in the order of `parameter_names`.

    Attributes
    ----------
    model
        Full name, which `get_model` takes; it also records the form of a dust model.
    parameter_names, values
        (p,) fitted or fixed values; NaN for a channel that was not measured. Where errors that
        frames share were stated, they are the most probable ones, with those errors as unknowns
        (unless the model is wrong, see `marginal`).
    covariance_random, covariance_common
        (p, p) from the errors of each value, and from errors that frames share (0 unless they were
        stated). Fits of scans with one calibration have the latter errors in common. NaN for
        parameters the data say nothing of. sigma_d near 0 has a deviation that covers the interval
        of sigma_d^2 (`uncertainty.published_scale`). With `model_error_std` above 0 they belong to
        a model that is wrong: they say how well its best values are defined, not how near the
        truth they are.
    at_bound
        Names of the free parameters that ended at a bound; deviations there are one-sided at best.
    undetermined
        Names of parameters whose value means nothing, for example sigma_s without a lobe.
    fixed
        Names of the parameters that were given.
    errors
        Error measures over the usable observations, of the parameters alone, without `nuisances`.
    model_error_std
        Standard deviation of radiance that was added to the noise because the model can't explain
        the data without; 0 where it can. The chi-square is without it.
    chi_square, degrees_of_freedom
        Sum of squared weighted residuals, and values less free parameters. Where errors that
        frames share were stated, residuals are those that the nuisances leave, and their squares in
        prior deviations are in the sum: each adds a term and an unknown.
    solver, reason, evaluations
        What ran, why it stopped, and how often it evaluated the model.
    solve_time_s
        Wall time of the whole fit with its uncertainty and error measures.
    internal_names, internal_values, internal_covariance
        The coordinates fitted (sigma_d^2, log(1/sigma_s), artanh(g)) and their total covariance:
        there deviations are closest to normal.
    internal_bounds
        (2, p) lower and upper bounds of the fit in these coordinates.
    nuisances
        Errors that frames share as the fit found them, with the standard deviation that is left:
        a gain's is relative, as in `gain_camera1_b`, `light_offset_sweep2_deg`, `plate_tilt_x_deg`.
    metric
        Of `metrics.METRICS`; `chi_square` and `model_error_std` are in it: for "log" and "relative"
        the latter is relative, else in radiance (for "cosine_weighted" of light along the normal).
    loss
        Of `losses.LOSSES`.
    down_weighted
        Number of values that a robust loss gave less than half of their weight.
    tied
        Parameters that follow another one, by name.
    optimum
        Where the fit ended, for `interval`; not kept when a result is pickled or copied.
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
    internal_bounds: FloatArray
    nuisances: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    metric: str = "radiance"
    loss: str = "least_squares"
    down_weighted: int = 0
    tied: Mapping[str, str] = field(default_factory=dict)
    optimum: Optimum | None = field(default=None, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"optimum": None}

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
        return float(self.values[self.index(name)])

    def standard_deviation(self, name: str) -> float:
        """Return a parameter's total standard deviation."""
        return float(self.standard_deviations[self.index(name)])

    def interval(self, name: str, sigmas: float = 3.0) -> tuple[float, float]:
        """Return the ends of a parameter's interval, published units, in general not symmetric.

        From the internal covariance where chi-square rises as that says, which takes two fits of
        the other parameters; else, as near a bound or where the parameter is undetermined, from
        the profile of chi-square, which takes some tens (see `profile_likelihood`). A fixed
        parameter's is its value, that of one without any data all that the bounds allow.

        Parameters
        ----------
        name
            Of the parameter.
        sigmas
            Half the length in standard deviations, as if the errors were normal: 3 covers 99.73 %.

        Raises
        ------
        KeyError
            No such parameter.
        ValueError
            `sigmas` is not a positive number, or a profile is needed and the result no longer has
            the data, as after pickling.
        """
        from .inference.profile_likelihood import interval

        return interval(self, name, sigmas)

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
            "internal_bounds": _plain(self.internal_bounds),
            "nuisances": {name: list(pair) for name, pair in self.nuisances.items()},
            "metric": self.metric,
            "loss": self.loss,
            "down_weighted": self.down_weighted,
            "tied": dict(self.tied),
        }

    def index(self, name: str) -> int:
        """Return a parameter's place in `parameter_names`."""
        if name not in self.parameter_names:
            raise KeyError(f"{self.model} has no parameter {name!r}: {self.parameter_names}")
        return self.parameter_names.index(name)


def _plain(values: FloatArray | float) -> Any:
    if isinstance(values, np.ndarray):
        return [_plain(v) for v in values]
    number = float(values)
    return number if math.isfinite(number) else None
