"""Bags of a small scan for the tests of refits, and how the verb is run."""

from __future__ import annotations

import json
import random
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.replay.process_replay import BAG
from tests.replay.recorded_rig import read_all, write_bag
from tvbrdf_launch.cli import main
from tvbrdf_messages.bag import BagReader
from tvbrdf_messages.envelope import Envelope

VALUES = ("parameter_names", "values", "standard_deviations", "covariance", "errors", "chi_square")


@dataclass
class Ended:
    """How a command ended."""

    status: int
    out: str
    err: str

    def json(self) -> Any:
        return json.loads(self.out)

    @property
    def error(self) -> str:
        """The one line of an error."""
        assert self.status == 1, self.out
        (line,) = self.err.splitlines()
        assert line.startswith("tvbrdf: error: ")
        return line


Refit = Callable[..., Ended]


def refit_with(capsys: pytest.CaptureFixture[str]) -> Refit:
    """Return what runs the verb in this process."""

    def run(*words: str | Path, jobs: int = 1) -> Ended:
        capsys.readouterr()
        try:
            status = main(["refit", *map(str, words), "--jobs", str(jobs)])
        except SystemExit as ended:
            status = int(ended.code or 0)
        found = capsys.readouterr()
        return Ended(status, found.out, found.err)

    return run


def results(folder: Path) -> list[dict[str, Any]]:
    """Return the records of a folder of results."""
    return [json.loads(line) for line in (folder / "results.jsonl").read_text().splitlines()]


def found_values(folder: Path) -> list[Any]:
    """Return all that was fitted, without what it was made from."""
    return [[record[name] for name in VALUES] for record in results(folder)]


def inside(bag: Path = BAG) -> dict[str, bytes]:
    """Return the attachments of a bag."""
    with BagReader(bag) as reader:
        return dict(reader.attachments())


def copy_bag(
    path: Path,
    keep: Callable[[Envelope], bool] = lambda envelope: True,
    attachments: Mapping[str, bytes] | None = None,
    bag: Path = BAG,
    **options: Any,
) -> Path:
    """Write a part of a bag, or the same with other attachments."""
    chosen = inside(bag) if attachments is None else attachments
    return write_bag(path, (e for e in read_all(bag) if keep(e)), chosen, **options)


def shuffled(envelopes: Iterable[Envelope], seed: int) -> Iterator[Envelope]:
    """Yield messages with publishers taking turns by chance; each one's own order is kept."""
    rng = random.Random(seed)
    left: dict[str, deque[Envelope]] = defaultdict(deque)
    for envelope in envelopes:
        left[envelope.header.publisher].append(envelope)
    while left:
        name = rng.choice(sorted(left))
        for _ in range(min(len(left[name]), int(rng.paretovariate(0.5)))):
            yield left[name].popleft()
        if not left[name]:
            del left[name]
