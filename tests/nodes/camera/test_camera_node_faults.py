"""The camera node when something goes wrong: with frames, with the device, with a reader."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import pytest

from tests.nodes.camera.conftest import NAME, Rig
from tvbrdf_messages.errors import BusError
from tvbrdf_messages.messages import Frame
from tvbrdf_nodes.camera.capture import FrameOrder
from tvbrdf_nodes.camera.driver import CameraIdentity, RawFrame
from tvbrdf_nodes.camera.simulated import SimulatedCamera
from tvbrdf_nodes.core.device import DeviceError
from tvbrdf_nodes.core.parameters import ParameterError

MakeRig = Callable[..., Rig]


def refused(rig: Rig, text: str) -> None:
    result = rig.result()
    assert result.state == "refused"
    assert text in result.reason


# -- what breaks a sweep


@pytest.mark.parametrize(
    ("fault", "reason", "counter"),
    [
        ({"kind": "drop", "frame": 4, "count": 3}, "dropped frames", {"device_dropped": 3}),
        ({"kind": "repeat", "frame": 4}, "repeated frames", {"device_repeated": 1}),
        ({"kind": "reorder", "frame": 4}, "reordered frames", {"device_reordered": 1}),
    ],
)
def test_device_that_loses_order_breaks_the_sweep(
    make_rig: MakeRig, fault: dict[str, Any], reason: str, counter: dict[str, int]
) -> None:
    rig = make_rig({**fault, "attempt": 1})
    result = rig.sweep()
    assert (result.state, result.action) == ("broken", "sweep")
    assert reason in result.reason
    frames = rig.frames()
    assert result.frames == len(frames)
    received = [envelope.header.received_ns for envelope in frames]
    assert received == sorted(set(received))
    assert counter.items() <= rig.node.diagnostics().items()
    # the retake is good
    again = rig.sweep(attempt=2)
    assert again.state == "done"


def test_camera_that_falls_silent_breaks_the_sweep(make_rig: MakeRig) -> None:
    rig = make_rig({"kind": "stop", "frame": 5, "attempt": 1})
    result = rig.sweep(seconds=4.0)
    assert (result.state, result.frames) == ("broken", 5)
    assert "gave no frame for 2.3 s" in result.reason
    assert rig.sweep(attempt=2).state == "done"


def test_camera_that_falls_silent_does_not_hang_dark_frames(make_rig: MakeRig) -> None:
    rig = make_rig({"kind": "stop", "frame": 1})
    rig.command("dark", exposures_ms=(4.0,), frames=4)
    rig.advance(4.0)
    result = rig.result()
    assert (result.state, result.action) == ("broken", "dark")
    assert "gave no frame" in result.reason


def test_sweep_without_a_frame_is_broken(rig: Rig) -> None:
    rig.command("prepare")
    rig.command("sweep")
    rig.results()
    rig.command("end_sweep")
    result = rig.result()
    assert (result.state, result.frames, result.first_sequence) == ("broken", 0, -1)
    assert "no frame" in result.reason


def test_wrong_exposure_is_broken_with_both_numbers(make_rig: MakeRig) -> None:
    rig = make_rig({"kind": "wrong_exposure", "factor": 1.25})
    rig.command("prepare", exposure_ms=8.0)
    result = rig.result()
    assert (result.state, result.exposure_ms) == ("broken", 10.0)
    assert "10 ms as read back, not 8 ms" in result.reason
    rig.command("sweep", exposure_ms=8.0)
    refused(rig, "not prepared")
    rig.command("prepare", exposure_ms=8.0)
    assert rig.result().state == "done"


def test_stale_frames_are_dropped_and_counted(make_rig: MakeRig) -> None:
    rig = make_rig({"kind": "stale", "count": 3})
    result = rig.sweep(exposure_ms=1.0)
    assert result.state == "done"
    frames = [envelope.message for envelope in rig.frames()]
    assert {f.exposure_ms for f in frames if isinstance(f, Frame)} == {1.0}
    assert [f.index for f in frames if isinstance(f, Frame)] == list(range(result.frames))
    assert rig.node.diagnostics()["stale"] == 3


def test_stale_frames_do_not_spoil_stills(make_rig: MakeRig) -> None:
    rig = make_rig({"kind": "stale", "count": 2})
    rig.command("still", exposures_ms=(1.0, 2.0))
    rig.advance(1.0)
    assert rig.result().state == "done"
    frames = [envelope.message for envelope in rig.frames()]
    assert [f.exposure_ms for f in frames if isinstance(f, Frame)] == [1.0, 2.0]


def test_stop_breaks_what_is_under_way(rig: Rig) -> None:
    rig.command("prepare")
    rig.command("sweep")
    rig.advance(0.3)
    rig.results()
    rig.command("stop")
    sweep, stop = rig.results()
    assert (sweep.action, sweep.state, sweep.reason) == ("sweep", "broken", "stopped")
    assert (stop.action, stop.state) == ("stop", "done")
    rig.frames()
    rig.advance(0.3)
    assert rig.frames() == []


def test_a_new_command_breaks_what_is_under_way(rig: Rig) -> None:
    rig.command("dark", exposures_ms=(4.0,), frames=100)
    rig.advance(0.3)
    rig.command("prepare")
    dark, prepare = rig.results()
    assert (dark.action, dark.state) == ("dark", "broken")
    assert "given up for command 2" in dark.reason
    assert prepare.state == "done"


def test_reader_without_room_breaks_a_live_cameras_sweep(make_rig: MakeRig) -> None:
    """A live source never waits: the frame is lost, and the sweep says so."""
    rig = make_rig(live=True)
    rig.command("prepare")
    rig.command("sweep")
    rig.results()
    rig.merger.close()
    rig.advance(0.3)
    rig.command("end_sweep")
    result = rig.result()
    assert result.state == "broken"
    assert f"a reader of /{NAME}/frame was too slow" in result.reason


def test_end_of_the_node_breaks_the_sweep(rig: Rig) -> None:
    rig.command("prepare")
    rig.command("sweep")
    rig.advance(0.2)
    rig.results()
    rig.graph.runners[NAME].put(rig.node.stop())
    result = rig.result()
    assert (result.action, result.state) == ("sweep", "broken")
    assert "stopped" in result.reason


# -- devices that fail, and devices that are not good enough


class Unreliable(SimulatedCamera):
    """The simulated camera behind a cable that can be pulled, or with less to say of itself."""

    pulled: ClassVar[bool] = False
    approximate: ClassVar[bool] = False
    opened: ClassVar[int] = 0

    @property
    def identity(self) -> CameraIdentity:
        identity = super().identity
        if not self.approximate:
            return identity
        return replace(identity, exact_exposure=False, hardware_stamps=False)

    def open(self) -> None:
        Unreliable.opened += 1
        if self.pulled:
            raise DeviceError("camera_2: not found")
        super().open()

    def close(self) -> None:
        """The link to the world stays: it is not what was pulled."""
        self.stop()

    def read(self) -> list[RawFrame]:
        frames = super().read()
        if self.pulled and self._capture is not None:
            raise DeviceError("camera_2: the cable was pulled")
        return frames


@pytest.fixture
def unreliable(make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch) -> Rig:
    import tvbrdf_nodes.camera.simulated as module

    for name, value in (("pulled", False), ("approximate", False), ("opened", 0)):
        monkeypatch.setattr(Unreliable, name, value)
    monkeypatch.setattr(module, "Unreliable", Unreliable, raising=False)
    return make_rig(driver="tvbrdf_nodes.camera.simulated:Unreliable")


def test_device_that_fails_breaks_the_sweep_and_is_opened_again(
    unreliable: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = unreliable
    rig.command("prepare")
    rig.command("sweep")
    rig.advance(0.2)
    rig.results()
    monkeypatch.setattr(Unreliable, "pulled", True)
    rig.advance(0.2)
    rig.command("end_sweep")
    result = rig.result()
    assert (result.action, result.state) == ("sweep", "broken")
    assert "cable was pulled" in result.reason
    rig.command("prepare", attempt=2)
    assert (rig.results()[0].state, rig.node.diagnostics()["device"]) == (
        "broken",
        "camera_2: not found",
    )
    monkeypatch.setattr(Unreliable, "pulled", False)
    assert rig.sweep(attempt=3).state == "done"
    assert Unreliable.opened == 3
    assert rig.node.diagnostics()["device"] == ""


def test_approximate_camera_is_refused_for_scans(
    unreliable: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Unreliable, "approximate", True)
    for action in ("prepare", "dark"):
        unreliable.command(action)
        refused(unreliable, "can't set its exposure exactly and gives no hardware stamps")
    unreliable.command("still", exposures_ms=(4.0,))
    unreliable.advance(0.5)
    assert unreliable.result().state == "done"


def test_wrong_parameters_of_a_driver_are_named(make_rig: MakeRig) -> None:
    with pytest.raises(
        ParameterError, match="camera_2: driver_parameters: unknown parameter 'widht'"
    ):
        make_rig(driver_parameters={"camera": 2, "widht": 5})


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"region": [1, 2, 3]}, "region"),
        ({"frame_rate_hz": 0.0}, "frame_rate_hz"),
        ({"silence_s": 0.0}, "silence_s"),
    ],
)
def test_impossible_parameters_are_refused(
    make_rig: MakeRig, wrong: dict[str, Any], text: str
) -> None:
    with pytest.raises(BusError, match=text):
        make_rig(**wrong)


def test_order_of_frame_numbers() -> None:
    order = FrameOrder()
    seen = [order.see(number) for number in (5, 6, 9, 8, 8, 7, 10, 10)]
    assert seen == ["", "", "dropped", "reordered", "repeated", "reordered", "", "repeated"]
    assert order.dropped == 0
