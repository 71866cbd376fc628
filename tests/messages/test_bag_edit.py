"""Bags out of bags: a selection, or several together, each message once."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from tests.messages.bag_samples import ATTACHMENTS, arm_state, plain, read, rig_messages, write
from tests.sample_messages import START_NS
from tvbrdf_messages.bag import (
    About,
    BagDamagedError,
    BagError,
    BagReader,
    BagTopicError,
    BagWriter,
    TopicFilter,
    check_bag,
    filter_bag,
    merge_bags,
)
from tvbrdf_messages.bag.edit import _Seen
from tvbrdf_messages.errors import BusError

SECOND_NS = 10**9


def test_a_selection_of_topics_and_time(tmp_path: Path) -> None:
    told = rig_messages(4)
    path = write(tmp_path / "a.mcap", told)
    start_ns, end_ns = START_NS + SECOND_NS, START_NS + 3 * SECOND_NS
    report = filter_bag(
        path,
        tmp_path / "out.mcap",
        regex="^/camera_",
        topics=["/arm/state"],
        exclude="camera_2",
        start_ns=start_ns,
        end_ns=end_ns,
    )
    expected = [
        t
        for t in told
        if t.envelope.topic in {"/arm/state", "/camera_1/frame"}
        and start_ns <= t.log_time_ns < end_ns
    ]
    found = read(tmp_path / "out.mcap")
    assert found[0].envelope == told[0].envelope  # latched: what the camera is
    assert found[0].log_time_ns == start_ns
    assert plain(found[1:]) == plain(expected)
    assert report.messages == len(expected)
    assert report.topics == {"/arm/state": 100, "/camera_1/frame": 20}
    assert report.left_out == len(told) - len(expected)
    with BagReader(tmp_path / "out.mcap") as reader:
        assert reader.attachments() == ATTACHMENTS
        assert reader.about.extra == {"filtered": "from a.mcap"}
        assert reader.summary().messages == len(expected)


def test_all_of_a_bag(tmp_path: Path) -> None:
    told = rig_messages(2)
    path = write(tmp_path / "bag", told, split_s=0.5)
    filter_bag(path, tmp_path / "out.mcap")
    assert plain(read(tmp_path / "out.mcap")) == plain(told)
    assert check_bag(tmp_path / "out.mcap").problems == check_bag(path).problems == []


@pytest.mark.parametrize(
    ("options", "kind", "text"),
    [
        ({"topics": ["/arm/stat"]}, BagTopicError, "has no topic '/arm/stat'; there are: /arm"),
        ({"exclude": "/"}, BagError, "has no message of those topics at that time"),
        ({"end_ns": START_NS - 1}, BagError, "has no message of those topics at that time"),
        ({"regex": "("}, BusError, r"'\(' is no regular expression"),
    ],
)
def test_nothing_selected(
    tmp_path: Path, options: dict[str, object], kind: type[Exception], text: str
) -> None:
    path = write(tmp_path / "a.mcap", rig_messages(1))
    with pytest.raises(kind, match=text):
        filter_bag(path, tmp_path / "out.mcap", **options)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == [path]


def test_topic_filter() -> None:
    topics = ["/arm/state", "/camera_1/frame", "/camera_2/frame", "/log"]

    def chosen(*arguments: object) -> list[str]:
        wanted = TopicFilter(*arguments)  # type: ignore[arg-type]
        return [topic for topic in topics if wanted(topic)]

    assert chosen() == topics
    assert chosen(["/log"]) == ["/log"]
    assert chosen([]) == []
    assert chosen(None, "camera") == ["/camera_1/frame", "/camera_2/frame"]
    assert chosen(["/log"], "camera", "_1") == ["/camera_2/frame", "/log"]
    assert chosen(None, None, "^/log$") == topics[:-1]


# -- merge


def test_two_recorders_of_one_run(tmp_path: Path) -> None:
    """Each lost some messages and got the rest at other times; together they have all, once."""
    told = rig_messages(3)
    rng = random.Random(9)
    first = [t for t in told if rng.random() < 0.8]
    second = [t._replace(log_time_ns=t.log_time_ns + 700) for t in told if rng.random() < 0.8]
    paths = [
        write(tmp_path / "a.mcap", first),
        write(tmp_path / "b", second, split_s=1.0),
    ]
    report = merge_bags(paths, tmp_path / "out.mcap")
    found = read(tmp_path / "out.mcap")
    have = {t.envelope.order() for t in first + second}
    assert sorted(each.envelope.order() for each in found) == sorted(have)
    assert [t.log_time_ns for t in found] == sorted(t.log_time_ns for t in found)
    assert report.messages == len(found)
    assert report.left_out == len(first) + len(second) - len(found)
    with BagReader(tmp_path / "out.mcap") as reader:
        assert reader.about.run == "run-1"
        assert reader.attachments() == ATTACHMENTS


def test_different_runs(tmp_path: Path) -> None:
    """Only if that is said: then nothing is taken for the same, and attachments get numbers."""
    told = rig_messages(1)
    one = write(tmp_path / "a.mcap", told)
    other = write(
        tmp_path / "b.mcap",
        told,
        about=About(run="run-2"),
        attachments={**ATTACHMENTS, "calibration/rig.yaml": b"other", "README": b"x"},
    )
    with pytest.raises(BagError, match=r"'run-2', .*a\.mcap of 'run-1'; .* --different-runs"):
        merge_bags([one, other], tmp_path / "out.mcap")
    report = merge_bags([one, other], tmp_path / "out.mcap", different_runs=True)
    assert (report.messages, report.left_out) == (2 * len(told), 0)
    with BagReader(tmp_path / "out.mcap") as reader:
        assert reader.about.run == ""
        assert reader.attachments() == {
            **ATTACHMENTS,
            "calibration/rig.2.yaml": b"other",
            "README": b"x",
        }


def test_parts_given_one_by_one_are_the_whole(tmp_path: Path) -> None:
    told = rig_messages(4)
    path = write(tmp_path / "bag", told, split_s=1.0)
    parts = sorted(path.iterdir(), reverse=True)
    merge_bags(parts, tmp_path / "out.mcap")
    assert plain(read(tmp_path / "out.mcap")) == plain(told)


def test_merging_nothing(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="nothing to merge"):
        merge_bags([], tmp_path / "out.mcap")


def test_sequence_numbers_seen_match_a_set() -> None:
    """Random numbers in random order (seed 10)."""
    rng = random.Random(10)
    for _ in range(50):
        seen, model = _Seen(), set[int]()
        for _ in range(200):
            number = rng.randrange(60)
            assert seen.add(number) == (number not in model)
            model.add(number)
        assert len(seen._starts) == sum(n - 1 not in model for n in model)


# -- read back


def test_a_disk_that_changes_bytes_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A byte changes after it was written: success is not said, and nothing is left."""
    path = write(tmp_path / "a.mcap", rig_messages(2))
    real = BagWriter.close

    def changed(self: BagWriter) -> None:
        real(self)
        file = self.files[0]
        data = bytearray(file.read_bytes())
        data[len(data) // 3] ^= 1
        file.write_bytes(data)

    monkeypatch.setattr(BagWriter, "close", changed)
    with pytest.raises(BagDamagedError, match=r"checksum|decompress"):
        filter_bag(path, tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == [path]


def test_a_message_that_is_lost_on_the_way_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a.mcap", [arm_state(k, START_NS + k) for k in range(10)])
    real = BagWriter.write_raw

    def careless(self: BagWriter, message: object) -> None:
        if message.sequence != 7:  # type: ignore[attr-defined]
            real(self, message)  # type: ignore[arg-type]

    monkeypatch.setattr(BagWriter, "write_raw", careless)
    with pytest.raises(BagDamagedError, match="10 messages were written and 9 read back"):
        filter_bag(path, tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == [path]
