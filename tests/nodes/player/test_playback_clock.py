"""All time logic of playback, without a bag, a bus or a real clock."""

from __future__ import annotations

import pytest

from tvbrdf_nodes.player.clock import PlaybackClock, PlaybackError

FIRST, LAST = 1_800_000_000_000_000_000, 1_800_000_010_000_000_000
"""A bag of ten seconds."""
S = 1_000_000_000
REAL = 7_000 * S


def clock(**options: object) -> PlaybackClock:
    made = PlaybackClock(FIRST, LAST, **options)  # type: ignore[arg-type]
    made.start(REAL)
    return made


@pytest.mark.parametrize("rate", [0.25, 1.0, 3.0, 1000.0])
def test_what_is_due_when_and_what_time_it_is_agree(rate: float) -> None:
    """To a nanosecond of real time: a message is never due before the clock shows its time."""
    one = clock(rate=rate)
    for offset_ns in (0, 1, 999_999_999, 3 * S + 1, 10 * S):
        due_ns = one.due_ns(FIRST + offset_ns)
        assert due_ns is not None
        assert 0 <= (due_ns - REAL) - offset_ns / rate < 1 + 1e-6 * offset_ns / rate
        assert one.now_ns(due_ns) >= FIRST + offset_ns
        assert one.now_ns(due_ns - 2) <= FIRST + offset_ns


def test_it_stands_before_its_start_and_after_its_end() -> None:
    one = PlaybackClock(FIRST, LAST)
    assert one.now_ns(REAL) == one.now_ns(REAL + S) == FIRST
    assert one.due_ns(FIRST) is None
    one.start(REAL)
    assert one.now_ns(REAL + 50 * S) == LAST


def test_a_start_offset_and_an_end() -> None:
    one = clock(start_offset_s=2.5, until_s=4.0)
    assert one.begin_ns == FIRST + 5 * S // 2
    assert one.last_ns == FIRST + 4 * S
    assert one.due_ns(one.begin_ns) == REAL
    assert one.now_ns(REAL + 20 * S) == FIRST + 4 * S
    assert clock(until_s=50.0).last_ns == LAST


def test_a_pause_takes_no_time_of_the_bag() -> None:
    one = clock(rate=2.0)
    one.pause(REAL + S)
    assert one.paused
    assert one.due_ns(FIRST + 9 * S) is None
    assert one.now_ns(REAL + 100 * S) == FIRST + 2 * S
    one.resume(REAL + 100 * S)
    assert one.due_ns(FIRST + 4 * S) == REAL + 101 * S
    one.resume(REAL + 100 * S + S // 2)  # it plays already
    assert one.due_ns(FIRST + 4 * S) == REAL + 101 * S


def test_a_step_moves_a_paused_clock_to_its_message() -> None:
    one = clock(paused=True)
    assert one.now_ns(REAL + 5 * S) == FIRST
    one.reach(FIRST + S)
    assert one.now_ns(REAL + 6 * S) == FIRST + S
    one.resume(REAL + 6 * S)
    assert one.due_ns(FIRST + 2 * S) == REAL + 7 * S


def test_a_message_moves_no_clock_that_runs() -> None:
    one = clock()
    one.reach(FIRST + 3 * S)
    assert one.now_ns(REAL + S) == FIRST + S


def test_at_rate_0_everything_is_due_and_time_is_the_last_message() -> None:
    one = clock(rate=0.0)
    assert one.due_ns(LAST) == REAL
    assert one.now_ns(REAL + 5 * S) == FIRST
    one.reach(FIRST + 3 * S)
    assert one.now_ns(REAL + 5 * S) == FIRST + 3 * S
    one.pause(REAL + 6 * S)
    assert one.due_ns(LAST) is None
    assert one.now_ns(REAL + 9 * S) == FIRST + 3 * S


def test_a_change_of_rate_goes_on_from_here() -> None:
    one = clock()
    one.set_rate(4.0, REAL + S)
    assert one.now_ns(REAL + S) == FIRST + S
    assert one.due_ns(FIRST + 5 * S) == REAL + 2 * S
    one.set_rate(0.0, REAL + 2 * S)
    assert one.now_ns(REAL + 9 * S) == FIRST + 5 * S
    one.set_rate(1.0, REAL + 9 * S)
    assert one.due_ns(FIRST + 6 * S) == REAL + 10 * S


def test_a_seek_is_a_new_epoch_and_keeps_pause_and_rate() -> None:
    one = clock(rate=2.0)
    one.seek(8.0, REAL + S)
    assert (one.epoch, one.now_ns(REAL + S)) == (2, FIRST + 8 * S)
    assert one.due_ns(FIRST + 9 * S) == REAL + 3 * S // 2
    one.pause(REAL + S)
    one.seek(0.0, REAL + 2 * S)
    assert (one.epoch, one.paused) == (3, True)
    assert one.due_ns(FIRST) is None
    assert one.now_ns(REAL + 9 * S) == FIRST


def test_a_loop_is_a_new_epoch_from_the_offset_on() -> None:
    one = clock(loop=True, start_offset_s=1.0, until_s=2.0)
    assert one.end(REAL + S)
    assert (one.epoch, one.now_ns(REAL + S)) == (2, FIRST + S)
    assert one.due_ns(FIRST + 2 * S) == REAL + 2 * S
    assert not clock().end(REAL + S)


def test_epochs_begin_with_1() -> None:
    """A told clock starts with 0 at the time of the launch, which is later than the bag's."""
    from tvbrdf_messages.clock import ToldClock

    told = ToldClock(LAST + 1000 * S)
    told.tell(FIRST, clock().epoch)
    assert told.now_ns() == FIRST


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"rate": -1.0}, r"rate -1: give 0 .* to 1e\+06"),
        ({"rate": float("nan")}, "rate nan"),
        ({"rate": 2e6}, r"rate 2e\+06"),
        ({"start_offset_s": 11.0}, "the bag lasts 10.000 s"),
        ({"start_offset_s": -1.0}, "start offset -1 s"),
        ({"start_offset_s": 3.0, "until_s": 2.0}, "until 2 s: nothing lies between"),
        ({"until_s": float("inf")}, "until inf s"),
    ],
)
def test_what_makes_no_sense_is_refused(options: dict[str, float], text: str) -> None:
    with pytest.raises(PlaybackError, match=text):
        clock(**options)


@pytest.mark.parametrize("offset_s", [-0.1, 10.1, float("nan")])
def test_a_seek_out_of_the_bag_is_refused_and_changes_nothing(offset_s: float) -> None:
    one = clock()
    with pytest.raises(PlaybackError, match=r"give 0 to 10\.000"):
        one.seek(offset_s, REAL + S)
    assert (one.epoch, one.now_ns(REAL + S)) == (1, FIRST + S)
