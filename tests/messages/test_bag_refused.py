"""What is no bag of this version is refused with what it is and what to do."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import pytest
from mcap.writer import Writer

from tests.messages.bag_samples import arm_state, as_bytes, frame, header, plain, write
from tests.sample_messages import START_NS
from tvbrdf_messages.bag import (
    BagEmptyError,
    BagError,
    BagForeignError,
    BagReader,
    BagVersionError,
    BagWriter,
    RawMessage,
    check_bag,
    filter_bag,
    merge_bags,
    recover,
)
from tvbrdf_messages.bag.about import FORMAT_VERSION, About
from tvbrdf_messages.bag.message_schema import MessageSchema, schema_of, why_unreadable
from tvbrdf_messages.bag.stored import pack_parts
from tvbrdf_messages.messages import ArmState, Frame
from tvbrdf_messages.schema import Message, array_field


def foreign(path: Path, profile: str = "ros2") -> Path:
    """Write what another program would."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile=profile, library="other 1.0")
        schema = writer.register_schema("std_msgs/String", "ros2msg", b"string data")
        channel = writer.register_channel("/chatter", "cdr", schema)
        for k in range(10):
            writer.add_message(channel, START_NS + k, b"\x00\x01\x00\x00hello", START_NS + k)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def test_mcap_files_of_other_programs(tmp_path: Path) -> None:
    path = foreign(tmp_path / "other.mcap")
    text = r"is an MCAP file of another program \(.*other 1\.0"
    with pytest.raises(BagForeignError, match=text):
        BagReader(path)
    with pytest.raises(BagForeignError, match=text):
        recover(path, tmp_path / "out.mcap")
    with pytest.raises(BagForeignError, match=text):
        filter_bag(path, tmp_path / "out.mcap")
    with pytest.raises(BagForeignError, match=text):
        merge_bags([path], tmp_path / "out.mcap")
    (problem,) = check_bag(path).problems
    assert problem.kind == "unreadable"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_only_says_it_is_ours(tmp_path: Path) -> None:
    path = foreign(tmp_path / "other.mcap", "tvbrdf")
    with pytest.raises(BagError, match="topic /chatter has messages of encoding 'cdr'"):
        BagReader(path)


@pytest.mark.parametrize("content", [b"hello, I am a text\n" * 100, b"\x89PNG\r\n\x1a\n", b"x"])
def test_other_files(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(BagForeignError, match=r"a\.mcap: is no bag and no other MCAP file"):
        BagReader(path)


def test_an_empty_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"")
    with pytest.raises(BagEmptyError, match="is empty: nothing was recorded into it"):
        BagReader(path)
    assert not check_bag(path).ok


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="there is no such bag"):
        BagReader(tmp_path / "a.mcap")
    with pytest.raises(BagError, match="there is no such bag"):
        check_bag(tmp_path / "a.mcap")


def test_a_newer_format(tmp_path: Path) -> None:
    about = About(format_version=FORMAT_VERSION + 1, version="9.9")
    path = write(tmp_path / "a.mcap", [], about=about)
    text = rf"of format {FORMAT_VERSION + 1}, recorded by tvbrdf 9\.9.* update it"
    with pytest.raises(BagVersionError, match=text):
        BagReader(path)
    with pytest.raises(BagVersionError, match=text):
        recover(path, tmp_path / "out.mcap")


# -- other versions of messages


def changed(cls: type[Message], **change: Any) -> MessageSchema:
    """Return the schema of another version of a message."""
    schema = schema_of(cls)
    return schema._replace(data=json.dumps({**json.loads(schema.data), **change}).encode())


def bag_of(path: Path, topic: str, schema: MessageSchema, *stored: list[bytes]) -> Path:
    """Write messages under any schema."""
    with BagWriter(path) as writer:
        for k, parts in enumerate(stored):
            writer.write_raw(
                RawMessage(
                    START_NS + k, START_NS, k, topic, "arm", False, schema, pack_parts(parts)
                )
            )
    return path


def test_a_field_that_a_newer_version_appended_is_ignored(tmp_path: Path) -> None:
    told = arm_state(0, START_NS)
    body = msgpack.unpackb(as_bytes(told.envelope)[1])
    body[1].append("new")
    fields = [*json.loads(schema_of(ArmState).data)["fields"], {"name": "mood", "type": "str"}]
    path = bag_of(
        tmp_path / "a.mcap",
        "/arm/state",
        changed(ArmState, fields=fields, version="9.9"),
        [b"/arm/state", msgpack.packb(body)],
    )
    with BagReader(path) as reader:
        assert [each.envelope for each in reader.messages()] == [told.envelope]


def test_an_array_that_a_newer_version_appended_is_ignored(tmp_path: Path) -> None:
    told = frame(0, START_NS)
    topic, raw, image = as_bytes(told.envelope)
    body = msgpack.unpackb(raw)
    body[2].append(["float64", [2]])
    arrays = [
        *json.loads(schema_of(Frame).data)["arrays"],
        {"name": "depth", "dtypes": ["float64"], "shape": [None]},
    ]
    path = bag_of(
        tmp_path / "a.mcap",
        told.envelope.topic,
        changed(Frame, arrays=arrays),
        [topic, msgpack.packb(body), image, bytes(16)],
    )
    with BagReader(path) as reader:
        found = [each.envelope for each in reader.messages()]
    assert [as_bytes(each) for each in found] == [as_bytes(told.envelope)]


def test_a_missing_field_is_told_by_name(tmp_path: Path) -> None:
    told = arm_state(0, START_NS)
    body = msgpack.unpackb(as_bytes(told.envelope)[1])
    body[1].pop()
    fields = json.loads(schema_of(ArmState).data)["fields"]
    path = bag_of(
        tmp_path / "a.mcap",
        "/arm/state",
        changed(ArmState, fields=fields[:-1], version="0.0.9"),
        [b"/arm/state", msgpack.packb(body)],
    )
    missing = fields[-1]["name"]
    with BagReader(path) as reader:
        with pytest.raises(
            BagVersionError,
            match=f"/arm/state: message ArmState has no field '{missing}': recorded by tvbrdf "
            r"0\.0\.9, read it with that version",
        ):
            list(reader.messages())
        assert len(list(reader.messages(raw=True))) == 1
    problems = [p for p in check_bag(path).problems if p.kind == "message"]
    assert len(problems) == 1
    assert f"has no field '{missing}'" in problems[0].text
    recover(path, tmp_path / "out.mcap")
    with BagReader(tmp_path / "out.mcap") as reader, pytest.raises(BagVersionError, match=missing):
        list(reader.messages())


def test_a_field_in_another_place_is_told(tmp_path: Path) -> None:
    """Without the schema, numbers would be taken for others: speed for angle."""
    fields = json.loads(schema_of(ArmState).data)["fields"]
    fields[0], fields[1] = fields[1], fields[0]
    told = arm_state(0, START_NS)
    path = bag_of(
        tmp_path / "a.mcap",
        "/arm/state",
        changed(ArmState, fields=fields),
        as_bytes(told.envelope),
    )
    with (
        BagReader(path) as reader,
        pytest.raises(BagVersionError, match="has field 'speed_deg_s' in place of 'angle_deg'"),
    ):
        list(reader.messages())


def test_a_topic_with_another_type_and_one_that_is_not_known(tmp_path: Path) -> None:
    told = arm_state(0, START_NS)
    other = schema_of(ArmState)._replace(name="tvbrdf.ArmPose")
    path = bag_of(tmp_path / "a.mcap", "/arm/state", other, as_bytes(told.envelope))
    with (
        BagReader(path) as reader,
        pytest.raises(BagVersionError, match="carries ArmPose, here ArmState"),
    ):
        list(reader.messages())
    path = bag_of(
        tmp_path / "b.mcap",
        "/arm/pose",
        other,
        [b"/arm/pose", *as_bytes(told.envelope)[1:]],
    )
    with BagReader(path) as reader:
        with pytest.raises(BagVersionError, match="/arm/pose: this version knows no such topic"):
            list(reader.messages())
        assert list(reader.messages(["/arm/state"])) == []
        assert reader.topics() == ("/arm/pose",)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sample(Message):
    number: int
    name: str
    values: Any = array_field("float64", shape=(None, 3))


def test_a_schema_tells_name_type_dtypes_and_shape() -> None:
    text = json.loads(schema_of(_Sample).data)
    assert text["fields"] == [{"name": "number", "type": "int"}, {"name": "name", "type": "str"}]
    assert text["arrays"] == [{"name": "values", "dtypes": ["float64"], "shape": [None, 3]}]
    assert text["header"][:2] == ["publisher", "incarnation"]
    assert text["version"]


def test_a_schema_that_is_no_schema() -> None:
    schema = schema_of(ArmState)
    for data in (b"", b"[]", b"{}", b'{"version": 1, "fields": 3}', b"\xff"):
        assert "can't be read" in why_unreadable("/arm/state", schema._replace(data=data))


def test_messages_that_do_not_decode_are_told_with_their_time(tmp_path: Path) -> None:
    """Stored as they came: right by every checksum, but no messages of their topic."""
    good = arm_state(0, START_NS)
    body = msgpack.packb([header("arm", 1, START_NS), ["east", 1.0], []])
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.write_envelope(good.envelope, START_NS)
        writer.write([b"/arm/state", body], START_NS + 5)
    with BagReader(tmp_path / "a.mcap") as reader:
        messages = reader.messages()
        assert plain([good]) == [(START_NS, as_bytes(next(messages).envelope))]
        with pytest.raises(BagError, match=f"/arm/state at {START_NS + 5}: .*fields missing"):
            next(messages)
    kinds = {problem.kind for problem in check_bag(tmp_path / "a.mcap").problems}
    assert "message" in kinds


def test_bytes_that_are_no_message_are_kept_but_told(tmp_path: Path) -> None:
    """In a bag they are the recorder's fault, not the disk's: no tool stumbles over them."""
    good = arm_state(0, START_NS)
    schema = schema_of(ArmState)
    path = tmp_path / "a.mcap"
    with BagWriter(path) as writer:
        writer.write_envelope(good.envelope, START_NS)
        for k, data in enumerate((b"", b"\x90", b"\xc1", b"\x92\xc4\x01a\xc4\x01b")):
            writer.write_raw(
                RawMessage(START_NS + k, START_NS, k, "/arm/state", "arm", False, schema, data)
            )
    assert recover(path, tmp_path / "out.mcap").messages == 5
    with BagReader(path) as reader:
        assert reader.summary().streams == reader.summary(recount=True).streams
        assert len(list(reader.messages(raw=True))) == 5
    assert [p.kind for p in check_bag(path).problems].count("message") == 4
    with pytest.raises(BagError, match=r"/arm/state at .*tvbrdf bag check"):
        merge_bags([path], tmp_path / "merged.mcap")
