"""Mappings from files of which every key must be known, there, and of the right kind."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Self, TypeVar

Option = TypeVar("Option", bound=str)


class StrictFields:
    """A mapping whose keys must all be known and of the right kind.

    Errors name place and key, and what to do.
    """

    fault: ClassVar[type[ValueError]] = ValueError
    """What is raised."""

    def __init__(self, data: object, where: str, defaults: Mapping[Any, Any] | None = None) -> None:
        if not isinstance(data, Mapping):
            found = "nothing" if data is None else type(data).__name__
            raise self.fault(f"{where}: has {found} where keys with values are needed")
        self.where = where
        self._data = {**(defaults or {}), **data}
        self._known: set[str] = set()

    def error(self, key: str, value: object, remedy: str) -> ValueError:
        """Return the error of a value that will not do."""
        shown = repr(value) if len(repr(value)) < 80 else f"{repr(value)[:76]}..."
        return self.fault(f"{self.where}: {key}: {shown} will not do; {remedy}")

    def take(self, key: str) -> Any:
        """Return a value that must be there."""
        self._known.add(key)
        if key not in self._data:
            raise self.fault(f"{self.where}: {key} is missing; add it")
        return self._data[key]

    def child(self, key: str) -> Self:
        """Return a mapping within this one."""
        return type(self)(self.take(key), f"{self.where}: {key}")

    def mapping(self, key: str) -> Mapping[Any, Any]:
        """Return a mapping whose keys are free."""
        value = self.take(key)
        if not isinstance(value, Mapping):
            raise self.error(key, value, "give keys with values")
        return value

    def number(self, key: str, low: float = -math.inf, high: float = math.inf) -> float:
        """Return a number in [low, high]."""
        value = self.take(key)
        number = number_of(value)
        if number is None or not low <= number <= high:
            raise self.error(key, value, f"give a number in [{low:g}, {high:g}]")
        return number

    def integer(self, key: str, low: int, high: int) -> int:
        """Return a whole number in [low, high]."""
        number = self.number(key, low, high)
        if number != int(number):
            raise self.error(key, number, "give a whole number")
        return int(number)

    def numbers(self, key: str) -> tuple[float, ...]:
        """Return a list of numbers."""
        value = self.take(key)
        numbers = numbers_of(value)
        if numbers is None:
            raise self.error(key, value, "give a list of numbers")
        return numbers

    def bgr(self, key: str) -> tuple[float, float, float]:
        """Return three numbers above 0: blue, green, red."""
        value = self.take(key)
        numbers = numbers_of(value, 3)
        if numbers is None or min(numbers) <= 0.0:
            raise self.error(key, value, "give three numbers above 0: [blue, green, red]")
        return numbers[0], numbers[1], numbers[2]

    def choice(self, key: str, *options: Option) -> Option:
        """Return one of the options."""
        value = self.take(key)
        for option in options:
            if value == option:
                return option
        raise self.error(key, value, f"use one of {', '.join(options)}")

    def finish(self) -> None:
        """Refuse keys that nobody asked for."""
        for key in self._data:
            if key not in self._known:
                close = difflib.get_close_matches(str(key), self._known, n=1)
                hint = f"did you mean {close[0]}?" if close else "remove it."
                known = ", ".join(sorted(self._known))
                raise self.fault(f"{self.where}: unknown key {key!r}; {hint} Known: {known}")


def number_of(value: object) -> float | None:
    """Return a finite number, or None; YAML reads 1e-3, without a point, as text."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def numbers_of(value: object, count: int | None = None) -> tuple[float, ...] | None:
    """Return a list's finite numbers, `count` of them if that is given; None for anything else."""
    if not isinstance(value, list) or (count is not None and len(value) != count):
        return None
    numbers = tuple(number for number in map(number_of, value) if number is not None)
    return numbers if len(numbers) == len(value) else None
