"""The fitter: fits each scan as it arrives, and publishes its parameters, errors and solve time."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import Parameters, Radiance, Stored

from ..core.device import DeviceError
from ..core.node import Node, Outputs, Release, Send, TopicUse

if TYPE_CHECKING:
    from tvbrdf_fitting.inference.nuisances import CommonErrors
    from tvbrdf_fitting.observations import Observations
    from tvbrdf_fitting.result import FitResult


AUTO = "auto"


@dataclass(frozen=True, slots=True, kw_only=True)
class FitterParameters:
    """What is fitted, and how."""

    model: str = "oren_nayar+torrance_sparrow"
    """Or ``auto``: the simplest that explains the data, and kept while the next scans allow."""
    method: str = "separable"
    metric: str = "radiance"
    loss: str = "least_squares"
    fixed: dict[str, Any] = field(default_factory=dict)
    """Published values that are known, by name (for dust: w, g, Kd and σd)."""

    def __post_init__(self) -> None:
        """Refuse fixed values that are no numbers, or whose model is not known yet."""
        if self.fixed and self.model == AUTO:
            raise ValueError(f"fixed: not with model: {AUTO}, which chooses among several models")
        for name, value in self.fixed.items():
            if not isinstance(value, (int, float)) or isinstance(value, bool):
                raise ValueError(f"fixed: {name} is {value!r}, expected a number")


class FitterNode(Node[FitterParameters]):
    """Turns ``/scan/radiance`` into ``/scan/parameters``."""

    parameters_type = FitterParameters
    drains = True

    @classmethod
    def topics(cls, name: str, parameters: FitterParameters) -> TopicUse:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return TopicUse(
            takes=("/clock", "/scan/radiance", "/scan/stored"),
            gives=("/scan/parameters", "/diagnostics", "/log"),
        )

    def prepare(self) -> None:
        """Load the solver, and refuse an unknown model or fixed parameter before anything moves."""
        from tvbrdf_fitting.fit import LOSSES, METRICS, SOLVERS  # takes most of a second
        from tvbrdf_fitting.models import get_model
        from tvbrdf_fitting.solve import separable

        given = self.parameters
        for name, known in (("method", SOLVERS), ("metric", METRICS), ("loss", LOSSES)):
            if getattr(given, name) not in known:
                raise DeviceError(
                    f"{name}: {getattr(given, name)!r} is unknown; known: {', '.join(known)}"
                )
        separable.compile_all()
        self._kept: dict[str, str] = {}
        if given.model == AUTO:
            import tvbrdf_fitting.choice.choose  # noqa: F401

            return
        try:
            names = get_model(given.model).parameter_names
        except ValueError as error:
            raise DeviceError(f"model: {error}") from error
        unknown = sorted(set(given.fixed) - set(names))
        if unknown:
            raise DeviceError(f"fixed: {', '.join(unknown)}: {given.model} has {', '.join(names)}")

    def handle(self, envelope: Envelope) -> Outputs:
        """Fit a scan; forget one that is stored."""
        message = envelope.message
        if isinstance(message, Radiance):
            yield Send(topic="/scan/parameters", message=self._fit(message), keep=str(message.scan))
        elif isinstance(message, Stored) and message.what == "parameters":
            yield Release("/scan/parameters", str(message.scan))

    def _fit(self, radiance: Radiance) -> Parameters:
        from tvbrdf_fitting.inference.nuisances import CommonErrors
        from tvbrdf_fitting.problem import FitError

        common = CommonErrors(
            light_angle_std_deg=dict(enumerate(radiance.light_angle_std_deg.tolist())),
            gain_relative_std=radiance.gain_relative_std,
            frame_relative_std=dict(enumerate(radiance.frame_relative_std, start=1)),
        )
        try:
            if self.parameters.model == AUTO:
                return self._chosen(radiance, common)
            return _parameters(radiance, self._fitted(radiance, common), {})
        except (FitError, ValueError) as error:
            self.context.log.error(f"scan {radiance.scan} can't be fitted: {error}")
            return _unfitted(radiance, self.parameters.model, str(error))

    def _fitted(self, radiance: Radiance, common: CommonErrors) -> FitResult:
        from tvbrdf_fitting.fit import fit_scan

        given = self.parameters
        return fit_scan(
            observations(radiance),
            given.model,
            method=given.method,
            metric=given.metric,
            loss=given.loss,
            fixed=given.fixed,
            common_errors=common,
        )

    def _chosen(self, radiance: Radiance, common: CommonErrors) -> Parameters:
        """Choose a model; the one of the sample's scan before stays unless evidence is clear."""
        from tvbrdf_fitting.choice.choose import choose_model

        given = self.parameters
        choice = choose_model(
            observations(radiance),
            method=given.method,
            metric=given.metric,
            loss=given.loss,
            common_errors=common,
            previous=self._kept.get(radiance.sample),
        )
        self._kept[radiance.sample] = choice.model
        why = {"reason": choice.reason, "rungs": [rung.as_dict() for rung in choice.rungs]}
        return _parameters(radiance, choice.result, {"choice": why})


def observations(radiance: Radiance) -> Observations:
    """Return the observations that a message carries."""
    from tvbrdf_fitting.observations import Observations

    return Observations(
        light_direction=radiance.light_direction,
        view_direction=radiance.view_direction,
        radiance=radiance.radiance,
        variance=radiance.variance,
        valid=radiance.valid,
        camera=radiance.camera,
        sweep=radiance.sweep,
        exposure_ms=radiance.exposure_ms,
        time_s=radiance.scan_time_s + (radiance.stamp_ns - radiance.scan_start_ns) / 1e9,
    )


def _parameters(radiance: Radiance, result: FitResult, more: dict[str, Any]) -> Parameters:
    return Parameters(
        sample=radiance.sample,
        scan=radiance.scan,
        scan_time_s=radiance.scan_time_s,
        model=result.model,
        parameter_names=result.parameter_names,
        values=tuple(result.values.tolist()),
        standard_deviations=tuple(result.standard_deviations.tolist()),
        at_bound=result.at_bound,
        undetermined=result.undetermined,
        errors=result.errors.as_dict(),
        chi_square=result.chi_square,
        degrees_of_freedom=result.degrees_of_freedom,
        model_error_std=result.model_error_std,
        reason=result.reason,
        solver=result.solver,
        evaluations=result.evaluations,
        solve_time_ms=1e3 * result.solve_time_s,
        details={
            "metric": result.metric,
            "loss": result.loss,
            "down_weighted": result.down_weighted,
            "nuisances": {name: list(pair) for name, pair in result.nuisances.items()},
            **more,
        },
        covariance=result.covariance,
    )


def _unfitted(radiance: Radiance, model: str, reason: str) -> Parameters:
    """Say that a scan could not be fitted: every parameter undetermined, and why."""
    import numpy as np

    from tvbrdf_fitting.models import SURFACE, get_model

    chosen = get_model(SURFACE if model == AUTO else model)
    count = len(chosen.parameter_names)
    nothing = (math.nan,) * count
    return Parameters(
        sample=radiance.sample,
        scan=radiance.scan,
        scan_time_s=radiance.scan_time_s,
        model=chosen.name,
        parameter_names=chosen.parameter_names,
        values=nothing,
        standard_deviations=nothing,
        at_bound=(),
        undetermined=chosen.parameter_names,
        errors={},
        chi_square=math.nan,
        degrees_of_freedom=0,
        model_error_std=math.nan,
        reason=f"not fitted: {reason}",
        solver="none",
        evaluations=0,
        solve_time_ms=0.0,
        details={},
        covariance=np.full((count, count), math.nan),
    )
