"""Parts of the shipped rig, in process and as processes; the test plays the others."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tvbrdf_launch.process_table import read_processes, wait_until_gone
from tvbrdf_launch.testing.bags import BagFactory
from tvbrdf_launch.testing.errors import MisuseError, WaitError
from tvbrdf_launch.testing.graphs import GraphFactory
from tvbrdf_launch.testing.rigs import RigFactory
from tvbrdf_messages.messages import Parameters, ScanCommand, SweepResult

SMALL: dict[str, Any] = {
    "scans": 1,
    "exposures_ms": [4.0],
    "sweep_s": 4,
    "warm_up_s": 1,
    "dark_frames": 3,
    "width": 16,
    "height": 16,
}
KS = 0.4
SATIN = {
    "kind": "constant",
    "model": "oren_nayar+torrance_sparrow",
    "parameters": {
        "kd_b": 0.1,
        "kd_g": 0.2,
        "kd_r": 0.6,
        "sigma_d": 0.3,
        "ks": KS,
        "inverse_sigma_s": 6.0,
    },
}


def test_a_scene_is_given_as_mappings_and_parameters_are_changed(rig: RigFactory) -> None:
    """Without effects the fit gives back the sample: frames are float32 here (6e-8)."""
    run = rig(
        **SMALL,
        name="satin",
        sample=SATIN,
        effects={"camera": {"saturation": True}},
        parameters={"fitter": {"fixed": {"sigma_d": 0.3}}},
        correct_motion_blur=False,
    )
    found = run.wait_for("/scan/parameters")
    values = dict(zip(found.parameter_names, found.values, strict=True))
    deviations = dict(zip(found.parameter_names, found.standard_deviations, strict=True))
    assert deviations["sigma_d"] == 0.0
    assert values["ks"] == pytest.approx(KS, rel=1e-6)


def test_the_test_plays_the_fitter(rig: RigFactory) -> None:
    """The rig waits for nobody who is played; what is played is stored as if it were real."""
    run = rig(**SMALL, without=["fitter"])
    assert run.played == ("fitter",)
    radiance = run.wait_for("/scan/radiance")
    assert run.published("/scan/parameters") == []
    played = Parameters(
        sample=radiance.sample,
        scan=1,
        scan_time_s=radiance.scan_time_s,
        model="lambert",
        parameter_names=("kd_b", "kd_g", "kd_r"),
        values=(0.1, 0.2, 0.3),
        standard_deviations=(0.01, 0.01, 0.01),
        at_bound=(),
        undetermined=(),
        errors={},
        chi_square=1.0,
        degrees_of_freedom=1,
        model_error_std=0.0,
        reason="",
        solver="",
        evaluations=1,
        solve_time_ms=0.1,
        details={},
        covariance=1e-4 * np.eye(3),
    )
    run.send("/scan/parameters", played)
    run.wait_for("/scan/stored", lambda stored: stored.what == "parameters")
    assert run.wait_until_ended().code == 0


def test_only_some_nodes_run_and_a_bag_feeds_them(rig: RigFactory, bag: BagFactory) -> None:
    live = rig(**SMALL, keep_frames=True)
    live.wait_until_ended()
    run = rig(**SMALL, nodes=["hdr_merger", "fitter"])
    run.feed(bag(live))
    (found,), (first,) = run.published("/scan/parameters"), live.published("/scan/parameters")
    assert found.values == first.values


def test_frames_are_only_there_when_they_are_kept(rig: RigFactory, bag: BagFactory) -> None:
    run = rig(**SMALL)
    with pytest.raises(MisuseError, match="keep_frames=True"):
        run.wait_for("/camera_1/frame")
    run.wait_for("/camera_1/info")
    run.wait_until(lambda: run.counts["/camera_1/frame"] > 3, "frames")
    with pytest.raises(MisuseError, match="keep_frames=True"):
        bag(run)


def test_the_arm_breaks_when_it_is_told_to(rig: RigFactory) -> None:
    stall = {"kind": "stall", "at_sweep": 1}
    run = rig(**SMALL, faults={"arm": [stall]}, effects="ideal")
    broken = run.wait_for("/scan/sweep_result", lambda result: result.state == "broken")
    assert broken.source == "arm"
    states = run.published("/arm/state")
    assert any(state.fault for state in states)


@pytest.mark.system
@pytest.mark.parametrize("processes", [False, True])
def test_people_may_ask_and_end_a_run(rig: RigFactory, processes: bool) -> None:
    run = rig(**SMALL | {"scans": 5}, processes=processes)
    run.wait_for("/scan/status", lambda status: status.scan == 1)
    refused = run.ask("sequencer", "dance")
    assert not refused.ok
    assert "dance" in refused.text
    with pytest.raises(MisuseError, match="merger"):
        run.ask("merger", "status")
    with pytest.raises(MisuseError, match="fitter takes no requests"):
        run.ask("fitter", "status")
    assert run.ask("sequencer", "mark", text="a fly sat down").ok
    assert run.wait_for("/operator/mark").text == "a fly sat down"


def test_a_camera_alone_obeys_the_test(graph: GraphFactory) -> None:
    """A driver's device is started with its node; commands and the light are the test's."""
    driver = "tvbrdf_nodes.camera.simulated:SimulatedCamera"
    parameters = {"driver": driver, "driver_parameters": {"camera": 1, "width": 8, "height": 8}}
    run = graph(
        ("world", {"sample": "drying_paint"}), "arm_controller", camera_1=("camera", parameters)
    )
    run.wait_for("/camera_1/info", lambda info: info.width == 8)
    command = ScanCommand(
        command_id=1,
        incarnation=run.incarnation("test"),
        not_after_ns=run.now_ns + 10**12,
        action="dark",
        exposure_ms=4.0,
        frames=5,
    )
    run.send("/scan/command", command)
    result = run.wait_for("/scan/sweep_result", lambda r: r.action == "dark")
    assert isinstance(result, SweepResult)
    assert (result.source, result.state, result.frames) == ("camera_1", "done", 5)
    assert [f.kind for f in run.published("/camera_1/frame")] == ["dark"] * 5


@pytest.mark.system
def test_processes_with_a_node_that_the_test_plays(rig: RigFactory) -> None:
    run = rig(**SMALL, processes=True, without=["fitter"])
    directory = Path(run.graph.directory)
    assert run.wait_for("/scan/radiance").scan == 1
    assert "fitter" not in run.processes()
    assert {"launcher", "sequencer", "hdr_merger"} <= set(run.processes())
    with pytest.raises(WaitError, match=r"the run has ended|not within") as caught:
        run.wait_for("/scan/parameters", timeout_s=1)
    assert "sequencer running" in str(caught.value)
    records = list(run.processes().values())
    run.stop()
    assert wait_until_gone(records, 10.0)
    assert not directory.exists()


@pytest.mark.system
def test_processes_that_do_not_start_say_why(
    rig: RigFactory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    launch = tmp_path / "broken.yaml"
    launch.write_text("nodes:\n- {name: broken, node: broken_node:Broken}\n")
    (tmp_path / "broken_node.py").write_text(
        textwrap.dedent("""
            from tvbrdf_nodes.core.node import Node, TopicUse

            class Broken(Node):
                @classmethod
                def topics(cls, name, parameters):
                    return TopicUse(gives=("/log", "/diagnostics"))

                def start(self):
                    raise RuntimeError("there is no oil in it")
        """)
    )
    monkeypatch.syspath_prepend(tmp_path)
    try:
        text = rig(launch, processes=True).wait_until_ended().text
    except WaitError as error:  # it ended before the test had joined it
        text = str(error)
    assert "there is no oil in it" in text


@pytest.mark.system
def test_a_test_that_is_killed_leaves_no_process(tmp_path: Path) -> None:
    code = f"""
        import json, sys
        from pathlib import Path
        from tvbrdf_launch.testing.rigs import RigFactory
        rig = RigFactory(Path({str(tmp_path)!r}))
        run = rig(processes=True, **{SMALL!r} | {{"interval_s": 0, "scans": 9}})
        run.wait_for("/scan/status", lambda status: status.scan == 1)
        print(json.dumps(run.graph.directory), flush=True)
        sys.stdin.read()
    """
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        directory = Path(json.loads(process.stdout.readline()))
        table = read_processes(directory)
        records = [table.launcher, *table.nodes.values()]
        assert all(record.alive() for record in records)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        deadline = time.monotonic() + 30.0
        assert wait_until_gone(records, deadline - time.monotonic())
    shutil.rmtree(directory.parent)  # nobody was left to do it
