"""Graphs of small nodes: links, inputs from the test, waiting, and what a failing wait says."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.plugin.probes import SECOND_NS, Breaks, Counter, Ticker
from tvbrdf_launch.testing.bags import BagFactory
from tvbrdf_launch.testing.errors import WaitError
from tvbrdf_launch.testing.graphs import START_NS, GraphFactory
from tvbrdf_messages.messages import Mark


def test_time_jumps_and_messages_come_in_order(graph: GraphFactory) -> None:
    run = graph(Ticker, Counter)
    assert run.published("/operator/mark") == []
    assert run.wait_for("/operator/mark", count=2).text == "tick 2"
    assert run.now_ns == START_NS + 120 * SECOND_NS
    # what has come already is there at once, and the clock stands still
    assert run.wait_for("/operator/mark").text == "tick 1"
    assert run.now_ns == START_NS + 120 * SECOND_NS
    heard = run.wait_for("/scan/missing", lambda missing: "tick 3" in missing.reason)
    assert heard.reason == "counter heard tick 3"
    stamps = [e.header.stamp_ns for e in run.envelopes("/operator/mark")]
    assert stamps == [START_NS + 60 * k * SECOND_NS for k in (1, 2, 3)]


def test_nodes_are_linked_by_topics_and_have_the_names_they_are_given(graph: GraphFactory) -> None:
    run = graph(ticker=(Ticker, {"ticks": 1}), one=Counter, two=(Counter, {}))
    run.wait_until(lambda: len(run.published("/scan/missing")) == 2, "both answers")
    reasons = sorted(missing.reason for missing in run.published("/scan/missing"))
    assert reasons == ["one heard tick 1", "two heard tick 1"]


def test_the_test_gives_what_nobody_gives(graph: GraphFactory) -> None:
    run = graph(Counter)
    assert run.played == ("test",)
    run.send("/operator/mark", Mark(text="hello"))
    assert run.wait_for("/scan/missing").reason == "counter heard hello"


def test_the_test_may_be_a_second_publisher(graph: GraphFactory) -> None:
    run = graph(Ticker, Counter, inputs=["/operator/mark"])
    run.send("/operator/mark", Mark(text="mine"), stamp_ns=5)
    run.advance(60)
    heard = [missing.reason for missing in run.published("/scan/missing")]
    assert heard == ["counter heard mine", "counter heard tick 1"]
    first, _ = run.envelopes("/operator/mark")
    assert (first.header.publisher, first.header.stamp_ns) == ("test", 5)


def test_a_played_participant_dies_and_comes_back(graph: GraphFactory) -> None:
    run = graph(Counter)
    life = run.incarnation("test")
    run.kill("test")
    run.return_("test")
    assert run.incarnation("test") != life
    run.send("/operator/mark", Mark(text="again"))
    assert run.wait_for("/scan/missing").reason == "counter heard again"


def test_a_bag_is_fed_or_played(graph: GraphFactory, bag: BagFactory) -> None:
    marks = [("/operator/mark", Mark(text=str(k))) for k in range(3)]
    recorded = bag(marks)
    expected = [f"counter heard {k}" for k in range(3)]
    fed = graph(Counter)
    fed.feed(recorded)
    assert [m.reason for m in fed.published("/scan/missing")] == expected
    played = graph(Counter, player=recorded.player(topics=["/operator/mark"]))
    played.wait_for("/scan/missing", count=3)
    assert [m.reason for m in played.published("/scan/missing")] == expected


def test_a_bag_of_a_run_holds_what_it_said(graph: GraphFactory, bag: BagFactory) -> None:
    run = graph(Ticker, Counter)
    run.wait_for("/scan/missing", count=3)
    recorded = bag(run, "mine.mcap")
    assert recorded.messages("/operator/mark") == run.published("/operator/mark")
    assert bag("mine.mcap").envelopes("/scan/missing") == run.envelopes("/scan/missing")


def test_a_wait_that_can_not_end_says_what_came_instead(graph: GraphFactory) -> None:
    run = graph(Ticker, Counter)
    with pytest.raises(WaitError) as caught:
        run.wait_for("/operator/mark", lambda mark: mark.text == "tock", count=2)
    text = str(caught.value)
    assert "message 2 on /operator/mark" in text
    assert "(0 of 2 came): nothing is left that could happen" in text
    assert "3 of that topic came, the last: Mark(text='tick 3', zero=False)" in text
    assert "/scan/missing 3" in text
    assert "ticker running; counter running" in text
    assert "ticker info: the ticker begins" in text


def test_a_wait_ends_after_its_time(graph: GraphFactory) -> None:
    run = graph((Ticker, {"ticks": 1_000_000_000}))
    with pytest.raises(WaitError, match=r"the moon: not within 0\.05 s"):
        run.wait_until(lambda: False, "the moon", timeout_s=0.05)


def test_a_node_that_fails_ends_the_run_and_is_told(graph: GraphFactory) -> None:
    run = graph((Ticker, {"ticks": 2, "then_fail": True}), Counter)
    with pytest.raises(WaitError, match=r"ticker has ended \(code 1: the spring is broken\)"):
        run.wait_for("/operator/mark", count=3)
    # the others have finished what they had
    assert len(run.published("/scan/missing")) == 2
    assert run.wait_until_ended() == ("ticker", 1, "the spring is broken")


def test_an_error_in_a_node_is_the_tests(graph: GraphFactory) -> None:
    run = graph(Counter)
    run.send("/operator/mark", Mark(text="break"))
    with pytest.raises(ZeroDivisionError, match="as it was told"):
        run.wait_for("/scan/missing")


def test_stopping_stops_all_also_when_one_fails_to(tmp_path: Path) -> None:
    before = Ticker.stopped
    factory = GraphFactory(tmp_path)
    run = factory(breaks=Breaks, first=Ticker, last=Ticker)
    directory = Path(run.graph.directory)
    assert directory.is_dir()
    with pytest.raises(OSError, match="the device is gone"):
        factory.__exit__(None, None, None)
    assert Ticker.stopped == before + 2
    assert not directory.exists()


def test_a_stopped_run_keeps_what_was_said(graph: GraphFactory) -> None:
    run = graph(Ticker)
    run.wait_for("/operator/mark")
    run.stop()
    run.stop()
    assert run.wait_for("/operator/mark").text == "tick 1"
    with pytest.raises(WaitError, match="the run has been stopped"):
        run.wait_for("/operator/mark", count=2)
