"""Parameters from launch files: checked against a node's frozen dataclass."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

T = TypeVar("T")


class ParameterError(ValueError):
    """A parameter is unknown, missing or of the wrong type; ``key`` names it."""

    def __init__(self, key: str, text: str) -> None:
        super().__init__(text)
        self.key = key


def build(cls: type[T], values: Mapping[str, Any]) -> T:
    """Return ``cls(**values)`` with every value checked against its declared type.

    Raises
    ------
    ParameterError
        Naming the parameter and what is allowed. ``__post_init__`` may raise ``ValueError`` for
        values out of range.
    """
    hints = get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    checked: dict[str, Any] = {}
    for key, value in values.items():
        if key not in fields:
            close = difflib.get_close_matches(key, fields, 1)
            hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(fields) or '-'}"
            raise ParameterError(key, f"unknown parameter {key!r}; {hint}")
        checked[key] = _convert(hints[key], value, key)
    for key, field in fields.items():
        required = (
            field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        )
        if required and key not in checked:
            raise ParameterError(key, f"parameter {key!r} is missing")
    try:
        return cls(**checked)
    except ParameterError:
        raise
    except ValueError as error:
        raise ParameterError("", str(error)) from error


def _convert(hint: Any, value: Any, key: str) -> Any:  # noqa: PLR0911
    if hint is Any:
        return value
    origin, args = get_origin(hint), get_args(hint)
    if type(None) in args:
        if value is None:
            return None
        return _convert(next(a for a in args if a is not type(None)), value, key)
    if hint is float and type(value) in (int, float):
        return float(value)
    if hint in (int, str, bool) and type(value) is hint:
        return value
    if origin is tuple and isinstance(value, (list, tuple)):
        return tuple(_convert(args[0], item, key) for item in value)
    if origin is dict or hint is dict:
        if isinstance(value, Mapping):
            return dict(value)
    elif dataclasses.is_dataclass(hint) and isinstance(value, Mapping):
        return build(hint, value)  # type: ignore[arg-type]
    name = getattr(hint, "__name__", None) if origin is None else str(hint)
    raise ParameterError(
        key, f"parameter {key!r} is {value!r} ({type(value).__name__}), expected {name or hint}"
    )
