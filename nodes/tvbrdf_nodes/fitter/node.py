"""The fitter: fits each scan as it arrives, and publishes its parameters, errors and solve time."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

from tvbrdf_messages.envelope import Envelope, epoch_of
from tvbrdf_messages.messages import Parameters, Radiance, Stored

from ..core.device import DeviceError
from ..core.node import Node, NodeContext, Outputs, Release, Send, TopicUse

if TYPE_CHECKING:
    from tvbrdf_fitting.inference.nuisances import CommonErrors
    from tvbrdf_fitting.observations import Observations
    from tvbrdf_fitting.result import FitResult


AUTO = "auto"
METHOD = "separable"
_OF_SCAN = ("sample", "scan", "scan_time_s")
_OF_RESULT = (
    "model",
    "parameter_names",
    "at_bound",
    "undetermined",
    "chi_square",
    "degrees_of_freedom",
    "model_error_std",
    "reason",
    "solver",
    "evaluations",
    "covariance",
)
"""What parameters have from their scan's radiance and from its fit, under the same names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitterParameters:
    """What is fitted, and how."""

    model: str = "oren_nayar+torrance_sparrow"
    """Or ``auto``: the simplest that explains the data, and kept while the next scans allow."""
    method: str = METHOD
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

    def __init__(self, context: NodeContext, parameters: FitterParameters) -> None:
        super().__init__(context, parameters)
        _check(parameters)
        self._kept: dict[str, str] = {}
        """The model chosen for a sample's last scan."""
        self._epoch = 0
        """Of that scan."""
        self._unstored: set[tuple[int, int]] = set()
        """Scan and attempt of parameters that were sent and are not stored yet."""

    @classmethod
    def topics(cls, name: str, parameters: FitterParameters) -> TopicUse:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return TopicUse(
            takes=("/clock", "/scan/radiance", "/scan/stored"),
            gives=("/scan/parameters", "/diagnostics", "/log"),
        )

    def prepare(self) -> None:
        """Load the solver; what is sent meanwhile waits."""
        import tvbrdf_fitting.fit  # takes most of a second
        from tvbrdf_fitting.solve import separable

        separable.compile_all()
        if self.parameters.model == AUTO:
            import tvbrdf_fitting.choice.choose  # noqa: F401

    def handle(self, envelope: Envelope) -> Outputs:
        """Fit a scan; forget one that is stored.

        Merger and database may both send a scan to a fitter that was restarted.
        """
        message = envelope.message
        if isinstance(message, Radiance):
            key = (message.scan, message.attempt)
            if key not in self._unstored:
                self._unstored.add(key)
                self._note_epoch(epoch_of(envelope.header.incarnation))
                fitted = self._fit(message)
                yield Send(topic="/scan/parameters", message=fitted, keep=str(message.scan))
        elif isinstance(message, Stored) and message.what == "parameters":
            self._unstored = {key for key in self._unstored if key[0] != message.scan}
            yield Release("/scan/parameters", str(message.scan))

    def _note_epoch(self, epoch: int) -> None:
        """Forget the model of the scan before if a replay has jumped, and begins anew.

        By the scan's own word: the database's may be here before the merger's last one of before.
        """
        if epoch != self._epoch:
            self._epoch = epoch
            self._kept.clear()

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


def _check(given: FitterParameters) -> None:
    """Refuse what is unknown before anything moves."""
    from tvbrdf_fitting.metrics import METRICS
    from tvbrdf_fitting.models import get_model
    from tvbrdf_fitting.solve.losses import LOSSES

    known: dict[str, Iterable[str]] = {"metric": METRICS, "loss": LOSSES}
    if given.method != METHOD:  # the others take long to load
        from tvbrdf_fitting.solve.solvers import SOLVERS

        known["method"] = SOLVERS
    for name, names in known.items():
        value = getattr(given, name)
        if value not in names:
            raise DeviceError(f"{name}: {value!r} is unknown; known: {', '.join(names)}")
    if given.model == AUTO:
        return
    try:
        parameter_names = get_model(given.model).parameter_names
    except ValueError as error:
        raise DeviceError(f"model: {error}") from error
    unknown = sorted(set(given.fixed) - set(parameter_names))
    if unknown:
        raise DeviceError(
            f"fixed: {', '.join(unknown)}: {given.model} has {', '.join(parameter_names)}"
        )


def observations(radiance: Radiance) -> Observations:
    """Return the observations that a message carries."""
    from tvbrdf_fitting.observations import Observations

    names = [part.name for part in fields(Observations) if part.name != "time_s"]
    since_start_s = (radiance.stamp_ns - radiance.scan_start_ns) / 1e9
    return Observations(**_copied(radiance, names), time_s=radiance.scan_time_s + since_start_s)


def _copied(source: Any, names: Iterable[str]) -> dict[str, Any]:
    return {name: getattr(source, name) for name in names}


def _parameters(radiance: Radiance, result: FitResult, more: dict[str, Any]) -> Parameters:
    nuisances = {name: list(pair) for name, pair in result.nuisances.items()}
    details = _copied(result, ("metric", "loss", "down_weighted"))
    return Parameters(
        **_copied(radiance, _OF_SCAN),
        **_copied(result, _OF_RESULT),
        values=tuple(result.values.tolist()),
        standard_deviations=tuple(result.standard_deviations.tolist()),
        errors=result.errors.as_dict(),
        solve_time_ms=1e3 * result.solve_time_s,
        details={**details, "nuisances": nuisances, **more},
    )


def _unfitted(radiance: Radiance, model: str, reason: str) -> Parameters:
    """Say that a scan could not be fitted: every parameter undetermined, and why."""
    import numpy as np

    from tvbrdf_fitting.models import SURFACE, get_model

    chosen = get_model(SURFACE if model == AUTO else model)
    names = chosen.parameter_names
    nothing = (math.nan,) * len(names)
    return Parameters(
        **_copied(radiance, _OF_SCAN),
        model=chosen.name,
        parameter_names=names,
        values=nothing,
        standard_deviations=nothing,
        at_bound=(),
        undetermined=names,
        errors={},
        chi_square=math.nan,
        degrees_of_freedom=0,
        model_error_std=math.nan,
        reason=f"not fitted: {reason}",
        solver="none",
        evaluations=0,
        solve_time_ms=0.0,
        details={},
        covariance=np.full((len(names), len(names)), math.nan),
    )
