"""A recording in several files: each can be read alone, all together give everything once."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from tests.messages.bag_samples import (
    ATTACHMENTS,
    Told,
    arm_state,
    camera_info,
    plain,
    read,
    rig_messages,
    write,
)
from tests.sample_messages import START_NS
from tvbrdf_messages.bag import BagError, BagReader, BagWriter, check_bag, merge_bags

SECOND_NS = 10**9


@pytest.mark.parametrize("options", [{"split_s": 1.5}, {"split_bytes": 40_000}, {}])
def test_parts_give_everything_once(tmp_path: Path, options: dict[str, float]) -> None:
    told = rig_messages(6)
    path = write(tmp_path / "bag", told, chunk_s=0.2, **options)
    names = sorted(part.name for part in path.iterdir())
    assert names == [f"bag_{k}.mcap" for k in range(len(names))]
    assert (len(names) > 1) == bool(options)
    assert plain(read(path)) == plain(told)
    assert [p for p in check_bag(path).problems if p.kind != "gap"] == []
    with BagReader(path) as reader:
        summary = reader.summary()
        assert reader.attachments() == ATTACHMENTS
    assert summary.messages == len(told)
    assert [file.path.name for file in summary.files] == names
    assert summary.size_bytes == sum(part.stat().st_size for part in path.iterdir())


def test_files_are_as_long_as_asked(tmp_path: Path) -> None:
    """By time to a chunk; by size to a chunk."""
    path = write(tmp_path / "time", rig_messages(6), chunk_s=0.2, split_s=1.5)
    with BagReader(path) as reader:
        for file in reader.summary().files[:-1]:
            assert file.end_ns - file.start_ns < 1.5 * SECOND_NS
        assert len(reader.files) == 4
    path = write(tmp_path / "size", rig_messages(6), chunk_bytes=5000, split_bytes=40_000)
    sizes = [part.stat().st_size for part in sorted(path.iterdir())]
    assert all(40_000 < size < 52_000 for size in sizes[:-1])


def test_each_part_begins_with_latched_state_and_attachments(tmp_path: Path) -> None:
    """What was said last before it, at the time of its first message; only topics that latch."""
    told = [camera_info(0, START_NS), camera_info(0, START_NS, "camera_2")]
    told += [arm_state(k, START_NS + k * SECOND_NS // 10) for k in range(60)]
    told += [camera_info(1, START_NS + 25 * SECOND_NS // 10)]
    told.sort(key=lambda each: each.log_time_ns)
    path = write(tmp_path / "bag", told, split_s=2.0)
    parts = sorted(path.iterdir())
    assert len(parts) == 3
    for part, last in zip(parts[1:], (0, 1), strict=True):
        with BagReader(part) as reader:
            assert reader.attachments() == ATTACHMENTS
            first_ns = reader.start_ns
            found = [Told(*each) for each in reader.messages(end_ns=first_ns + 1)]
            states = reader.last_before(["/camera_1/info", "/camera_2/info"], first_ns + 1)
        expected = [camera_info(last, START_NS), camera_info(0, START_NS, "camera_2")]
        infos = [each for each in found if each.envelope.topic != "/arm/state"]
        assert [each.envelope.topic for each in infos] == ["/camera_1/info", "/camera_2/info"]
        assert [each.envelope.message for each in infos] == [e.envelope.message for e in expected]
        assert [each.envelope.message for each in states] == [e.envelope.message for e in expected]
        assert {each.log_time_ns for each in found} == {first_ns}
    assert plain(read(path)) == plain(told)
    with BagReader(path) as reader:
        (state,) = reader.last_before(["/camera_1/info"], START_NS + 5 * SECOND_NS)
        assert state.log_time_ns == START_NS + 25 * SECOND_NS // 10
        assert reader.summary().messages == len(told)


def test_without_its_first_files_latched_state_is_still_told(tmp_path: Path) -> None:
    """As when old parts are removed to make room."""
    told = rig_messages(6)
    path = write(tmp_path / "bag", told, split_s=2.0)
    (path / "bag_0.mcap").unlink()
    found = read(path)
    second_ns = found[0].log_time_ns
    assert [each.envelope.topic for each in found[:2]] == ["/camera_1/info", "/camera_2/info"]
    rest = [each for each in told if each.log_time_ns >= second_ns]
    assert plain(found[2:]) == plain(rest)


def test_gaps_across_files_are_seen(tmp_path: Path) -> None:
    """Numbers that were lost just where one file ended and the next began."""
    numbers = [*range(10), *range(13, 25)]
    told = [arm_state(n, START_NS + n * SECOND_NS // 10) for n in numbers]
    path = write(tmp_path / "bag", told, split_s=1.0)
    assert len(list(path.iterdir())) == 3
    with BagReader(path) as reader:
        kept, counted = reader.summary().streams, reader.summary(recount=True).streams
    assert kept == counted
    assert (kept[0].lost, kept[0].gaps) == (3, [(10, 12)])


def test_a_publisher_that_sends_again_is_no_gap(tmp_path: Path) -> None:
    """In a later file come old numbers again, then new ones."""
    numbers = [*range(10), 4, 5, *range(10, 15)]
    told = [arm_state(n, START_NS + k * SECOND_NS // 10) for k, n in enumerate(numbers)]
    path = write(tmp_path / "bag", told, split_s=1.0)
    with BagReader(path) as reader:
        (stream,) = reader.summary().streams
    assert (stream.messages, stream.lost, stream.again) == (17, 0, 2)


def test_names_of_files_do_not_matter(tmp_path: Path) -> None:
    """Each file knows its place."""
    told = rig_messages(5)
    path = write(tmp_path / "bag", told, split_s=1.0)
    names = [f"{k:02}.mcap" for k in range(20)]
    random.Random(8).shuffle(names)
    for part, name in zip(list(path.iterdir()), names, strict=False):
        part.rename(path / name)
    assert plain(read(path)) == plain(told)


def test_a_missing_file_is_refused_but_the_others_can_be_merged(tmp_path: Path) -> None:
    told = rig_messages(6)
    path = write(tmp_path / "bag", told, split_s=2.0)
    (path / "bag_1.mcap").unlink()
    with pytest.raises(BagError, match="of its files, number 1 is missing: put it back"):
        BagReader(path)
    report = merge_bags(sorted(path.iterdir()), tmp_path / "rest.mcap")
    with BagReader(tmp_path / "rest.mcap") as reader:
        lost = {s.topic: s.lost for s in reader.summary().streams if s.publisher == "arm"}
    assert lost["/arm/state"] == 100
    assert report.left_out == 2  # latched state that is in both


def test_files_of_two_recordings_in_a_folder_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", rig_messages(1))
    other = write(tmp_path / "other.mcap", rig_messages(1))
    other.rename(path / "bag_1.mcap")
    with pytest.raises(BagError, match="different recordings"):
        BagReader(path)


def test_a_folder_without_bags(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"a folder without \*\.mcap files is no bag"):
        BagReader(tmp_path)


def test_a_split_can_be_asked_for(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_envelope(camera_info(0, START_NS).envelope, START_NS)
        writer.split()
        writer.write_envelope(arm_state(0, START_NS).envelope, START_NS + 5)
        assert [file.name for file in writer.files] == ["bag_0.mcap", "bag_1.mcap"]
    with BagReader(tmp_path / "bag" / "bag_1.mcap") as reader:
        assert [each.envelope.topic for each in reader.messages()] == [
            "/camera_1/info",
            "/arm/state",
        ]
    with BagWriter(tmp_path / "one.mcap") as writer, pytest.raises(BagError, match="is a folder"):
        writer.split()
