"""The bag for Foxglove and Rerun, read back with the ``mcap`` package's protobuf decoder."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from tests.launch.export_inputs import results, the_radiance, whole_bag
from tests.launch.refit_inputs import inside
from tests.replay.process_replay import BAG
from tests.replay.recorded_rig import read_all, write_bag
from tvbrdf_fitting.geometry import light_direction
from tvbrdf_fitting.measurement.calibration import parse_calibration
from tvbrdf_launch.errors import RunError
from tvbrdf_launch.export import export_bag, protobuf
from tvbrdf_launch.export.foxglove import eight_bits
from tvbrdf_launch.export.protobuf import field_names, own_schema
from tvbrdf_messages.bag import BagReader
from tvbrdf_messages.bag.errors import BagError
from tvbrdf_messages.messages import ArmState, Frame, Parameters

DOUBLE = 1e-12
"""Of directions: a few sines, cosines and products of doubles."""


class Read(NamedTuple):
    topic: str
    schema: str
    log_time_ns: int
    stamp_ns: int
    message: Any


def read(path: Path) -> list[Read]:
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    with path.open("rb") as file:
        return [
            Read(
                each.channel.topic,
                each.schema.name if each.schema else "",
                each.message.log_time,
                each.message.publish_time,
                each.decoded_message,
            )
            for each in make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
        ]


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> list[Read]:
    folder = tmp_path_factory.mktemp("foxglove")
    export_bag(whole_bag(folder / "a.mcap"), folder / "out", ["foxglove"])
    return read(folder / "out" / "foxglove.mcap")


def on(shown: list[Read], topic: str) -> list[Read]:
    return [each for each in shown if each.topic == topic]


def time_ns(stamp: Any) -> int:
    return int(stamp.seconds) * 10**9 + int(stamp.nanos)


def turned(rotation: Any, vector: Any) -> Any:
    """Rotate a vector by a unit quaternion: v + 2 w (q × v) + 2 q × (q × v)."""
    q = np.array([rotation.x, rotation.y, rotation.z])
    across = np.cross(q, vector)
    return np.asarray(vector) + 2 * (rotation.w * across + np.cross(q, across))


def inverse(rotation: Any) -> Any:
    found = type(rotation)()
    found.CopyFrom(rotation)
    found.w = -found.w
    return found


def place(transform: Any) -> Any:
    return np.array([transform.translation.x, transform.translation.y, transform.translation.z])


def test_topics_and_schemas(shown: list[Read]) -> None:
    schemas = {each.topic: each.schema for each in shown}
    cameras = [f"/camera_{number}" for number in range(1, 5)]
    assert schemas == {
        **{f"{camera}/image": "foxglove.RawImage" for camera in cameras},
        **{f"{camera}/frame": "tvbrdf.Frame" for camera in cameras},
        "/tf": "foxglove.FrameTransforms",
        "/tf_static": "foxglove.FrameTransforms",
        "/arm/state": "tvbrdf.ArmState",
        "/scan/parameters": "tvbrdf.Parameters",
        "/log": "foxglove.Log",
    }
    times = [each.log_time_ns for each in shown]
    assert times == sorted(times)


def test_images_are_the_frames(shown: list[Read]) -> None:
    frames = [e for e in read_all(BAG) if e.topic == "/camera_2/frame"]
    images, facts = on(shown, "/camera_2/image"), on(shown, "/camera_2/frame")
    assert len(images) == len(facts) == len(frames) > 100
    for envelope, told, fact in zip(frames, images, facts, strict=True):
        frame, found = envelope.message, told.message
        assert isinstance(frame, Frame)
        height, width = frame.image.shape[:2]
        assert (found.encoding, found.height, found.width) == ("bgr8", height, width)
        assert (found.step, found.frame_id) == (3 * width, "camera_2")
        pixels = np.frombuffer(found.data, np.uint8).reshape(height, width, 3)
        np.testing.assert_array_equal(pixels, frame.image // 2 ** (frame.bit_depth - 8))
        assert time_ns(found.timestamp) == told.stamp_ns == envelope.header.stamp_ns
        assert fact.message.exposure_ms == frame.exposure_ms
        assert (fact.message.kind, fact.message.sweep) == (frame.kind, frame.sweep)


def test_images_of_all_kinds_of_codes() -> None:
    frame = next(m for e in read_all(BAG) if isinstance(m := e.message, Frame))
    wide = replace(frame, bit_depth=16, image=np.full((2, 2, 3), 65535, np.uint16))
    float_codes = replace(frame, bit_depth=12, image=np.full((2, 2, 3), 4095.9, np.float32))
    negative = replace(frame, bit_depth=12, image=np.full((2, 2, 3), -3.0, np.float32))
    narrow = replace(frame, bit_depth=8, image=np.full((2, 2, 3), 7, np.uint8))
    for each, code in ((wide, 255), (float_codes, 255), (negative, 0), (narrow, 7)):
        found = eight_bits(each)
        assert found.dtype == np.uint8
        assert (found == code).all()


def test_transforms_give_the_directions_of_the_fit(shown: list[Read]) -> None:
    (fixed,) = on(shown, "/tf_static")
    by_child = {t.child_frame_id: t for t in fixed.message.transforms}
    assert {t.parent_frame_id for t in by_child.values()} == {"rig"}
    into_sample = inverse(by_child.pop("sample").rotation)
    views = parse_calibration(inside()["calibration/calibration.yaml"].decode()).view_directions
    assert [*by_child] == [f"camera_{number}" for number in range(1, 5)]
    for transform, view in zip(by_child.values(), views, strict=True):
        seen = turned(into_sample, place(transform)) / 0.94
        np.testing.assert_allclose(seen, view, atol=DOUBLE)
        # it looks to the centre
        axis = turned(transform.rotation, [0.0, 0.0, 1.0])
        np.testing.assert_allclose(axis, -place(transform) / 0.94, atol=DOUBLE)
        np.testing.assert_allclose(turned(transform.rotation, [1.0, 0, 0]), [1, 0, 0], atol=DOUBLE)


def test_the_light_moves_with_the_arm(shown: list[Read]) -> None:
    (fixed,) = on(shown, "/tf_static")
    into_sample = inverse(fixed.message.transforms[0].rotation)
    states = [e for e in read_all(BAG) if isinstance(e.message, ArmState)]
    lights, arms = on(shown, "/tf"), on(shown, "/arm/state")
    assert len(lights) == len(arms) == len(states) > 500
    angles = set()
    for envelope, told, arm in zip(states, lights, arms, strict=True):
        (transform,) = told.message.transforms
        state = envelope.message
        assert isinstance(state, ArmState)
        angles.add(state.angle_deg)
        seen = turned(into_sample, place(transform)) / 0.44
        np.testing.assert_allclose(seen, light_direction(state.angle_deg), atol=DOUBLE)
        axis = turned(transform.rotation, [0.0, 0.0, 1.0])
        np.testing.assert_allclose(axis, -place(transform) / 0.44, atol=DOUBLE)
        assert time_ns(transform.timestamp) == told.stamp_ns == envelope.header.stamp_ns
        assert (arm.message.angle_deg, arm.message.lamp) == (state.angle_deg, state.lamp)
    assert len(angles) > 100


def test_parameters_are_fields(shown: list[Read]) -> None:
    (told,) = on(shown, "/scan/parameters")
    (fit,) = [e.message for e in results() if isinstance(e.message, Parameters)]
    message = told.message
    assert (message.sample, message.scan, message.model) == (fit.sample, 1, fit.model)
    for name, value, deviation in zip(
        fit.parameter_names, fit.values, fit.standard_deviations, strict=True
    ):
        assert getattr(message, name) == value
        assert getattr(message, f"{name}_std") == deviation
    assert message.error_rms_percent == fit.errors["rms_percent"]


def test_models_may_differ_from_scan_to_scan(tmp_path: Path) -> None:
    _, first = results()
    fit = first.message
    assert isinstance(fit, Parameters)
    second = replace(
        fit, scan=2, model="lambert", parameter_names=("kd_b", "1/x"), values=(0.25, 2.0),
        standard_deviations=(0.01, 0.1), errors={},
    )  # fmt: skip
    path = write_bag(tmp_path / "a.mcap", [first, first._replace(message=second)], {})
    export_bag(path, tmp_path / "out", ["foxglove"])
    one, two = (each.message for each in read(tmp_path / "out" / "foxglove.mcap"))
    assert math.isnan(two.ks)
    assert math.isnan(one.p_1_x)
    assert (two.kd_b, two.p_1_x, two.p_1_x_std) == (0.25, 2.0, 0.1)
    assert one.ks == dict(zip(fit.parameter_names, fit.values, strict=True))["ks"]


def test_log_has_notes_and_faults_too(shown: list[Read]) -> None:
    lines = [(m.name, m.level, m.message) for m in (each.message for each in on(shown, "/log"))]
    assert ("arm", 3, "slow answer") in lines
    assert ("operator", 2, "painted (t = 0)") in lines
    assert ("sequencer", 3, "scan 2 is missing: lamp failed") in lines


def test_without_calibration_all_but_the_geometry(tmp_path: Path) -> None:
    bag = whole_bag(tmp_path / "a.mcap", attachments={})
    (written,) = export_bag(bag, tmp_path / "out", ["foxglove"]).written
    assert written.remarks == [
        "the rig's geometry: the bag has no calibration; give it with --calibration"
    ]
    topics = {each.topic for each in read(tmp_path / "out" / "foxglove.mcap")}
    assert not topics & {"/tf", "/tf_static"}
    assert topics > {"/camera_1/image", "/arm/state", "/scan/parameters", "/log"}


def test_the_file_is_whole_and_says_where_it_comes_from(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    export_bag(BAG, tmp_path / "out", ["foxglove"])
    with (tmp_path / "out" / "foxglove.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert sum(1 for _ in reader.iter_messages()) == summary.statistics.message_count
        (note,) = reader.iter_metadata()
    with BagReader(BAG) as bag:
        assert note.metadata == {"run": bag.about.run, "recorded_with": bag.about.version}


def test_missing_packages_are_named_with_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(protobuf, "PACKAGES", ("google.no_such_thing", "mcap"))
    with pytest.raises(
        RunError, match=r"google.no_such_thing is not installed; .*pip install 'tvbrdf\[foxglove\]'"
    ):
        export_bag(BAG, tmp_path / "out", ["foxglove"])
    monkeypatch.setattr(protobuf, "PACKAGES", ("no_such_package.inner",))
    report = export_bag(BAG, tmp_path / "out")
    assert "no_such_package.inner is not installed" in report.left_out["foxglove"]
    assert [written.format for written in report.written] == ["exr"]


def test_nothing_to_show_is_told(tmp_path: Path) -> None:
    radiance, _ = results()
    path = write_bag(tmp_path / "a.mcap", [radiance], {})
    with pytest.raises(BagError, match="nothing to show"):
        export_bag(path, tmp_path / "out", ["foxglove"])


def test_own_schemas() -> None:
    names = field_names(["kd_b", "Kd_b", "1/x", "Ä", "scan", "timestamp", ""], taken=["scan"])
    assert [*names.values()] == [
        "kd_b",
        "kd_b_2",
        "p_1_x",
        "value",
        "scan_2",
        "timestamp_2",
        "value_2",
    ]
    kinds = {"a": float, "b": int, "c": str, "d": bool}
    made = own_schema("Test", kinds)(a=1.5, b=-(2**60), c="grün", d=True)
    made.timestamp.seconds = 3
    again = type(made).FromString(made.SerializeToString())
    assert (again.a, again.b, again.c, again.d) == (1.5, -(2**60), "grün", True)
    assert made.DESCRIPTOR.full_name == "tvbrdf.Test"
    assert the_radiance().scan == 1
