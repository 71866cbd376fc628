"""The database writer: puts every scan on disk exactly once, and says when it is there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import (
    DatabaseState,
    Mark,
    Parameters,
    Radiance,
    ScanMissing,
    Stored,
)

from ..core.device import DeviceError
from ..core.node import Node, NodeContext, Outputs, Send, TopicUse

if TYPE_CHECKING:
    from .store import DatabaseStore, Outcome

RETRY_S = 5.0
"""Real time after which a full disk is tried again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DatabaseWriterParameters:
    """Where what is measured goes."""

    path: str
    sample: str
    process: str = ""
    """What the sample does, for the published info file."""
    resume: bool = False
    """Go on in a database of the same sample that is not empty."""


class DatabaseWriterNode(Node[DatabaseWriterParameters]):
    """Stores scans, parameters, missing scans and notes; acknowledges each.

    What is stored and not fitted it sends to the fitter: nobody else may have it any more.
    """

    parameters_type = DatabaseWriterParameters
    drains = True

    def __init__(self, context: NodeContext, parameters: DatabaseWriterParameters) -> None:
        super().__init__(context, parameters)
        self._store: DatabaseStore | None = None
        self._waiting: list[Envelope] = []
        """What could not be stored yet: the disk was full, or the scan itself has not come."""
        self._stored = self._repeats = 0
        self._refused: set[int] = set()
        """Scans whose radiance can't be stored: their parameters can't be either."""

    @classmethod
    def topics(cls, name: str, parameters: DatabaseWriterParameters) -> TopicUse:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return TopicUse(
            takes=(
                "/clock",
                "/scan/radiance",
                "/scan/parameters",
                "/scan/missing",
                "/operator/mark",
            ),
            gives=("/scan/stored", "/scan/database", "/scan/radiance", "/diagnostics", "/log"),
        )

    def prepare(self) -> None:
        """Open the database; one that can't be used ends the run before anything moves."""
        from tvbrdf_fitting.published.database import DatabaseError

        from .store import DatabaseStore

        try:
            self._store = DatabaseStore(
                self.parameters.path,
                self.parameters.sample,
                resume=self.parameters.resume,
                process=self.parameters.process,
                run_id=f"{self.context.run_directory.name}-{self.context.graph.utc_ns}",
            )
        except DatabaseError as error:
            raise DeviceError(str(error)) from error

    def start(self) -> Outputs:
        """Tell what the database holds, and have fitted what is not."""
        yield self._state()
        yield from self._send_unfitted()

    def on_reader(self, reader: str) -> Outputs:
        """Send it again: a restarted fitter may lack it, a restarted sequencer waits for it."""
        if {"/scan/radiance", "/scan/database"} & {*self.context.graph.find(reader).takes}:
            yield from self._send_unfitted()

    def _state(self) -> Send:
        contents = self._opened().contents()
        state = contents._asdict() | {"missing": tuple(contents.missing)}
        message = DatabaseState(sample=self.parameters.sample, **state)
        return Send(topic="/scan/database", message=message)

    def _send_unfitted(self) -> Outputs:
        from tvbrdf_fitting.published.database import DatabaseError

        from .conversion import stored_radiance

        for scan in self._opened().unfitted():
            try:
                message = stored_radiance(self.parameters.sample, scan)
            except DatabaseError as error:
                self.context.log.error(str(error))
                yield self._stored_message(scan.scan, "parameters", refused=str(error))
            else:
                stamp_ns = int(message.stamp_ns.max(initial=scan.start_stamp_ns))
                yield Send(topic="/scan/radiance", message=message, stamp_ns=stamp_ns)

    def handle(self, envelope: Envelope) -> Outputs:
        """Store a message; what has to wait is tried again later."""
        self._waiting.append(envelope)
        yield from self._work()

    def on_timer(self, name: str) -> Outputs:
        """Try again what a full disk had refused."""
        yield from self._work()

    def _work(self) -> Outputs:
        """Store what can be stored, radiance first; keep the rest."""
        from tvbrdf_fitting.published.database import DatabaseError, DiskFullError

        waiting, self._waiting = self._waiting, []
        before = self._stored
        for envelope in sorted(waiting, key=lambda e: not isinstance(e.message, Radiance)):
            if self._must_wait(envelope):
                self._waiting.append(envelope)
                continue
            already, refused = False, ""
            try:
                already = self._put(envelope) == "already_stored"
            except DiskFullError as error:
                self.context.log.error(f"{error}; trying again every {RETRY_S:g} s")
                self._waiting.append(envelope)
                self.context.set_watchdog("retry", RETRY_S)
                continue
            except DatabaseError as error:
                if not _is_its_own_fault(error):
                    raise DeviceError(str(error)) from error  # a new start may help
                refused = str(error)
                self.context.log.error(refused)
            yield self._acknowledge(envelope, already=already, refused=refused)
        if self._stored > before:
            yield self._state()

    def _must_wait(self, envelope: Envelope) -> bool:
        """Return whether these are parameters of a scan that may still come."""
        message = envelope.message
        if not isinstance(message, Parameters) or message.scan in self._refused:
            return False
        return message.scan not in self._opened().contents().scans

    def _acknowledge(self, envelope: Envelope, *, already: bool, refused: str) -> Send:
        what = _KINDS[type(envelope.message)]
        scan = getattr(envelope.message, "scan", envelope.header.sequence)
        if refused and what == "radiance":
            self._refused.add(scan)
        self._stored += not (already or refused)
        self._repeats += already
        return self._stored_message(scan, what, already=already, refused=refused)

    def _stored_message(self, scan: int, what: str, **more: Any) -> Send:
        message = Stored(sample=self.parameters.sample, scan=scan, what=what, **more)
        return Send(topic="/scan/stored", message=message)

    def _put(self, envelope: Envelope) -> Outcome:
        from .conversion import fit_record, scan_record

        store, message = self._opened(), envelope.message
        if isinstance(message, Radiance):
            return store.store_scan(scan_record(message))
        if isinstance(message, Parameters):
            return store.store_parameters(fit_record(message))
        if isinstance(message, ScanMissing):
            store.check_sample(message.sample)
            return store.store_missing(message.scan, message.reason, time_s=message.scan_time_s)
        if isinstance(message, Mark):
            return store.store_note(envelope.header.stamp_ns, message.text, zero=message.zero)
        raise TypeError(f"{envelope.topic} is not for the database")

    def _opened(self) -> DatabaseStore:
        if self._store is None:
            raise DeviceError("the database is not open")
        return self._store

    def stop(self) -> Outputs:
        """Close the database; everything acknowledged is on disk already."""
        if self._store is not None:
            self._store.close()
        return ()

    def diagnostics(self) -> dict[str, Any]:
        """See :class:`~tvbrdf_nodes.core.node.Node`."""
        return {
            "stored": self._stored,
            "already_stored": self._repeats,
            "waiting": len(self._waiting),
            "refused_scans": len(self._refused),
        }


_KINDS = {Radiance: "radiance", Parameters: "parameters", ScanMissing: "missing", Mark: "mark"}


def _is_its_own_fault(error: Exception) -> bool:
    """Return whether a message is refused for what it is, not for the state of the disk."""
    from sqlalchemy.exc import SQLAlchemyError

    return not isinstance(error.__cause__, (OSError, SQLAlchemyError))
