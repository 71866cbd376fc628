"""Protobuf messages: Foxglove's schemas, and own ones of named numbers, made when they are asked.

The packages are an optional group; nothing here loads them before they are needed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

PACKAGES = ("google.protobuf", "mcap_protobuf", "foxglove_schemas_protobuf")
INSTALL = "pip install 'tvbrdf[foxglove]'"
_TIME_FIELD = "timestamp"
_KINDS = {float: "TYPE_DOUBLE", int: "TYPE_INT64", str: "TYPE_STRING", bool: "TYPE_BOOL"}


def lacks_packages() -> str:
    """Return why protobuf can't be written here; empty if it can."""
    for package in PACKAGES:
        try:
            missing = find_spec(package) is None
        except ModuleNotFoundError:  # the package that it is in
            missing = True
        if missing:
            return f"the Python package {package} is not installed; install it with: {INSTALL}"
    return ""


def schema(name: str) -> Any:
    """Return the class of one of Foxglove's messages, such as ``RawImage``."""
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


def own_schema(name: str, kinds: Mapping[str, type]) -> Any:
    """Return the class of a message ``tvbrdf.<name>``: a time stamp, and fields of plain types.

    Parameters
    ----------
    kinds
        ``float``, ``int``, ``str`` or ``bool`` by field; names as :func:`field_names` gives them.
    """
    descriptors = import_module("google.protobuf.descriptor_pb2")
    stamp = import_module("google.protobuf.timestamp_pb2").Timestamp.DESCRIPTOR
    file = descriptors.FileDescriptorProto(
        name=f"tvbrdf/{name}.proto", package="tvbrdf", syntax="proto3"
    )
    file.dependency.append(stamp.file.name)
    message = file.message_type.add(name=name)
    field = descriptors.FieldDescriptorProto
    message.field.add(
        name=_TIME_FIELD,
        number=1,
        label=field.LABEL_OPTIONAL,
        type=field.TYPE_MESSAGE,
        type_name=f".{stamp.full_name}",
    )
    for number, (key, kind) in enumerate(kinds.items(), start=2):
        message.field.add(
            name=key, number=number, label=field.LABEL_OPTIONAL, type=getattr(field, _KINDS[kind])
        )
    pool = import_module("google.protobuf.descriptor_pool").DescriptorPool()
    time_file = descriptors.FileDescriptorProto()
    stamp.file.CopyToProto(time_file)
    pool.Add(time_file)
    pool.Add(file)
    found = pool.FindMessageTypeByName(f"tvbrdf.{name}")
    return import_module("google.protobuf.message_factory").GetMessageClass(found)


def field_names(names: Iterable[str], taken: Iterable[str] = ()) -> dict[str, str]:
    """Return a protobuf field's name for each name, all different."""
    found: dict[str, str] = {}
    used = {_TIME_FIELD, *taken}
    for name in names:
        plain = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower() or "value"
        if not plain[0].isalpha():
            plain = f"p_{plain}"
        field, count = plain, 1
        while field in used:
            count += 1
            field = f"{plain}_{count}"
        used.add(field)
        found[name] = field
    return found


def set_time(stamp: Any, time_ns: int) -> None:
    """Set a ``google.protobuf.Timestamp``."""
    stamp.seconds, stamp.nanos = divmod(time_ns, 10**9)


class ProtobufBag:
    """An MCAP file of protobuf messages; use as a context manager.

    Raises
    ------
    OSError
        From every method, if the system refuses.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> ProtobufBag:
        from mcap.writer import CompressionType

        writer = import_module("mcap_protobuf.writer")
        self._file = self._path.open("wb")
        self._writer = writer.Writer(self._file, compression=CompressionType.LZ4)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._writer.finish()
        finally:
            self._file.close()

    def write(self, topic: str, message: Any, log_time_ns: int, stamp_ns: int) -> None:
        """Write a message; its own time stamp is set, too, where it has one."""
        if _TIME_FIELD in message.DESCRIPTOR.fields_by_name:
            set_time(message.timestamp, stamp_ns)
        self._writer.write_message(topic, message, log_time=log_time_ns, publish_time=stamp_ns)

    def note(self, name: str, facts: Mapping[str, str]) -> None:
        """Write facts about the whole file."""
        self._writer.add_metadata(name, dict(facts))
