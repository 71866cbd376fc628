"""What starts things for a test, and stops them all at its end."""

from __future__ import annotations

import contextlib
from pathlib import Path
from types import TracebackType
from typing import Self


class Factory:
    """Keeps what it started until its end; `folder` is for what that writes."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._last = contextlib.ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._last.__exit__(kind, error, trace)
