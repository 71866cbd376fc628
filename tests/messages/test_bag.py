"""Bags give back what was recorded, in order, by time and by topic; other tools open them."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from mcap.reader import NonSeekingReader, make_reader

from tests.messages.bag_samples import (
    ATTACHMENTS,
    Told,
    arm_state,
    as_bytes,
    camera_info,
    frame,
    header,
    plain,
    read,
    rig_messages,
    write,
)
from tests.sample_messages import START_NS
from tvbrdf_messages.bag import (
    About,
    BagDamagedError,
    BagError,
    BagReader,
    BagTopicError,
    BagWriter,
)
from tvbrdf_messages.bag.stored import HeaderReader, pack_parts, unpack_parts
from tvbrdf_messages.bag.streams import Stream
from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.errors import MessageError
from tvbrdf_messages.messages import Radiance


def radiance(n: int) -> Radiance:
    def numbers(*shape: int) -> Any:
        return np.random.default_rng(n).normal(size=shape)

    return Radiance(
        sample="paint",
        scan=3,
        attempt=1,
        scan_time_s=1.5,
        scan_start_ns=START_NS,
        exposures_ms=(1.0, 4.0),
        cameras=("camera_1",),
        gain_relative_std=0.01,
        quality={"gaps": 0, "notes": ["a", None]},
        camera=np.arange(n),
        sweep=np.arange(n),
        exposure_ms=numbers(n),
        stamp_ns=np.arange(n),
        light_angle_deg=numbers(n),
        light_direction=numbers(n, 3),
        view_direction=numbers(n, 3),
        radiance=numbers(n, 3),
        variance=numbers(n, 3),
        valid=numbers(n, 3) > 0,
        light_angle_std_deg=numbers(2),
        grid_angle_deg=numbers(5),
        grid_radiance=numbers(4, 5, 3),
        grid_variance=numbers(4, 5, 3),
        grid_valid=numbers(4, 5, 3) > 0,
    )


@pytest.mark.parametrize("compression", ["lz4", "none"])
def test_what_was_recorded_is_read(tmp_path: Path, compression: str) -> None:
    told = rig_messages(3.5)
    scan = Envelope("/scan/radiance", header("hdr_merger", 0, START_NS), radiance(50))
    told.append(Told(told[-1].log_time_ns, scan))
    path = write(tmp_path / "a.mcap", told, compression=compression)
    assert plain(read(path)) == plain(told)


def test_parts_of_the_bus_are_stored_as_they_are(tmp_path: Path) -> None:
    """Bytes, ``zmq.Frame`` and arrays; small messages that travel together are taken apart."""
    first, second = arm_state(0, START_NS), arm_state(1, START_NS)
    image = frame(0, START_NS)
    together = as_bytes(first.envelope)
    together[1] += as_bytes(second.envelope)[1]
    with BagWriter(tmp_path / "a.mcap") as writer:
        assert writer.write(together, START_NS) == 2
        assert writer.write([zmq.Frame(part) for part in as_bytes(image.envelope)], START_NS) == 1
    assert plain(read(tmp_path / "a.mcap")) == plain([first, second, image])
    with BagReader(tmp_path / "a.mcap") as reader:
        raw = list(reader.messages(raw=True))
    assert [each.parts() for each in raw] == [as_bytes(t.envelope) for t in (first, second, image)]
    assert [each.header() for each in raw] == [t.envelope.header for t in (first, second, image)]
    assert [each.publish_time_ns for each in raw] == [
        t.envelope.header.stamp_ns for t in (first, second, image)
    ]


def test_buffers_may_be_reused_after_a_write(tmp_path: Path) -> None:
    told = frame(0, START_NS)
    before = plain([told])
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.write_envelope(told.envelope, START_NS)
        told.envelope.message.image[:] = 0  # type: ignore[attr-defined]
    assert plain(read(tmp_path / "a.mcap")) == before


@pytest.mark.parametrize(
    "parts",
    [
        [b"/no/such/topic", b""],
        [b"/arm/state", b"\xc1"],
        [b"/arm/state", msgpack.packb([["arm", 1], [], []])],
        [b"/arm/state", msgpack.packb(7)],
        [b"\xff", b""],
        [b"/arm/state"],
        [],
    ],
)
def test_what_is_no_message_is_refused_and_does_no_harm(tmp_path: Path, parts: list[bytes]) -> None:
    good = [arm_state(0, START_NS), arm_state(1, START_NS)]
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.write(as_bytes(good[0].envelope), START_NS)
        with pytest.raises(MessageError):
            writer.write(parts, START_NS)
        writer.write(as_bytes(good[1].envelope), START_NS)
    assert plain(read(tmp_path / "a.mcap")) == plain(good)


def test_times_before_1970_are_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        with pytest.raises(MessageError, match="before 1970"):
            writer.write_envelope(arm_state(0, 5).envelope, 5)
        with pytest.raises(MessageError, match="before 1970"):
            writer.write_envelope(arm_state(0, START_NS).envelope, -5)


@pytest.mark.parametrize("size", [0, 1, 255, 256, 65535, 65536, 70000])
def test_stored_parts_are_msgpack(size: int) -> None:
    """Our own lengths are those that msgpack itself would write."""
    parts = [b"/topic", b"x" * size, b"y" * (size // 2)]
    assert pack_parts(parts) == msgpack.packb(parts)
    assert unpack_parts(pack_parts(parts)) == parts
    many = [b"z"] * 20
    assert pack_parts(many) == msgpack.packb(many)


def test_headers_are_read_without_the_rest() -> None:
    told = frame(3, START_NS, shape=(100, 100))
    body = as_bytes(told.envelope)[1]
    assert HeaderReader().split(body) == [(told.envelope.header, body)]


# -- selection


def test_times_and_topics_select_like_a_list_would(tmp_path: Path) -> None:
    """Against a plain list, at random times, topics and sizes of chunks (seed 4)."""
    rng = random.Random(4)
    told = rig_messages(3)
    topics = sorted({each.envelope.topic for each in told})
    for k in range(20):
        path = write(
            tmp_path / f"{k}.mcap", told, chunk_s=rng.uniform(0.05, 2), chunk_bytes=rng.choice(
                [1, 5000, 1 << 20])
        )  # fmt: skip
        with BagReader(path) as reader:
            for _ in range(5):
                start, end = sorted(rng.randrange(-(10**9), 4 * 10**9) + START_NS for _ in "ab")
                chosen = rng.sample(topics, rng.randint(0, len(topics)))
                expected = [
                    t for t in told if t.envelope.topic in chosen and start <= t.log_time_ns < end
                ]
                got = [Told(*each) for each in reader.messages(chosen, start, end)]
                assert plain(got) == plain(expected)
                last = {
                    (t.envelope.topic, t.envelope.header.publisher): t
                    for t in told
                    if t.envelope.topic in chosen and t.log_time_ns < start
                }
                latest = sorted(last.values(), key=told.index)
                found = [Told(*each) for each in reader.last_before(chosen, start)]
                assert plain(found) == plain(latest)


def test_order_is_log_time_also_when_the_clock_went_back(tmp_path: Path) -> None:
    """Two epochs of a replay over the same times; equal times keep the order of recording."""
    told = rig_messages(2.5)
    again = [
        each._replace(
            envelope=each.envelope._replace(header=each.envelope.header._replace(incarnation="two"))
        )
        for each in told
    ]
    path = write(tmp_path / "a.mcap", told + again)
    expected = sorted(told + again, key=lambda each: each.log_time_ns)
    assert plain(read(path)) == plain(expected)


def test_topics_that_are_not_there(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [arm_state(0, START_NS)])
    with BagReader(path) as reader:
        assert list(reader.messages(["/scan/radiance"])) == []
        with pytest.raises(BagTopicError, match=r"a\.mcap: has no topic '/scan/radience'; there"):
            reader.messages(["/scan/radience"])
        with pytest.raises(BagError, match=r"no attachment 'x'; it has: calibration/rig\.yaml, "):
            reader.attachment("x")


# -- what is told


def test_summary_comes_from_the_index_alone(tmp_path: Path) -> None:
    """With every chunk made unreadable it is still the same, and messages are refused."""
    told = rig_messages(4)
    path = write(tmp_path / "a.mcap", told)
    with BagReader(path) as reader:
        before = reader.summary()
        chunks = [index for file in reader.files for index in file.chunks]
    assert len(chunks) == 4
    data = bytearray(path.read_bytes())
    for index in chunks:
        end = index.chunk_start_offset + index.chunk_length
        data[index.chunk_start_offset : end] = bytes(index.chunk_length)
    path.write_bytes(data)
    with BagReader(path) as reader:
        assert reader.summary() == before
        with pytest.raises(BagDamagedError, match="tvbrdf bag recover"):
            list(reader.messages())
    topics = {topic.topic: topic for topic in before.topics}
    assert topics["/arm/state"].messages == 200
    assert topics["/arm/state"].rate_hz == pytest.approx(50)
    assert topics["/arm/state"].type == "ArmState"
    assert topics["/camera_2/frame"].quality == "lossless"
    assert topics["/diagnostics"].publishers == ("arm", "fitter")
    assert before.messages == len(told)
    assert (before.start_ns, before.end_ns) == (told[0].log_time_ns, told[-1].log_time_ns)
    assert before.about.run == "run-1"
    assert {a.name: a.size_bytes for a in before.attachments} == {
        name: len(data) for name, data in ATTACHMENTS.items()
    }
    json.dumps(before.plain())


def test_an_empty_recording_is_a_bag(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [])
    with BagReader(path) as reader:
        assert list(reader.messages()) == []
        summary = reader.summary()
        assert reader.attachments() == ATTACHMENTS
    assert (summary.messages, summary.duration_s, summary.topics) == (0, 0, ())


def test_attachments_may_come_later(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap", attachments={"notes.txt": b"old"}) as writer:
        writer.write_envelope(arm_state(0, START_NS).envelope, START_NS)
        writer.attach("notes.txt", b"new")
        writer.attach("scene/x.yaml", bytes(100000))
        writer.write_envelope(arm_state(1, START_NS).envelope, START_NS)
    with BagReader(tmp_path / "a.mcap") as reader:
        assert reader.attachments() == {"notes.txt": b"new", "scene/x.yaml": bytes(100000)}
        assert len(list(reader.messages())) == 2


def test_gaps_are_counted_by_sequence_numbers(tmp_path: Path) -> None:
    """3 and 4 are lost, 7 comes late, 9 twice; another life of the arm counts from 0 again."""
    order = [1, 2, 5, 6, 8, 7, 9, 9, 10]
    told = [arm_state(n, START_NS + k) for k, n in enumerate(order)]
    told += [arm_state(n, START_NS + 100 + n, "two") for n in (0, 1)]
    path = write(tmp_path / "a.mcap", told)
    with BagReader(path) as reader:
        kept, counted = reader.summary().streams, reader.summary(recount=True).streams
    assert kept == counted
    one, two = kept
    assert (one.incarnation, one.messages, one.lost, one.again) == ("one", 9, 2, 1)
    assert one.gaps == [(3, 4)]
    assert (one.first_sequence, one.last_sequence) == (1, 10)
    assert (two.messages, two.lost, two.again, two.gaps) == (2, 0, 0, [])


def test_gaps_match_a_model_of_sets() -> None:
    """Random sequences (seed 5): what is lost is what never came between first and last."""
    rng = random.Random(5)
    for _ in range(300):
        numbers = [n for n in range(3, 40) if rng.random() < 0.8] or [3]
        for _ in range(rng.randint(0, 4)):
            k, n = rng.randrange(1, len(numbers) + 1), rng.choice(numbers)
            numbers.insert(k, n)  # a repeat or one that comes early
        if min(numbers) != numbers[0]:
            continue
        stream = Stream("/t", "p", "i", "T")
        for n in numbers:
            stream.add(n, n, 1)
        missing = set(range(numbers[0], max(numbers))) - set(numbers)
        assert stream.lost == len(missing)
        assert {n for first, last in stream.gaps for n in range(first, last + 1)} == missing
        assert stream.again == len(numbers) - len(set(numbers))


def test_counts_while_it_records(tmp_path: Path) -> None:
    """Those of closed chunks; a tick of the clock closes one, and so does a flush."""
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.write_envelope(arm_state(0, START_NS).envelope, START_NS)
        writer.tick(START_NS + 999_999_999)
        assert writer.counts() == {}
        writer.tick(START_NS + 1_000_000_000)
        assert writer.counts() == {"/arm/state": 1}
        size = writer.size_bytes
        assert size == (tmp_path / "a.mcap").stat().st_size
        writer.write_envelope(camera_info(0, START_NS).envelope, START_NS)
        assert writer.size_bytes == size
        writer.flush()
        assert writer.size_bytes == (tmp_path / "a.mcap").stat().st_size > size
        assert writer.counts() == {"/arm/state": 1, "/camera_1/info": 1}


# -- files


def test_nothing_is_overwritten_and_nothing_recorded_after_the_end(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [arm_state(0, START_NS)])
    before = path.read_bytes()
    with pytest.raises(BagError, match="exists already"):
        BagWriter(path)
    writer = BagWriter(tmp_path / "b.mcap")
    writer.close()
    writer.close()
    with pytest.raises(BagError, match="nothing more can be recorded: it was closed"):
        writer.write_envelope(arm_state(0, START_NS).envelope, START_NS)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"compression": "zip"}, "choose lz4 or none"),
        ({"chunk_s": 0}, "chunk_s is 0: it must be above 0"),
        ({"split_s": -1.0}, "split_s is -1"),
        ({"split_bytes": 1000}, "a bag in parts is a folder: leave out .mcap"),
    ],
)
def test_options_without_meaning(tmp_path: Path, options: dict[str, Any], text: str) -> None:
    with pytest.raises(BagError, match=text):
        BagWriter(tmp_path / "a.mcap", **options)
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_can_not_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match="can't be made: Not a directory"):
        BagWriter(tmp_path / "file" / "bag")
    with pytest.raises(BagError, match="can't be written: No such file or directory"):
        BagWriter(tmp_path / "missing" / "bag.mcap")


def test_an_error_in_the_recorder_ends_the_bag(tmp_path: Path) -> None:
    told = rig_messages(1)

    def fail() -> None:
        with BagWriter(tmp_path / "a.mcap") as writer:
            for log_time_ns, envelope in told:
                writer.write_envelope(envelope, log_time_ns)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert plain(read(tmp_path / "a.mcap")) == plain(told)


# -- other tools


@pytest.mark.parametrize("compression", ["lz4", "none"])
def test_the_mcap_package_reads_it(tmp_path: Path, compression: str) -> None:
    """By index and as a stream, every checksum verified; schemas tell the fields."""
    told = rig_messages(2.5)
    path = write(tmp_path / "a.mcap", told, compression=compression)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "tvbrdf"
        found = list(reader.iter_messages())
        assert {a.name: a.data for a in reader.iter_attachments()} == ATTACHMENTS
        assert [m.name for m in reader.iter_metadata()] == ["tvbrdf", "tvbrdf.streams"]
        summary = reader.get_summary()
    assert [(m.log_time, msgpack.unpackb(m.data)) for _, _, m in found] == plain(told)
    assert [c.topic for _, c, _ in found] == [t.envelope.topic for t in told]
    assert [m.publish_time for _, _, m in found] == [t.envelope.header.stamp_ns for t in told]
    assert [m.sequence for _, _, m in found] == [t.envelope.header.sequence for t in told]
    with path.open("rb") as stream:
        streamed = NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        assert len(list(streamed)) == len(told)
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(told)
    assert summary.statistics.chunk_count == 3
    schema = next(s for s in summary.schemas.values() if s.name == "tvbrdf.Frame")
    fields = json.loads(schema.data)
    assert fields["arrays"] == [
        {"name": "image", "dtypes": ["uint8", "uint16", "float32"], "shape": [None, None, 3]}
    ]
    assert fields["fields"][0] == {"name": "camera", "type": "str"}
    assert {c.message_encoding for c in summary.channels.values()} == {"msgpack"}
    assert {c.metadata["quality"] for c in summary.channels.values() if "frame" in c.topic} == {
        "lossless"
    }


def test_message_indexes_point_at_messages(tmp_path: Path) -> None:
    """Other tools use them; ours reads chunks as a whole."""
    from mcap.records import Chunk, Message, MessageIndex
    from mcap.stream_reader import StreamReader, get_chunk_data_stream

    path = write(tmp_path / "a.mcap", rig_messages(2.5))
    pointed, chunk = 0, None
    with path.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk):
                chunk = record
            elif isinstance(record, MessageIndex):
                assert chunk is not None
                for log_time, offset in record.records:
                    data, _ = get_chunk_data_stream(chunk)
                    data.read(offset + 1)
                    found = Message.read(data, data.read8())
                    assert (found.channel_id, found.log_time) == (record.channel_id, log_time)
                    pointed += 1
    assert pointed == len(rig_messages(2.5))


def test_images_that_do_not_shrink_are_not_compressed(tmp_path: Path) -> None:
    """Noise stays as it is, states and dark images shrink: each chunk is looked at."""
    noise = [frame(k, START_NS + k, shape=(200, 200)) for k in range(10)]
    states = [arm_state(k, START_NS + 2 * 10**9 + k) for k in range(500)]
    path = write(tmp_path / "a.mcap", noise + states)
    with BagReader(path) as reader:
        first, second = reader.files[0].chunks
    assert first.compression == ""
    assert second.compression == "lz4"
    assert second.compressed_size < 0.5 * second.uncompressed_size
    assert plain(read(path)) == plain(noise + states)


def test_about_keeps_what_it_is_told(tmp_path: Path) -> None:
    about = About(run="r", extra={"operator": "Ève", "rig": "two"})
    path = write(tmp_path / "a.mcap", [], about=about)
    with BagReader(path) as reader:
        assert reader.about == about
