"""The catalogue's tables. They are the truth about what a database holds.

A file belongs to the database once its row in ``files`` is committed; it may then still lie under
its temporary name, which the next opening puts right. Stamps are nanoseconds of the run's clock.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from sqlalchemy import JSON, BigInteger, ForeignKey, UniqueConstraint, create_engine, event
from sqlalchemy.engine import Engine
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column, relationship


class Base(DeclarativeBase):
    """All tables of the catalogue."""

    type_annotation_map = {dict[str, Any]: JSON, list[str]: JSON, list[float]: JSON}  # noqa: RUF012


class SchemaVersion(Base):
    """Version of these tables; one row."""

    __tablename__ = "schema_version"
    version: Mapped[int] = mapped_column(primary_key=True)


class Sample(Base):
    """One sample: ``number`` gives its folder ``sampleNN``."""

    __tablename__ = "samples"
    id: Mapped[int] = mapped_column(primary_key=True)
    number: Mapped[int] = mapped_column(unique=True)
    name: Mapped[str] = mapped_column(unique=True)
    process: Mapped[str]
    run_id: Mapped[str]
    """The run that created it: only that one may open it again without being told to resume."""


class Scan(Base):
    """One scan, measured or missing."""

    __tablename__ = "scans"
    __table_args__ = (UniqueConstraint("sample_id", "number"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    sample_id: Mapped[int] = mapped_column(ForeignKey("samples.id"))
    number: Mapped[int]
    state: Mapped[str]
    """``measured`` or ``missing``."""
    reason: Mapped[str] = mapped_column(default="")
    """Why it is missing."""
    start_stamp_ns: Mapped[int | None] = mapped_column(BigInteger)
    time_s: Mapped[float | None]
    """Since t = 0."""
    exposures_ms: Mapped[list[float]] = mapped_column(default=list)
    quality: Mapped[dict[str, Any]] = mapped_column(default=dict)
    digest: Mapped[str] = mapped_column(default="")
    """SHA-256 of all that was sent of it, by which a repetition is told from a contradiction."""
    files: Mapped[list[StoredFile]] = relationship(cascade="all, delete-orphan")
    fit: Mapped[Fit | None] = relationship(cascade="all, delete-orphan")


class StoredFile(Base):
    """One file of a scan, published text or raw observations; ``path`` below the database."""

    __tablename__ = "files"
    id: Mapped[int] = mapped_column(primary_key=True)
    scan_id: Mapped[int] = mapped_column(ForeignKey("scans.id"), index=True)
    path: Mapped[str] = mapped_column(unique=True)
    kind: Mapped[str]
    """``text`` or ``observations``."""
    size: Mapped[int]
    sha256: Mapped[str]


class Fit(Base):
    """A model fitted to one scan."""

    __tablename__ = "fits"
    scan_id: Mapped[int] = mapped_column(ForeignKey("scans.id"), primary_key=True)
    model: Mapped[str]
    solver: Mapped[str]
    reason: Mapped[str]
    """Why the solver stopped."""
    evaluations: Mapped[int]
    solve_time_ms: Mapped[float]
    covariance: Mapped[bytes]
    """(p, p) doubles, little endian, row by row."""
    at_bound: Mapped[list[str]]
    undetermined: Mapped[list[str]]
    details: Mapped[dict[str, Any]]
    """Metric, loss, common errors as found, and why this model."""
    digest: Mapped[str]
    parameters: Mapped[list[Parameter]] = relationship(
        cascade="all, delete-orphan", order_by="Parameter.position"
    )
    errors: Mapped[list[ErrorMeasure]] = relationship(cascade="all, delete-orphan")


class Parameter(Base):
    """One fitted parameter; NULL stands for a number that is not known (NaN)."""

    __tablename__ = "parameters"
    id: Mapped[int] = mapped_column(primary_key=True)
    scan_id: Mapped[int] = mapped_column(ForeignKey("fits.scan_id"), index=True)
    position: Mapped[int]
    name: Mapped[str]
    value: Mapped[float | None]
    standard_deviation: Mapped[float | None]


class ErrorMeasure(Base):
    """One error measure of a fit; NULL where nothing was left to measure."""

    __tablename__ = "errors"
    id: Mapped[int] = mapped_column(primary_key=True)
    scan_id: Mapped[int] = mapped_column(ForeignKey("fits.scan_id"), index=True)
    name: Mapped[str]
    value: Mapped[float | None]
    is_count: Mapped[bool]


class Note(Base):
    """What the operator or the store noted."""

    __tablename__ = "notes"
    __table_args__ = (UniqueConstraint("sample_id", "stamp_ns", "text"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    sample_id: Mapped[int] = mapped_column(ForeignKey("samples.id"))
    stamp_ns: Mapped[int] = mapped_column(BigInteger)
    text: Mapped[str]
    zero: Mapped[bool]


def open_engine(path: Path) -> Engine:
    """Return an engine on a catalogue file; each commit is on disk when it returns."""
    engine = create_engine(f"sqlite:///{path}")

    @event.listens_for(engine, "connect")
    def _set_up(connection: Any, _record: Any) -> None:
        for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
            connection.execute(f"PRAGMA {pragma}").close()

    return engine


def close_engine(engine: Engine) -> None:
    """Close it and, unless someone reads it right now, leave one plain file for any reader."""
    try:
        with suppress(DBAPIError), engine.connect() as connection:
            connection.exec_driver_sql("PRAGMA journal_mode=DELETE")
    finally:
        engine.dispose()
