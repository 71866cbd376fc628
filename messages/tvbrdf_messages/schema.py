"""What a message class is: a frozen dataclass whose fields the codec can check one by one.

Allowed field types: ``int``, ``float``, ``str``, ``bool``, homogeneous tuples of these
(``tuple[float, ...]``), ``dict[str, Any]`` of plain values, any of them ``| None``, and arrays
declared with :func:`array_field`. Fields are sent by position; a new version of a message may only
append fields, so that an older reader ignores what it does not know.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

from .errors import MessageError

SCALARS: dict[str, type] = {"int": int, "float": float, "str": str, "bool": bool}


class ArraySpec(NamedTuple):
    """What an array field may hold: allowed dtypes and the shape, ``None`` for any length."""

    dtypes: tuple[str, ...]
    shape: tuple[int | None, ...]

    def check(self, dtype: str, shape: tuple[int, ...], where: str) -> None:
        """Raise :class:`MessageError` unless dtype and shape are allowed."""
        if dtype not in self.dtypes:
            raise MessageError(f"{where}: dtype {dtype}, expected one of {', '.join(self.dtypes)}")
        if len(shape) != len(self.shape) or any(
            want is not None and got != want for got, want in zip(shape, self.shape, strict=True)
        ):
            expected = "×".join("n" if n is None else str(n) for n in self.shape)
            raise MessageError(f"{where}: shape {shape}, expected {expected}")


def array_field(*dtypes: str, shape: tuple[int | None, ...]) -> Any:
    """Declare an array field, e.g. ``array_field("uint8", "uint16", shape=(None, None, 3))``."""
    return dataclasses.field(metadata={"array": ArraySpec(dtypes, shape)})


class Field(NamedTuple):
    """One field of a message: its name, a check of plain values, or the array's specification."""

    name: str
    annotation: str
    check: Callable[[Any], bool] | None
    array: ArraySpec | None


def _checker(annotation: str, where: str) -> Callable[[Any], bool]:
    """Return a predicate for one annotation (a string, never evaluated)."""
    text = annotation.replace(" ", "")
    if text.endswith("|None"):
        inner = _checker(text[: -len("|None")], where)
        return lambda value: value is None or inner(value)
    if text == "float":
        # msgpack keeps 1 and 1.0 apart; a whole number is a legal float
        return lambda value: type(value) is float or type(value) is int
    if text in SCALARS:
        kind = SCALARS[text]
        return lambda value: type(value) is kind
    if text.startswith("tuple[") and text.endswith(",...]"):
        item = _checker(text[len("tuple[") : -len(",...]")], where)
        return lambda value: isinstance(value, (list, tuple)) and all(map(item, value))
    if text == "dict[str,Any]":
        return lambda value: type(value) is dict and all(type(key) is str for key in value)
    raise TypeError(f"{where}: fields of type {annotation!r} can't be sent")


class Message:
    """Base of all messages; subclasses are frozen dataclasses with slots and keywords only."""

    __slots__ = ()
    _fields: ClassVar[tuple[Field, ...]]

    @classmethod
    def schema(cls) -> tuple[Field, ...]:
        """Return the fields in the order in which they are sent."""
        cached = cls.__dict__.get("_fields")
        if cached is None:
            cached = tuple(
                Field(field.name, str(field.type), None, field.metadata["array"])
                if "array" in field.metadata
                else Field(
                    field.name,
                    str(field.type),
                    _checker(str(field.type), f"{cls.__name__}.{field.name}"),
                    None,
                )
                for field in dataclasses.fields(cls)  # type: ignore[arg-type]
            )
            cls._fields = cached
        return cached
