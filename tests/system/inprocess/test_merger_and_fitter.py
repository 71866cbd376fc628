"""Merger and fitter on recorded inputs, whole and spoilt in every way."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tvbrdf_messages.envelope import Envelope
from tvbrdf_messages.messages import (
    ArmState,
    Frame,
    Parameters,
    Radiance,
    ScanCommand,
    Stored,
    SweepResult,
)
from tvbrdf_messages.run_directory import Graph
from tvbrdf_nodes.core.device import DeviceError
from tvbrdf_nodes.core.inprocess import InProcessGraph
from tvbrdf_nodes.core.parameters import ParameterError

if TYPE_CHECKING:
    from conftest import Run

Change = Callable[[Envelope, Any], Envelope | None]
"""What becomes of a message on its way; None: it is lost."""


def changed(graph: Graph, name: str, parameters: Mapping[str, Any]) -> Graph:
    participants = tuple(
        replace(p, parameters={**p.parameters, **parameters}) if p.name == name else p
        for p in graph.participants
    )
    return replace(graph, participants=participants)


def new(envelope: Envelope, **fields: Any) -> Envelope:
    """Return an envelope whose message has other fields."""
    message: Any = envelope.message
    return envelope._replace(message=replace(message, **fields))


class Bench:
    """A merger or fitter alone, fed with what was recorded."""

    def __init__(self, graph: Graph, name: str) -> None:
        self.graph = InProcessGraph(graph, run=[name])
        self.name = name

    def __enter__(self) -> Bench:
        self.graph.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self.graph.__exit__(None, None, None)

    def take(self, *envelopes: Envelope) -> None:
        port = self.graph.bus.ports[self.name]
        for envelope in envelopes:
            port.take(envelope)
        while self.graph.step():
            pass

    def feed(self, run: Run, change: Change = lambda envelope, message: envelope) -> None:
        """Give it all that it takes of a record, changed on the way."""
        takes = run.graph.find(self.name).takes
        for envelope in run.messages:
            if envelope.topic in takes and envelope.header.publisher != self.name:
                sent = change(envelope, envelope.message)
                if sent is not None:
                    self.take(sent)

    def published(self, kind: type[Any]) -> list[Any]:
        messages = [envelope.message for envelope in self.graph.bus.taps]
        return [message for message in messages if isinstance(message, kind)]

    def results(self) -> list[tuple[int, str, str]]:
        """Sweep, state and reason of what the merger has said."""
        return [(r.sweep, r.state, r.reason) for r in self.published(SweepResult)]

    def stored(self, scan: int, what: str, **fields: Any) -> None:
        message = Stored(sample="x", scan=scan, what=what, **fields)
        header = self.graph.bus.port("database_writer")
        header.publish("/scan/stored", message, stamp_ns=0)
        while self.graph.step():
            pass

    @property
    def counters(self) -> dict[str, Any]:
        return self.graph.runners[self.name].node.diagnostics()


def merge(run: Run, change: Change, **parameters: Any) -> list[tuple[int, str, str]]:
    """Return what the merger says of a record that was changed on the way."""
    with Bench(changed(run.graph, "hdr_merger", parameters), "hdr_merger") as bench:
        bench.feed(run, change)
        return bench.results()


# -- the merger


def test_a_whole_record_gives_its_radiance(record: Run) -> None:
    with Bench(record.graph, "hdr_merger") as bench:
        bench.feed(record)
        assert bench.results() == [(0, "done", ""), (1, "done", "")]
        (radiance,) = bench.published(Radiance)
        (live,) = record.radiance
        assert radiance.radiance.tobytes() == live.radiance.tobytes()
        assert bench.counters["open_sweeps"] == 0
        last = max(r.last_sequence for r in record.on("/scan/sweep_result") if r.source == "arm")
        sent = len(record.on("/arm/state"))
        assert bench.counters["kept_states"] == sent - last - 1  # those since the last sweep
        assert bench.counters["frames"] == len([m for m in record.messages if "frame" in m.topic])
        assert radiance.cameras == ("camera_1", "camera_2", "camera_3", "camera_4")
        assert set(radiance.camera) == {1, 2, 3, 4}
        assert set(radiance.sweep) == {0, 1}
        # nothing is resampled: each row is one frame
        assert len(radiance.camera) == len({*zip(radiance.camera, radiance.stamp_ns, strict=True)})
        facts = radiance.quality["sweeps"]["0"]
        assert facts["arm"]["delay_ms"] == pytest.approx(1.2, abs=0.2)  # as the scene says
        assert abs(facts["arm"]["drift_ppm"] + 40.0) < 5.0


def test_a_frame_that_is_lost_breaks_the_sweep(record: Run) -> None:
    def lose(envelope: Envelope, message: Any) -> Envelope | None:
        lost = isinstance(message, Frame) and (message.camera, message.sweep) == ("camera_3", 0)
        return None if lost and message.kind == "light" and message.index == 100 else envelope

    first = merge(record, lose)[0]
    sent = [r for r in record.on("/scan/sweep_result") if (r.source, r.sweep) == ("camera_3", 0)]
    count = next(r.frames for r in sent if r.action == "sweep")
    assert first == (0, "broken", f"camera_3 sent {count} frames, {count - 1} arrived")


def test_a_camera_that_saw_nothing_breaks_the_sweep(record: Run) -> None:
    def blind(envelope: Envelope, message: Any) -> Envelope | None:
        if isinstance(message, Frame) and message.camera == "camera_1" and message.kind == "light":
            return None
        if isinstance(message, SweepResult) and message.source == "camera_1":
            return new(envelope, frames=0)
        return envelope

    assert merge(record, blind)[0] == (0, "broken", "camera_1 saw no frame")


def test_lost_states_of_the_arm_break_the_sweep(record: Run) -> None:
    counted = 0

    def lose(envelope: Envelope, message: Any) -> Envelope | None:
        nonlocal counted
        counted += isinstance(message, ArmState) and message.moving
        return None if isinstance(message, ArmState) and counted == 300 else envelope

    results = merge(record, lose)
    assert ("broken", "arm: states of the sweep are missing") in [r[1:] for r in results]


def test_states_of_an_earlier_life_of_the_arm_do_not_count(record: Run) -> None:
    """A restarted node counts its states from 0 again."""
    with Bench(record.graph, "hdr_merger") as bench:
        for envelope in record.messages:
            if isinstance(envelope.message, ArmState):
                old = envelope.header._replace(incarnation="earlier")
                bench.take(new(envelope, angle_deg=12.0)._replace(header=old))
        bench.feed(record)
        assert [state for _, state, _ in bench.results()] == ["done", "done"]
        (radiance,) = bench.published(Radiance)
        assert radiance.radiance.tobytes() == record.radiance[0].radiance.tobytes()


def test_a_clock_that_jumps_breaks_the_sweep(record: Run) -> None:
    frames = 0

    def jump(envelope: Envelope, message: Any) -> Envelope:
        nonlocal frames
        if not isinstance(message, Frame) or message.camera != "camera_2":
            return envelope
        frames += message.kind == "light"
        late = envelope.header.hardware_ns + (50_000_000 if frames > 150 else 0)
        return envelope._replace(header=envelope.header._replace(hardware_ns=late))

    sweep, state, reason = merge(record, jump)[0]
    assert (sweep, state) == (0, "broken")
    assert reason.startswith("camera 2: clock stepped by ")
    assert float(reason.split()[5]) == pytest.approx(50.0, abs=1.0)  # jitter has a mean of 0.5 ms


def test_frames_that_are_not_the_calibrations_are_told_once(record: Run) -> None:
    def eight_bits(envelope: Envelope, message: Any) -> Envelope:
        if isinstance(message, Frame) and message.camera == "camera_4":
            return new(envelope, image=(message.image // 16).astype(np.uint8))
        return envelope

    results = merge(record, eight_bits)
    told = [reason for _, state, reason in results if "12 bits" in reason]
    # once for the dark frames' sweep and once for each sweep, not for every frame
    assert 1 <= len(told) <= 3
    assert told[0].startswith("camera 4: frame is uint8 of shape (16, 16, 3)")


@pytest.mark.parametrize("kept", [0, 5])
def test_dark_frames_that_are_lost_break_the_first_sweep(record: Run, kept: int) -> None:
    """It is taken again with them; the sweeps after it are not broken by what it lacked."""

    def lose(envelope: Envelope, message: Any) -> Envelope | None:
        dark = isinstance(message, Frame) and (message.camera, message.kind) == ("camera_2", "dark")
        return None if dark and message.index >= kept else envelope

    results = [r for r in record.on("/scan/sweep_result") if r.source == "camera_2"]
    (sent,) = (r.frames for r in results if r.action == "dark")
    frames = [e.message for e in record.messages if isinstance(e.message, Frame)]
    got = len([f for f in frames if (f.camera, f.kind) == ("camera_2", "dark") and f.index < kept])
    assert got < sent
    with Bench(record.graph, "hdr_merger") as bench:
        bench.feed(record, lose)
        reason = f"camera_2 sent {sent} dark frames, {got} arrived"
        assert bench.results()[0] == (0, "broken", reason)
        assert bench.counters["frames_lost"] == sent - got
        assert not bench.published(Radiance)
        bench.graph.bus.taps.clear()
        bench.feed(record, lambda e, m: new(e, attempt=2) if hasattr(m, "attempt") else e)
        assert bench.results() == [(0, "done", ""), (1, "done", "")]
        (radiance,) = bench.published(Radiance)
        assert radiance.radiance.tobytes() == record.radiance[0].radiance.tobytes()
        assert bench.counters["frames_lost"] == sent - got


def test_dark_frames_with_light_in_them_break_the_sweep(record: Run) -> None:
    def leak(envelope: Envelope, message: Any) -> Envelope:
        if isinstance(message, Frame) and (message.camera, message.kind) == ("camera_1", "dark"):
            return new(envelope, image=np.minimum(message.image + 500, 4095).astype(np.uint16))
        return envelope

    _, state, reason = merge(record, leak)[0]
    assert state == "broken"
    assert "check that the lamp was off" in reason


def test_stills_and_broken_parts_are_passed_over(record: Run) -> None:
    def add(envelope: Envelope, message: Any) -> Envelope | None:
        if isinstance(message, Frame) and message.kind == "dark":
            return new(envelope, kind="still")
        return None if getattr(message, "action", "") == "dark" else envelope

    # without dark frames the calibration's nominal black level is used
    assert [state for _, state, _ in merge(record, add)] == ["done", "done"]

    def break_(envelope: Envelope, message: Any) -> Envelope:
        if isinstance(message, SweepResult) and (message.source, message.sweep) == ("camera_1", 0):
            return new(envelope, state="broken", reason="frames were dropped")
        return envelope

    # the sequencer knows already; the second sweep then finds that the first is not there
    assert merge(record, break_) == [(1, "broken", "sweeps [0] of the scan were lost here")]


def test_a_merger_that_was_restarted_says_what_it_lacks(record: Run) -> None:
    def second_only(envelope: Envelope, message: Any) -> Envelope | None:
        first = getattr(message, "sweep", 1) == 0 and getattr(message, "kind", "light") == "light"
        return None if first else envelope

    assert merge(record, second_only) == [(1, "broken", "sweeps [0] of the scan were lost here")]


def test_without_its_command_a_sweep_waits(record: Run) -> None:
    def drop(envelope: Envelope, message: Any) -> Envelope | None:
        return None if isinstance(message, ScanCommand) else envelope

    with Bench(record.graph, "hdr_merger") as bench:
        bench.feed(record, drop)
        assert bench.results() == []
        assert bench.counters["open_sweeps"] == 2
        commands = [e for e in record.messages if isinstance(e.message, ScanCommand)]
        bench.take(*commands)
        assert bench.results() == [(0, "done", ""), (1, "done", "")]
        (radiance,) = bench.published(Radiance)
        assert radiance.radiance.tobytes() == record.radiance[0].radiance.tobytes()


def test_sweeps_that_are_given_up_do_not_pile_up(record: Run) -> None:
    with Bench(record.graph, "hdr_merger") as bench:
        frames = [e for e in record.messages if isinstance(e.message, Frame)][:20]
        for attempt in range(1, 100):
            bench.take(*(new(e, kind="light", attempt=attempt) for e in frames))
        assert bench.counters["open_sweeps"] <= 12
        bench.feed(record, lambda e, m: new(e, scan=2) if hasattr(m, "attempt") else e)
        assert bench.counters["open_sweeps"] == 0


def unconfirmed(envelope: Envelope, message: Any) -> Envelope | None:
    """Drop what the database has confirmed."""
    return None if isinstance(message, Stored) else envelope


def test_radiance_is_kept_until_it_is_stored_and_fitted(record: Run) -> None:
    with Bench(record.graph, "hdr_merger") as bench:
        bench.feed(record, unconfirmed)

        def kept() -> int:
            """How many scans a writer that is started now would get."""
            bench.graph.bus.port("fitter").close()
            return len(bench.graph.bus.port("fitter").receive())

        assert kept() == 1
        assert bench.counters["unstored"] == 1
        bench.stored(1, "radiance")
        assert kept() == 1  # its fitter may still need it
        bench.stored(1, "parameters")
        assert kept() == 0
        assert bench.counters["unstored"] == 0


def test_radiance_that_the_database_refuses_is_forgotten(record: Run) -> None:
    with Bench(record.graph, "hdr_merger") as bench:
        bench.feed(record, unconfirmed)
        assert bench.counters["unstored"] == 1
        bench.stored(1, "radiance", refused="no camera has a valid value")
        assert bench.counters["unstored"] == 0


@pytest.mark.parametrize(
    ("content", "text"),
    [("tilt_deg: 12.0", "missing"), ("[", "cannot be read|not YAML|YAML"), ("{}", "missing")],
)
def test_a_calibration_that_is_wrong_ends_the_node_before_anything_moves(
    record: Run, tmp_path: Path, content: str, text: str
) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text(content)
    graph = changed(record.graph, "hdr_merger", {"calibration": str(path)})
    with pytest.raises(DeviceError, match=rf"{path}.*({text})"), Bench(graph, "hdr_merger"):
        pass


def test_a_calibration_that_is_not_there_is_refused(record: Run) -> None:
    graph = changed(record.graph, "hdr_merger", {"calibration": "/nowhere.yaml"})
    with pytest.raises((ParameterError, RuntimeError), match=r"/nowhere\.yaml is no file"):
        Bench(graph, "hdr_merger")


# -- the fitter


def fit(run: Run, change: Change = lambda e, m: e, **parameters: Any) -> Parameters:
    with Bench(changed(run.graph, "fitter", parameters), "fitter") as bench:
        bench.feed(run, change)
        (found,) = bench.published(Parameters)
        assert isinstance(found, Parameters)
        return found


def test_the_fitter_gives_what_it_gave_live(record: Run) -> None:
    found, (live,) = fit(record), record.parameters
    assert replace(found, solve_time_ms=0.0, covariance=live.covariance) == replace(
        live, solve_time_ms=0.0
    )
    assert found.covariance.tobytes() == live.covariance.tobytes()
    assert 0.0 < found.solve_time_ms < 10_000.0
    assert found.errors["rms_percent"] < 1.0


def test_known_parameters_are_not_fitted(record: Run) -> None:
    found = fit(record, fixed={"sigma_d": 0.35, "ks": 0.9})
    values = dict(zip(found.parameter_names, found.values, strict=True))
    errors = dict(zip(found.parameter_names, found.standard_deviations, strict=True))
    assert (values["sigma_d"], values["ks"]) == (0.35, 0.9)
    assert (errors["sigma_d"], errors["ks"]) == (0.0, 0.0)
    assert errors["kd_b"] > 0.0


def test_the_model_is_chosen_and_why_is_kept(record: Run) -> None:
    found = fit(record, model="auto", metric="radiance")
    live = record.parameters[0]
    assert found.model == live.model == "oren_nayar+torrance_sparrow"
    assert found.details["choice"]["reason"].startswith(found.model)
    tried = [rung["model"] for rung in found.details["choice"]["rungs"]]
    assert {"lambert", "oren_nayar", found.model} <= set(tried)
    # one fit among several, from the same values
    np.testing.assert_allclose(found.values, live.values, rtol=1e-6)


def test_what_the_fit_assumed_travels_with_it(record: Run) -> None:
    found = fit(record, loss="huber", metric="log")
    assert (found.details["metric"], found.details["loss"]) == ("log", "huber")
    gain, deviation = record.parameters[0].details["nuisances"]["gain_camera1_b"]
    # the calibration's own statement of its gains limits both
    assert abs(gain) < 5 * record.radiance[0].gain_relative_std
    assert 0 < deviation < 1.01 * record.radiance[0].gain_relative_std


def test_a_scan_that_can_not_be_fitted_is_told_and_does_not_end_the_node(record: Run) -> None:
    def spoil(envelope: Envelope, message: Any) -> Envelope:
        if isinstance(message, Radiance):
            return new(envelope, valid=np.zeros_like(message.valid))
        return envelope

    with Bench(record.graph, "fitter") as bench:
        bench.feed(record, spoil)
        bench.feed(record)
        lost, good = bench.published(Parameters)
    assert lost.reason.startswith("not fitted: 0 usable values cannot determine")
    assert all(math.isnan(value) for value in (*lost.values, *lost.standard_deviations))
    assert lost.undetermined == lost.parameter_names
    assert good.values == record.parameters[0].values


def test_parameters_are_kept_until_they_are_stored(record: Run) -> None:
    with Bench(record.graph, "fitter") as bench:
        bench.feed(record, unconfirmed)

        def kept() -> int:
            bench.graph.bus.port("database_writer").close()
            return len(bench.graph.bus.port("database_writer").receive())

        assert kept() == 1
        bench.stored(1, "radiance")
        assert kept() == 1
        bench.stored(1, "parameters")
        assert kept() == 0


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"model": "velvet"}, "model: unknown model 'velvet'; known models: cook_torrance"),
        ({"fixed": {"colour": 1.0}}, "fixed: colour: .* has kd_b, kd_g"),
        ({"metric": "beauty"}, "metric: 'beauty' is unknown; known: radiance"),
        ({"method": "magic"}, "method: 'magic' is unknown; known: separable"),
    ],
)
def test_an_unknown_model_or_parameter_ends_the_fitter_before_anything_moves(
    record: Run, parameters: dict[str, Any], text: str
) -> None:
    graph = changed(record.graph, "fitter", parameters)
    with pytest.raises(DeviceError, match=text), Bench(graph, "fitter"):
        pass
