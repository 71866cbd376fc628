"""Where a refit goes: one folder a source, with a record of each scan, resumable at any moment.

``refit.json`` says what the folder was made from and with; ``results.jsonl`` has a line a scan,
sorted. While work goes on, lines are appended to ``results.jsonl.part`` as scans are done: a scan
belongs to the result once its line is whole there. ``database/`` is a database as a run writes it.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tvbrdf_messages.bag.about import software_version
from tvbrdf_messages.codec import decode
from tvbrdf_messages.envelope import Envelope, Header
from tvbrdf_messages.messages import Log, Mark, ScanMissing, Stored
from tvbrdf_nodes.core.device import DeviceError

from ..errors import RunError
from .events import Aside, Outcome, Parts, Unfinished
from .pipeline import WRITER, NodesInProcess, graph_of

if TYPE_CHECKING:
    from .settings import Plan
    from .sources import Source

HEADER_FILE, RESULTS_FILE, PART_FILE = "refit.json", "results.jsonl", "results.jsonl.part"
DATABASE_FOLDER = "database"
FORMAT = 1


class ResultFolder:
    """The results of one source.

    Parameters
    ----------
    folder
        Made if it is not there.
    source, facts, plan
        What is refitted, what is known of it, and how it is done.
    """

    def __init__(self, folder: Path, source: Source, facts: Mapping[str, Any], plan: Plan) -> None:
        self.folder = folder
        self._source, self._facts, self._plan = source, facts, plan
        self._header = {
            "format": FORMAT,
            "version": software_version(),
            "source": {"name": source.path.resolve().name, **facts},
            "settings": plan.plain(),
        }
        self._lines: dict[int, bytes] = {}
        self._part = -1
        self._nodes: NodesInProcess | None = None
        self._unfinished: dict[int, Unfinished] = {}
        self.complete = False
        """Whether an earlier refit has done all of it."""

    # -- opening

    def open(self, *, again: bool) -> frozenset[int]:
        """Return the scans that are there already, made from the same with the same settings.

        Raises
        ------
        RunError
            If the folder holds something else, or results that were made otherwise.
        """
        if again:
            self._remove()
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / HEADER_FILE
        if path.exists():
            self._check_same(self._read_header(path))
        else:
            self._refuse_foreign()
        self._lines = self._read_lines()
        if self._plan.sequential and not self.complete:
            self._lines = {}  # each model depends on the one before
        self._check_hashes()
        if not self.complete:
            self._write_header(complete=False)
            self._write_part()
        return frozenset(self._lines)

    def _remove(self) -> None:
        if not self.folder.exists():
            return
        if (self.folder / HEADER_FILE).exists():
            shutil.rmtree(self.folder)
        else:
            self._refuse_foreign()

    def _refuse_foreign(self) -> None:
        strangers = sorted(entry.name for entry in self.folder.iterdir())
        if strangers:
            raise RunError(
                f"{self.folder}: is not empty and no result of a refit (it holds "
                f"{strangers[0]!r}); give another folder with --out"
            )

    def _read_header(self, path: Path) -> dict[str, Any]:
        try:
            found = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise RunError(f"{path}: can't be read: {error}; make it anew with --again") from error
        if not isinstance(found, dict):
            raise RunError(f"{path}: is no record of a refit; make it anew with --again")
        return found

    def _check_same(self, found: dict[str, Any]) -> None:
        mine = json.loads(json.dumps(self._header))
        different = _differences(
            {key: found.get(key) for key in mine},
            mine,
        )
        if different:
            raise RunError(
                f"{self.folder}: holds a refit that was made otherwise: {'; '.join(different)}; "
                "give another folder with --out, or --again to make it anew"
            )
        self.complete = bool(found.get("complete"))

    def _read_lines(self) -> dict[int, bytes]:
        lines: dict[int, bytes] = {}
        for name in (RESULTS_FILE, PART_FILE):
            path = self.folder / name
            if not path.exists():
                continue
            whole = path.read_bytes().split(b"\n")[:-1]  # the last one may have been cut
            for line in whole:
                try:
                    lines[int(json.loads(line)["scan"])] = line
                except (ValueError, KeyError, TypeError) as error:
                    raise RunError(
                        f"{path}: a line is damaged ({error}); make it anew with --again"
                    ) from error
        return lines

    def _check_hashes(self) -> None:
        """Refuse to go on where the files of a scan have changed since."""
        for scan, line in sorted(self._lines.items()):
            now = self._source.hashes(scan)
            if now is not None and json.loads(line)["made_from"]["files"] != now:
                raise RunError(
                    f"{self.folder}: scan {scan} was refitted from other files than "
                    f"{self._source.path} has now; give another folder with --out, or --again to "
                    "make it anew"
                )

    def _write_header(self, *, complete: bool) -> None:
        lost = {str(scan): one.reason for scan, one in sorted(self._unfinished.items())}
        header = {**self._header, "complete": complete, "not_whole": lost}
        text = json.dumps(header, indent=1, ensure_ascii=False) + "\n"
        self._guarded(lambda: _write_whole(self.folder / HEADER_FILE, text.encode()))

    def _write_part(self) -> None:
        """Begin the file of what is done, with what is done already."""
        path = self.folder / PART_FILE

        def write() -> None:
            self._part = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
            for line in self._lines.values():
                _write(self._part, line + b"\n")

        self._guarded(write)

    # -- results

    def take(self, outcome: Outcome) -> None:
        """Store a scan: first in the database, then its line."""
        if outcome.radiance:
            self._store(outcome.radiance, outcome.parameters)

        def append() -> None:
            _write(self._part, outcome.line + b"\n")

        self._guarded(append)
        self._lines[outcome.scan] = outcome.line

    def take_aside(self, event: Aside | Unfinished) -> None:
        """Store a note, or a scan that is missing."""
        if isinstance(event, Aside):
            self._store(event.parts)
        else:
            self._unfinished[event.scan] = event

    @property
    def scans(self) -> int:
        """How many scans it has."""
        return len(self._lines)

    @property
    def unfinished(self) -> dict[int, str]:
        """Scans that were begun and are not whole in the source, with the reason."""
        return {scan: one.reason for scan, one in sorted(self._unfinished.items())}

    def finish(self, *, complete: bool) -> None:
        """Put the results in order; they are whole when this returns."""
        if self._source.keeps_radiance and self._lines:
            for lost in self._unfinished.values():
                if lost.scan not in self._lines:
                    self._store_missing(lost)
            self._store_note()
        lines = b"".join(line + b"\n" for _, line in sorted(self._lines.items()))

        def write() -> None:
            _write_whole(self.folder / RESULTS_FILE, lines)
            if not self._source.keeps_radiance:
                self._write_published()
            os.close(self._part)
            self._part = -1
            (self.folder / PART_FILE).unlink()

        self._guarded(write)
        self._write_header(complete=complete)

    def close(self) -> None:
        """Close files and database; what is stored stays."""
        if self._part >= 0:
            os.close(self._part)
            self._part = -1
        if self._nodes is not None:
            nodes, self._nodes = self._nodes, None
            nodes.__exit__(None, None, None)

    def _write_published(self) -> None:
        """Write ``brdf-params.txt``: a line a fitted scan that the layout has room for."""
        from tvbrdf_fitting.published import format_parameters, parameters_row
        from tvbrdf_fitting.published.sample import FITS_FILE, LOST_FILE

        rows = {}
        for scan, line in sorted(self._lines.items()):
            record = json.loads(line)
            values = [math.nan if value is None else value for value in record["values"]]
            row = parameters_row(record["parameter_names"], values)
            if row is not None:
                rows[scan] = row
        if not rows:
            return
        path = self.folder / FITS_FILE
        path.parent.mkdir(exist_ok=True)
        _write_whole(path, format_parameters([row.values for row in rows.values()]))
        lost = [f"scan {scan}: {row.lost}\n" for scan, row in rows.items() if row.lost]
        if lost:
            _write_whole(self.folder / LOST_FILE, "".join(lost).encode())

    def _guarded(self, write: Any) -> None:
        """Write; explain what can go wrong."""
        try:
            write()
        except OSError as error:
            raise RunError(
                f"{self.folder}: writing failed: {error.strerror or error}; what is finished is "
                "kept: free some space, and run the same command again"
            ) from error

    # -- the database

    def _database(self, sample: str) -> NodesInProcess:
        if self._nodes is None:
            parameters = {
                "path": str(self.folder / DATABASE_FOLDER),
                "sample": self._facts.get("sample") or sample,
                "process": self._facts.get("process", ""),
                "resume": True,
            }
            start_ns = int(self._facts.get("start_ns", 0))
            graph = graph_of({WRITER: parameters}, start_ns, str(self.folder))
            try:
                nodes = NodesInProcess(graph).__enter__()
            except DeviceError as error:
                raise RunError(str(error)) from error
            nodes.work()  # of what is not fitted the next lines tell
            self._nodes = nodes
        return self._nodes

    def _store(self, *messages: Parts) -> None:
        envelopes = [decode(parts) for parts in messages]
        sample = getattr(envelopes[0].message, "sample", "")
        self._hand_over(self._database(sample), *envelopes)

    def _store_missing(self, lost: Unfinished) -> None:
        sample = self._facts.get("sample") or lost.sample
        message = ScanMissing(
            sample=sample, scan=lost.scan, scan_time_s=lost.scan_time_s, reason=lost.reason
        )
        header = Header("refit", "", "", "", lost.scan, 0)
        self._hand_over(self._database(sample), Envelope("/scan/missing", header, message))

    def _store_note(self) -> None:
        """Note in the database what it was made from."""
        files = ", ".join(
            f"{one['name']} (SHA-256 {one['sha256']})" for one in self._facts.get("files", ())
        )
        text = (
            f"refitted by tvbrdf {software_version()} from {self._plan.start} of "
            f"{files or self._source.path.resolve().name}, model {self._plan.fitter['model']}"
        )
        header = Header("refit", "", "", "", 0, int(self._facts.get("start_ns", 0)))
        self._hand_over(self._database(""), Envelope("/operator/mark", header, Mark(text=text)))

    def _hand_over(self, nodes: NodesInProcess, *envelopes: Envelope) -> None:
        """Have messages stored; they are on disk when this returns.

        Raises
        ------
        RunError
            If one is refused or the disk is full.
        """
        for envelope in envelopes:
            nodes.feed(envelope)
        try:
            said = [envelope.message for envelope in nodes.work()]
        except DeviceError as error:
            raise RunError(str(error)) from error
        refused = [one.refused for one in said if isinstance(one, Stored) and one.refused]
        if refused:
            raise RunError(f"{self.folder}: {refused[0]}")
        if nodes.counter(WRITER, "waiting"):
            errors = [one.text for one in said if isinstance(one, Log) and one.level == "error"]
            why = errors[0].split("; trying again")[0] if errors else "the database can't store it"
            raise RunError(
                f"{why}; what is finished is kept: free some space, and run the same command again"
            )


def _write_whole(path: Path, data: bytes) -> None:
    """Write a whole file or none; its data are on disk when this returns."""
    from tvbrdf_fitting.published.text import write_beside

    # the folder is not synced each time: a name that a power failure takes back is made again
    write_beside(path, data).replace(path)


def _write(descriptor: int, data: bytes) -> None:
    from tvbrdf_fitting.published.text import write_all

    write_all(descriptor, data)


def _differences(then: Mapping[str, Any], now: Mapping[str, Any], at: str = "") -> list[str]:
    """Say what differs between two nested mappings."""
    found = []
    for key in dict.fromkeys([*then, *now]):
        old, new, name = then.get(key), now.get(key), f"{at}{key}"
        if isinstance(old, dict) and isinstance(new, dict):
            found += _differences(old, new, f"{name}.")
        elif old != new:
            found.append(f"{name} was {_short(old)}, now {_short(new)}")
    return found


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 80 else f"{text[:77]}..."
