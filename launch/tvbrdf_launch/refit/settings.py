"""With which settings a refit is made: those of the run that was recorded, and what is asked."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from ..errors import RunError, did_you_mean

AUTO, DEFAULT_METHOD = "auto", "separable"
FRAMES, RADIANCE = "frames", "radiance"


@dataclass(frozen=True, slots=True)
class CalibrationFile:
    """A calibration as it was read: from a file, or from inside a bag."""

    name: str
    data: bytes

    @property
    def sha256(self) -> str:
        """SHA-256 of its bytes."""
        return hashlib.sha256(self.data).hexdigest()


@dataclass(frozen=True, slots=True)
class Settings:
    """What the user asks for; None: as in the run that was recorded, else the fitter's default."""

    model: str | None = None
    metric: str | None = None
    loss: str | None = None
    method: str | None = None
    fixed: Mapping[str, float] | None = None
    calibration: CalibrationFile | None = None
    start: str | None = None
    """``frames`` or ``radiance``; None: frames where there are any."""

    def fitter(self, recorded: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fitter's parameters; ``recorded`` are those of the run."""
        from tvbrdf_nodes.fitter.node import FitterParameters

        known = {part.name for part in fields(FitterParameters)}
        found = asdict(FitterParameters())
        found |= {name: value for name, value in recorded.items() if name in known}
        if self.model is not None and self.model != found["model"] and self.fixed is None:
            found["fixed"] = {}  # they belong to the run's model
        for name in ("model", "metric", "loss", "method"):
            value = getattr(self, name)
            if value is not None:
                found[name] = value
        if self.fixed is not None:
            found["fixed"] = dict(self.fixed)
        return found


@dataclass(frozen=True, slots=True)
class Plan:
    """The parameters of the nodes for one source."""

    start: str
    fitter: dict[str, Any]
    merger: dict[str, Any] = field(default_factory=dict)
    """Without the calibration's path."""
    calibration: CalibrationFile | None = None

    @property
    def sequential(self) -> bool:
        """Whether a scan's result depends on the scan before: a model is kept while it holds."""
        return bool(self.fitter["model"] == AUTO)

    def plain(self) -> dict[str, Any]:
        """Return what decides about results, for records."""
        found: dict[str, Any] = {"from": self.start, "fitter": self.fitter}
        if self.merger:
            found["hdr_merger"] = self.merger
        if self.calibration is not None:
            found["calibration"] = {
                "name": self.calibration.name,
                "sha256": self.calibration.sha256,
            }
        return found


def read_calibration_file(path: Path) -> CalibrationFile:
    """Return a calibration file's bytes.

    Raises
    ------
    RunError
        If it can't be read.
    """
    try:
        return CalibrationFile(path.name, path.read_bytes())
    except OSError as error:
        raise RunError(
            f"{path}: the calibration can't be read: {error.strerror}; give the rig's own file "
            "with --calibration"
        ) from error


def check_settings(settings: Settings) -> None:
    """Refuse unknown names before anything is read.

    Raises
    ------
    RunError
        The text names what there is.
    """
    from tvbrdf_fitting.metrics import METRICS
    from tvbrdf_fitting.models import get_model
    from tvbrdf_fitting.solve.losses import LOSSES

    names: dict[str, Iterable[str]] = {"metric": METRICS, "loss": LOSSES}
    if settings.method not in {None, DEFAULT_METHOD}:  # the others take long to load
        from tvbrdf_fitting.solve.solvers import SOLVERS

        names["method"] = SOLVERS
    for name, known in names.items():
        value = getattr(settings, name)
        if value is not None and value not in known:
            hint = did_you_mean(value, known, "there are")
            raise RunError(f"unknown {name} {value!r}; {hint}")
    if settings.model is None:
        return
    if settings.model == AUTO:
        if settings.fixed:
            raise RunError("--fixed needs a model: with --model auto, parameters differ")
        return
    try:
        model = get_model(settings.model)
    except ValueError as error:
        raise RunError(str(error)) from error
    if model.delta:
        raise RunError(f"model {model.name} is a delta function: for rendering, not for fits")
