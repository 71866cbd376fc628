"""Launch files: YAML with arguments, nodes and includes; every error has its file and line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .arguments import TYPES, Argument, resolve
from .errors import COMMAND_LINE, LaunchError, Place, did_you_mean
from .substitution import Scope, substitute
from .yaml_items import Item, as_item, load_items

RESTARTS = ("never", "on_failure", "always")
_NODE_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")


@dataclass(frozen=True, slots=True)
class RestartPolicy:
    """When a node that ended is started again."""

    policy: str = "never"
    """``never``, ``on_failure`` or ``always``."""
    max_restarts: int = 3
    """In a row; a node that then works for a minute has them all again."""
    delay_s: float = 0.5


@dataclass(frozen=True, slots=True)
class NodeEntry:
    """One node of a launch file, all substitutions made."""

    name: str
    kind: str
    """Short name or ``package.module:Class``."""
    parameters: Item
    restart: RestartPolicy
    ends_run: bool
    """``on_exit: shutdown``."""
    place: Place
    kind_place: Place


@dataclass(frozen=True, slots=True)
class LaunchFile:
    """A launch file with its includes, resolved with its arguments."""

    path: Path
    description: str
    arguments: Mapping[str, Any]
    nodes: tuple[NodeEntry, ...]
    files: tuple[Path, ...]
    """It and all files that it includes."""


@dataclass(frozen=True, slots=True)
class Declaration:
    """The head of a launch file: what it is and which arguments it takes."""

    description: str
    arguments: Mapping[str, Argument]


def load_launch_file(path: Path, arguments: Mapping[str, str], run: Path) -> LaunchFile:
    """Return a launch file resolved with the command line's arguments.

    Parameters
    ----------
    path
        Of the file.
    arguments
        As given on the command line, by name.
    run
        The run directory that ``$(run)`` stands for; it need not exist.

    Raises
    ------
    LaunchError
        With file and line of the first thing that is wrong.
    """
    given = {name: as_item(text, COMMAND_LINE) for name, text in arguments.items()}
    return _load(path.resolve(), given, run, ())


def load_declaration(path: Path) -> Declaration:
    """Return what a launch file says of itself, without resolving its nodes."""
    document = _fields(load_items(path), _FILE_KEYS, "launch file")
    return Declaration(_text(document, "description"), _declared(document.get("arguments")))


_FILE_KEYS = {"description": str, "arguments": dict, "include": list, "nodes": list}
_ARGUMENT_KEYS = {"default": object, "type": str, "description": str, "choices": list}
_INCLUDE_KEYS = {"file": str, "arguments": dict, "when": object}
_NODE_KEYS = {
    "name": str,
    "node": str,
    "parameters": dict,
    "restart": object,
    "on_exit": str,
    "when": object,
}
_RESTART_KEYS = {"policy": str, "max_restarts": int, "delay_s": float}
_TYPE_NAMES = {str: "a text", dict: "a mapping", list: "a list", int: "a whole number",
               float: "a number"}  # fmt: skip


def _fields(
    item: Item, keys: Mapping[str, type], what: str, required: tuple[str, ...] = ()
) -> dict[str, Item]:
    """Return the parts of a mapping, checked for unknown and missing keys and kinds of values."""
    if not isinstance(item.value, dict):
        raise LaunchError(f"{what} must be a mapping of keys to values", item.place)
    for key, part in item.value.items():
        if key not in keys:
            hint = did_you_mean(key, keys)
            raise LaunchError(f"unknown key {key!r} in {what}; {hint}", part.place)
        wanted = keys[key]
        number = wanted is float and type(part.value) in (int, float)
        flag_for_number = wanted is int and isinstance(part.value, bool)
        if flag_for_number or not (number or isinstance(part.value, wanted)):
            text = f"{key!r} of {what} is {part.plain()!r:.60}, expected {_TYPE_NAMES[wanted]}"
            raise LaunchError(text, part.place)
    for key in required:
        if key not in item.value:
            raise LaunchError(f"{what} lacks key {key!r}", item.place)
    return item.value


def _text(fields: Mapping[str, Item], key: str) -> str:
    return str(fields[key].value).strip() if key in fields else ""


def _declared(item: Item | None) -> dict[str, Argument]:
    if item is None:
        return {}
    found = {}
    for name, part in item.value.items():
        if not name.isidentifier():
            raise LaunchError(
                f"argument name {name!r} has other than letters, digits, _", part.place
            )
        fields = _fields(part, _ARGUMENT_KEYS, f"argument {name!r}")
        default = fields.get("default")
        kind = _text(fields, "type") or _type_of(default)
        if kind not in TYPES and kind != "any":
            hint = did_you_mean(kind, TYPES, "types")
            raise LaunchError(f"argument {name!r} has unknown type {kind!r}; {hint}", part.place)
        choices = tuple(fields["choices"].plain()) if "choices" in fields else ()
        description = _text(fields, "description")
        found[name] = Argument(name, kind, default, description, choices, part.place)
    return found


def _type_of(default: Item | None) -> str:
    if default is None:
        return "str"
    return next((name for name, cls in TYPES.items() if type(default.value) is cls), "any")


def _load(
    path: Path, given: Mapping[str, Item], run: Path, above: tuple[tuple[Path, Place], ...]
) -> LaunchFile:
    document = _fields(load_items(path), _FILE_KEYS, "launch file")
    if "nodes" not in document and "include" not in document:
        raise LaunchError("no launch file: neither 'nodes' nor 'include' in it", Place(path, 1))
    declared = _declared(document.get("arguments"))
    scope = resolve(declared, given, Scope({}, run, path.parent))
    nodes: list[NodeEntry] = []
    files = [path]
    for item in document["include"].value if "include" in document else ():
        included = _include(item, scope, path, above)
        if included is not None:
            nodes += included.nodes
            files += [file for file in included.files if file not in files]
    for item in document["nodes"].value if "nodes" in document else ():
        node = _node(item, scope)
        if node is not None:
            nodes.append(node)
    first: dict[str, Place] = {}
    for node in nodes:
        if node.name in first:
            text = f"node {node.name!r} a second time; first in {first[node.name]}"
            raise LaunchError(text, node.place)
        first[node.name] = node.place
    description = _text(document, "description")
    return LaunchFile(path, description, scope.arguments, tuple(nodes), tuple(files))


def _include(
    item: Item, scope: Scope, path: Path, above: tuple[tuple[Path, Place], ...]
) -> LaunchFile | None:
    raw = _fields(item, _INCLUDE_KEYS, "include", ("file",))
    if not _wanted(raw, scope, "include"):
        return None
    fields = _fields(substitute(item, scope), _INCLUDE_KEYS, "include")
    file = (path.parent / fields["file"].value).resolve()
    at = fields["file"].place
    if file == path or any(file == each for each, _ in above):
        chain = " -> ".join(each.name for each in (*(p for p, _ in above), path, file))
        raise LaunchError(f"files include each other in a loop: {chain}", at)
    if not file.is_file():
        raise LaunchError(f"no file {file}", at)
    given = fields["arguments"].value if "arguments" in fields else {}
    return _load(file, given, scope.run, (*above, (path, at)))


def _wanted(fields: Mapping[str, Item], scope: Scope, what: str) -> bool:
    """Return what ``when`` says; true without it."""
    if "when" not in fields:
        return True
    when = substitute(fields["when"], scope)
    if not isinstance(when.value, bool):
        text = f"'when' of {what} is {when.plain()!r}, expected true or false"
        raise LaunchError(text, when.place)
    return when.value


def _node(item: Item, scope: Scope) -> NodeEntry | None:
    raw = _fields(item, _NODE_KEYS, "node", ("name", "node"))
    if not _wanted(raw, scope, "node"):
        return None
    fields = _fields(substitute(item, scope), _NODE_KEYS, "node")
    name = fields["name"].value
    if not _NODE_NAME.fullmatch(name):
        text = f"node name {name!r}: expected up to 32 small letters, digits and _"
        raise LaunchError(text, fields["name"].place)
    on_exit = fields.get("on_exit")
    if on_exit is not None and on_exit.value != "shutdown":
        raise LaunchError(f"on_exit is {on_exit.value!r}, expected 'shutdown'", on_exit.place)
    return NodeEntry(
        name=name,
        kind=fields["node"].value,
        parameters=fields.get("parameters") or Item({}, item.place),
        restart=_restart(fields.get("restart"), name),
        ends_run=on_exit is not None,
        place=fields["name"].place,
        kind_place=fields["node"].place,
    )


def _restart(item: Item | None, name: str) -> RestartPolicy:
    if item is None:
        return RestartPolicy()
    if not isinstance(item.value, dict):
        item = Item({"policy": item}, item.place)
    fields = _fields(item, _RESTART_KEYS, f"restart of node {name!r}", ("policy",))
    policy = fields["policy"].value
    if policy not in RESTARTS:
        hint = did_you_mean(policy, RESTARTS, "policies")
        raise LaunchError(f"unknown restart policy {policy!r}; {hint}", fields["policy"].place)
    values = {key: part.value for key, part in fields.items()}
    for key in ("max_restarts", "delay_s"):
        if values.get(key, 0) < 0:
            raise LaunchError(f"{key!r} is negative", fields[key].place)
    return RestartPolicy(**values)
