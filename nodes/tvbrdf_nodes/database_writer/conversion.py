"""From messages to what the store keeps, and back."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final

from tvbrdf_fitting.geometry import light_direction
from tvbrdf_fitting.published import CameraScan
from tvbrdf_fitting.published.database import DatabaseError
from tvbrdf_messages.errors import MessageError
from tvbrdf_messages.messages import Parameters, Radiance

from .records import FitRecord, ScanRecord

if TYPE_CHECKING:
    from tvbrdf_fitting.published.database import StoredScan

_ARRAYS: Final = {part.name: part.array for part in Radiance.schema() if part.array}
"""What is kept of a scan bit for bit: the message's arrays."""
_BESIDE_QUALITY: Final[dict[str, Any]] = {
    "attempt": 0,
    "cameras": (),
    "gain_relative_std": 0.0,
    "frame_relative_std": (),
}
"""Fields of the message that are kept among its quality, and what they are in old databases."""
_OF_FIT: Final = ("chi_square", "degrees_of_freedom", "model_error_std")
"""Fields of the message that are kept among the error measures."""


def scan_record(radiance: Radiance) -> ScanRecord:
    """Return what the store keeps of a message."""
    beside = {name: getattr(radiance, name) for name in _BESIDE_QUALITY}
    return ScanRecord(
        sample=radiance.sample,
        scan=radiance.scan,
        start_stamp_ns=radiance.scan_start_ns,
        time_s=radiance.scan_time_s,
        exposures_ms=radiance.exposures_ms,
        grid=_grid(radiance),
        observations={name: getattr(radiance, name) for name in _ARRAYS},
        quality={**radiance.quality, **beside},
    )


def stored_radiance(sample: str, scan: StoredScan) -> Radiance:
    """Return the message that a stored scan came from.

    Raises
    ------
    DatabaseError
        If its observations can't be read, or lack a part; the message names the file.
    """
    quality = dict(scan.quality)
    found: dict[str, Any] = {}
    for name, default in _BESIDE_QUALITY.items():
        value = quality.pop(name, default)
        found[name] = tuple(value) if isinstance(value, list) else value
    arrays = scan.observations()
    try:
        for name, expected in _ARRAYS.items():
            found[name] = arrays[name]
            expected.check(str(found[name].dtype), found[name].shape, name)
    except (KeyError, MessageError) as error:
        what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise DatabaseError(
            f"{scan.observations_path}: observations of scan {scan.scan} cannot be used: {what}; "
            "restore the file from a copy"
        ) from error
    return Radiance(
        sample=sample,
        scan=scan.scan,
        scan_start_ns=scan.start_stamp_ns,
        scan_time_s=scan.time_s,
        exposures_ms=scan.exposures_ms,
        quality=quality,
        **found,
    )


def _grid(radiance: Radiance) -> dict[int, CameraScan]:
    """Return each camera's radiance on the grid, without what is not valid."""
    grid: dict[int, CameraScan] = {}
    for index in range(radiance.grid_radiance.shape[0]):
        seen = radiance.camera == index + 1
        if not seen.any():
            continue
        valid = radiance.grid_valid[index].all(axis=1)
        grid[index + 1] = CameraScan(
            exposures_ms=radiance.exposures_ms,
            light_direction=light_direction(radiance.grid_angle_deg[valid]),
            view_direction=radiance.view_direction[seen][0],
            radiance=radiance.grid_radiance[index][valid],
        )
    return grid


def fit_record(parameters: Parameters) -> FitRecord:
    """Return what the store keeps of a message."""
    same = [part.name for part in fields(FitRecord) if part.name != "errors"]
    return FitRecord(
        **{name: getattr(parameters, name) for name in same},
        errors={**parameters.errors, **{name: getattr(parameters, name) for name in _OF_FIT}},
    )
