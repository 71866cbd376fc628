"""Whatever happens to a file, all that is intact in it is saved, and nothing wrong is."""

from __future__ import annotations

import contextlib
import random
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.messages.bag_samples import (
    ATTACHMENTS,
    Told,
    arm_state,
    as_bytes,
    frame,
    plain,
    read,
    rig_messages,
    write,
)
from tests.paths import ROOT
from tests.sample_messages import START_NS
from tvbrdf_messages.bag import (
    BagDamagedError,
    BagEmptyError,
    BagError,
    BagForeignError,
    BagIncompleteError,
    BagReader,
    BagWriter,
    check_bag,
    recover,
)

SECONDS = 3


class Sample:
    """A bag, its messages, and where its chunks are."""

    def __init__(self, folder: Path, compression: str) -> None:
        told = rig_messages(SECONDS)
        self.path = write(folder / f"{compression}.mcap", told, compression=compression)
        self.data = self.path.read_bytes()
        self.told = told
        with BagReader(self.path) as reader:
            self.data_end = reader.files[0].data_bytes
            self.chunks = [
                (index.chunk_start_offset, index.chunk_start_offset + index.chunk_length)
                for index in reader.files[0].chunks
            ]
            spans = [
                (index.message_start_time, index.message_end_time)
                for index in reader.files[0].chunks
            ]
        assert len(self.chunks) == SECONDS
        self.in_chunk = [
            [each for each in told if start <= each.log_time_ns <= end] for start, end in spans
        ]

    def outside(self, begin: int, end: int) -> list[Told]:
        """Return the messages of the chunks that a stretch of bytes does not touch."""
        return [
            each
            for (start, stop), inside in zip(self.chunks, self.in_chunk, strict=True)
            if stop <= begin or start >= end
            for each in inside
        ]


@pytest.fixture(scope="module", params=["lz4", "none"])
def sample(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Sample:
    return Sample(tmp_path_factory.mktemp("bag"), request.param)


def recovered(path: Path) -> list[Told]:
    """Recover a bag and return what the new one holds; it is flawless."""
    out = path.with_name("recovered.mcap")
    out.unlink(missing_ok=True)
    report = recover(path, out)
    got = read(out)
    assert report.messages == len(got)
    problems = [p for p in check_bag(out).problems if p.kind not in {"gap", "calibration"}]
    assert problems == []
    assert sorted(p.name for p in path.parent.iterdir()) == sorted({path.name, out.name})
    return got


def is_part(found: list[Told], whole: list[Told]) -> bool:
    """Return whether all that was found was told, in the same order."""
    rest = iter(plain(whole))
    return all(each in rest for each in plain(found))


# -- cut


def test_cut_anywhere_all_whole_chunks_are_saved(sample: Sample, tmp_path: Path) -> None:
    """At 40 random bytes (seed 1) and at the edges of every chunk; none reads as a whole bag."""
    rng = random.Random(1)
    cuts = {rng.randrange(1, len(sample.data)) for _ in range(40)}
    for begin, end in sample.chunks:
        cuts |= {begin - 1, begin, begin + 1, begin + 8, begin + 30, end - 1, end, end + 1}
    cuts |= {len(sample.data) - k for k in (1, 8, 9, 20, 37)} | {sample.data_end}
    path = tmp_path / "cut.mcap"
    for cut in sorted(cuts):
        path.write_bytes(sample.data[:cut])
        with pytest.raises(BagIncompleteError, match="tvbrdf bag recover"):
            BagReader(path)
        if cut < sample.chunks[0][0]:
            with contextlib.suppress(BagError):  # cut before it says where it comes from
                assert recovered(path) == []
            continue
        sure = sample.outside(cut, len(sample.data))
        found = recovered(path)
        with BagReader(path.with_name("recovered.mcap")) as reader:
            assert reader.attachments() == ATTACHMENTS
            assert reader.about.run == "run-1"
        assert is_part(sure, found), cut
        assert is_part(found, sample.told), cut


def test_of_the_cut_chunk_the_whole_messages_are_saved(sample: Sample, tmp_path: Path) -> None:
    """Cut in the middle of the last chunk: about half of it is there (LZ4: whole blocks)."""
    begin, end = sample.chunks[-1]
    path = tmp_path / "cut.mcap"
    path.write_bytes(sample.data[: (begin + end) // 2])
    found = recovered(path)
    sure = sample.outside(begin, end)
    assert plain(found[: len(sure)]) == plain(sure)
    if sample.path.stem == "none":
        part = len(found) - len(sure)
        assert 0.2 < part / len(sample.in_chunk[-1]) < 0.8


def test_the_report_says_what_is_lost(sample: Sample, tmp_path: Path) -> None:
    begin, end = sample.chunks[1]
    path = tmp_path / "damaged.mcap"
    data = bytearray(sample.data)
    data[(begin + end) // 2] ^= 1
    path.write_bytes(data)
    report = recover(path, tmp_path / "out.mcap")
    assert report.complete
    (lost,) = report.lost
    assert (lost.offset, lost.bytes) == (begin, end - begin)
    assert lost.after_ns == sample.in_chunk[0][-1].log_time_ns
    assert lost.before_ns == sample.in_chunk[2][0].log_time_ns
    assert "checksum" in lost.why or "decompress" in lost.why.lower()
    assert report.attachments == tuple(sorted(ATTACHMENTS))


# -- changed


def test_a_flipped_bit_anywhere_is_found(sample: Sample, tmp_path: Path) -> None:
    """150 random bits (seed 2): ``check`` tells each, and no reader gives a wrong message."""
    rng = random.Random(2)
    path = tmp_path / "flipped.mcap"
    whole = plain(sample.told)
    for _ in range(150):
        at, bit = rng.randrange(len(sample.data)), rng.randrange(8)
        data = bytearray(sample.data)
        data[at] ^= 1 << bit
        path.write_bytes(data)
        assert not check_bag(path).ok, (at, bit)
        assert read_or_refuse(path) in (whole, None), (at, bit)


def read_or_refuse(path: Path) -> list[tuple[int, list[bytes]]] | None:
    """Return all messages of a bag; None if that is refused."""
    try:
        return plain(read(path))
    except BagError:
        return None


def test_after_a_flipped_bit_all_other_chunks_are_saved(sample: Sample, tmp_path: Path) -> None:
    """30 random bits (seed 3), and every byte of a chunk's head and of what follows a chunk."""
    rng = random.Random(3)
    spots = [rng.randrange(len(sample.data)) for _ in range(30)]
    begin, end = sample.chunks[1]
    spots += [*range(begin, begin + 52), *range(end, end + 24)]
    path = tmp_path / "flipped.mcap"
    for at in spots:
        data = bytearray(sample.data)
        data[at] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
        found = recovered(path)
        assert is_part(sample.outside(at, at + 1), found), at
        assert is_part(found, sample.told), at


def test_damaged_heads_of_chunks_cost_nothing(sample: Sample, tmp_path: Path) -> None:
    """Opcode, either length, and times of a chunk can be told without."""
    begin, _ = sample.chunks[1]
    path = tmp_path / "flipped.mcap"
    for at in (0, 1, 3, 9, 17, 9 + 16):
        data = bytearray(sample.data)
        data[begin + at] ^= 0x10
        path.write_bytes(data)
        assert plain(recovered(path)) == plain(sample.told), at


@pytest.mark.parametrize(
    "damage",
    [
        lambda data, at, rng: data[:at] + bytes(4096) + data[at + 4096 :],
        lambda data, at, rng: data[:at] + rng.randbytes(4096) + data[at + 4096 :],
        lambda data, at, rng: data[:at] + data[at + 4096 :],
        lambda data, at, rng: data[:at] + rng.randbytes(777) + data[at:],
    ],
    ids=["zeroed page", "overwritten page", "bytes missing", "bytes inserted"],
)
def test_larger_damage(
    sample: Sample, tmp_path: Path, damage: Callable[[bytes, int, random.Random], bytes]
) -> None:
    """20 places (seed 6): what does not touch the damage is saved, nothing else comes out."""
    rng = random.Random(6)
    path = tmp_path / "damaged.mcap"
    for _ in range(20):
        at = rng.randrange(len(sample.data) - 4096)
        path.write_bytes(damage(sample.data, at, rng))
        found = recovered(path)
        assert is_part(sample.outside(at, at + 4096), found), at
        assert is_part(found, sample.told), at


def test_damage_at_the_end_and_in_the_index(sample: Sample, tmp_path: Path) -> None:
    """All messages are there; the reader refuses the index and says what to do."""
    path = tmp_path / "damaged.mcap"
    for at in (sample.data_end + 20, len(sample.data) - 30, len(sample.data) - 3):
        data = bytearray(sample.data)
        data[at] ^= 4
        path.write_bytes(data)
        with pytest.raises((BagDamagedError, BagIncompleteError), match="tvbrdf bag recover"):
            BagReader(path)
        assert plain(recovered(path)) == plain(sample.told)


def test_recovering_a_whole_bag_changes_nothing(sample: Sample, tmp_path: Path) -> None:
    report = recover(sample.path, tmp_path / "out.mcap")
    assert (report.complete, report.lost, report.messages) == (True, [], len(sample.told))
    assert plain(read(tmp_path / "out.mcap")) == plain(sample.told)
    with BagReader(sample.path) as before, BagReader(tmp_path / "out.mcap") as after:
        assert after.about.extra.keys() == {"recovered"}
        assert after.about.recording == before.about.recording
        assert after.summary().streams == before.summary().streams


def test_random_bytes_are_refused(tmp_path: Path) -> None:
    """Files of noise (seed 7), with and without a bag's first bytes."""
    rng = random.Random(7)
    head = write(tmp_path / "a.mcap", []).read_bytes()
    for begin in (b"", head[:8], head[:30]):
        for size in (1, 100, 100_000):
            path = tmp_path / "noise.mcap"
            path.write_bytes(begin + rng.randbytes(size))
            with pytest.raises((BagForeignError, BagIncompleteError, BagDamagedError)):
                BagReader(path)
            with pytest.raises(BagError, match="nothing in it is intact"):
                recover(path, tmp_path / "out.mcap")
            assert not (tmp_path / "out.mcap").exists()


def test_what_can_not_be_recovered(tmp_path: Path) -> None:
    (tmp_path / "empty.mcap").write_bytes(b"")
    with pytest.raises(BagEmptyError, match="nothing to recover"):
        recover(tmp_path / "empty.mcap", tmp_path / "out.mcap")
    with pytest.raises(BagError, match="there is no such bag"):
        recover(tmp_path / "missing.mcap", tmp_path / "out.mcap")
    good = write(tmp_path / "a.mcap", [arm_state(0, START_NS)])
    with pytest.raises(BagError, match="exists already"):
        recover(good, good)


# -- killed


RECORDER = """
import sys
from pathlib import Path
from tests.messages.bag_samples import frame, arm_state
from tests.sample_messages import START_NS
from tvbrdf_messages.bag import BagWriter
with BagWriter(Path(sys.argv[1]), attachments={"calibration/rig.yaml": b"x"}) as writer:
    k = 0
    while True:
        now_ns = START_NS + k * 20_000_000
        writer.write_envelope(arm_state(k, now_ns).envelope, now_ns)
        writer.write_envelope(frame(k, now_ns, shape=(40, 50)).envelope, now_ns)
        print(now_ns, flush=True)
        k += 1
"""


@pytest.mark.system
def test_a_killed_recorder_loses_a_second_at_most(tmp_path: Path) -> None:
    """SIGKILL between two messages; what it wrote more than a second before is all there."""
    path = tmp_path / "killed.mcap"
    process = subprocess.Popen(
        [sys.executable, "-c", RECORDER, str(path)], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert process.stdout is not None
    with process:
        for line in process.stdout:
            if int(line) >= START_NS + 3_700_000_000:
                break
        with pytest.raises(BagIncompleteError, match="still being recorded; wait"):
            BagReader(path)
        with pytest.raises(BagIncompleteError, match="still being recorded; wait"):
            recover(path, tmp_path / "out.mcap")
        process.send_signal(signal.SIGKILL)
        last_ns = max([int(line), *(int(rest) for rest in process.stdout if rest.endswith("\n"))])
    with pytest.raises(BagIncompleteError, match="its recorder was killed or it was cut"):
        BagReader(path)
    found = recovered(path)
    expected = [
        one(k, START_NS + k * 20_000_000)
        for k in range(len(found) // 2 + 1)
        for one in (arm_state, lambda k, now_ns: frame(k, now_ns, shape=(40, 50)))
    ]
    # a recorder that had to wait may write its chunk between the two of a pair
    assert plain(found) == plain(expected[: len(found)])
    assert last_ns - found[-1].log_time_ns <= 1_000_000_000


# -- in parts


def test_a_bag_in_parts_is_recovered_as_one(tmp_path: Path) -> None:
    """The last part was cut, one in the middle has a damaged chunk; latched state comes once."""
    told = rig_messages(6)
    path = write(tmp_path / "bag", told, split_s=2.0)
    parts = sorted(path.iterdir())
    assert [part.name for part in parts] == ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"]
    parts[2].write_bytes(parts[2].read_bytes()[:-10])
    with BagReader(parts[1]) as reader:
        index = reader.files[0].chunks[0]
    data = bytearray(parts[1].read_bytes())
    data[index.chunk_start_offset + index.chunk_length - 9] ^= 1
    parts[1].write_bytes(data)
    report = recover(path, tmp_path / "out")
    start_ns, end_ns = index.message_start_time, index.message_end_time
    expected = [t for t in told if not start_ns <= t.log_time_ns <= end_ns]
    assert plain(read(tmp_path / "out")) == plain(expected)
    assert len(list((tmp_path / "out").iterdir())) == 3
    assert not report.complete
    with BagReader(tmp_path / "out") as reader:
        lost = {s.topic: s.lost for s in reader.summary().streams if s.lost}
    assert lost["/arm/state"] == 50


def test_an_interrupted_recovery_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a.mcap", rig_messages(3))
    calls = []

    def interrupted(self: BagWriter, message: object) -> None:
        calls.append(message)
        if len(calls) > 50:
            raise KeyboardInterrupt

    monkeypatch.setattr(BagWriter, "write_raw", interrupted)
    with pytest.raises(KeyboardInterrupt):
        recover(path, tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == [path]


def test_parts_survive_unchanged(tmp_path: Path) -> None:
    """What is saved is bit for bit what the bus carried."""
    told = rig_messages(1)
    path = write(tmp_path / "a.mcap", told)
    path.write_bytes(path.read_bytes()[:-1])
    recover(path, tmp_path / "out.mcap")
    with BagReader(tmp_path / "out.mcap") as reader:
        raw = [each.parts() for each in reader.messages(raw=True)]
    assert raw == [as_bytes(each.envelope) for each in told]
