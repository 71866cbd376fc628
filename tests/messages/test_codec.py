"""Messages survive the way through bytes; anything else is refused with what was wrong."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.sample_messages import frame
from tvbrdf_messages.codec import MAX_BODY_BYTES, decode, encode
from tvbrdf_messages.envelope import Header
from tvbrdf_messages.errors import BusError, MessageError
from tvbrdf_messages.messages import ArmState, Diagnostics, Frame, Log, Mark, SimMotion
from tvbrdf_messages.topics import find_topic, frame_topic, table

HEADER = Header("arm", "abc", "host", "boot", 7, 1_800_000_000_000_000_001, 2, 3)


def as_bytes(parts: list[Any]) -> list[bytes]:
    return [bytes(memoryview(part).cast("B")) for part in parts]


def test_a_frame_survives_and_is_not_copied() -> None:
    image = np.arange(2 * 3 * 3, dtype=np.uint16).reshape(2, 3, 3)
    parts = encode(find_topic(frame_topic("camera_1")), HEADER, frame(image))
    assert np.shares_memory(parts[2], image)
    envelope = decode(as_bytes(parts))
    assert envelope.header == HEADER
    assert isinstance(envelope.message, Frame)
    assert envelope.message.exposure_ms == 4.0
    np.testing.assert_array_equal(envelope.message.image, image)
    with pytest.raises(ValueError, match="read-only"):
        envelope.message.image[0, 0, 0] = 1


def test_a_slice_arrives_as_it_looks() -> None:
    image = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)[:, ::-2]
    envelope = decode(as_bytes(encode(find_topic(frame_topic("camera_1")), HEADER, frame(image))))
    assert isinstance(envelope.message, Frame)
    np.testing.assert_array_equal(envelope.message.image, image)


@given(
    angle=st.floats(allow_nan=False),
    text=st.text(max_size=50),
    flags=st.tuples(st.booleans(), st.booleans(), st.booleans()),
    delay=st.integers(-(2**63), 2**63 - 1),
)
def test_every_value_survives(
    angle: float, text: str, flags: tuple[bool, bool, bool], delay: int
) -> None:
    state = ArmState(
        angle_deg=angle,
        speed_deg_s=-angle,
        lamp=flags[0],
        moving=flags[1],
        homed=flags[2],
        fault=text,
        one_way_delay_ns=delay,
    )
    envelope = decode(as_bytes(encode(find_topic("/arm/state"), HEADER, state)))
    assert envelope.message == state


def test_not_a_number_survives() -> None:
    state = ArmState(angle_deg=math.nan, speed_deg_s=0.0, lamp=True, moving=True, homed=True)
    message = decode(as_bytes(encode(find_topic("/arm/state"), HEADER, state))).message
    assert isinstance(message, ArmState)
    assert math.isnan(message.angle_deg)


def test_tuples_come_back_as_tuples() -> None:
    motion = SimMotion(
        until_ns=5,
        start_ns=(1, 2),
        angle_deg=(0.0, 1.0),
        speed_deg_s=(1.0, 1.0),
        acceleration_deg_s2=(0.0, 0.0),
        lamp=(True, False),
    )
    assert decode(as_bytes(encode(find_topic("/sim/motion"), HEADER, motion))).message == motion


def test_a_message_on_the_wrong_topic_is_refused() -> None:
    with pytest.raises(MessageError, match="/arm/state carries ArmState, not Mark"):
        encode(find_topic("/arm/state"), HEADER, Mark(text="x"))


def test_a_wrong_array_is_refused() -> None:
    topic = find_topic(frame_topic("camera_1"))
    with pytest.raises(MessageError, match="dtype float64"):
        encode(topic, HEADER, frame(np.zeros((2, 2, 3))))
    with pytest.raises(MessageError, match="shape"):
        encode(topic, HEADER, frame(np.zeros((2, 2), np.uint8)))


def mutate(change: Any) -> list[bytes]:
    """Return a frame's parts after a change of its unpacked body."""
    image = np.zeros((2, 3, 3), np.uint8)
    parts = as_bytes(encode(find_topic(frame_topic("camera_1")), HEADER, frame(image)))
    body = msgpack.unpackb(parts[1])
    change(body)
    return [parts[0], msgpack.packb(body), *parts[2:]]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda body: body[1].pop(), "fields missing: region_y"),
        (lambda body: body[1].__setitem__(3, "one"), "field scan holds 'one'"),
        (lambda body: body[0].pop(), "header holds"),
        (lambda body: body[0].__setitem__(4, "x"), "header holds"),
        (lambda body: body[2][0].__setitem__(1, [2, 300, 3]), "18 bytes, dtype and shape say"),
        (lambda body: body[2][0].__setitem__(1, [2, -3, 3]), "shape is"),
        (lambda body: body[2][0].__setitem__(1, [2**31, 2**31, 3]), "the limit is"),
        (lambda body: body[2][0].__setitem__(0, "object"), "dtype object"),
        (lambda body: body[2].clear(), "array frames, expected 1"),
        (lambda body: body.clear(), "not a header"),
    ],
)
def test_a_hostile_body_is_refused_with_the_reason(change: Any, text: str) -> None:
    with pytest.raises(MessageError, match=text):
        decode(mutate(change))


def test_fields_of_a_newer_version_are_ignored() -> None:
    plain = decode(mutate(lambda body: None)).message
    newer = decode(mutate(lambda body: body[1].append("news"))).message
    assert type(newer) is type(plain) is Frame
    for field in fields(Frame):
        np.testing.assert_array_equal(getattr(newer, field.name), getattr(plain, field.name))


@given(st.lists(st.binary(max_size=64), max_size=5))
def test_any_bytes_are_refused_or_decoded_never_worse(parts: list[bytes]) -> None:
    with pytest.raises(MessageError):
        decode(parts)


@given(st.binary(max_size=256))
def test_any_body_on_a_real_topic_is_refused(body: bytes) -> None:
    with pytest.raises(MessageError):
        decode([b"/arm/state", body])


def test_an_endless_body_is_refused() -> None:
    with pytest.raises(MessageError, match="the limit is"):
        decode([b"/log", bytes(MAX_BODY_BYTES + 1)])


def test_a_log_with_a_dictionary_survives() -> None:
    message = Diagnostics(node="arm", state="running", counters={"gaps": 1, "rate": 2.5})
    assert decode(as_bytes(encode(find_topic("/diagnostics"), HEADER, message))).message == message


def test_every_row_of_the_table_has_a_sendable_type() -> None:
    names = [row.name for row in table()]
    assert len(names) == len(set(names))
    for row in table():
        assert row.type.schema(), row.name


def test_an_unknown_topic_names_the_known_ones() -> None:
    with pytest.raises(BusError, match=r"no topic '/arm/stat'.*/arm/state"):
        find_topic("/arm/stat")
    assert find_topic("/camera_7/frame").type is Frame
    assert find_topic("/log").type is Log
