"""One camera's file of one scan: its lines, read and written.

First line ``Exposure 0.200000 4.000000 32.000000`` (ms), then a group of three lines a light
position::

    F b g r      radiance, blue first
    L x y z      unit vector to the light, sample frame
    V x y z      unit vector to the camera, the same in the whole file

Every number has 6 decimals. A light position that was hidden by the arm, or where any channel is
invalid, has no group: nothing stands for "not measured". A file that was cut exactly between two
groups therefore reads as one with fewer light positions; the other cameras' files show it (see
:mod:`.checks`, also for the order of the colours, which no line states).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .text import (
    COPY_AGAIN,
    PublishedFormatError,
    format_exposures,
    parse_exposures,
    parse_number,
    read_bytes,
    shown,
    write_atomically,
)

UNIT_TOLERANCE: Final = 1e-4
"""Largest accepted difference of a direction's length from 1 (rounding to 6 decimals: 9e-7)."""

LARGEST_RADIANCE: Final = 1e12
"""Anything above is a damaged number: squares of sums of squares must stay finite."""

_KEYS: Final = ("F", "L", "V")
_MEANING: Final = {"F": "radiance b g r", "L": "light x y z", "V": "view x y z"}


@dataclass(frozen=True, eq=False)
class CameraScan:
    """One camera's radiance in one scan, on the light positions where it is known.

    Attributes
    ----------
    exposures_ms
        Exposure times of the sweeps, ms.
    light_direction
        (m, 3) unit vectors to the light, sample frame.
    view_direction
        (3,) unit vector to the camera, sample frame.
    radiance
        (m, 3) B, G, R; divided by the calibration constants it is π·BRDF·cosθi.
    """

    exposures_ms: tuple[float, ...]
    light_direction: NDArray[np.float64]
    view_direction: NDArray[np.float64]
    radiance: NDArray[np.float64]


def read_scan_file(path: Path | str, *, read: Callable[[Path], bytes] = read_bytes) -> CameraScan:
    """Read one camera's file of one scan.

    Parameters
    ----------
    path
        The file.
    read
        Gives its bytes: for callers that want these too, for example to tell their checksum.

    Raises
    ------
    PublishedFormatError
        With file and line: missing or bad exposures, a wrong key or count, a number that is not
        finite, a direction that is not a unit vector, a light or camera below the horizon, a
        view that changes within the file, or a truncated file.
    """
    path = Path(path)
    data = read(path)
    end = data.find(b"\n")
    if end < 0:
        raise PublishedFormatError(
            path, 1, f"the file is truncated: its first line has no end; {COPY_AGAIN}"
        )
    exposures_ms = parse_exposures(data[:end].decode("utf-8", "replace"), path, 1)
    if end + 1 == len(data):
        raise PublishedFormatError(
            path, 1, f"the file is truncated: no 'F' line follows; {COPY_AGAIN}"
        )
    body = data[end + 1 :]
    groups = _parse_canonical(body)
    if groups is None:  # not as we write it: find out where and why, or accept it
        groups = _parse_lines(body, path)
    return _checked(exposures_ms, groups, path)


def _parse_canonical(body: bytes) -> NDArray[np.float64] | None:
    """(m, 3, 3) numbers of groups in exactly the published form; None for any other."""
    from .compiled import SHORTEST_GROUP, parse_groups  # takes long

    if not body.endswith(b"\n"):
        return None
    groups = np.empty((len(body) // SHORTEST_GROUP + 1, 3, 3))
    count = parse_groups(np.frombuffer(body, dtype=np.uint8), groups)
    return groups[:count] if count > 0 else None


def _parse_lines(body: bytes, path: Path) -> NDArray[np.float64]:
    """(m, 3, 3) numbers of groups, line by line, with the reason and line of the first fault."""
    lines = body.decode("utf-8", "replace").split("\n")
    if lines[-1]:
        raise PublishedFormatError(
            path,
            len(lines) + 1,
            f"the file is truncated: its last line has no end; {COPY_AGAIN}",
        )
    lines.pop()
    numbers: list[list[float]] = []
    for index, text in enumerate(lines):
        line = index + 2
        tokens = text.split()
        key = _KEYS[index % 3]
        if not tokens or tokens[0] != key:
            found = tokens[0] if tokens else ""
            raise PublishedFormatError(
                path,
                line,
                f"starts with {shown(found)} where a line '{key} a b c' belongs: each light "
                f"position has an F, an L and a V line; {COPY_AGAIN}",
            )
        if len(tokens) != 4:
            raise PublishedFormatError(
                path,
                line,
                f"has {len(tokens) - 1} numbers after {key!r} instead of 3 ({_MEANING[key]})",
            )
        numbers.append([parse_number(token, path, line) for token in tokens[1:]])
    if len(numbers) % 3:
        raise PublishedFormatError(
            path,
            len(numbers) + 1,
            f"the file is truncated: no {_KEYS[len(numbers) % 3]!r} line follows; {COPY_AGAIN}",
        )
    return np.array(numbers, dtype=np.float64).reshape(-1, 3, 3)


def _checked(
    exposures_ms: tuple[float, ...], groups: NDArray[np.float64], path: Path
) -> CameraScan:
    from .compiled import are_sound

    if not are_sound(groups, LARGEST_RADIANCE, UNIT_TOLERANCE):
        _say_what_is_wrong(groups, path)
    return CameraScan(
        exposures_ms=exposures_ms,
        light_direction=groups[:, 1].copy(),
        view_direction=groups[0, 2].copy(),
        radiance=groups[:, 0].copy(),
    )


def _say_what_is_wrong(groups: NDArray[np.float64], path: Path) -> None:
    absurd = np.abs(groups[:, 0]) > LARGEST_RADIANCE
    if absurd.any():
        group, channel = (int(index) for index in np.argwhere(absurd)[0])
        raise PublishedFormatError(
            path,
            2 + 3 * group,
            f"radiance {groups[group, 0, channel]:g} is beyond any that a camera measures",
        )
    directions = groups[:, 1:]
    lengths = np.sqrt(np.einsum("mkc,mkc->mk", directions, directions))
    _refuse(
        np.abs(lengths - 1) > UNIT_TOLERANCE,
        directions,
        path,
        "is no unit vector",
        "give x y z of length 1, in the sample's frame",
    )
    _refuse(
        directions[..., 2] <= 0,
        directions,
        path,
        "is below the sample's horizon",
        "leave out such positions, or turn the directions into the sample's frame (z its normal)",
    )
    view = groups[0, 2]
    changed = (groups[:, 2] != view).any(axis=1)
    _refuse(
        np.stack([np.zeros_like(changed), changed], axis=1),
        directions,
        path,
        "changes within the file",
        f"it began as {_vector(view)}; a file belongs to one camera",
    )


def _refuse(
    faults: NDArray[np.bool_],
    directions: NDArray[np.float64],
    path: Path,
    problem: str,
    remedy: str,
) -> None:
    """Raise for the first true entry of (m, 2) faults of the directions (m, 2, 3), L and V."""
    if not faults.any():
        return
    group, which = (int(index) for index in np.argwhere(faults)[0])
    vector, count = directions[group, which], int(faults[:, which].sum())
    found = f"{_vector(vector)}, length {float(np.linalg.norm(vector)):.6g}"
    also = f"; {count} such lines" if count > 1 else ""
    raise PublishedFormatError(
        path,
        3 + 3 * group + which,
        f"the {('light', 'view')[which]} direction {problem} ({found}{also}): {remedy}",
    )


def _vector(vector: NDArray[np.float64]) -> str:
    return " ".join(f"{component:g}" for component in vector)


def format_scan_file(camera_scan: CameraScan, path: Path | str = "scan file") -> bytes:
    """A scan file's bytes; ``path`` only names it in errors.

    A position where any channel is not finite gets no group.

    Raises
    ------
    PublishedFormatError
        If shapes disagree, no position is left, or the file would not be read back: directions
        that are not finite unit vectors above the horizon, bad exposures.
    """
    path = Path(path)
    light = np.asarray(camera_scan.light_direction, dtype=np.float64)
    view = np.asarray(camera_scan.view_direction, dtype=np.float64)
    radiance = np.asarray(camera_scan.radiance, dtype=np.float64)
    if light.ndim != 2 or light.shape[1:] != (3,) or light.shape != radiance.shape:
        raise PublishedFormatError(
            path, None, f"light {light.shape} and radiance {radiance.shape} are not both (m, 3)"
        )
    if view.shape != (3,):
        raise PublishedFormatError(path, None, f"view direction has shape {view.shape}, not (3,)")
    head = format_exposures(camera_scan.exposures_ms, path)
    known = np.isfinite(radiance).all(axis=1)
    if not known.any():
        raise PublishedFormatError(
            path, None, "no light position with three valid channels: there is nothing to write"
        )
    if not (np.isfinite(light[known]).all() and np.isfinite(view).all()):
        raise PublishedFormatError(path, None, "a light or view direction is not finite")
    groups = np.stack(
        [radiance[known], light[known], np.broadcast_to(view, (int(known.sum()), 3))], axis=1
    )
    _checked(camera_scan.exposures_ms, np.round(groups, 6), path)
    group = "F %.6f %.6f %.6f\nL %.6f %.6f %.6f\nV %.6f %.6f %.6f\n"
    body = (group * len(groups)) % tuple(groups.ravel().tolist())
    return f"{head}\n{body}".encode("ascii")


def write_scan_file(path: Path | str, camera_scan: CameraScan) -> None:
    """Write one camera's file of one scan, whole or not at all; see :func:`format_scan_file`."""
    write_atomically(Path(path), format_scan_file(camera_scan, path))
