"""The camera node: what it does for whom; the test plays sequencer, world and arm."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.nodes.camera.conftest import NAME, Rig
from tvbrdf_messages.messages import CameraInfo, Frame, ScanCommand

MakeRig = Callable[..., Rig]


# -- what it does


def test_says_what_the_camera_is(rig: Rig) -> None:
    (info,) = [e.message for e in rig.merger.receive(1000) if isinstance(e.message, CameraInfo)]
    assert (info.camera, info.model, info.width, info.height) == (NAME, "simulated", 16, 16)
    assert (info.bit_depth, info.frame_rate_hz) == (12, 30.0)
    assert info.hardware_stamps
    assert info.exact_exposure


def test_prepare_answers_with_the_exposure_read_back(rig: Rig) -> None:
    command = rig.command("prepare", exposure_ms=0.2, scan=3, sweep=1, attempt=2)
    result = rig.result()
    assert (result.source, result.action, result.state) == (NAME, "prepare", "done")
    assert (result.command_id, result.scan, result.sweep, result.attempt) == (
        command.command_id,
        3,
        1,
        2,
    )
    assert result.exposure_ms == 0.2
    rig.advance(0.2)
    assert rig.frames() == []


def test_sweep_is_answered_after_its_last_frame(rig: Rig) -> None:
    fields = {"scan": 2, "sweep": 1, "attempt": 3, "exposure_ms": 2.0}
    rig.command("prepare", **fields)
    sweep = rig.command("sweep", **fields)
    assert [r.action for r in rig.results()] == ["prepare"]
    rig.advance(1.0)
    assert rig.results() == []
    rig.command("end_sweep", **fields)
    result = rig.result()
    assert (result.action, result.command_id, result.state) == ("sweep", sweep.command_id, "done")
    envelopes = rig.frames()
    assert len(envelopes) == result.frames
    assert result.frames in (29, 30, 31)
    sequences = [envelope.header.sequence for envelope in envelopes]
    assert sequences == list(range(result.first_sequence, result.last_sequence + 1))
    assert result.exposure_ms == 2.0
    published = [e.topic for e in rig.graph.bus.taps]
    last_frame = max(k for k, topic in enumerate(published) if topic == f"/{NAME}/frame")
    assert published.index("/scan/sweep_result", last_frame) > last_frame
    for index, envelope in enumerate(envelopes):
        frame = envelope.message
        assert isinstance(frame, Frame)
        assert (frame.camera, frame.kind, frame.sample) == (NAME, "light", "paint")
        assert (frame.scan, frame.sweep, frame.attempt, frame.index) == (2, 1, 3, index)
        assert (frame.exposure_ms, frame.bit_depth) == (2.0, 12)
        assert frame.image.shape == (16, 16, 3)
        header = envelope.header
        assert header.stamp_ns == header.received_ns - 1_000_000
        assert header.hardware_ns > 0
    rig.advance(0.5)
    assert rig.frames() == []


def test_sequence_numbers_go_on_from_sweep_to_sweep(rig: Rig) -> None:
    first = rig.sweep(sweep=0)
    second = rig.sweep(sweep=1, exposure_ms=32.0)
    assert second.first_sequence == first.last_sequence + 1
    frames = [e.message for e in rig.frames()]
    assert {f.exposure_ms for f in frames if isinstance(f, Frame) and f.sweep == 1} == {32.0}


def test_dark_takes_frames_at_each_exposure(rig: Rig) -> None:
    command = rig.command("dark", target="cameras", exposures_ms=(0.2, 4.0, 32.0), frames=4)
    rig.advance(2.0)
    result = rig.result()
    assert (result.action, result.state, result.frames) == ("dark", "done", 12)
    assert result.command_id == command.command_id
    frames = [e.message for e in rig.frames()]
    assert [f.exposure_ms for f in frames if isinstance(f, Frame)] == [0.2] * 4 + [4.0] * 4 + [
        32.0
    ] * 4
    assert [f.index for f in frames if isinstance(f, Frame)] == list(range(12))
    assert {f.kind for f in frames if isinstance(f, Frame)} == {"dark"}


def test_still_takes_one_frame_at_each_exposure(rig: Rig) -> None:
    rig.command("still", target=NAME, exposures_ms=(1.0, 8.0))
    rig.advance(1.0)
    result = rig.result()
    assert (result.action, result.state, result.frames) == ("still", "done", 2)
    frames = [e.message for e in rig.frames()]
    assert [(f.kind, f.exposure_ms) for f in frames if isinstance(f, Frame)] == [
        ("still", 1.0),
        ("still", 8.0),
    ]


def test_a_sweep_needs_a_new_prepare_after_dark_frames(rig: Rig) -> None:
    rig.command("prepare")
    rig.command("dark", exposures_ms=(4.0,), frames=1)
    rig.advance(0.5)
    rig.results()
    rig.command("sweep")
    result = rig.result()
    assert (result.state, result.action) == ("refused", "sweep")
    assert "not prepared" in result.reason


def test_region_is_used(make_rig: MakeRig) -> None:
    rig = make_rig(region=[4, 2, 8, 6])
    assert rig.sweep().state == "done"
    frame = rig.frames()[0].message
    assert isinstance(frame, Frame)
    assert (frame.region_x, frame.region_y, frame.image.shape) == (4, 2, (6, 8, 3))


def test_frames_right_after_a_change_are_thrown_away_when_told(make_rig: MakeRig) -> None:
    rig = make_rig(drop_stale_ms=200.0)
    rig.command("prepare", exposure_ms=1.0)
    assert rig.results() == []
    rig.advance(0.4)
    assert rig.result().state == "done"
    assert rig.frames() == []
    rig.command("sweep", exposure_ms=1.0)
    rig.advance(0.2)
    rig.command("end_sweep", exposure_ms=1.0)
    assert rig.result().frames == len(rig.frames()) > 0


# -- what it refuses


def refused(rig: Rig, text: str) -> None:
    result = rig.result()
    assert result.state == "refused"
    assert text in result.reason


def test_late_command_is_refused(rig: Rig) -> None:
    rig.advance(1.0)
    rig.command("prepare", not_after_ns=rig.graph.clock.now_ns() - 5_000_000)
    refused(rig, "5 ms late")


def test_repeated_command_is_refused(rig: Rig) -> None:
    rig.command("prepare", command_id=7)
    assert rig.result().state == "done"
    rig.command("prepare", command_id=7)
    refused(rig, "came again")
    rig.command("prepare", command_id=6)
    refused(rig, "came again")


def test_commands_of_an_earlier_sequencer_are_refused(rig: Rig) -> None:
    rig.command("prepare")
    assert rig.result().state == "done"
    earlier, earlier_incarnation = rig.sequencer, rig.sequencer.incarnation
    rig.sequencer = rig.graph.bus.port("sequencer")
    rig.command("prepare", command_id=1)
    assert rig.result().state == "done"
    command = ScanCommand(
        command_id=99,
        incarnation=earlier_incarnation,
        not_after_ns=rig.graph.clock.now_ns() + 10**9,
        action="prepare",
        exposure_ms=1.0,
    )
    earlier.publish("/scan/command", command, stamp_ns=0)
    rig.settle()
    refused(rig, "earlier sequencer")


def test_command_signed_by_another_is_refused(rig: Rig) -> None:
    rig.command("prepare", incarnation="somebody")
    refused(rig, "not its publisher's own")


@pytest.mark.parametrize("target", ["arm", "camera_1", "camera"])
def test_commands_for_others_are_ignored(rig: Rig, target: str) -> None:
    rig.command("prepare", target=target)
    assert rig.results() == []


@pytest.mark.parametrize("action", ["home", "lamp", "jog"])
def test_commands_for_the_arm_are_ignored(rig: Rig, action: str) -> None:
    rig.command(action)
    assert rig.results() == []


def test_unknown_action_is_refused(rig: Rig) -> None:
    rig.command("dance")
    refused(rig, "no action 'dance'")


def test_sweep_without_prepare_is_refused(rig: Rig) -> None:
    rig.command("sweep")
    refused(rig, "not prepared")


def test_sweep_at_another_exposure_is_refused(rig: Rig) -> None:
    rig.command("prepare", exposure_ms=4.0)
    rig.results()
    rig.command("sweep", exposure_ms=32.0)
    refused(rig, "prepared for 4 ms, not for 32 ms")


def test_end_of_another_sweep_is_refused(rig: Rig) -> None:
    rig.command("end_sweep")
    refused(rig, "no sweep is under way")
    rig.command("prepare")
    rig.command("sweep")
    rig.results()
    rig.command("end_sweep", attempt=2)
    refused(rig, "(1, 0, 1) is under way, not (1, 0, 2)")
