"""The information file of a published sample, ``tvBrdf-info.txt``.

Sample name (process), exposures, number of scans, time stamp of each::

    Sample blue_paint (drying paint)
    Exposure 0.200000 4.000000 32.000000
    Scans 2
    Scan 01 2026-01-31T09:30:00.000000000Z 0.000000 fitted
    Scan 03 2026-01-31T09:32:00.000000000Z 120.000000 unfitted
    Missing 02 the arm did not answer

A ``Scan`` line: number, start (UTC, nanoseconds), seconds since t = 0, and ``fitted`` if it has a
line in ``brdf-params.txt``. A ``Missing`` line: a scan that was not measured, and why. The
exposures are those of the first scan; each scan file states its own.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from .text import (
    COPY_AGAIN,
    PublishedFormatError,
    format_exposures,
    parse_exposures,
    parse_number,
    read_lines,
    write_atomically,
)

INFO_FILE: Final = "tvBrdf-info.txt"

_SAMPLE = re.compile(r"Sample (\S(?:.*\S)?) \(([^()]*)\)")
_SCANS = re.compile(r"Scans (\d+)")
_SCAN = re.compile(r"Scan (\d{2,}) (\S+) (\S+) (fitted|unfitted)")
_MISSING = re.compile(r"Missing (\d{2,}) (\S.*)")
_STAMP = re.compile(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)\.(\d{9})Z")


@dataclass(frozen=True)
class ScanInfo:
    """When a scan was made and whether ``brdf-params.txt`` has a line for it."""

    scan: int
    stamp_ns: int
    """Start of the scan, UTC in nanoseconds since 1970."""
    time_s: float
    """Seconds since t = 0."""
    fitted: bool


@dataclass(frozen=True)
class SampleInfo:
    """What ``tvBrdf-info.txt`` says."""

    sample_name: str
    process: str
    exposures_ms: tuple[float, ...]
    scans: tuple[ScanInfo, ...]
    missing: tuple[tuple[int, str], ...] = ()
    """Scans that were not measured, and why."""


def read_info(path: Path | str) -> SampleInfo:
    """Read ``tvBrdf-info.txt``.

    Raises
    ------
    PublishedFormatError
        With file and line: a line that breaks the layout, a wrong number of scans, scans that
        are not in order or appear twice, a truncated file.
    """
    path = Path(path)
    lines = read_lines(path)
    if len(lines) < 3:
        raise PublishedFormatError(
            path,
            len(lines),
            f"the file is truncated: 'Sample', 'Exposure', 'Scans' are needed; {COPY_AGAIN}",
        )
    sample = _match(_SAMPLE, lines[0], path, 1, "Sample NAME (PROCESS)")
    exposures_ms = parse_exposures(lines[1], path, 2)
    count = int(_match(_SCANS, lines[2], path, 3, "Scans N")[1])
    if len(lines) < 3 + count:
        raise PublishedFormatError(
            path,
            len(lines),
            f"the file is truncated: {len(lines) - 3} of {count} scans; {COPY_AGAIN}",
        )
    scans = []
    for line, text in enumerate(lines[3 : 3 + count], start=4):
        match = _match(_SCAN, text, path, line, "Scan TT STAMP SECONDS fitted|unfitted")
        stamp_ns = _parse_stamp(match[2], path, line)
        time_s = parse_number(match[3], path, line)
        scans.append(ScanInfo(int(match[1]), stamp_ns, time_s, match[4] == "fitted"))
    missing = []
    for line, text in enumerate(lines[3 + count :], start=4 + count):
        match = _match(_MISSING, text, path, line, "Missing TT REASON")
        missing.append((int(match[1]), match[2]))
    info = SampleInfo(sample[1], sample[2], exposures_ms, tuple(scans), tuple(missing))
    _check_order(info, path)
    return info


def format_info(info: SampleInfo, path: Path | str = INFO_FILE) -> bytes:
    """Bytes of ``tvBrdf-info.txt``.

    Raises
    ------
    PublishedFormatError
        If the name, process or a reason does not fit in its line (line breaks, parentheses in
        the process, empty), a number is not finite, or the scans are not in order.
    """
    head = f"Sample {info.sample_name} ({info.process})"
    if "\n" in head or _SAMPLE.fullmatch(head) is None:
        raise PublishedFormatError(
            path,
            1,
            f"sample name {info.sample_name!r} or process {info.process!r} cannot be written: no "
            "line breaks, no parentheses in the process, no blanks around the name",
        )
    _check_order(info, path)
    lines = [head, format_exposures(info.exposures_ms, path), f"Scans {len(info.scans)}"]
    for scan in info.scans:
        if not np.isfinite(scan.time_s):
            raise PublishedFormatError(path, None, f"time of scan {scan.scan} is not finite")
        state = "fitted" if scan.fitted else "unfitted"
        lines.append(
            f"Scan {scan.scan:02d} {format_stamp(scan.stamp_ns)} {scan.time_s:.6f} {state}"
        )
    for number, reason in info.missing:
        if not reason.strip() or "\n" in reason or reason != reason.strip():
            raise PublishedFormatError(
                path, None, f"reason {reason!r} of missing scan {number} is not one line of text"
            )
        lines.append(f"Missing {number:02d} {reason}")
    return "".join(f"{line}\n" for line in lines).encode()


def write_info(path: Path | str, info: SampleInfo) -> None:
    """Write ``tvBrdf-info.txt``, whole or not at all; see :func:`format_info`."""
    write_atomically(Path(path), format_info(info, path))


def format_stamp(stamp_ns: int) -> str:
    """UTC time stamp with nanoseconds, e.g. ``2026-01-31T09:30:00.000000000Z``."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    moment = datetime.fromtimestamp(seconds, UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{nanoseconds:09d}Z"


def _parse_stamp(text: str, path: Path, line: int) -> int:
    match = _STAMP.fullmatch(text)
    try:
        if match is None:
            raise ValueError
        moment = datetime.fromisoformat(f"{match[1]}+00:00")
    except ValueError:
        raise PublishedFormatError(
            path, line, f"{text!r} is not a UTC time stamp with nanoseconds"
        ) from None
    return int(moment.timestamp()) * 1_000_000_000 + int(match[2])


def _match(pattern: re.Pattern[str], text: str, path: Path, line: int, form: str) -> re.Match[str]:
    match = pattern.fullmatch(text)
    if match is None:
        raise PublishedFormatError(path, line, f"{text!r} is not of the form '{form}'")
    return match


def _check_order(info: SampleInfo, path: Path | str) -> None:
    for what, numbers in (
        ("scans", [scan.scan for scan in info.scans]),
        ("missing scans", [scan for scan, _ in info.missing]),
    ):
        if numbers != sorted(set(numbers)) or any(number < 1 for number in numbers):
            raise PublishedFormatError(
                path, None, f"{what} {numbers} are not in order, each once, from 1"
            )
    twice = {scan.scan for scan in info.scans} & {scan for scan, _ in info.missing}
    if twice:
        raise PublishedFormatError(path, None, f"scans {sorted(twice)} are there and missing")
