"""What can be refitted: bags, databases of a run, samples in the published text layout."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from ..errors import RunError

if TYPE_CHECKING:
    from .events import Event
    from .settings import Plan, Settings

SUFFIX = ".mcap"


@dataclass(frozen=True, slots=True)
class Unit:
    """A share of a source that one process works through by itself."""

    scans: frozenset[int] | None = None
    """Only these; None: all but those of ``skip``."""
    skip: frozenset[int] = frozenset()
    """Scans that are there already."""
    share: tuple[int, int] = (0, 1)
    """(r, m): the scans whose number leaves r when divided by m."""
    files: tuple[dict[str, Any], ...] = ()
    """Facts of the files that all its scans are made from."""
    with_asides: bool = True
    """Whether notes and missing scans come with it: with one unit of each source."""

    def wants(self, scan: int) -> bool:
        """Return whether a scan belongs to this share."""
        if self.scans is not None:
            return scan in self.scans
        return scan not in self.skip and scan % self.share[1] == self.share[0]


class Source(Protocol):
    """One thing that is refitted into one folder. It can be pickled."""

    @property
    def path(self) -> Path:
        """Where it is."""
        ...

    @property
    def keeps_radiance(self) -> bool:
        """Whether the result is a database with radiance, not fits alone."""
        ...

    def plan(self, settings: Settings) -> Plan:
        """Return the nodes' parameters; raise what :func:`input_errors` has if there are none."""
        ...

    def facts(self) -> dict[str, Any]:
        """Return sample, process, beginning, and the files that it consists of, with hashes."""
        ...

    def units(self, jobs: int, sources: int, done: frozenset[int], plan: Plan) -> list[Unit]:
        """Return shares for so many processes, of which each of so many sources gets its part."""
        ...

    def work(self, unit: Unit, plan: Plan) -> Iterator[Event]:
        """Work through a share."""
        ...

    def hashes(self, scan: int) -> list[dict[str, Any]] | None:
        """Return the facts of a scan's own files; None where :meth:`facts` has them."""
        ...


def input_errors() -> tuple[type[Exception], ...]:
    """Return what is raised for input that can't be used; each text names the file."""
    from tvbrdf_fitting.published import PublishedFormatError
    from tvbrdf_fitting.published.database import DatabaseError
    from tvbrdf_messages.bag.errors import BagError

    return BagError, DatabaseError, PublishedFormatError, RunError


def find_sources(paths: Sequence[Path]) -> list[Source]:
    """Return what lies at paths: each is a bag, a database, a sample, or a folder of such.

    Raises
    ------
    RunError
        If a path holds nothing that can be refitted, or the same twice.
    """
    found: list[Source] = []
    for path in paths:
        if not path.exists():
            raise RunError(f"{path}: there is no such file or folder")
        one = _source_at(path)
        below = [one] if one is not None else _sources_below(path)
        if not below:
            raise RunError(
                f"{path}: holds nothing to refit; give a bag (NAME{SUFFIX}, or a folder of its "
                "parts), a database of a run (with catalogue.sqlite), a sample in the published "
                "layout (with tvBrdf-data/), or a folder of such"
            )
        found += below
    seen: set[Path] = set()
    for source in found:
        place = source.path.resolve()
        if place in seen:
            raise RunError(f"{source.path}: is given twice; give it once")
        seen.add(place)
    return found


def _source_at(path: Path) -> Source | None:
    from tvbrdf_fitting.published.database import CATALOGUE_FILE
    from tvbrdf_fitting.published.scan import DATA_FOLDER

    from .bag_source import BagSource
    from .stored_sources import DatabaseSource, PublishedSource

    if path.is_file():
        if path.suffix == ".txt":
            raise RunError(f"{path}: is one file of a scan; give the sample's folder")
        return BagSource(path)
    if (path / CATALOGUE_FILE).is_file():
        return DatabaseSource(path)
    if (path / DATA_FOLDER).is_dir():
        return PublishedSource(path)
    files = sorted(path.glob(f"*{SUFFIX}"))
    return BagSource(path) if files and _is_one_bag(path, files) else None


def _is_one_bag(path: Path, files: list[Path]) -> bool:
    """Return whether a folder holds the parts of one recording, rather than bags each by itself."""
    from tvbrdf_messages.bag import BagReader
    from tvbrdf_messages.bag.errors import BagError

    if len(files) == 1:
        return files[0].stem == f"{path.name}_0"
    try:
        with BagReader(path):
            return True
    except BagError:
        # parts of one bag are named after its folder; what is wrong with it is told when it is read
        return all(file.stem.startswith(f"{path.name}_") for file in files)


def _sources_below(path: Path) -> list[Source]:
    if not path.is_dir():
        return []
    entries = sorted(path.iterdir(), key=lambda entry: _natural(entry.name))
    inside = (e for e in entries if e.is_dir() or e.suffix == SUFFIX)
    return [source for entry in inside if (source := _source_at(entry)) is not None]


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort sample2 before sample10."""
    import re

    return [(int(word), "") if word.isdigit() else (-1, word) for word in re.split(r"(\d+)", name)]


def result_names(sources: Sequence[Source]) -> list[str]:
    """Return the name of each source's folder of results, all different."""
    names = [source.path.resolve().name.removesuffix(SUFFIX) for source in sources]
    longer = [f"{s.path.resolve().parent.name}_{n}" for s, n in zip(sources, names, strict=True)]
    chosen = [
        long if names.count(name) > 1 else name for name, long in zip(names, longer, strict=True)
    ]
    for name, source in zip(chosen, sources, strict=True):
        if chosen.count(name) > 1:
            raise RunError(
                f"{source.path}: another input would be written to {name!r} too; refit them into "
                "different folders"
            )
    return chosen
