"""The arm controller's line protocol, as described in docs/serial_protocol.md.

Pure functions between bytes and messages, and a parser that survives whatever a serial line does.
"""

from __future__ import annotations

import binascii
import math
import re
from dataclasses import dataclass
from typing import NamedTuple

MAX_LINE_BYTES = 160
"""Of a line as it is sent, without its newline."""
MAX_STAMPED_BYTES = MAX_LINE_BYTES + 48
"""The same with the annotation of a line monitor."""
MAX_ID = 999_999_999
MAX_NUMBER = 1e9

VERBS: dict[str, tuple[int, ...]] = {
    "IDENTIFY": (0,),
    "LIMITS": (0, 4),
    "STATUS": (0,),
    "HOME": (0,),
    "MOVE": (1,),
    "SWEEP": (3,),
    "STOP": (0,),
    "LAMP": (1,),
    "ALIVE": (0,),
    "TICK": (0,),
    "REPORTS": (1,),
}
"""Every verb, with the numbers of arguments it may have."""

REASONS = {
    "busy": "a motion is under way",
    "not_homed": "it has not been homed since it was switched on",
    "limit": "outside the controller's limits",
    "fault": "the controller has a fault; homing clears it",
    "estop": "the emergency stop is pressed",
    "no_keepalive": "no keepalive has arrived lately",
    "unknown_verb": "the controller does not know this request",
    "bad_argument": "the controller can't use these arguments",
    "stopped": "it was stopped",
    "watchdog": "keepalives had ceased, the controller stopped by itself",
    "stall": "the motor stalled: something is in the arm's way",
}
"""What refusals and broken motions mean, for people."""

_LINE = re.compile(
    rb"([\x20-\x29\x2b-\x7d]+)\*([0-9A-F]{4})(?: ~([0-9]{1,19})(?:,([0-9]{1,19}))?)?"
)
_NUMBER = re.compile(r"-?[0-9]{1,9}(\.[0-9]{1,6})?")
_COUNT = re.compile(r"0|[1-9][0-9]{0,19}")
_KEY = re.compile(r"[a-z][a-z0-9_]{0,15}")
_VALUE = re.compile(r"[A-Za-z0-9_.+-]{1,32}")
_FLAGS = re.compile(r"-|(?=.)L?M?H?F?E?")


class ProtocolError(ValueError):
    """Bytes that are no line of this protocol, or a message that can't be written as one."""


class ChecksumError(ProtocolError):
    """A line whose bytes do not give its checksum."""


@dataclass(frozen=True, slots=True)
class Request:
    """Something asked of the controller; numbers travel with six decimals."""

    request_id: int
    verb: str
    arguments: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Answer:
    """The controller has accepted a request; ``fields`` are what it says about it, in order."""

    request_id: int
    fields: tuple[tuple[str, str], ...] = ()

    def text(self, key: str) -> str:
        """Return a field, or raise :class:`ProtocolError`."""
        for name, value in self.fields:
            if name == key:
                return value
        raise ProtocolError(f"answer {self.request_id} has no field {key!r}")

    def number(self, key: str) -> float:
        """Return a field that is a number."""
        return _number(self.text(key))

    def count(self, key: str) -> int:
        """Return a field that is a whole number, 0 or more."""
        return _count(self.text(key))


@dataclass(frozen=True, slots=True)
class Refusal:
    """The controller has not accepted a request; ``code`` is one of :data:`REASONS`."""

    request_id: int
    code: str


@dataclass(frozen=True, slots=True)
class Flags:
    """What is on: letters ``L M H F E`` in this order, ``-`` when none is."""

    lamp: bool = False
    moving: bool = False
    homed: bool = False
    fault: bool = False
    emergency_stop: bool = False

    def text(self) -> str:
        """Return the letters."""
        states = (self.lamp, self.moving, self.homed, self.fault, self.emergency_stop)
        return "".join(c for c, on in zip("LMHFE", states, strict=True) if on) or "-"


@dataclass(frozen=True, slots=True)
class Report:
    """Where the arm was at a count of the controller's microsecond clock."""

    tick: int
    angle_deg: float
    speed_deg_s: float
    flags: Flags


@dataclass(frozen=True, slots=True)
class Event:
    """Request ``request_id`` has ended, or (id 0) the controller did something by itself.

    ``outcome``: ``DONE``, ``BROKEN`` or (id 0 only) ``NOTICE``; ``code`` is ``-`` when done.
    """

    request_id: int
    tick: int
    outcome: str
    code: str = "-"


Message = Request | Answer | Refusal | Report | Event


class Line(NamedTuple):
    """A message, its length on the wire, and the stamps that a line monitor added (or none)."""

    message: Message
    stamps: tuple[int, ...] = ()
    size: int = 0


# -- writing


def checksum(body: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE of ``body`` (polynomial 0x1021, start 0xFFFF)."""
    return binascii.crc_hqx(body, 0xFFFF)


def number_text(value: float) -> str:
    """Return a number with at most six decimals.

    Raises
    ------
    ProtocolError
        If it is not finite, or not below 1e9.
    """
    if not math.isfinite(value) or abs(value) >= MAX_NUMBER - 1:
        raise ProtocolError(f"{value!r} can't be sent: numbers are finite and below 1e9")
    text = f"{value:.6f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def flags_from_text(text: str) -> Flags:
    """Return the flags that letters stand for."""
    if not _FLAGS.fullmatch(text):
        raise ProtocolError(f"{text!r} are no flags")
    return Flags("L" in text, "M" in text, "H" in text, "F" in text, "E" in text)


def _body(message: Message) -> str:
    match message:
        case Request(request_id, verb, arguments):
            return " ".join(["Q", str(request_id), verb, *map(number_text, arguments)])
        case Answer(request_id, fields):
            return " ".join(["A", str(request_id), *(f"{key}={value}" for key, value in fields)])
        case Refusal(request_id, code):
            return f"N {request_id} {code}"
        case Report(tick, angle, speed, flags):
            return f"P {tick} {number_text(angle)} {number_text(speed)} {flags.text()}"
        case Event(request_id, tick, outcome, code):
            return f"E {request_id} {tick} {outcome} {code}"


def encode(message: Message) -> bytes:
    """Return the line of a message, with checksum and newline.

    Raises
    ------
    ProtocolError
        If the message breaks the protocol's rules (a number out of range, a word with a space …).
    """
    text = _body(message)
    _parse(text)  # what we would not read, we do not send
    body = text.encode("ascii")
    if len(body) + 5 > MAX_LINE_BYTES:
        raise ProtocolError(f"line of {len(body) + 5} bytes; at most {MAX_LINE_BYTES} are allowed")
    return b"%s*%04X\n" % (body, checksum(body))


def annotate(line: bytes, *stamps_ns: int) -> bytes:
    """Return a line with the arrival stamp, or the departure and arrival stamps, behind it."""
    stamps = ",".join(map(str, stamps_ns)).encode("ascii")
    return line[:-1] + b" ~" + stamps + b"\n"


# -- reading


def decode(line: bytes) -> Line:
    """Return the message of a line without its newline.

    Raises
    ------
    ProtocolError
        If it is none; :class:`ChecksumError` when only the checksum is wrong.
    """
    found = _LINE.fullmatch(line)
    if found is None:
        raise ProtocolError("not a line of this protocol")
    body, digits, *stamps = found.groups()
    size = len(body) + 6
    if size > MAX_LINE_BYTES + 1:
        raise ProtocolError(f"line of {size} bytes")
    if checksum(body) != int(digits, 16):
        raise ChecksumError("wrong checksum")
    message = _parse(body.decode("ascii"))
    return Line(message, tuple(int(stamp) for stamp in stamps if stamp is not None), size)


def _number(text: str) -> float:
    if not _NUMBER.fullmatch(text):
        raise ProtocolError(f"{text!r} is no number")
    return float(text)


def _count(text: str) -> int:
    if not _COUNT.fullmatch(text):
        raise ProtocolError(f"{text!r} is no whole number")
    return int(text)


def _id(text: str, smallest: int = 1) -> int:
    found = _count(text)
    if not smallest <= found <= MAX_ID:
        raise ProtocolError(f"{text!r} is no request's number")
    return found


def _word(text: str) -> str:
    if not _KEY.fullmatch(text):
        raise ProtocolError(f"{text!r} is no word of this protocol")
    return text


def _parse(body: str) -> Message:
    kind, *words = body.split(" ")
    match kind, words:
        case "Q", [number, verb, *arguments]:
            if not re.fullmatch("[A-Z]{1,16}", verb):
                raise ProtocolError(f"{verb!r} is no verb")
            return Request(_id(number), verb, tuple(map(_number, arguments)))
        case "A", [number, *fields]:
            return Answer(_id(number), tuple(map(_field, fields)))
        case "N", [number, code]:
            return Refusal(_id(number), _word(code))
        case "P", [tick, angle, speed, flags]:
            return Report(_count(tick), _number(angle), _number(speed), flags_from_text(flags))
        case "E", [number, tick, outcome, code]:
            return _event(_id(number, 0), _count(tick), outcome, code)
    raise ProtocolError("unknown kind of line")


def _field(text: str) -> tuple[str, str]:
    key, _, value = text.partition("=")
    if not _VALUE.fullmatch(value):
        raise ProtocolError(f"{value!r} is no value")
    return _word(key), value


def _event(request_id: int, tick: int, outcome: str, code: str) -> Event:
    if outcome not in (("NOTICE",) if request_id == 0 else ("DONE", "BROKEN")):
        raise ProtocolError(f"{outcome!r} is no outcome")
    if (outcome == "DONE") != (code == "-"):
        raise ProtocolError(f"{outcome} with code {code!r}")
    return Event(request_id, tick, outcome, code if code == "-" else _word(code))


class LineParser:
    """Takes bytes as they come, gives messages, and counts what was none. Never raises."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._discarding = False
        self.read = 0
        """Good lines."""
        self.wrong_checksums = 0
        self.malformed = 0
        self.too_long = 0

    @property
    def unreadable(self) -> int:
        """How many lines could not be used."""
        return self.wrong_checksums + self.malformed + self.too_long

    def feed(self, data: bytes) -> list[Line]:
        """Return the messages that ``data`` completes; empty lines are passed over."""
        found: list[Line] = []
        self._buffer += data
        *lines, rest = bytes(self._buffer).split(b"\n")
        for line in lines:
            if self._discarding:
                self._discarding = False
            elif len(line) > MAX_STAMPED_BYTES:
                self.too_long += 1
            elif line not in (b"", b"\r"):
                self._take(line.removesuffix(b"\r"), found)
        if len(rest) > MAX_STAMPED_BYTES:
            self.too_long += not self._discarding
            self._discarding, rest = True, b""
        elif self._discarding:
            rest = b""
        self._buffer = bytearray(rest)
        return found

    def _take(self, line: bytes, found: list[Line]) -> None:
        try:
            found.append(decode(line))
        except ChecksumError:
            self.wrong_checksums += 1
        except ProtocolError:
            self.malformed += 1
        else:
            self.read += 1
