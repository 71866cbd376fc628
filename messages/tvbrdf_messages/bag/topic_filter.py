"""Which topics are meant: by name, by regular expression, and which are left out."""

from __future__ import annotations

import re
from collections.abc import Iterable

from ..errors import BusError


class TopicFilter:
    """Selects topics as ``ros2 bag`` does.

    Parameters
    ----------
    topics
        Full names.
    regex
        Topics that contain it are meant too. With neither, all are.
    exclude
        Topics that contain this regular expression are left out.

    Raises
    ------
    BusError
        If an expression is none.
    """

    def __init__(
        self,
        topics: Iterable[str] | None = None,
        regex: str | None = None,
        exclude: str | None = None,
    ) -> None:
        self.topics = frozenset(topics) if topics is not None else frozenset()
        self._all = topics is None and regex is None
        self._regex = _compile(regex)
        self._exclude = _compile(exclude)

    def __call__(self, topic: str) -> bool:
        """Return whether a topic is meant."""
        if self._exclude is not None and self._exclude.search(topic):
            return False
        found = self._regex is not None and self._regex.search(topic) is not None
        return self._all or found or topic in self.topics


def _compile(text: str | None) -> re.Pattern[str] | None:
    if text is None:
        return None
    try:
        return re.compile(text)
    except re.error as error:
        raise BusError(f"{text!r} is no regular expression: {error}") from error
