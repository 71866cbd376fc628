"""Where a bag comes from: one metadata record at the beginning of each of its files."""

from __future__ import annotations

import json
import time
import uuid
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from ..envelope import host_name
from .clock_jumps import ClockJump
from .errors import BagDamagedError, BagVersionError

PROFILE = "tvbrdf"
"""In the header of each file: by it a bag of ours is told from other MCAP files."""
FORMAT_VERSION = 1
ABOUT_RECORD, STREAMS_RECORD = "tvbrdf", "tvbrdf.streams"

LAUNCH, SCENE, CALIBRATION, NOTES = "launch", "scene", "calibration", "notes"
"""First words of attachments' names, as in ``calibration/rig.yaml`` or ``notes.txt``."""
SOURCE = "source"
"""Of a replay that was recorded: which bag was played."""


@cache
def software_version() -> str:
    """Return the version of this installation of tvbrdf."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("tvbrdf")
    except PackageNotFoundError:
        return "unknown"


def attachment_kind(name: str) -> str:
    """Return the first word of an attachment's name: ``calibration`` of ``calibration/rig.yaml``.

    What stands before the first ``/`` or, without one, before the first ``.``.
    """
    return name.split("/", 1)[0].split(".", 1)[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class About:
    """Where a bag comes from.

    ``run`` names one run and no other (the name of its directory will do): bags with the same one
    may be merged without doubling messages.
    """

    run: str = ""
    host: str = field(default_factory=host_name)
    created_ns: int = field(default_factory=time.time_ns)
    """Wall clock (UTC) when the recording began."""
    version: str = field(default_factory=software_version)
    """Of tvbrdf, which recorded it."""
    recording: str = field(default_factory=lambda: uuid.uuid4().hex)
    """Tells this recording from every other; the files of a split bag share it."""
    format_version: int = FORMAT_VERSION
    extra: Mapping[str, str] = field(default_factory=dict)
    """Anything else worth keeping, by name; what recover, filter and merge did is here too."""


def about_record(about: About, split: int) -> dict[str, str]:
    """Return the metadata record of one file of a bag."""
    return sealed(
        {
            "format_version": str(about.format_version),
            "version": about.version,
            "run": about.run,
            "host": about.host,
            "created_ns": str(about.created_ns),
            "recording": about.recording,
            "split": str(split),
            "extra": json.dumps(dict(about.extra), ensure_ascii=False),
        }
    )


def read_about(path: Path, record: Mapping[str, str]) -> tuple[About, int]:
    """Return what :func:`about_record` wrote, and the number of the file within its bag.

    Raises
    ------
    BagVersionError
        If a newer version wrote it, in another format.
    BagDamagedError
        If it is not what was written.
    """
    try:
        fields = unsealed(path, record)
        version = int(fields["format_version"])
        if version > FORMAT_VERSION:
            raise BagVersionError(
                path,
                f"a bag of format {version}, recorded by tvbrdf {fields['version']}; this is "
                f"tvbrdf {software_version()}, which reads up to {FORMAT_VERSION}: update it",
            )
        about = About(
            run=fields["run"],
            host=fields["host"],
            created_ns=int(fields["created_ns"]),
            version=fields["version"],
            recording=fields["recording"],
            format_version=version,
            extra=json.loads(fields["extra"]),
        )
        return about, int(fields["split"])
    except (KeyError, ValueError) as error:
        raise BagDamagedError(path, f"its metadata are not of this version: {error!r}") from error


def sealed(fields: dict[str, str]) -> dict[str, str]:
    """Return the fields with a checksum; MCAP has none for metadata."""
    return {**fields, "crc32": str(_checksum(fields))}


def unsealed(path: Path, record: Mapping[str, str]) -> dict[str, str]:
    """Return the fields of :func:`sealed` without the checksum, which is verified."""
    fields = dict(record)
    if fields.pop("crc32", None) != str(_checksum(fields)):
        raise BagDamagedError(path, "the checksum of a metadata record is wrong")
    return fields


def _checksum(fields: Mapping[str, str]) -> int:
    return zlib.crc32(json.dumps(sorted(fields.items())).encode())


def streams_record(
    streams: list[dict[str, Any]], clock_jumps: Iterable[ClockJump]
) -> dict[str, str]:
    """Return the metadata record that counts messages and gaps, and tells jumps of clocks."""
    jumps = [jump._asdict() for jump in clock_jumps]
    return sealed({"streams": json.dumps(streams), "clock_jumps": json.dumps(jumps)})
