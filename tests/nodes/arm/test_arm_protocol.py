"""The line protocol: what is written is read, and nothing that comes in can do harm."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tvbrdf_nodes.arm.protocol import (
    MAX_LINE_BYTES,
    MAX_STAMPED_BYTES,
    REASONS,
    VERBS,
    Answer,
    Event,
    Flags,
    LineParser,
    Message,
    ProtocolError,
    Refusal,
    Report,
    Request,
    annotate,
    checksum,
    decode,
    encode,
    flags_from_text,
)

ids = st.integers(1, 999_999_999)
ticks = st.integers(0, 2**64 - 1)
numbers = st.floats(-1e8, 1e8).map(lambda x: round(x, 6) + 0.0)
flags = st.builds(Flags, *[st.booleans()] * 5)
words = st.from_regex(r"[a-z][a-z0-9_]{0,15}", fullmatch=True)
values = st.from_regex(r"[A-Za-z0-9_.+-]{1,24}", fullmatch=True)
messages = st.one_of(
    st.builds(Request, ids, st.sampled_from(list(VERBS)), st.lists(numbers, max_size=4).map(tuple)),
    st.builds(Answer, ids, st.lists(st.tuples(words, values), max_size=2).map(tuple)),
    st.builds(Refusal, ids, st.sampled_from(list(REASONS))),
    st.builds(Report, ticks, numbers, numbers, flags),
    st.builds(Event, ids, ticks, st.just("DONE")),
    st.builds(Event, ids, ticks, st.just("BROKEN"), words),
    st.builds(Event, st.just(0), ticks, st.just("NOTICE"), words),
)
stamps = st.lists(st.integers(0, 10**19 - 1), min_size=1, max_size=2)


@settings(deadline=None)
@given(messages)
def test_what_is_written_is_read(message: Message) -> None:
    line = encode(message)
    assert line.endswith(b"\n")
    assert len(line) <= MAX_LINE_BYTES + 1
    found = decode(line[:-1])
    assert (found.message, found.stamps, found.size) == (message, (), len(line))


@settings(deadline=None)
@given(messages, stamps)
def test_a_line_monitors_stamps_are_read(message: Message, when_ns: list[int]) -> None:
    line = encode(message)
    found = decode(annotate(line, *when_ns)[:-1])
    assert (found.message, found.stamps, found.size) == (message, tuple(when_ns), len(line))


@settings(deadline=None)
@given(st.floats(-1e8, 1e8))
def test_numbers_travel_with_six_decimals(value: float) -> None:
    found = decode(encode(Request(1, "MOVE", (value,)))[:-1]).message
    assert isinstance(found, Request)
    # half of the last decimal, and the rounding of a double that large
    assert found.arguments[0] == pytest.approx(value, abs=5e-7 + 1e-8, rel=1e-15)


@settings(deadline=None)
@given(st.binary(max_size=2000), st.lists(st.integers(1, 50), max_size=40))
def test_any_bytes_in_any_pieces(data: bytes, pieces: list[int]) -> None:
    whole, split = LineParser(), LineParser()
    found = whole.feed(data)
    again, at = [], 0
    for size in [*pieces, len(data)]:
        again += split.feed(data[at : at + size])
        at += size
    assert again == found
    for name in ("read", "wrong_checksums", "malformed", "too_long", "unreadable"):
        assert getattr(split, name) == getattr(whole, name)


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.binary(max_size=300), messages), max_size=6),
    st.booleans(),
)
def test_lines_between_garbage_are_found(parts: list[tuple[bytes, Message]], crlf: bool) -> None:
    parser = LineParser()
    data = b""
    for garbage, message in parts:
        line = encode(message)
        data += garbage + b"\n" + (line[:-1] + b"\r\n" if crlf else line)
    found = [line.message for line in parser.feed(data)]
    for _, message in parts:
        assert message in found
    assert parser.read == len(found)


@settings(deadline=None)
@given(messages, st.data())
def test_a_changed_byte_is_noticed(message: Message, data: st.DataObject) -> None:
    line = encode(message)[:-1]
    at = data.draw(st.integers(0, len(line) - 1))
    byte = data.draw(st.integers(0, 255).filter(lambda b: b not in (line[at], 10)))
    parser = LineParser()
    # a CRC of 16 bits notices every change within 16 bits in a row
    assert parser.feed(line[:at] + bytes([byte]) + line[at + 1 :] + b"\n") == []
    assert parser.unreadable == 1


def test_checksum_is_the_documented_one() -> None:
    assert checksum(b"123456789") == 0x29B1  # check value of CRC-16/CCITT-FALSE
    assert encode(Request(17, "SWEEP", (-90.0, 90.0, 12.0))) == b"Q 17 SWEEP -90 90 12*CB42\n"


def test_too_long_lines_are_counted_once_and_end() -> None:
    parser = LineParser()
    for _ in range(20):
        assert parser.feed(b"x" * 100) == []
    assert parser.too_long == 1
    (line,) = parser.feed(b"\n" + encode(Request(1, "STOP")))
    assert line.message == Request(1, "STOP")
    assert parser.feed(b"y" * (MAX_STAMPED_BYTES + 1) + b"\n\n\r\n") == []
    assert (parser.too_long, parser.unreadable) == (2, 2)


@pytest.mark.parametrize(
    "message",
    [
        Request(0, "STOP"),
        Request(1_000_000_000, "STOP"),
        Request(1, "stop"),
        Request(1, "STOP NOW"),
        Request(1, "MOVE", (float("nan"),)),
        Request(1, "MOVE", (float("inf"),)),
        Request(1, "MOVE", (1e9,)),
        Answer(1, (("key", "two words"),)),
        Answer(1, (("key", "star*"),)),
        Answer(1, (("key", ""),)),
        Answer(1, tuple((f"key{i}", "x" * 30) for i in range(9))),
        Refusal(1, "Busy"),
        Report(-1, 0.0, 0.0, Flags()),
        Event(1, 0, "NOTICE", "stall"),
        Event(0, 0, "DONE"),
        Event(1, 0, "BROKEN"),
        Event(1, 0, "DONE", "stall"),
    ],
)
def test_what_breaks_the_rules_is_not_written(message: Message) -> None:
    with pytest.raises(ProtocolError):
        encode(message)


@pytest.mark.parametrize("text", ["", "X", "HL", "LL", "L-", "lm"])
def test_flags_have_one_spelling(text: str) -> None:
    with pytest.raises(ProtocolError):
        flags_from_text(text)


def test_answers_name_what_they_lack() -> None:
    answer = Answer(3, (("angle", "-1.5"), ("tick", "12"), ("model", "X-1")))
    assert answer.number("angle") == -1.5
    assert answer.count("tick") == 12
    with pytest.raises(ProtocolError, match="answer 3 has no field 'speed'"):
        answer.number("speed")
    with pytest.raises(ProtocolError, match="'X-1' is no number"):
        answer.number("model")
    with pytest.raises(ProtocolError, match="no whole number"):
        answer.count("angle")


# -- the document


def document() -> str:
    path = Path(__file__).parents[3] / "docs" / "serial_protocol.md"
    return path.read_text(encoding="utf-8")


def test_the_documents_exchange_is_right() -> None:
    lines = [line.strip() for line in document().split("## An exchange")[1].splitlines()]
    parser = LineParser()
    found = parser.feed("".join(f"{line}\n" for line in lines).encode("ascii"))
    assert (parser.read, parser.unreadable) == (len([line for line in lines if line]), 0)
    assert {type(line.message) for line in found} == {Request, Answer, Refusal, Report, Event}
    assert max(len(line.stamps) for line in found) == 2


def test_the_document_names_every_verb_and_reason() -> None:
    text = document()
    for verb in VERBS:
        assert f"| `{verb}" in text, verb
    for reason in REASONS:
        assert f"| `{reason}` |" in text, reason
    assert f"at most {MAX_LINE_BYTES} bytes" in text
