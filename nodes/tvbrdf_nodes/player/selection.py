"""Which of a bag's topics are played, and under which names; what moves hardware never is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from tvbrdf_messages.errors import BusError
from tvbrdf_messages.messages import Clock, ScanCommand
from tvbrdf_messages.topics import find_topic, table

COMMAND, TOLD_COMMAND = "/scan/command", "/replay/command"
"""What the rig was told is played under the second name, which nothing that moves takes."""
OF_EVERY_NODE = frozenset({"/diagnostics", "/log"})
"""What nodes of this run say of themselves: recorded ones would be taken for theirs."""
FRAMES, RADIANCE = "frames", "radiance"
PRESETS = (FRAMES, RADIANCE)
_STORED_BESIDES = ("/scan/missing", "/operator/mark")


class SelectionError(ValueError):
    """Topics were asked for that are not played; the text says which are."""


def command_topic(recorded: Iterable[str]) -> str:
    """Return under which name a bag has what the rig was told: the second if it is of a replay."""
    has = set(recorded)
    return TOLD_COMMAND if TOLD_COMMAND in has and COMMAND not in has else COMMAND


def moves_hardware(topic: str) -> bool:
    """Return whether a device may act on what is said there."""
    return find_topic(topic).type is ScanCommand and topic != TOLD_COMMAND


def select(
    recorded: Iterable[str], topics: Iterable[str] = (), remap: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Return under which name each recorded topic is played.

    Parameters
    ----------
    recorded
        The bag's topics; one that this version does not know is left out.
    topics
        Names to be played. None: all that are recorded but ``/sim/`` (which simulated devices
        say to each other) and what nodes say of themselves.
    remap
        Other names, by name.

    Raises
    ------
    SelectionError
        If a topic is unknown, may not be played, or is remapped to one of another type.
    """
    remap = dict(remap or {})
    recorded = tuple(recorded)
    command = command_topic(recorded)
    asked = tuple(topics)
    names = asked or tuple(sorted(filter(_by_default, map(_told, recorded))))
    chosen: dict[str, str] = {}
    for name in names:
        _check(name)
        chosen[command if name == TOLD_COMMAND else name] = remap.get(name, name)
    for old, new in remap.items():
        _check(new)
        if _row_type(old) is not _row_type(new):
            raise SelectionError(
                f"remap {old}:={new}: {old} carries {_row_type(old).__name__}, {new} carries "
                f"{_row_type(new).__name__}; both must carry the same"
            )
        if asked and old not in asked:
            raise SelectionError(f"remap {old}:={new}: {old} is not played; add it to the topics")
    return chosen


def preset(what: str, cameras: Iterable[str]) -> tuple[str, ...]:
    """Return the topics that the pipeline is fed with: from frames on, or from radiance on."""
    if what == RADIANCE:
        return ("/scan/radiance", *_STORED_BESIDES)
    of_cameras = (f"/{camera}/{end}" for camera in cameras for end in ("info", "frame"))
    return (*of_cameras, "/arm/state", TOLD_COMMAND, "/scan/sweep_result", *_STORED_BESIDES)


def needed(what: str, recorded: Iterable[str]) -> tuple[str, ...]:
    """Return the recorded topics without which a preset gives nothing, besides frames."""
    if what == RADIANCE:
        return ("/scan/radiance",)
    return ("/arm/state", command_topic(recorded), "/scan/sweep_result")


def cameras_of(recorded: Iterable[str]) -> tuple[str, ...]:
    """Return the cameras whose frames were recorded, sorted by name, numbers as numbers."""
    names = [topic.split("/")[1] for topic in recorded if topic.endswith("/frame")]
    return tuple(sorted(names, key=lambda name: (name.rstrip("0123456789"), len(name), name)))


def _told(recorded: str) -> str:
    return TOLD_COMMAND if recorded == COMMAND else recorded


def _by_default(name: str) -> bool:
    try:
        row = find_topic(name)
    except BusError:
        return False
    return not row.simulation and row.type is not Clock and name not in OF_EVERY_NODE


def _check(name: str) -> None:
    """Refuse a name under which nothing is played."""
    try:
        row = find_topic(name)
    except BusError as error:
        raise SelectionError(str(error)) from error
    if moves_hardware(name):
        raise SelectionError(
            f"{name} is never played: hardware moves by it; as {TOLD_COMMAND}, which moves "
            "nothing, what it said is"
        )
    if row.type is Clock:
        raise SelectionError(f"{name} is the player's own: it tells the bag's time")


def _row_type(name: str) -> type:
    try:
        return find_topic(name).type
    except BusError as error:
        known = ", ".join(row.name for row in table())
        raise SelectionError(f"remap: no topic {name!r}; there are: {known}") from error
