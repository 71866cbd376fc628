"""The MCAP schema of a message class: its fields as a JSON text, and whether it can be read.

A message's plain fields are sent by position, and so are its arrays; a newer version may append
to either. So a class reads what a bag holds if its fields are the first ones of the bag's.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple

from ..envelope import Header
from ..errors import BusError
from ..schema import Message
from ..topics import find_topic
from .about import software_version

SCHEMA_ENCODING = "tvbrdf"
MESSAGE_ENCODING = "msgpack"


class MessageSchema(NamedTuple):
    """A schema as it stands in a file."""

    name: str
    """Of the message class, after ``tvbrdf.``."""
    encoding: str
    data: bytes

    @property
    def type_name(self) -> str:
        """The message class's name."""
        return self.name.removeprefix("tvbrdf.")


def schema_of(cls: type[Message]) -> MessageSchema:
    """Return the schema of a message class."""
    found = _SCHEMAS.get(cls)
    if found is None:
        found = _SCHEMAS[cls] = _make_schema(cls)
    return found


_SCHEMAS: dict[type[Message], MessageSchema] = {}


def _make_schema(cls: type[Message]) -> MessageSchema:
    fields: list[dict[str, Any]] = []
    arrays: list[dict[str, Any]] = []
    for field in cls.schema():
        if field.array is None:
            fields.append({"name": field.name, "type": field.annotation})
        else:
            arrays.append(
                {
                    "name": field.name,
                    "dtypes": list(field.array.dtypes),
                    "shape": list(field.array.shape),
                }
            )
    text = {
        "message": cls.__name__,
        "version": software_version(),
        "layout": "msgpack array of the parts: topic, body, one part for each array; "
        "body: msgpack array of header, fields, [dtype, shape] of each array",
        "header": list(Header._fields),
        "fields": fields,
        "arrays": arrays,
    }
    return MessageSchema(f"tvbrdf.{cls.__name__}", SCHEMA_ENCODING, json.dumps(text).encode())


def why_unreadable(topic: str, schema: MessageSchema) -> str:
    """Return why this version can't read a topic that was recorded so; empty if it can."""
    try:
        mine = schema_of(find_topic(topic).type)
    except BusError:
        return "this version knows no such topic; read it with the version that recorded it"
    if schema == mine:
        return ""
    try:
        theirs, ours = json.loads(schema.data), json.loads(mine.data)
        recorded_by = str(theirs["version"])
        wrong = (
            f"carries {schema.type_name}, here {mine.type_name}"
            if schema.name != mine.name
            else _wrong_field("fields", theirs, ours) or _wrong_field("arrays", theirs, ours)
        )
    except (ValueError, KeyError, TypeError):
        return f"the schema of message {mine.type_name} can't be read"
    return f"{wrong}: recorded by tvbrdf {recorded_by}, read it with that version" if wrong else ""


def _wrong_field(kind: str, theirs: dict[str, Any], ours: dict[str, Any]) -> str:
    """Return what is wrong with the first of our fields that is not in its place in theirs."""
    told = [str(field["name"]) for field in theirs[kind]]
    for position, field in enumerate(ours[kind]):
        name = field["name"]
        if position >= len(told):
            return f"message {ours['message']} has no field {name!r}"
        if told[position] != name:
            return f"message {ours['message']} has field {told[position]!r} in place of {name!r}"
    return ""
