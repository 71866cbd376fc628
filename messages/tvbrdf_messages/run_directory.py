"""A run's private directory: its sockets, the graph that the launcher wrote, and the logs."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from .errors import BusError
from .topics import find_topic

GRAPH_FILE = "graph.json"
MAX_IPC_PATH = 107
"""Of a Unix socket; longer ones can't be bound."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Participant:
    """One name on the bus: a node, or the simulated device inside or beside it."""

    name: str
    takes: tuple[str, ...] = ()
    gives: tuple[str, ...] = ()
    node: str = ""
    """Class of the node as ``module:Class``; empty for a device that another process owns."""
    driver: str = ""
    parameters: dict[str, Any] = field(default_factory=dict)
    live: bool = False
    """A live source never waits for a slow reader: its sweep is broken instead."""
    counted_bytes: int = 0
    """Above 0: a counted reader, which nobody waits for. Each publisher has so many bytes on the
    way to it at most; what does not fit is left out, and the reader sees the gap."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Graph:
    """Who is in a run and who reads what from whom."""

    directory: str
    utc_ns: int
    """Wall clock at launch, read together with ``monotonic_ns``."""
    monotonic_ns: int
    simulated: bool
    participants: tuple[Participant, ...]
    working_directory: str = ""
    """Of the launcher and its nodes."""

    def located(self, path: str) -> Path:
        """Return where a path is that a node of this run was given."""
        return Path(self.working_directory, path)

    def find(self, name: str) -> Participant:
        """Return the participant of that name."""
        for participant in self.participants:
            if participant.name == name:
                return participant
        known = ", ".join(p.name for p in self.participants)
        raise BusError(f"no node {name!r} in this run; there are: {known}")

    def readers(self, publisher: str, topic: str) -> tuple[str, ...]:
        """Return who takes ``topic`` from ``publisher``."""
        if topic not in self.find(publisher).gives:
            return ()
        return tuple(p.name for p in self.participants if topic in p.takes and p.name != publisher)

    def publishers(self, topic: str) -> tuple[str, ...]:
        """Return who gives ``topic``."""
        return tuple(p.name for p in self.participants if topic in p.gives)

    def topics(self) -> Iterator[str]:
        """Yield every topic of the run, sorted."""
        names = {t for p in self.participants for t in (*p.takes, *p.gives)}
        yield from sorted(names)

    def endpoint(self, name: str, channel: str) -> str:
        """Return the address of a participant's ``lossless``, ``latest`` or ``service`` socket."""
        path = f"{self.directory}/{name}.{channel}"
        if len(path.encode()) > MAX_IPC_PATH:
            raise BusError(
                f"socket path {path} has more than {MAX_IPC_PATH} characters; "
                "set TVBRDF_RUN to a shorter directory"
            )
        return f"ipc://{path}"

    def check(self) -> None:
        """Refuse unknown topics, readers without a publisher and nodes that cross into /sim/."""
        for participant in self.participants:
            for name in (*participant.takes, *participant.gives):
                topic = find_topic(name)
                if (
                    topic.simulation
                    and participant.node
                    and not participant.node.startswith("tvbrdf_nodes.world")
                    and ".simulated" not in participant.node
                    # a player reads nothing of it, and tells what was recorded when asked to
                    and not participant.node.startswith("tvbrdf_nodes.player.")
                ):
                    raise BusError(f"node {participant.name} may not touch {name}: real nodes "
                                   "must not know that they are simulated")  # fmt: skip
            for name in participant.takes:
                if not self.publishers(name) and find_topic(name).quality != "latest":
                    raise BusError(f"node {participant.name} takes {name}, which nobody gives")

    def write(self) -> None:
        """Write the graph into its directory (beside, then renamed)."""
        path = Path(self.directory) / GRAPH_FILE
        beside = path.with_suffix(".json.new")
        beside.write_text(json.dumps(asdict(self), indent=1))
        beside.rename(path)


def read_graph(directory: str | Path) -> Graph:
    """Return the graph that a launcher wrote into a run's directory."""
    path = Path(directory) / GRAPH_FILE
    try:
        raw = json.loads(path.read_text())
        participants = tuple(
            Participant(**{**p, "takes": tuple(p["takes"]), "gives": tuple(p["gives"])})
            for p in raw.pop("participants")
        )
        return Graph(participants=participants, **raw)
    except FileNotFoundError:
        raise BusError(f"{directory} holds no run: no {GRAPH_FILE} in it") from None
    except (ValueError, TypeError, KeyError) as error:
        raise BusError(f"{path} is not a graph of this version: {error}") from error


def make_private(directory: Path) -> Path:
    """Make a directory that only its owner can enter (0700); refuse one that others can."""
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    mode = directory.stat().st_mode
    if directory.stat().st_uid != os.getuid() or stat.S_IMODE(mode) & 0o077:
        raise BusError(f"{directory} is open to others; chmod 700 it or choose another")
    return directory


def runs_directory() -> Path:
    """Return the private folder that holds this user's runs."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    return Path(runtime) / "tvbrdf" if runtime else Path(f"/tmp/tvbrdf-{os.getuid()}")


def find_run(given: str | Path | None = None) -> Path:
    """Return the run that is meant: given, else ``$TVBRDF_RUN``, else the newest."""
    for candidate in (given, os.environ.get("TVBRDF_RUN")):
        if candidate:
            return Path(candidate)
    latest = runs_directory() / "latest"
    if latest.exists():
        return latest.resolve()
    raise BusError(f"no run found: neither $TVBRDF_RUN nor {latest}; start one with tvbrdf launch")
