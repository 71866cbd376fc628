"""The record of one refitted scan: what came out, and what it was made from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tvbrdf_messages.bag.about import software_version
from tvbrdf_messages.codec import encode
from tvbrdf_messages.envelope import Envelope, Header
from tvbrdf_messages.messages import Frame, Radiance, ScanCommand, SweepResult
from tvbrdf_messages.topics import find_topic

from .events import Outcome, Parts

if TYPE_CHECKING:
    from .pipeline import Fitted
    from .settings import Plan

NOT_FITTED, SOLVE_TIME = "not fitted: ", "solve_time_s"
_BLOCK = 1 << 22


def file_facts(path: Path) -> dict[str, Any]:
    """Return name, size and SHA-256 of a file."""
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
            size += len(block)
    return _facts(path, size, digest)


def content_facts(path: Path, data: bytes) -> dict[str, Any]:
    """Return name, size and SHA-256 of a file that was read."""
    return _facts(path, len(data), hashlib.sha256(data))


def _facts(path: Path, size: int, digest: hashlib._Hash) -> dict[str, Any]:
    return {"name": path.name, "size": size, "sha256": digest.hexdigest()}


@dataclass(slots=True)
class MessageRanges:
    """Which messages belong to each scan: topic, publisher, its life, sequence numbers."""

    arm: str = "arm"
    """Its results say which states belong to a sweep."""
    _ranges: dict[int, dict[tuple[str, str, str], list[int]]] = field(default_factory=dict)

    def note(self, envelope: Envelope) -> None:
        """Take a message that says which scan it belongs to."""
        message, header = envelope.message, envelope.header
        if not isinstance(message, (Frame, ScanCommand, SweepResult, Radiance)):
            return
        scan = message.scan
        self._add(scan, envelope, header.sequence, header.sequence, 1)
        if (
            isinstance(message, SweepResult)
            and message.action == "sweep"
            and message.source == header.publisher == self.arm
            and message.last_sequence >= message.first_sequence >= 0
        ):
            states = envelope._replace(topic="/arm/state")
            count = message.last_sequence - message.first_sequence + 1
            self._add(scan, states, message.first_sequence, message.last_sequence, count)

    def _add(self, scan: int, envelope: Envelope, first: int, last: int, count: int) -> None:
        key = (envelope.topic, envelope.header.publisher, envelope.header.incarnation)
        found = self._ranges.setdefault(scan, {}).setdefault(key, [first, last, 0])
        found[0], found[1] = min(found[0], first), max(found[1], last)
        found[2] += count

    def take(self, scan: int) -> list[dict[str, Any]]:
        """Return a scan's ranges, and forget them."""
        return [
            {
                "topic": topic,
                "publisher": publisher,
                "incarnation": incarnation,
                "first_sequence": first,
                "last_sequence": last,
                "messages": count,
            }
            for (topic, publisher, incarnation), (first, last, count) in sorted(
                self._ranges.pop(scan, {}).items()
            )
        ]


def outcome(
    fitted: Fitted,
    source: str,
    settings: str,
    files: Sequence[Mapping[str, Any]],
    messages: Sequence[Mapping[str, Any]],
    *,
    with_messages: bool,
) -> Outcome:
    """Return what is kept of a refitted scan; nothing in its record depends on when or how fast.

    Parameters
    ----------
    fitted
        Radiance and parameters.
    source, settings, files, messages
        From what it was made, and with what (see :func:`settings_text`).
    with_messages
        Whether the database writer will want the messages themselves.
    """
    radiance: Any = fitted.radiance.message
    found: Any = fitted.parameters.message
    record = {
        "scan": found.scan,
        "sample": found.sample,
        "scan_start_ns": radiance.scan_start_ns,
        "scan_time_s": found.scan_time_s,
        "model": found.model,
        "parameter_names": found.parameter_names,
        "values": found.values,
        "standard_deviations": found.standard_deviations,
        "covariance": found.covariance.tolist(),
        "at_bound": found.at_bound,
        "undetermined": found.undetermined,
        "errors": found.errors,
        "chi_square": found.chi_square,
        "degrees_of_freedom": found.degrees_of_freedom,
        "model_error_std": found.model_error_std,
        "solver": found.solver,
        "reason": found.reason,
        "evaluations": found.evaluations,
        "details": _untimed(found.details),
        "made_from": {"source": source, "files": files, "messages": messages},
    }
    lost = found.reason.startswith(NOT_FITTED)
    return Outcome(
        scan=found.scan,
        line=f"{_json(record)[:-1]},{settings[1:]}".encode(),
        radiance=parts_of(fitted.radiance) if with_messages else (),
        parameters=parts_of(fitted.parameters) if with_messages else (),
        problem=f"scan {found.scan} can't be fitted: {found.reason.removeprefix(NOT_FITTED)}"
        if lost
        else "",
    )


def _untimed(details: Any) -> Any:
    """Return details without how long anything took."""
    if isinstance(details, Mapping):
        return {key: _untimed(value) for key, value in details.items() if key != SOLVE_TIME}
    if isinstance(details, (list, tuple)):
        return [_untimed(value) for value in details]
    return details


def settings_text(plan: Plan) -> str:
    """Return the part of a record that says with what it was made, the same for all of a source."""
    return _json({"settings": plan.plain(), "version": software_version()})


def _json(value: Any) -> str:
    """Return JSON on one line; numbers that are not finite, which JSON lacks, as null."""
    try:
        return _ENCODER.encode(value)
    except ValueError:
        from tvbrdf_nodes.database_writer.records import plain

        return _ENCODER.encode(plain(value))


def _plain(value: Any) -> Any:
    from tvbrdf_nodes.database_writer.records import plain

    return plain(value)


_ENCODER = json.JSONEncoder(
    ensure_ascii=False, separators=(",", ":"), allow_nan=False, default=_plain
)


def parts_of(envelope: Envelope) -> Parts:
    """Return a message as bytes."""
    parts = encode(find_topic(envelope.topic), Header(*envelope.header), envelope.message)
    return tuple(bytes(memoryview(part)) for part in parts)
