"""Which bags a run's recorder has made, kept in the run's directory: its next life must know."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

from tvbrdf_messages.run_directory import Graph

RECORDING, COMPLETE, ENDED = "recording", "complete", "ended"


@dataclass(slots=True, kw_only=True)
class BagEntry:
    """One bag and what is in it."""

    path: str
    state: str = RECORDING
    """``recording`` (for good, if the recorder was killed), ``complete``, or ``ended`` early."""
    text: str = ""
    """Why it ended early."""
    bytes: int = 0
    files: int = 0
    messages: Mapping[str, int] = field(default_factory=dict)
    """Of each topic."""
    lost: Mapping[str, int] = field(default_factory=dict)
    """Of each topic that has gaps, how many messages are missing."""


class RecordBook:
    """The bags that a node of a run has made, in all its lives.

    Parameters
    ----------
    graph
        The run's; a directory may see several runs one after the other.
    name
        Of the recorder's node.
    """

    def __init__(self, graph: Graph, name: str) -> None:
        self._file = Path(graph.directory) / f"{name}.bags.json"
        self._utc_ns = graph.utc_ns
        self.entries = self._read()

    def next_path(self, wanted: Path) -> Path:
        """Return where this life records to: as wanted, or numbered beside it after a restart."""
        if not self.entries:
            return wanted
        number = len(self.entries) + 1
        while True:
            path = wanted.with_name(f"{wanted.stem}_{number}{wanted.suffix}")
            if wanted.suffix != ".mcap":
                path = wanted.with_name(f"{wanted.name}_{number}")
            if not path.exists():
                return path
            number += 1

    def begin(self, path: Path) -> BagEntry:
        """Note a bag that was begun."""
        self.entries.append(BagEntry(path=str(path)))
        self.write()
        return self.entries[-1]

    def write(self) -> None:
        """Keep it (beside, then renamed)."""
        content = {"utc_ns": self._utc_ns, "bags": [asdict(entry) for entry in self.entries]}
        beside = self._file.with_suffix(".new")
        beside.write_text(json.dumps(content, indent=1))
        beside.rename(self._file)

    def _read(self) -> list[BagEntry]:
        try:
            content = json.loads(self._file.read_text())
            if content["utc_ns"] != self._utc_ns:
                return []
            return [BagEntry(**entry) for entry in content["bags"]]
        except FileNotFoundError:
            return []
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(f"{self._file}: not what a recorder wrote: {error}") from error


def describe_bags(graph: Graph) -> list[str]:
    """Return what the recorders of an ended run have to tell, a line each."""
    lines = []
    for participant in graph.participants:
        if not participant.node.endswith(":RecorderNode"):
            continue
        for entry in RecordBook(graph, participant.name).entries:
            lines.append(f"{participant.name}: {describe_bag(entry)}")
            lines += [f"  {row}" for row in topic_rows(entry)]
    return lines


def describe_bag(entry: BagEntry) -> str:
    """Return what came of a bag."""
    if entry.state == RECORDING:
        return f"{entry.path} was cut off; save it with: tvbrdf bag recover {entry.path}"
    lost = sum(entry.lost.values())
    text = (
        f"{entry.path}: {sum(entry.messages.values())} messages of {len(entry.messages)} topics, "
        f"{entry.bytes / 1e6:.1f} MB, {f'{lost} messages lost' if lost else 'no gaps'}"
    )
    return f"{text}; ended early: {entry.text}" if entry.state == ENDED else text


def topic_rows(entry: BagEntry) -> list[str]:
    """Return counts of each topic."""
    return [
        f"{topic}: {count}" + (f", {entry.lost[topic]} lost" if topic in entry.lost else "")
        for topic, count in sorted(entry.messages.items())
    ]
