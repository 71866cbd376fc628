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
    from tvbrdf_fitting.observations import Observations
    from tvbrdf_fitting.result import FitResult


@dataclass(frozen=True, slots=True, kw_only=True)
class FitterParameters:
    """What is fitted, and how."""

    model: str = "oren_nayar+torrance_sparrow"
    method: str = "separable"
    fixed: dict[str, Any] = field(default_factory=dict)
    """Published values that are known, by name (for dust: w, g, Kd and σd)."""

    def __post_init__(self) -> None:
        """Refuse fixed values that are no numbers."""
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
        from tvbrdf_fitting import separable
        from tvbrdf_fitting.fit import fit_scan  # noqa: F401 - takes most of a second
        from tvbrdf_fitting.models import get_model

        separable.compile_all()
        try:
            names = get_model(self.parameters.model).parameter_names
        except ValueError as error:
            raise DeviceError(f"model: {error}") from error
        unknown = sorted(set(self.parameters.fixed) - set(names))
        if unknown:
            raise DeviceError(
                f"fixed: {', '.join(unknown)}: {self.parameters.model} has {', '.join(names)}"
            )

    def handle(self, envelope: Envelope) -> Outputs:
        """Fit a scan; forget one that is stored."""
        message = envelope.message
        if isinstance(message, Radiance):
            yield Send(topic="/scan/parameters", message=self._fit(message), keep=str(message.scan))
        elif isinstance(message, Stored) and message.what == "parameters":
            yield Release("/scan/parameters", str(message.scan))

    def _fit(self, radiance: Radiance) -> Parameters:
        from tvbrdf_fitting.fit import fit_scan
        from tvbrdf_fitting.nuisances import CommonErrors
        from tvbrdf_fitting.problem import FitError

        offsets = dict(enumerate(radiance.light_angle_std_deg.tolist()))
        common = CommonErrors(
            light_angle_std_deg=offsets,
            gain_relative_std=radiance.gain_relative_std,
            frame_relative_std=dict(enumerate(radiance.frame_relative_std, start=1)),
        )
        try:
            result = fit_scan(
                observations(radiance),
                self.parameters.model,
                method=self.parameters.method,
                fixed=self.parameters.fixed,
                common_errors=common,
            )
        except (FitError, ValueError) as error:
            self.context.log.error(f"scan {radiance.scan} can't be fitted: {error}")
            return _unfitted(radiance, self.parameters.model, str(error))
        return _parameters(radiance, result)


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


def _parameters(radiance: Radiance, result: FitResult) -> Parameters:
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
        covariance=result.covariance,
    )


def _unfitted(radiance: Radiance, model: str, reason: str) -> Parameters:
    """Say that a scan could not be fitted: every parameter undetermined, and why."""
    import numpy as np

    from tvbrdf_fitting.models import get_model

    chosen = get_model(model)
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
        covariance=np.full((count, count), math.nan),
    )
