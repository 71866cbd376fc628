"""What a choice of model gives: the kept fit, why it was kept, and every rung that was tried."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..geometry import FloatArray
from ..result import FitResult


@dataclass(frozen=True)
class Rung:
    """One model of the ladder and why it was kept or not.

    Attributes
    ----------
    model
        Its name, with what was held; `previous` takes it.
    parameters
        Number of free parameters.
    rejected
        Why it was not kept; empty for the kept one.
    chi_square, degrees_of_freedom, model_error_std
        Of its fit, at the stated variances.
    noise
        Root mean square of its residuals in stated deviations: the noise it would need.
    criterion
        As in `choose`; of a jointly chosen series the sum over scans.
    error
        Root mean square of its residuals, in deviations of the errors estimated for all rungs.
    highlight
        Share of its most distinct lobe that diffuse parts can't make; infinite without lobes, NaN
        where a rung explains the data, so that it does not count.
    undetermined
        Parameters that the data do not determine.
    explains
        Whether noise explains what it leaves: `noise` squared is at most `ladder.EXPLAINED`.
    solve_time_s
        Cost of its fit.
    """

    model: str
    parameters: int
    rejected: str
    chi_square: float = math.nan
    degrees_of_freedom: int = 0
    model_error_std: float = math.nan
    noise: float = math.nan
    criterion: float = math.nan
    error: float = math.nan
    highlight: float = math.nan
    undetermined: tuple[str, ...] = ()
    explains: bool = False
    solve_time_s: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Everything as plain Python types, numbers that are not finite as None (valid JSON)."""
        plain = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return {
            name: None if isinstance(v, float) and not math.isfinite(v) else v
            for name, v in plain.items()
        } | {"undetermined": list(self.undetermined)}


@dataclass(frozen=True, eq=False)
class ModelChoice:
    """The fit that was kept, and why.

    Attributes
    ----------
    result
        The kept fit.
    model
        Its rung's name, with what was held; what `previous` takes.
    reason
        In words.
    rungs
        Every rung fitted, in the order of the climb.
    standard_deviations
        (p,) of the result's parameters, published units, with the spread over the rungs that
        explain the data as well (see `spread`). NaN and 0 as in the result.
    internal_deviations
        (p,) the same in the coordinates fitted.
    weights
        Of these rungs by name, sum 1.
    values, effective_values
        Number of values, and how many independent ones they are worth.
    solve_time_s
        Of all rungs.
    """

    result: FitResult
    model: str
    reason: str
    rungs: tuple[Rung, ...]
    standard_deviations: FloatArray
    internal_deviations: FloatArray
    weights: Mapping[str, float]
    values: int
    effective_values: float
    solve_time_s: float

    def as_dict(self) -> dict[str, Any]:
        """Everything as plain Python types, numbers that are not finite as None (valid JSON)."""
        return {
            "model": self.model,
            "reason": self.reason,
            "values": self.values,
            "effective_values": self.effective_values,
            "solve_time_s": self.solve_time_s,
            "standard_deviations": {
                name: float(d) if math.isfinite(d) else None
                for name, d in zip(
                    self.result.parameter_names, self.standard_deviations, strict=True
                )
            },
            "weights": dict(self.weights),
            "rungs": [rung.as_dict() for rung in self.rungs],
            "result": self.result.as_dict(),
        }
