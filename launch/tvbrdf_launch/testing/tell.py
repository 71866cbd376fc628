"""Runs and messages in words, for tests that fail."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

LINES = 12
LENGTH = 400


def short(message: Any) -> str:
    """Return a message in one line: arrays as their shape, cut where it gets long."""
    if not dataclasses.is_dataclass(message):
        return f"{message!r:.{LENGTH}}"
    fields = ((f.name, getattr(message, f.name)) for f in dataclasses.fields(message))
    text = ", ".join(f"{name}={_value(value)}" for name, value in fields)
    text = f"{type(message).__name__}({text})"
    return text if len(text) <= LENGTH else f"{text[: LENGTH - 3]}..."


def _value(value: Any) -> str:
    shape = getattr(value, "shape", None)
    return repr(value) if shape is None else f"{value.dtype}{list(shape)}"


def describe_wait(
    wanted: str,
    why: str,
    *,
    close: Sequence[Any],
    counts: Mapping[str, int],
    nodes: Mapping[str, str],
    logs: Iterable[str],
) -> str:
    """Return why a wait failed: what was wanted, what came instead, how the nodes are, their logs.

    Parameters
    ----------
    close
        Messages of the right topic that were not what was wanted, oldest first.
    counts
        Messages by topic.
    nodes
        How each node is, by name.
    """
    lines = [f"waited in vain for {wanted}: {why}"]
    if close:
        lines += [f"{len(close)} of that topic came, the last: {short(close[-1])}"]
    came = ", ".join(f"{topic} {count}" for topic, count in sorted(counts.items()))
    lines += [f"published in all: {came or 'nothing'}"]
    lines += [f"nodes: {'; '.join(f'{name} {how}' for name, how in nodes.items()) or 'none'}"]
    lines += ["logs:", *(f"  {line}" for line in list(logs)[-LINES * 3 :])]
    return "\n".join(lines)
